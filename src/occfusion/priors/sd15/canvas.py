"""The picture of a skeleton as OpenPose draws it, which is what ControlNet was trained on (paper §4.1)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.observation.keypoints import LIMBS, NUM_KEYPOINTS, Keypoints

COLORS = (
    (255, 0, 0), (255, 85, 0), (255, 170, 0), (255, 255, 0), (170, 255, 0), (85, 255, 0), (0, 255, 0),
    (0, 255, 85), (0, 255, 170), (0, 255, 255), (0, 170, 255), (0, 85, 255), (0, 0, 255), (85, 0, 255),
    (170, 0, 255), (255, 0, 255), (255, 0, 170), (255, 0, 85),
)  # fmt: skip
"""RGB of each key point; a limb has the colour of its place in `LIMBS`."""

THICKNESS = 4.0
"""Half-width of a limb and radius of a joint, pixels of a canvas of `REFERENCE` pixels."""
REFERENCE = 512
"""Longer side of the canvases of ControlNet's training data, pixels."""
LIMB_BRIGHTNESS = 0.6

_FRACTION_BITS = 4  # cv2 takes polygons in sixteenths of a pixel
_CORNERS = 72


def draw_canvas(
    pixels: NDArray[np.floating], shown: NDArray[np.bool_], width: int, height: int
) -> NDArray[np.uint8]:
    """Returns the skeleton on black, RGB `[H, W, 3]`, 0..255.

    Limbs are filled ellipses at 0.6 of their colour, drawn in the order of `LIMBS`; then come the joints, discs of
    full colour. The thickness grows with the canvas, from 4 pixels at 512.

    Args:
        pixels: key points, `[18, 2]`, pixels, centres of pixels at +0.5; may lie outside the canvas.
        shown: which of them are drawn, bool `[18]`; a limb needs both of its ends.
        width: columns.
        height: rows.

    Raises:
        ValueError: not 18 points, or a shown one is not finite.
    """
    if pixels.shape != (NUM_KEYPOINTS, 2) or shown.shape != (NUM_KEYPOINTS,):
        raise ValueError(f"{NUM_KEYPOINTS} key points are needed, not {pixels.shape} and {shown.shape}")
    if not np.isfinite(pixels[shown]).all():
        raise ValueError("a key point that is shown is not finite")
    canvas = np.zeros((height, width, 3), np.uint8)
    radius = THICKNESS * max(width, height) / REFERENCE
    for (start, end), color in zip(LIMBS, COLORS, strict=False):
        if shown[start] and shown[end]:
            dimmed = tuple(int(LIMB_BRIGHTNESS * value) for value in color)
            _fill(canvas, _ellipse(pixels[start], pixels[end], radius), dimmed)
    for point, color in zip(pixels[shown], np.array(COLORS)[shown], strict=True):
        _fill(canvas, _ellipse(point, point, radius), tuple(int(value) for value in color))
    return canvas


def draw_keypoints(seen: Keypoints, width: int, height: int) -> NDArray[np.uint8]:
    """Returns the canvas, `[H, W, 3]`, of the key points that a camera sees; self-occluded ones are left out."""
    return draw_canvas(seen.pixels, seen.shown, width, height)


def _ellipse(start: NDArray[np.floating], end: NDArray[np.floating], radius: float) -> NDArray[np.float64]:
    """Returns the outline, `[P, 2]`, of a limb; of a disc where both ends are one point."""
    along = 0.5 * (end - start)
    length = float(np.hypot(*along))
    direction = along / length if length > 0.0 else np.array([1.0, 0.0])
    across = np.array([-direction[1], direction[0]])
    angle = np.linspace(0.0, 2.0 * np.pi, _CORNERS, endpoint=False)[:, None]
    half_length = length if length > 0.0 else radius
    offsets = half_length * np.cos(angle) * direction + radius * np.sin(angle) * across
    return np.asarray(0.5 * (start + end) + offsets)


def _fill(canvas: NDArray[np.uint8], outline: NDArray[np.float64], color: tuple[int, ...]) -> None:
    height, width = canvas.shape[:2]
    if (outline.max(axis=0) < 0).any() or (outline.min(axis=0) > (width, height)).any():
        return
    # what lies almost beside the camera projects far away, where cv2's fixed-point numbers would overflow
    bound = 64.0 * max(width, height)
    fixed = np.rint((np.clip(outline, -bound, bound) - 0.5) * (1 << _FRACTION_BITS)).astype(np.int32)
    cv2.fillConvexPoly(canvas, fixed, color, lineType=cv2.LINE_8, shift=_FRACTION_BITS)
