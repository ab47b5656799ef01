"""What a fit keeps of a mask: how far each place lies off it, and points of its outline."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

EDGE_POINTS = 140
"""Points of each mask's outline."""
FIELD = 160
"""Side, in cells, of the distance field about a person."""


def mask_field(mask: Mask, hidden: Mask | None) -> tuple[NDArray[np.float32], Floats, float, Floats]:
    """Returns distances to the mask `[FIELD, FIELD]` in pixels, the corner and the cell of the field, edge points.

    What lies in `hidden` is at distance 0, and edges that touch it are none of the body's.
    """
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return np.zeros((FIELD, FIELD), np.float32), np.zeros(2), 1.0, np.zeros((EDGE_POINTS, 2))
    side = 1.5 * max(rows[-1] - rows[0], columns[-1] - columns[0]) + 16
    corner = np.array([(columns[0] + columns[-1] - side) / 2, (rows[0] + rows[-1] - side) / 2])
    step = side / FIELD
    affine = np.array([[step, 0, corner[0] + 0.5 * step - 0.5], [0, step, corner[1] + 0.5 * step - 0.5]])
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP

    def cells(picture: Mask) -> Mask:
        return np.asarray(cv2.warpAffine(picture.astype(np.uint8), affine, (FIELD, FIELD), flags=flags)) > 0

    small = cells(mask)
    allowed = small | ~cells(np.ones_like(mask))  # beyond the picture nothing is known
    if hidden is not None:
        allowed |= cells(hidden)
    away = cv2.distanceTransform((~allowed).astype(np.uint8), cv2.DIST_L2, 5) * step
    contours, _ = cv2.findContours(small.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    outline = np.concatenate([contour.reshape(-1, 2) for contour in contours])
    blocked = cv2.dilate((allowed & ~small).astype(np.uint8), np.ones((5, 5), np.uint8))
    free = outline[blocked[outline[:, 1], outline[:, 0]] == 0]
    outline = free if len(free) else outline
    chosen = outline[np.linspace(0, len(outline) - 1, EDGE_POINTS).round().astype(int)]
    return away.astype(np.float32), corner, step, (chosen + 0.5) * step + corner
