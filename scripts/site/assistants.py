"""Write what coding assistants read.

llms.txt lists the pages, llms-full.txt holds the commands and the Python of all guides in one text.
"""

from __future__ import annotations

import re
import textwrap
from pathlib import Path

import griffe
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.nav import Link, Navigation, Section
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
FENCE = re.compile(r"^( *)```(\w+)\n((?:.*\n)*?)\1```$", re.MULTILINE)
API = re.compile(r"^::: ([\w.]+)((?:\n    .*)*)", re.MULTILINE)
NOT_GUIDES = ("cli.md", "api.md", "results.md", "paper.md")
RULES = """Options are keywords of every API and options of every command. Arrays have a leading
axis N; units are SI. Actions are in [-1, 1], and 0 hovers. A task of one's own imports from
`quadrl` and `quadrl.tasks` alone; `quadrl.testing.check_task` judges it.
"""


def on_nav(nav: Navigation, config: MkDocsConfig, files: Files) -> Navigation:
    """Make both files from the navigation, and link to the second."""
    pages = [page for page in nav.pages if page.file.src_uri.endswith(".md")]
    head = f"# {config.site_name}\n\n> {config.site_description}\n"
    lists = [f"\n## {item.title}\n\n{_listed(item)}" for item in nav.items if item.children]
    whole = [head, RULES, *map(_commands, pages), "## Python", *_api(pages)]
    for name, parts in {"llms.txt": [head, *lists], "llms-full.txt": whole}.items():
        files.append(File.generated(config, name, content="\n".join(parts) + "\n"))
    link, reference = Link("For coding assistants", "llms-full.txt"), nav.items[-1]
    link.parent = reference
    reference.children.append(link)
    return nav


def _listed(section: Section) -> str:
    """The pages of a section, those of its sections too, a line each."""
    lines = []
    for child in section.children:
        if isinstance(child, Section):
            lines.append(_listed(child))
        elif isinstance(child, Page):
            title, first = _title(child), _first_sentence(child)
            lines.append(f"- [{title}]({child.file.dest_uri}){f': {first}' if first else ''}")
    return "\n".join(lines)


def _title(page: Page) -> str:
    """As the navigation has it, or the first heading."""
    heading = re.search(r"^\W*# (.*?)[\"\\]?$", page.file.content_string, re.MULTILINE)
    named = heading[1].removesuffix('\\n",') if heading else page.file.name
    return str(page.title or named)


def _first_sentence(page: Page) -> str:
    """What a page says first; "" of a notebook, or where it begins with something else."""
    prose = page.file.content_string.partition("\n# ")[2] or page.file.content_string[2:]
    found = re.match(r".*?\n\n([A-Z].*?\.)(?=\s)", prose, re.DOTALL)
    plain = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", " ".join(found[1].split())) if found else ""
    return plain if len(plain) < 200 and "<" not in plain else ""


def _commands(page: Page) -> str:
    """The blocks of a guide under its headings; the command line's page as it is."""
    text = re.sub(r"^---\n.*?\n---\n", "", page.file.content_string, flags=re.DOTALL)
    if page.file.src_uri == "cli.md":
        return text.replace("\n# ", "\n## ")
    if page.file.src_uri in NOT_GUIDES:
        return ""
    parts = [f"## {_title(page)} ({page.file.src_uri})"]
    for _, language, block in FENCE.findall(text):
        parts.append(f"```{language}\n{textwrap.dedent(block)}```")
    return "\n\n".join(parts) + "\n" if len(parts) > 1 else ""


def _api(pages: list[Page]) -> list[str]:
    """A line for each name on the page of the Python interface, with those of its methods.

    The sources are read and not imported, so that the site is built without torch.
    """
    (page,) = (page for page in pages if page.file.src_uri == "api.md")
    package = griffe.load("quadrl", search_paths=[ROOT], resolve_aliases=True)
    lines = []
    for path, options in API.findall(page.file.content_string):
        thing = package[path.removeprefix("quadrl.")]
        members = re.search(r"members: \[(.*)\]", options)
        if thing.is_module:
            names = members[1].split(", ") if members else _public(thing)
            lines += [_line(f"{path}.{name}", thing[name]) for name in names]
        else:
            lines.append(_line(path, thing))
    return lines


def _public(thing: griffe.Object | griffe.Alias) -> list[str]:
    """The functions and classes that a module, or a class, defines for others."""
    return [
        name
        for name, of in thing.members.items()
        if not (name.startswith("_") or of.is_alias) and (of.is_function or of.is_class)
    ]


def _line(path: str, thing: griffe.Object | griffe.Alias) -> str:
    """Its signature and its first sentence."""
    about = thing.docstring.value if thing.docstring else ""
    about = about.partition("\n\n")[0].replace("\n", " ")
    # The keywords of a TypedDict are its attributes.
    if thing.is_class and not thing.parameters:
        given = f"({', '.join(name for name in thing.attributes if not name.startswith('_'))})"
    elif thing.is_class or thing.is_function:
        given = thing.signature().removeprefix(thing.name).replace("(self, ", "(")
    else:
        given = ""
    methods = (
        f" Methods: {', '.join(names)}." if thing.is_class and (names := _public(thing)) else ""
    )
    return f"- `{path}{given}`: {about}{methods}"
