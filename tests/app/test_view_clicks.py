"""The page of `view` in a real browser: what is clicked is what the avatar does."""

from __future__ import annotations

import base64
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import headless
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from occfusion.evaluation.pictures import to_uint8
from occfusion.geometry.rotation import matrix_to_quaternion
from occfusion.human.rendering import Renderer
from occfusion.run.bodies import make_body, make_data
from occfusion.run.loaded import load_run
from occfusion.viewer.room import UNITS, furnish

pytestmark = [
    pytest.mark.slow,  # a browser that draws without a GPU: half a minute and more
    pytest.mark.skipif(
        headless.find_browser() is None, reason="no Chromium: the page of `view` goes unclicked"
    ),
]
Picture = NDArray[np.uint8]
SHOWN = "e.getBoundingClientRect().height > 0"
WIDTH, HEIGHT = 1100, 600
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


def folder(label: str) -> str:
    heads = "[...document.querySelectorAll('div')].filter(e => e.style.cursor === 'pointer')"
    return f"{heads}.find(e => e.textContent.trim() === '{label}')"


def decoded(content: bytes) -> Picture:
    return cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def off(a: Picture, b: Picture) -> float:
    """Mean difference, of 255; all of it where sizes differ."""
    if a.shape != b.shape:
        return 255.0
    return float(np.abs(a.astype(float) - b.astype(float)).mean())


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

    def tick(self, label: str, number: int = 0) -> None:
        """Clicks a box until it has its tick, again where it was still moving."""

        def is_ticked() -> bool:
            if self.browser.evaluate(f"{field(label, number)}.checked"):
                return True
            self.browser.click(field(label, number))
            time.sleep(0.5)
            return False

        self.until(lambda: self.is_there(field(label, number)))
        self.until(is_ticked)

    def shown(self) -> Picture:
        """What the panel shows of a camera, 8-bit RGB; black of one pixel before it is there."""
        image = f"[...document.querySelectorAll('img')].find(e => {SHOWN} && e.src.startsWith('blob:'))"
        content = self.browser.evaluate(
            f"(() => {{ const e = {image}; const c = document.createElement('canvas');"
            " if (!e || !e.naturalWidth) return null; c.width = e.naturalWidth; c.height = e.naturalHeight; "
            " c.getContext('2d').drawImage(e, 0, 0); return c.toDataURL('image/png').split(',')[1] })()"
        )
        return decoded(base64.b64decode(content)) if content else np.zeros((1, 1, 3), np.uint8)

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


@pytest.fixture(scope="module")
def visitor(short_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Visitor]:
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
        with headless.opened(address, tmp_path_factory.mktemp("profile"), headless.SELDOM) as browser:
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

    # pictures drawn here stand where the browser draws the Gaussians; white ones need no order
    def white() -> NDArray[np.bool_]:
        picture = cv2.resize(decoded(visitor.browser.screenshot()), (WIDTH, HEIGHT))
        return (picture[:, WIDTH // 3 : -WIDTH // 3] > 200).all(axis=2)

    def overlap(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
        return float((a & b).sum() / max((a | b).sum(), 1))

    visitor.until(lambda: (first := white()).sum() > 1000 and overlap(first, white()) == 1.0)
    by_browser = white()
    visitor.choose("drawn by", "server")
    visitor.until(lambda: page._has_pictures)
    assert page.server.scene.get_handle_by_name("/splats") is None
    visitor.until(lambda: overlap(white(), by_browser) > 0.9)
    visitor.click(field("play"))
    visitor.until(lambda: page.frame.value > 3)
    visitor.until(lambda: overlap(white(), by_browser) < 0.8)
    visitor.click(field("play"))
    visitor.until(lambda: not page.playing.value)


def test_input_truth_and_error_are_those_of_the_camera_that_is_chosen(
    visitor: Visitor, short_run: Path
) -> None:
    page, browser = visitor.page, visitor.browser
    page.playing.value = False
    settings = load_run(short_run).settings
    data = make_data(settings, make_body(settings.body))
    data.setup()
    index, camera = data.test_views[0]
    visitor.choose("drawn by", "server")  # a browser without a GPU has more time for clicks then
    visitor.click(folder("input"))
    visitor.tick("show", 1)
    visitor.until(lambda: page.with_input.value)
    for name, frame, kinds in (
        ("training", data.train_frame(3), ("input", "avatar", "truth", "error")),
        (f"held out, camera {camera}", data.test_frame(index, camera), ("error",)),
    ):
        page.frame.value = frame.index
        page._seek()
        assert frame.truth is not None
        drawn = to_uint8(Renderer("auto").frame(load_run(short_run).avatar, frame).rgb)
        truth = to_uint8(frame.truth.rgb)
        error = 4 * np.abs(drawn / 255.0 - truth / 255.0).mean(axis=2, keepdims=True).repeat(3, 2)
        expected = {
            "input": to_uint8(frame.rgb), "avatar": drawn, "truth": truth,
            "error": (255 * error.clip(0, 1)).astype(np.uint8),
        }  # fmt: skip
        visitor.choose("camera", name)
        for kind in kinds:
            visitor.choose("picture", kind)
            visitor.until(lambda wanted=expected[kind]: off(visitor.shown(), wanted) < 1.0)
            found = {other: off(visitor.shown(), picture) for other, picture in expected.items()}
            assert all(found[kind] < 0.7 * found[other] for other in expected if other != kind), (name, found)
            if kind == "error":
                said = f"error x4 against the truth of frame {frame.index}"
                assert said in browser.evaluate("document.body.innerText")

    # whoever stands where the camera stood sees its picture fill the middle of the page, the person behind it
    (client,) = page.server.get_clients().values()
    home = page.figure.own.upright @ torch.linalg.inv(frame.camera.viewmat)
    half = 0.5 * frame.camera.height / float(frame.camera.K[1, 1])
    with client.atomic():
        client.camera.fov = 2 * math.atan(2 * half)
        client.camera.wxyz = matrix_to_quaternion(home[:3, :3]).numpy()
        client.camera.position = (home[:3, 3] * UNITS).numpy()
    side = HEIGHT // 2

    def likeness(picture: Picture) -> float:
        whole = cv2.resize(decoded(browser.screenshot()), (WIDTH, HEIGHT))
        middle = whole[(HEIGHT - side) // 2 :, (WIDTH - side) // 2 :][:side, :side]
        found = cv2.resize(middle, picture.shape[1::-1], interpolation=cv2.INTER_AREA)
        return float(np.corrcoef(found.ravel(), picture.ravel())[0, 1])

    shown = visitor.shown()
    visitor.until(lambda: likeness(shown) > 0.85)
    assert likeness(shown[:, ::-1]) < 0.5 and likeness(np.roll(shown, 4, axis=1)) < 0.8
