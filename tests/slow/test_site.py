"""The documentation site: it builds strictly, its links lead somewhere, and it loads nothing."""

import html.parser
import re
from pathlib import Path
from urllib.parse import unquote

import pytest
from processes import python

from quadrl import tasks

REPOSITORY = Path(__file__).parents[2]
LOADED = {"img": "src", "script": "src", "link": "href", "iframe": "src", "source": "src"}
WITHOUT_TORCH = "import sys; sys.modules['torch'] = None; from mkdocs.__main__ import cli; cli()"
"""The extra that builds the site leaves torch out."""


class Parsed(html.parser.HTMLParser):
    """The links, the loaded files and the anchors of a page."""

    def __init__(self, path):
        super().__init__()
        self.links, self.loads, self.anchors = [], [], {""}
        self.feed(path.read_text())

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.anchors |= {given.get("id"), given.get("name")} - {None}
        if tag == "a" and given.get("href"):
            self.links.append(given["href"])
        if given.get(LOADED.get(tag)):
            self.loads.append(given[LOADED[tag]])


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    config = REPOSITORY / "scripts" / "site" / "mkdocs.yml"
    python("-c", WITHOUT_TORCH, "build", "--strict", "--config-file", config, "--site-dir", folder)
    return folder


@pytest.fixture(scope="module")
def pages(site):
    return {path: Parsed(path) for path in site.rglob("*.html")}


def test_every_page_is_there(site, pages):
    names = {path.relative_to(site).with_suffix("").as_posix() for path in pages}
    docs = REPOSITORY / "docs"
    wanted = {path.relative_to(docs).with_suffix("").as_posix() for path in docs.rglob("*.md")}
    assert wanted <= names
    assert {f"source/tasks/{name}.py" for name in tasks.TASKS} <= names


def test_links_lead_somewhere(site, pages):
    for page, parsed in pages.items():
        for link in parsed.links + parsed.loads:
            if ":" in link.partition("/")[0]:  # https:, mailto:
                continue
            path, _, anchor = unquote(link).partition("#")
            # Of the page for missing ones, from the root of the server.
            folder = site if path.startswith("/") else page.parent
            there = (folder / path.lstrip("/")).resolve() if path else page
            if there.is_relative_to(site / "fly"):  # scripts/web makes it afterwards
                continue
            assert there.exists(), f"{page.relative_to(site)}: {link}"
            if there in pages:
                found = anchor in pages[there].anchors or anchor.startswith("__")
                assert found, f"{page.relative_to(site)}: {link}"


def test_nothing_is_loaded_from_elsewhere(site, pages):
    for page, parsed in pages.items():
        loads = (load for load in parsed.loads if not load.startswith("data:"))
        foreign = [load for load in loads if "//" in load]
        assert not foreign, f"{page.relative_to(site)}: {foreign}"
    for sheet in site.rglob("*.css"):
        assert "url(http" not in sheet.read_text() and "@import" not in sheet.read_text(), sheet


def test_the_search_knows_the_pages(site):
    index = (site / "search" / "search_index.json").read_text()
    for words in ("target_velocity", "geometric controller", "write_video", "gladLoadGL"):
        assert words in index
    for words in ("optuna", "hyperparameter", "Colab", "Docker", "conda", "W&amp;B"):
        assert words in index
    # What newcomers look for; "not yet" is an answer, too.
    asked = (
        "payload battery ONNX PX4 Betaflight gate camera lidar obstacles swarm GPU MJX Isaac ROS"
    )
    page = REPOSITORY / "docs" / "elsewhere.md"
    answers = page.read_text().partition("## What is there, what is not yet")[2]
    assert not [word for word in asked.split() if word not in answers]
    assert "class Hover(Task)" not in index  # the sources are not searched


def test_assistants_find_every_page_and_the_commands_in_one_text(site):
    listed = re.findall(r"^- \[.*?\]\((.*?)\)", (site / "llms.txt").read_text(), re.MULTILINE)
    guides = (REPOSITORY / "docs").glob("*.md")
    assert {path.with_suffix(".html").name for path in guides} <= {*listed}
    assert [link for link in listed if not (site / link).exists()] == []
    whole = (site / "llms-full.txt").read_text()
    for words in (
        "quadrl train hover --algo apg",
        "@quadrl.register",
        "- `quadrl.evaluate(controller",
    ):
        assert words in whole
    assert "0x" not in whole  # the same text whenever it is built
