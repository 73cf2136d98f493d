"""The notebooks run as they stand, without a warning, and their outputs are in place."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).parents[2] / "docs" / "notebooks").glob("*.ipynb"))
assert NOTEBOOKS
RICH = ("text/html", "image/png")


def code(book):
    return [cell for cell in book.cells if cell.cell_type == "code"]


def kinds(book):
    """The kinds of output of all cells: some have pictures, tables or videos."""
    outputs = [output for cell in code(book) for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "error"]
    assert not [output.text for output in outputs if output.get("name") == "stderr"]
    return {kind for output in outputs for kind in output.get("data", {})}


@pytest.mark.timeout(900)
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path, tmp_path):
    book = nbformat.read(path, as_version=4)
    assert kinds(book) & set(RICH)
    assert [cell.execution_count for cell in code(book)] == list(range(1, len(code(book)) + 1))
    resources = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(book, timeout=600, kernel_name="python3", resources=resources).execute()
    assert kinds(book) & set(RICH)
