"""Chromium without a window, spoken to by its DevTools protocol."""

from __future__ import annotations

import base64
import json
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
OPTIONS = [
    "--headless", "--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader", "--disable-quic",
    "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--enable-unsafe-swiftshader", "--remote-debugging-port=0", "--remote-allow-origins=*",
]  # fmt: skip


def find_browser() -> str | None:
    return next((path for name in BROWSERS if (path := shutil.which(name))), None)


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port: int = free.getsockname()[1]
    return port


class Page:
    def __init__(self, socket: Any) -> None:
        self._socket, self._last = socket, 0

    def command(self, method: str, patience: float = 120.0, **parameters: Any) -> dict[str, Any]:
        self._last += 1
        self._socket.send(json.dumps({"id": self._last, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=patience))
            if answer.get("id") == self._last:
                assert "error" not in answer, answer["error"]
                found: dict[str, Any] = answer["result"]
                return found

    def evaluate(self, expression: str, patience: float = 120.0) -> Any:
        answer = self.command(
            "Runtime.evaluate", patience, expression=expression, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def click(self, element: str) -> None:
        """Presses and lets go of the mouse in the middle of what a JavaScript expression gives."""
        self.drag(element, 0.0, 0.0)

    def drag(self, element: str, right: float, down: float) -> None:
        """Moves the pressed mouse from the middle of an element by pixels."""
        x, y = self.evaluate(
            f"(() => {{ const e = {element}; e.scrollIntoView({{block: 'nearest'}});"
            " const r = e.getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2] })()"
        )
        whole = {"button": "left", "clickCount": 1}
        self.command("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        self.command("Input.dispatchMouseEvent", type="mousePressed", x=x, y=y, **whole)
        if right or down:
            for part in (0.5, 1.0):
                moved = {"x": x + part * right, "y": y + part * down}
                self.command("Input.dispatchMouseEvent", type="mouseMoved", buttons=1, button="left", **moved)
        self.command("Input.dispatchMouseEvent", type="mouseReleased", x=x + right, y=y + down, **whole)

    def type(self, text: str) -> None:
        self.command("Input.insertText", text=text)

    def screenshot(self) -> bytes:
        return base64.b64decode(self.command("Page.captureScreenshot", format="png")["data"])

    def wait_for(self, expression: str, seconds: float) -> Any:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if found := self.evaluate(expression):
                return found
            time.sleep(0.3)
        raise TimeoutError(expression)


SELDOM = "window.requestAnimationFrame = f => setTimeout(() => f(performance.now()), 4000)"
"""Without a GPU a page that draws without pause leaves no time for clicks."""


@contextmanager
def opened(place: Path | str, profile: Path, before: str | None = None) -> Iterator[Page]:
    """Opens a file or an address; `before` is a script that runs ahead of those of the page."""
    from websockets.sync.client import connect

    browser = find_browser()
    assert browser is not None
    command = [browser, *OPTIONS, f"--user-data-dir={profile}", "about:blank"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            told = profile / "DevToolsActivePort"
            end = time.monotonic() + 60
            while not (told.is_file() and told.read_text().strip()):
                assert time.monotonic() < end, "the browser did not start"
                time.sleep(0.2)
            port = told.read_text().split()[0]
            for page in _connected(connect, port):
                if before is not None:
                    page.command("Page.enable")
                    page.command("Page.addScriptToEvaluateOnNewDocument", source=before)
                page.command(
                    "Page.navigate", url=place if isinstance(place, str) else place.resolve().as_uri()
                )
                yield page
        finally:
            process.terminate()


def _connected(connect: Any, port: str) -> Iterator[Page]:
    from urllib.request import urlopen

    pages = json.loads(urlopen(f"http://127.0.0.1:{port}/json").read())
    address = next(page["webSocketDebuggerUrl"] for page in pages if page["type"] == "page")
    with connect(address, max_size=None) as socket:
        yield Page(socket)
