"""The docstrings under the fields of dataclasses, read from their source."""

from __future__ import annotations

import ast
import inspect
import linecache
import textwrap


def docstrings(kind: type) -> dict[str, str]:
    """The docstrings under the fields of a dataclass or a TypedDict and of its bases, by field."""
    found: dict[str, str] = {}
    for base in reversed([c for c in kind.__mro__ if vars(c).get("__annotations__")]):
        body = source(base)
        for field, text in zip(body, body[1:], strict=False):
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
                value = text.value if isinstance(text, ast.Expr) else None
                if isinstance(value, ast.Constant):
                    found[field.target.id] = " ".join(str(value.value).split()).rstrip(".")
    return found


def source(kind: type) -> list[ast.stmt]:
    """The statements of a class; none where its source is unknown, as at Python's prompt."""
    try:
        text = inspect.getsource(kind)
    except OSError:
        # Up to Python 3.12 no class of a notebook is found, but its methods know their cell.
        own = [method for method in vars(kind).values() if inspect.isfunction(method)]
        files = {method.__code__.co_filename for method in own}
        text = "".join(line for file in files for line in linecache.getlines(file))
    nodes = ast.walk(ast.parse(textwrap.dedent(text)))
    found = [n for n in nodes if isinstance(n, ast.ClassDef) and n.name == kind.__name__]
    return found[-1].body if found else []
