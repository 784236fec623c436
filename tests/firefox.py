"""Firefox for tests: Debian's, on a screen of Xvfb, by WebDriver BiDi, which it speaks itself on a socket.

The messages are those of https://www.w3.org/TR/webdriver-bidi/.
"""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Any

from websockets.sync.client import ClientConnection, connect

XVFB = shutil.which("Xvfb") or ""
FIREFOX = shutil.which("firefox-esr") or shutil.which("firefox") or ""
PATIENCE_S = 90.0
PREFERENCES = {
    # WebGL in software where there is no GPU.
    "webgl.force-enabled": True,
    "webgl.forbid-software": False,
    # Nothing in the background.
    "app.normandy.enabled": False,
    "app.update.enabled": False,
    "browser.safebrowsing.malware.enabled": False,
    "datareporting.policy.dataSubmissionEnabled": False,
    "network.captive-portal-service.enabled": False,
    "network.connectivity-service.enabled": False,
}


class Page:
    """A tab."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket, self._ids = socket, count(1)
        self._call("session.new", capabilities={})
        self._tab = self._call("browsingContext.getTree")["contexts"][0]["context"]

    def open(self, address: str, width: int = 1280, height: int = 800) -> None:
        self._call("browsingContext.setViewport", context=self._tab, viewport={"width": width, "height": height})
        self._call("browsingContext.navigate", context=self._tab, url=address, wait="complete")

    def tell(self, expression: str) -> Any:
        """Return the JSON value of an expression of JavaScript."""
        return json.loads(self._evaluate(f"JSON.stringify({expression})").get("value", "null"))

    def wait_for(self, expression: str) -> Any:
        """Wait until an expression is true; return its value."""
        deadline = time.monotonic() + PATIENCE_S
        while not (value := self.tell(expression)):
            assert time.monotonic() < deadline, f"not true in {PATIENCE_S:g} s: {expression}"
            time.sleep(0.1)
        return value

    def choose_file(self, selector: str, file: Path) -> None:
        """Give a file to an input."""
        node = self._evaluate(f"document.querySelector({json.dumps(selector)})")
        self._call("input.setFiles", context=self._tab, element={"sharedId": node["sharedId"]}, files=[str(file)])

    def screenshot(self) -> bytes:
        """Return the page as a PNG."""
        return base64.b64decode(self._call("browsingContext.captureScreenshot", context=self._tab)["data"])

    def _evaluate(self, expression: str) -> dict[str, Any]:
        asked = {"expression": expression, "target": {"context": self._tab}, "awaitPromise": True}
        told = self._call("script.evaluate", **asked)
        assert told["type"] == "success", told
        return told["result"]

    def _call(self, method: str, **params: Any) -> dict[str, Any]:
        number = next(self._ids)
        self._socket.send(json.dumps({"id": number, "method": method, "params": params}))
        while (answer := json.loads(self._socket.recv(PATIENCE_S))).get("id") != number:
            pass  # an event
        assert answer["type"] == "success", answer
        return answer["result"]


@contextmanager
def firefox(folder: Path) -> Iterator[Page]:
    """Run Firefox with a profile in an empty folder; gives its tab."""
    lines = [f"user_pref({json.dumps(name)}, {json.dumps(value)});\n" for name, value in PREFERENCES.items()]
    (folder / "user.js").write_text("".join(lines), "utf-8")
    command = [FIREFOX, "--no-remote", "--profile", str(folder), "--remote-debugging-port", "0"]
    with _screen() as display:
        given = {**os.environ, "DISPLAY": display, "LIBGL_ALWAYS_SOFTWARE": "1"}
        child = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=given)
        try:
            with connect(_address(child, folder), max_size=2**26, proxy=None, open_timeout=PATIENCE_S) as socket:
                yield Page(socket)
        finally:
            child.terminate()
            child.wait(30)


@contextmanager
def _screen() -> Iterator[str]:
    """Run an X server without a screen: without one Firefox has no WebGL. Gives its name."""
    command = [XVFB, "-displayfd", "1", "-screen", "0", "1400x1000x24", "-nolisten", "tcp"]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        assert server.stdout
        yield f":{server.stdout.readline().strip()}"
    finally:
        server.terminate()
        server.communicate(timeout=30)


def _address(child: subprocess.Popen[bytes], folder: Path) -> str:
    """Wait until Firefox has written where it listens."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        with suppress(FileNotFoundError, ValueError):
            told = json.loads((folder / "WebDriverBiDiServer.json").read_text("utf-8"))
            return f"ws://{told['ws_host']}:{told['ws_port']}/session"
        assert child.poll() is None, f"Firefox ended with {child.returncode}"
        assert time.monotonic() < deadline, f"Firefox doesn't listen after {PATIENCE_S:g} s"
        time.sleep(0.1)
