"""Chromium without a window, spoken to by its DevTools protocol."""

from __future__ import annotations

import json
import shutil
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


class Page:
    def __init__(self, socket: Any) -> None:
        self._socket, self._last = socket, 0

    def evaluate(self, expression: str, patience: float = 120.0) -> Any:
        self._last += 1
        parameters = {"expression": expression, "awaitPromise": True, "returnByValue": True}
        self._socket.send(json.dumps({"id": self._last, "method": "Runtime.evaluate", "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=patience))
            if answer.get("id") == self._last:
                assert "exceptionDetails" not in answer["result"], answer["result"]["exceptionDetails"]
                return answer["result"]["result"].get("value")

    def wait_for(self, expression: str, seconds: float) -> Any:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if found := self.evaluate(expression):
                return found
            time.sleep(0.3)
        raise TimeoutError(expression)


@contextmanager
def opened(file: Path, profile: Path) -> Iterator[Page]:
    from websockets.sync.client import connect

    browser = find_browser()
    assert browser is not None
    command = [browser, *OPTIONS, f"--user-data-dir={profile}", file.resolve().as_uri()]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            told = profile / "DevToolsActivePort"
            end = time.monotonic() + 60
            while not (told.is_file() and told.read_text().strip()):
                assert time.monotonic() < end, "the browser did not start"
                time.sleep(0.2)
            port = told.read_text().split()[0]
            yield from _connected(connect, port)
        finally:
            process.terminate()


def _connected(connect: Any, port: str) -> Iterator[Page]:
    from urllib.request import urlopen

    pages = json.loads(urlopen(f"http://127.0.0.1:{port}/json").read())
    address = next(page["webSocketDebuggerUrl"] for page in pages if page["type"] == "page")
    with connect(address, max_size=None) as socket:
        yield Page(socket)
