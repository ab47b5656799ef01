"""How well a projected body and a person's mask fit together, estimated on small previews."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.data import checks
from occfusion.data.scene import Array, Calibration

PREVIEW = 128
"""Longer side, in pixels, at which the projected body is compared with the mask."""


def body_outline(
    vertices: Array, camera: Calibration, shape: tuple[int, ...], gap: int = 5
) -> NDArray[np.bool_]:
    """Returns roughly what the body covers of a picture `[H, W]`, on a preview of at most `PREVIEW` pixels.

    Made from the vertices alone, closed over gaps of less than `gap` pixels: 6890 of them leave none.
    """
    small, scale = _preview(shape)
    pixels, depth = checks.project(vertices, camera)
    place = np.floor(pixels[depth > 0] * scale).astype(np.int64)
    place = place[(place >= 0).all(axis=1) & (place < np.array(small)).all(axis=1)]
    body = np.zeros(small[::-1], dtype=np.uint8)
    body[place[:, 1], place[:, 0]] = 1
    return np.asarray(cv2.morphologyEx(body, cv2.MORPH_CLOSE, np.ones((gap, gap), np.uint8))) > 0


def preview(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Returns a mask `[H, W]` at the size of `body_outline`."""
    small, _ = _preview(mask.shape)
    return cv2.resize(mask.astype(np.uint8) * 255, small, interpolation=cv2.INTER_AREA) >= 128


def mask_overlap(vertices: Array, camera: Calibration, mask: NDArray[np.bool_]) -> tuple[float, float]:
    """Returns how well the projected body fits a mask, estimated on a small preview from the vertices.

    Returns:
        The IoU, and the share of the mask that lies inside the body (high for partly hidden people too).
    """
    person, body = preview(mask), body_outline(vertices, camera, mask.shape)
    union, both = int((person | body).sum()), int((person & body).sum())
    return both / max(union, 1), both / max(int(person.sum()), 1)


def seen_share(vertices: Array, camera: Calibration, mask: NDArray[np.bool_]) -> float:
    """Returns which share of the projected body a mask of the visible person covers, 0..1; 0 out of view.

    A rim of one pixel of the preview is left out: there the two never agree.
    """
    person, body = preview(mask), body_outline(vertices, camera, mask.shape, 3)
    body = np.asarray(cv2.erode(body.astype(np.uint8), np.ones((3, 3), np.uint8))) > 0
    return int((person & body).sum()) / max(int(body.sum()), 1)


def joints_inside(joints: Array, camera: Calibration, mask: NDArray[np.bool_]) -> float:
    """Returns the share of the joints `[24, 3]` that lie in a mask, of those inside the picture."""
    pixels, depth = checks.project(joints, camera)
    place = np.floor(pixels[depth > 0]).astype(np.int64)
    place = place[(place >= 0).all(axis=1) & (place < np.array(mask.shape[::-1])).all(axis=1)]
    return float(mask[place[:, 1], place[:, 0]].mean()) if len(place) else 0.0


def _preview(shape: tuple[int, ...]) -> tuple[tuple[int, int], float]:
    height, width = shape[:2]
    scale = min(PREVIEW / max(width, height), 1.0)
    return (max(round(width * scale), 1), max(round(height * scale), 1)), scale
