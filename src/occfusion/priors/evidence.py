"""What a video says about where an occluder stands, from masks and body meshes alone.

A pixel well inside the body's projection that does not show the person is hidden. Beside the body, a pixel may be
hidden as well when the nearest pixel of the person is: an occluder does not end where the body does. The rest of what
does not show the person is background.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]

CORE = 0.01
"""Of the person's size in the picture: how far inside the body's outline a pixel must lie to be surely the body."""
REACH = 0.06
"""Of the same: how far from a hidden pixel clothes and hair may be hidden as well."""
GROWTH = 2.5
"""Of `CORE`: how far the hidden part of the core is grown back into the body's outline."""
HIDDEN_SHARE = 0.03
"""Of the core: less hidden than this is put down to errors of pose and mask, and the person counts as whole."""


@dataclass(frozen=True)
class Evidence:
    """What is known of a frame.

    Attributes:
        hidden: pixels inside the body that do not show the person, bool `[H, W]`.
        background: pixels taken for background, bool `[H, W]`.
        hidden_share: share of the body's core that is hidden, 0..1.
        occluded: whether that is more than errors of pose and mask explain.
        outside_share: share of the whole body that does not show the person, 0..1: more than its core tells of
            small errors of the pose.
    """

    hidden: Mask
    background: Mask
    hidden_share: float
    occluded: bool
    outside_share: float


def person_size(body: Mask) -> float:
    """Returns the longer side of a mask's bounding box, pixels; 0 if it is empty."""
    rows, columns = np.flatnonzero(body.any(axis=1)), np.flatnonzero(body.any(axis=0))
    if not len(rows):
        return 0.0
    return float(max(rows[-1] - rows[0], columns[-1] - columns[0]) + 1)


def gather_evidence(bodies: Sequence[Mask], visible: Sequence[Mask]) -> list[Evidence]:
    """Returns the evidence of each frame of one camera.

    Args:
        bodies: the body's projection in each frame, bool `[H, W]`.
        visible: the paper's M of each.
    """
    cores = [_shrunk(body, CORE * person_size(body)) for body in bodies]
    found = []
    for body, core, seen in zip(bodies, cores, visible, strict=True):
        hidden = _without_specks(core & ~seen, CORE * person_size(body))
        size = int(core.sum())
        share = float(hidden.sum()) / size if size else 0.0
        unknown = _unknown(hidden, body, seen)
        outside = float((body & ~seen).sum()) / max(1, int(body.sum()))
        found.append(Evidence(hidden, ~seen & ~unknown, share, share > HIDDEN_SHARE, outside))
    return found


def _unknown(hidden: Mask, body: Mask, seen: Mask) -> Mask:
    """Returns what may be hidden: the hidden part of the body and what lies nearer to it than to what is seen."""
    size = person_size(body)
    part = _grown(hidden, GROWTH * CORE * size) & body & ~seen
    if not part.any():
        return part
    to_hidden = cv2.distanceTransform((~part).astype(np.uint8), cv2.DIST_L2, 5)
    to_seen = cv2.distanceTransform((~seen).astype(np.uint8), cv2.DIST_L2, 5)
    if not seen.any():
        to_seen = np.full_like(to_hidden, np.inf)
    return np.asarray((to_hidden <= to_seen) & (to_hidden < REACH * size) & ~seen)


def _disk(radius: float) -> NDArray[np.uint8]:
    r = max(1, round(radius))
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * r + 1, 2 * r + 1)), np.uint8)


def _shrunk(mask: Mask, radius: float) -> Mask:
    # what lies beyond the picture's edge is as much the body as what lies inside it
    inside = cv2.erode(mask.astype(np.uint8), _disk(radius), borderType=cv2.BORDER_REPLICATE)
    return inside.astype(bool)


def _grown(mask: Mask, radius: float) -> Mask:
    return cv2.dilate(mask.astype(np.uint8), _disk(radius)).astype(bool)


def _without_specks(mask: Mask, radius: float) -> Mask:
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, _disk(0.5 * radius)).astype(bool)
