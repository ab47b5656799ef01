"""Distances in masks, in pixels: to the edge, and to the nearest pixel that is set."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def signed_distance(mask: NDArray[np.bool_], window: int = 5) -> NDArray[np.float32]:
    """Returns how far each pixel is from the nearest of the other kind, positive inside the mask, `[H, W]`, pixels.

    Borgefors' chamfer distances ("Distance transformations in digital images", CVGIP 34, 1986) as OpenCV has them. A
    mask without an edge is far from it everywhere: more than any picture is wide.

    Args:
        mask: bool `[H, W]`.
        window: side of the chamfer mask, 3 (within 8 % of the true distance) or 5 (within 2.5 %).
    """
    inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, window)
    outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, window)
    return np.asarray(inside - outside, np.float32)


def nearest_set(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Returns which set pixel is nearest to each pixel, as its index in the flattened mask, `[H, W]`.

    Nearest by the 5x5 chamfer distance: of pixels about equally far, one.

    Raises:
        ValueError: no pixel is set.
    """
    if not mask.any():
        raise ValueError("no pixel of the mask is set, so that none is the nearest")
    _, labels = cv2.distanceTransformWithLabels(
        (~mask).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    index = np.zeros(int(labels.max()) + 1, np.int64)
    index[labels[mask]] = np.flatnonzero(mask.ravel())
    return np.asarray(index[labels])
