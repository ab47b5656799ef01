"""The page of `view` in a real browser: what is clicked is what the avatar does."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import headless
import pytest

from occfusion.viewer.room import furnish

pytestmark = [
    pytest.mark.slow,  # a browser that draws without a GPU: half a minute and more
    pytest.mark.skipif(
        headless.find_browser() is None, reason="no Chromium: the page of `view` goes unclicked"
    ),
]
SHOWN = "e.getBoundingClientRect().height > 0"
WIDTH, HEIGHT = 700, 600
PATIENCE = 120.0
"""Seconds: a machine can be full."""


def field(label: str, number: int = 0) -> str:
    """What a label stands beside: the n-th of that name which is there to be seen."""
    named = (
        f"[...document.querySelectorAll('label')].filter(e => e.textContent.trim() === '{label}' && {SHOWN})"
    )
    return f"document.getElementById({named}[{number}].htmlFor)"


def option(text: str) -> str:
    return f"[...document.querySelectorAll('[role=option]')].find(e => e.textContent.trim() === '{text}' && {SHOWN})"


class Visitor:
    def __init__(self, browser: headless.Page, page: Any) -> None:
        self.browser, self.page = browser, page

    def until(self, done: Callable[[], Any]) -> None:
        """Lets the server work until something is true."""
        end = time.monotonic() + PATIENCE
        while not done():
            assert time.monotonic() < end, "nothing happened"
            self.page.step()
            time.sleep(0.05)
        self.page.step()

    def is_there(self, element: str) -> bool:
        return bool(self.browser.evaluate(f"(() => {{ try {{ return !!({element}) }} catch {{ }} }})()"))

    def click(self, element: str) -> None:
        self.until(lambda: self.is_there(element))
        self.browser.click(element)

    def choose(self, label: str, text: str, number: int = 0) -> None:
        """Opens a list and clicks one of its lines, again where the list was still moving."""

        def is_chosen() -> bool:
            if self.browser.evaluate(f"{field(label, number)}.value") == text:
                return True
            self.browser.click(option(text) if self.is_there(option(text)) else field(label, number))
            time.sleep(0.5)
            return False

        self.until(lambda: self.is_there(field(label, number)))
        self.until(is_chosen)


@pytest.fixture
def visitor(short_run: Path, tmp_path: Path) -> Iterator[Visitor]:
    viser = pytest.importorskip("viser", reason="no viser (extra `view`): its page goes unclicked")
    pytest.importorskip("websockets", reason="speaks to the browser")
    from occfusion.viewer.page import Page

    server = viser.ViserServer("127.0.0.1", headless.free_port(), verbose=False)
    furnish(server)
    try:
        page = Page(server, {"one": short_run}, "squat")
        page.playing.value = False
        page.step()
        address = f"http://127.0.0.1:{server.get_port()}"
        with headless.opened(address, tmp_path / "profile", headless.SELDOM) as browser:
            size = {"width": WIDTH, "height": HEIGHT, "deviceScaleFactor": 0.5, "mobile": False}
            browser.command("Emulation.setDeviceMetricsOverride", **size)
            yield Visitor(browser, page)
    finally:
        server.stop()


def test_what_is_clicked_is_what_the_avatar_does(visitor: Visitor) -> None:
    page = visitor.page
    visitor.choose("show", "occupancy")
    visitor.until(lambda: page.look.value == "occupancy")
    assert (page.server.scene.get_handle_by_name("/splats").rgbs == 255).all()
    visitor.choose("stage", "optim")
    visitor.until(lambda: page.stage.value == "optim")
    assert "optim, done" in visitor.browser.evaluate("document.body.innerText")
    visitor.click(field("play"))
    visitor.until(lambda: page.frame.value > 3)
