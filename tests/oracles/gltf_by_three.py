"""A skinned `.glb` as three.js reads it, in Chromium: the loader, the mixer and the bones are three's own.

`gltf_by_three.js.gz` is `scripts/web_player/gltf_reader.js` bundled with `three` 0.187.0 by the `build.sh` beside it;
Copyright three.js authors, MIT (`src/occfusion/assets/web_player.LICENSE.txt`).
"""

from __future__ import annotations

import base64
import gzip
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_READER = Path(__file__).with_suffix(".js.gz")


class GltfByThree:
    """A file in a page of a browser.

    Args:
        page: `headless.Page`, empty.
        path: the file.
    """

    def __init__(self, page: Any, path: Path) -> None:
        self._page = page
        page.evaluate(gzip.decompress(_READER.read_bytes()).decode() + ";true")
        content = base64.b64encode(path.read_bytes()).decode()
        self.about: dict[str, Any] = page.evaluate(f"gltfReader.open('{content}')")

    def posed(self, motion: str, seconds: float, bone: int = -1, turn: float = 0.0) -> NDArray[np.float64]:
        """Returns the vertices at a moment, `[V, 3]`; a bone may be turned about its z by radians on top."""
        text = self._page.evaluate(f"gltfReader.posed('{motion}', {seconds!r}, {bone}, {turn})")
        return np.frombuffer(base64.b64decode(text), "<f4").reshape(-1, 3).astype(np.float64)

    def drawn(self, view: NDArray[Any], K: NDArray[Any], width: int, height: int) -> NDArray[np.uint8]:
        """Returns a picture `[H, W, 3]` of what was posed last; OpenCV axes, world to camera `[4, 4]`."""
        pinhole = [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])]
        url = self._page.evaluate(
            f"gltfReader.draw({np.asarray(view).flatten().tolist()}, {pinhole}, {width}, {height})"
        )
        content = np.frombuffer(base64.b64decode(url.split(",")[1]), np.uint8)
        return cv2.imdecode(content, cv2.IMREAD_COLOR)[..., ::-1]
