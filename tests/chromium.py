"""A page in headless Chromium, by the DevTools protocol over a pipe: nothing but the browser."""

import json
import os
import select
import subprocess
import time

# A software renderer, since there may be no graphics card.
COMMAND = (
    *("chromium", "--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader"),
    *("--enable-unsafe-swiftshader", "--remote-debugging-pipe", "--window-size=480,360"),
)


class Page:
    """An open page; use it in a `with`."""

    def __init__(self, url, folder):
        """Start a browser that keeps its files in a folder, and open the address."""
        (asked, self._ask), (self._answers, answered) = os.pipe(), os.pipe()
        redirected = f'exec "$@" 3<&{asked} 4>&{answered}'  # where Chromium looks for the pipe
        profile = f"--user-data-dir={folder}"
        self._process = subprocess.Popen(
            ["bash", "-c", redirected, "bash", *COMMAND, profile],
            pass_fds=(asked, answered),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(asked)
        os.close(answered)
        self._number, self._buffer, self._session = 0, b"", {}
        self.complaints = []
        """Errors and warnings of the page, and what it asked of other hosts."""
        target = self.ask("Target.createTarget", url="about:blank")["targetId"]
        attached = self.ask("Target.attachToTarget", targetId=target, flatten=True)
        self._session = {"sessionId": attached["sessionId"]}
        for domain in ("Runtime", "Log", "Network", "Page", "DOM"):
            self.ask(f"{domain}.enable")
        self.ask("Page.navigate", url=url)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self._process.kill()
        self._process.wait()
        os.close(self._ask)
        os.close(self._answers)

    def ask(self, method, **parameters):
        """The answer of the browser to a command."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters} | self._session
        os.write(self._ask, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return answer["result"]
            self._note(answer)

    def value(self, expression):
        """The value of JavaScript in the page."""
        answer = self.ask("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def wait(self, expression, seconds=180):
        """Wait until JavaScript is true."""
        end = time.monotonic() + seconds
        while not self.value(expression):
            assert time.monotonic() < end, (expression, self.complaints)
            time.sleep(0.2)

    def give(self, selector, *files):
        """Choose files in an input element."""
        root = self.ask("DOM.getDocument")["root"]["nodeId"]
        node = self.ask("DOM.querySelector", nodeId=root, selector=selector)["nodeId"]
        self.ask("DOM.setFileInputFiles", nodeId=node, files=[str(file) for file in files])

    def press(self, key):
        """Press a key."""
        self.ask("Input.dispatchKeyEvent", type="keyDown", key=key)
        self.ask("Input.dispatchKeyEvent", type="keyUp", key=key)

    def _next(self):
        while b"\0" not in self._buffer:
            assert select.select([self._answers], [], [], 60)[0], "the browser does not answer"
            part = os.read(self._answers, 1 << 16)
            assert part, "the browser has ended"
            self._buffer += part
        message, _, self._buffer = self._buffer.partition(b"\0")
        return json.loads(message)

    def _note(self, event):
        method, given = event.get("method"), event.get("params", {})
        if method == "Runtime.exceptionThrown":
            self.complaints.append(given["exceptionDetails"])
        elif method == "Runtime.consoleAPICalled" and given["type"] in ("error", "warning"):
            self.complaints.append(given["args"])
        elif method == "Log.entryAdded" and given["entry"]["level"] in ("error", "warning"):
            self.complaints.append(given["entry"])
        elif method == "Network.requestWillBeSent":
            if given["request"]["url"].split(":")[0] not in ("file", "data", "blob"):
                self.complaints.append(given["request"]["url"])
