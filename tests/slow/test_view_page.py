"""The page of `quadrl view` in a real browser, which steers it; another page, which may not."""

import contextlib
import os
import shutil
import subprocess
import sys

import chromium
import pytest

SHOWN = "/rotor speeds/.test(document.body?.innerText ?? '')"
KNOCK = """
    window.heard = "";
    const socket = new WebSocket("{}");
    socket.onopen = () => (window.heard = "open");
    socket.onerror = () => (window.heard = "refused");
    1
"""


@pytest.fixture(scope="module")
def address():
    """Where a command serves its page."""
    if not shutil.which("chromium"):
        reason = "chromium is not installed: run scripts/web"
        pytest.fail(reason) if os.environ.get("QUADRL_REQUIRE_WEB") == "1" else pytest.skip(reason)
    words = [sys.executable, "-m", "quadrl", "view", "hover", "--port", "0"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as serving:
        try:
            (said,) = (line for line in [serving.stdout.readline()] if "open http://" in line)
            yield said.partition("open ")[2].split()[0]
        finally:
            serving.terminate()


def test_the_page_shows_the_flight_and_its_keys_work(address, tmp_path):
    with chromium.Page(address, tmp_path / "own") as shown:
        shown.wait(SHOWN)
        ticked = "[...document.querySelectorAll('input[type=checkbox]')].map(x => x.checked).join()"
        before = shown.value(ticked)
        shown.ask("Input.dispatchKeyEvent", type="keyDown", key=" ", code="Space")
        shown.ask("Input.dispatchKeyEvent", type="keyUp", key=" ", code="Space")
        shown.wait(f"{ticked} !== {before!r}", seconds=30)  # the flight has ticked "paused"


def test_another_page_may_not_steer_it(address, tmp_path):
    foreign = tmp_path / "foreign.html"
    foreign.write_text("<!doctype html><title>elsewhere</title>")
    with contextlib.ExitStack() as stack:
        for number, url in enumerate(("about:blank", foreign.as_uri())):
            page = stack.enter_context(chromium.Page(url, tmp_path / f"profile {number}"))
            page.wait("document.readyState === 'complete'")
            page.value(KNOCK.format(address.replace("http", "ws")))
            page.wait("window.heard !== ''", seconds=30)
            assert page.value("window.heard") == "refused"
