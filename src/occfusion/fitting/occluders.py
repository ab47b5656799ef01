"""What stands before a person, told from what a fitted body says should be seen and the mask does not show.

A body that merely lies a little off its mask misses it along its edge. Something before the person cuts into the
body: there is a stretch of it, deeper than an edge is wrong, that the mask leaves out, and the frames before and
after miss the same stretch. All else is left to be background.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.fitting.quality import posed, preview, silhouette
from occfusion.fitting.solver import Solution
from occfusion.human import Body

Mask = NDArray[np.bool_]

DEEP = 0.022
"""Distance from the body's edge, in its heights, from which on a place that the mask leaves out is no misfit."""
LEAST, EACH = 0.03, 0.003
"""Share of the body that is deep and missing below which nothing is said, and that each piece must have of it."""
SHARED = 0.3
"""Share of a piece that a neighbouring frame misses too."""
GROWN = 1
"""Pixels of the preview by which pieces are made larger, over edges that masks draw too wide."""


def found_occluders(body: Body, solution: Solution, masks: Sequence[Mask]) -> list[Mask] | None:
    """Returns what hides parts of the person in each frame, `[H, W]`, none of it in the mask; None for nothing.

    Args:
        body: that was fitted.
        solution: the fit.
        masks: of the visible person, `[H, W]` each; an empty one says nothing.
    """
    faces = body.faces.numpy()
    shown = [
        silhouette(vertices, solution.K, faces, mask.shape)
        for (vertices, _), mask in zip(posed(body, solution), masks, strict=True)
    ]
    small = [preview(mask, body_.shape) for mask, body_ in zip(masks, shown, strict=True)]
    pieces = [_pieces(a, b) for a, b in zip(shown, small, strict=True)]
    kept = _steady(pieces)
    if not any(piece.any() for piece in kept):
        return None
    out = []
    for piece, mask in zip(kept, masks, strict=True):
        wide = cv2.dilate(piece.astype(np.uint8), np.ones((2 * GROWN + 1,) * 2, np.uint8))
        large = cv2.resize(wide.astype(np.float32), mask.shape[::-1], interpolation=cv2.INTER_LINEAR) > 0.5
        out.append(large & ~mask)
    return out


def _pieces(shown: Mask, mask: Mask) -> Mask:
    """Returns the pieces of a body that its mask leaves out and that reach deep into it, `[h, w]`."""
    if not shown.any() or not mask.any():
        return np.zeros(shown.shape, dtype=bool)
    rows, columns = np.flatnonzero(shown.any(axis=1)), np.flatnonzero(shown.any(axis=0))
    size = max(rows[-1] - rows[0], columns[-1] - columns[0]) + 1
    # the border of the picture is no edge of the body
    padded = cv2.copyMakeBorder(shown.astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    inside = cv2.distanceTransform(padded, cv2.DIST_L2, 5)[1:-1, 1:-1]
    missing = shown & ~mask
    count, labels = cv2.connectedComponents(missing.astype(np.uint8), connectivity=4)
    deep = np.bincount(labels[missing & (inside > DEEP * size)], minlength=count)
    keep = deep >= EACH * shown.sum()
    keep[0] = False
    if deep[keep].sum() < LEAST * shown.sum():
        keep[:] = False
    return np.asarray(keep[labels])


def _steady(pieces: Sequence[Mask]) -> list[Mask]:
    """Returns the pieces that a frame before or after has too, at the same place."""
    out = []
    for k, piece in enumerate(pieces):
        near = np.zeros_like(piece)
        for other in (k - 1, k + 1):
            if 0 <= other < len(pieces):
                near |= pieces[other]
        count, labels = cv2.connectedComponents(piece.astype(np.uint8), connectivity=4)
        both, whole = (np.bincount(part, minlength=count) for part in (labels[near], labels.reshape(-1)))
        keep = both >= SHARED * whole
        keep[0] = False
        out.append(np.asarray(keep[labels]))
    return out
