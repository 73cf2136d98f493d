"""Extend mkdocs: a link to the page that flies, and pages of the sources that pages link to."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.nav import Link, Navigation
from mkdocs.structure.pages import Page

REPOSITORY = Path(__file__).resolve().parents[2]
LINK = re.compile(r"\]\(([^)#\s]+)")
SOURCE_PAGE = """---
search:
  exclude: true
hide:
  - toc
---
# {path}

````{language}
{text}
````
"""
LANGUAGES = {".py": "python", ".c": "c", ".h": "c", ".xml": "xml", ".md": "markdown"}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Make a page of every source file that a page links to."""
    linked: set[Path] = set()
    for file in files.documentation_pages():
        if file.abs_src_path and file.src_uri.endswith(".md"):
            folder = Path(file.abs_src_path).parent
            for target in LINK.findall(file.content_string):
                linked.add(_source(folder, target) or REPOSITORY)
    for source in sorted(linked - {REPOSITORY}):
        path = source.relative_to(REPOSITORY).as_posix()
        language = LANGUAGES.get(source.suffix, "text")
        text = SOURCE_PAGE.format(path=path, language=language, text=source.read_text().rstrip())
        page = File.generated(config, f"source/{path}.md", content=text)
        page.inclusion = InclusionLevel.NOT_IN_NAV
        files.append(page)
    return files


def on_nav(nav: Navigation, config: MkDocsConfig, files: Files) -> Navigation:
    """Link to the page that flies in the browser."""
    # Made by scripts/web after mkdocs, which therefore does not know it.
    link, start = Link("Fly it in the browser", "fly/index.html"), nav.items[0]
    link.parent = start
    start.children.insert(2, link)
    return nav


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Lead links to source files to their pages."""
    if not page.file.abs_src_path:
        return markdown
    folder = Path(page.file.abs_src_path).parent

    def led(found: re.Match[str]) -> str:
        source = _source(folder, found[1])
        if source is None:
            return found[0]
        target = f"source/{source.relative_to(REPOSITORY).as_posix()}.md"
        return f"]({posixpath.relpath(target, posixpath.dirname(page.file.src_uri) or '.')}"

    return LINK.sub(led, markdown)


def _source(folder: Path, target: str) -> Path | None:
    """The source file of this repository that a link means; None for anything else."""
    path = (folder / target).resolve()
    inside = path.is_relative_to(REPOSITORY / "docs") and path.suffix != ".py"
    return path if path.is_file() and path.is_relative_to(REPOSITORY) and not inside else None
