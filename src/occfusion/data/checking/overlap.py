"""How well a projected body and a mask fit, on small previews, and which known camera error explains a misfit."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.data.checking import checks
from occfusion.data.scene import Array, Calibration

PREVIEW = 128
"""Longer side, in pixels, at which the projected body is compared with the mask."""

LOW_OVERLAP = 0.5
"""IoU of body and mask below which it is reported: a clothed person has 0.8 to 0.95."""
SUSPECT = 0.65
"""IoU below which a camera may have been exchanged with another."""


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
    return _overlap(preview(mask), body_outline(vertices, camera, mask.shape))


def _overlap(person: NDArray[np.bool_], body: NDArray[np.bool_]) -> tuple[float, float]:
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


EXPLAINS = 0.15
"""By how much more IoU an error has to explain the data to be named."""

FLIP = np.diag([1.0, -1.0, -1.0])

CAMERA_ERRORS: dict[str, Callable[[Calibration], Calibration]] = {
    "R is transposed (camera to world)": lambda c: replace(c, R=c.R.T),
    "R and T are the camera's place, not world to camera": lambda c: replace(c, R=c.R.T, t=-c.R.T @ c.t),
    "T is the camera's centre": lambda c: replace(c, t=-c.R @ c.t),
    "T is 1000 times too large (millimetres)": lambda c: replace(c, t=c.t / 1000),
    "T is 1000 times too small (metres read as millimetres)": lambda c: replace(c, t=c.t * 1000),
    "camera axes are OpenGL's (y up, z backward)": lambda c: replace(c, R=FLIP @ c.R, t=FLIP @ c.t),
}
"""Errors seen in data of this field, as what would undo them."""


def explain_misfit(views: Sequence[tuple[Array, Calibration, NDArray[np.bool_]]]) -> str:
    """Returns a sentence naming the error in the camera whose undoing makes body and masks meet; empty when none does.

    Args:
        views: of some frames the body in the world, `[V, 3]`, metres; the camera as it was read; and the person,
            `[H, W]`.
    """

    def fit(undo: Callable[[Calibration], Calibration]) -> float:
        return float(np.mean([mask_overlap(body, undo(camera), mask)[0] for body, camera, mask in views]))

    best, reason = fit(lambda camera: camera) + EXPLAINS, ""
    for name, undo in CAMERA_ERRORS.items():
        score = fit(undo)
        if score > best:
            best, reason = score, name
    return f"it seems that {reason}: undone, the IoU is {best:.2f}" if reason else ""


EXCHANGES: dict[str, Callable[[Calibration, Calibration], Calibration]] = {
    "rotations (R)": lambda own, other: replace(own, R=other.R),
    "places (T)": lambda own, other: replace(own, t=other.t),
    "R and T": lambda own, other: replace(own, R=other.R, t=other.t),
}
"""What of two cameras may have been exchanged, as what would undo it."""


def find_exchange(moments: Sequence[tuple[Array, Sequence[tuple[Calibration, NDArray[np.bool_]]]]]) -> str:
    """Returns a sentence naming two cameras whose calibrations were exchanged; empty where nothing shows it.

    Both must fit their masks clearly better with what is the other's: then the data prove it.

    Args:
        moments: of each the body in the world, `[V, 3]`, metres, and the same cameras in the same order, each with the
            complete person that it saw, `[H, W]`.
    """
    shown = range(len(moments[0][1]) if moments else 0)
    people = [[preview(mask) for _, mask in seen] for _, seen in moments]

    def fits(
        own: int, other: int, taken: Callable[[Calibration, Calibration], Calibration]
    ) -> Iterator[float]:
        """Yields the IoU of a camera with what is taken of another, moment by moment that it saw somebody."""
        for (vertices, seen), person in zip(moments, people, strict=True):
            if person[own].any():
                camera, mask = seen[own]
                outline = body_outline(vertices, taken(camera, seen[other][0]), mask.shape)
                yield _overlap(person[own], outline)[0]

    read = {k: found for k in shown if (found := list(fits(k, k, lambda own, _: own)))}
    suspects = [k for k, found in read.items() if np.mean(found) < SUSPECT]
    best, reason = 0.0, ""
    for pair in combinations(suspects, 2):
        own = [float(np.mean(read[k])) for k in pair]
        for what, taken in EXCHANGES.items():
            both = list(zip(pair, reversed(pair), strict=True))
            # most are worse at the first moment already: of many cameras that all miss, few pairs are left
            if any(next(fits(*each, taken)) < read[each[0]][0] for each in both):
                continue
            undone = [float(np.mean(list(fits(*each, taken)))) for each in both]
            gain = min(after - before for before, after in zip(own, undone, strict=True))
            if min(undone) >= LOW_OVERLAP and gain >= EXPLAINS and sum(undone) > best:
                best, names = sum(undone), [moments[0][1][k][0].name for k in pair]
                reason = (
                    f"{what} of cameras {names[0]} and {names[1]} are exchanged: as they are, body and mask have an "
                    f"IoU of {own[0]:.2f} and {own[1]:.2f}, with each other's {undone[0]:.2f} and {undone[1]:.2f}"
                )
    return reason
