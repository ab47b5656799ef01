"""What a video says about where an occluder stands, from masks and body meshes alone.

A pixel well inside the body's projection that does not show the person is hidden. Beside the body, a pixel may be
hidden as well when the nearest pixel of the person is: an occluder does not end where the body does. The rest of what
does not show the person is background.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.fields.bits import Bits

Mask = NDArray[np.bool_]

CORE = 0.01
"""Of the person's size in the picture: how far inside the body's outline a pixel must lie to be surely the body."""
REACH = 0.06
"""Of the same: how far from a hidden pixel clothes and hair may be hidden as well."""
GROWTH = 2.5
"""Of `CORE`: how far the hidden part of the core is grown back into the body's outline."""
HIDDEN_SHARE = 0.03
"""Of the core: less hidden than this is put down to errors of pose and mask, and the person counts as whole."""
THIN_CORE = 0.005
"""As `CORE`, where doubt is enough: an occluder that takes a sliver of the person leaves little of the thicker core."""
AROUND = 0.02
"""Of the person's size: how far from the hull of hidden parts the person may be hidden as well."""
FITTING = 1e-3
"""Of the body: where less lies outside the masks of whole people, poses need no mending. Embedded scenes with exact
poses have 4e-5 at most, those with an estimator's errors and ragged masks 2.6e-2 at least
(docs/experiments/004-leaving-out.md)."""
FRAMES_TO_JUDGE = 10
"""Fewer frames of a whole person say too little about how well poses fit."""
SLIVER_SHARE = 3 * FITTING
"""Of the body: where poses fit, more than this outside the mask is hidden, however thin."""


@dataclass(frozen=True)
class Evidence:
    """What is known of a frame; masks are kept packed.

    Attributes:
        hidden: pixels inside the body that do not show the person, bool `[H, W]`.
        background: pixels taken for background, bool `[H, W]`.
        maybe_hidden: pixels that do not show the person and are not background for certain, since something hidden
            lies near or on both sides of them, bool `[H, W]`; by a thinner core, or all of the body where poses fit,
            and so more than `background` leaves.
        hidden_share: share of the body's core that is hidden, 0..1.
        occluded: whether that is more than errors of pose and mask explain.
        outside_share: share of the whole body that does not show the person, 0..1: more than its core tells of
            small errors of the pose.
    """

    hidden: Bits = Bits()  # noqa: RUF009
    background: Bits = Bits()  # noqa: RUF009
    maybe_hidden: Bits = Bits()  # noqa: RUF009
    hidden_share: float  # type: ignore[misc]  # a descriptor is no default
    occluded: bool  # type: ignore[misc]  # a descriptor is no default
    outside_share: float  # type: ignore[misc]  # a descriptor is no default


def person_size(body: Mask) -> float:
    """Returns the longer side of a mask's bounding box, pixels; 0 if it is empty."""
    rows, columns = np.flatnonzero(body.any(axis=1)), np.flatnonzero(body.any(axis=0))
    if not len(rows):
        return 0.0
    return float(max(rows[-1] - rows[0], columns[-1] - columns[0]) + 1)


def gather_evidence(bodies: Collection[Mask], visible: Collection[Mask]) -> list[Evidence]:
    """Returns the evidence of frames of one camera, poses judged by themselves.

    Args:
        bodies: the body's projection in each frame, bool `[H, W]`.
        visible: the paper's M of each.
    """
    fits = are_fitting(map(_shares, bodies, visible))
    return [evidence_of(body, seen, fits=fits) for body, seen in zip(bodies, visible, strict=True)]


def _shares(whole_body: Mask, whole_seen: Mask) -> tuple[float, float]:
    """Returns `Evidence.hidden_share` and `outside_share` of a frame."""
    window = _window(whole_body, whole_seen)
    body, seen = whole_body[window], whole_seen[window]
    return _hidden(body, seen, CORE * person_size(body))[1], _outside_share(body, seen)


def are_fitting(shares: Iterable[tuple[float, float]]) -> bool:
    """Returns whether poses need no mending, by `Evidence.hidden_share` and `outside_share` of frames."""
    missed = misfit([outside for hidden, outside in shares if hidden <= HIDDEN_SHARE])
    return missed is not None and missed < FITTING


def evidence_of(whole_body: Mask, whole_seen: Mask, *, fits: bool) -> Evidence:
    """Returns the evidence of a frame.

    Args:
        whole_body: the body's projection, bool `[H, W]`.
        whole_seen: the paper's M.
        fits: whether poses need no mending: `are_fitting`.
    """
    window = _window(whole_body, whole_seen)
    body, seen = whole_body[window], whole_seen[window]
    size = person_size(body)
    own_hidden, share = _hidden(body, seen, CORE * size)
    hidden, background, maybe = np.zeros_like(whole_seen), ~whole_seen, np.zeros_like(whole_seen)
    hidden[window] = own_hidden
    background[window] = ~seen & ~_unknown(_hidden_part(own_hidden, body, seen, size), seen, size)
    maybe[window] = _maybe_hidden(body, seen, size, fits)
    return Evidence(hidden, background, maybe, share, share > HIDDEN_SHARE, _outside_share(body, seen))


def _window(body: Mask, seen: Mask) -> tuple[slice, slice]:
    """Returns the rows and columns in which something may be hidden: about the body and what is seen, with room."""
    room = 2 + int(np.ceil(max(REACH, AROUND, GROWTH * CORE) * person_size(body)))
    there = body | seen
    if not there.any():
        return slice(None), slice(None)
    spans = (np.flatnonzero(there.any(axis=1)), np.flatnonzero(there.any(axis=0)))
    rows, columns = (slice(max(0, span[0] - room), span[-1] + 1 + room) for span in spans)
    return rows, columns


def misfit(outside_shares: Sequence[float]) -> float | None:
    """Returns how much of the body lies outside the mask in frames that show a whole person; None if they are few.

    Args:
        outside_shares: `Evidence.outside_share` of those frames.
    """
    return float(np.median(outside_shares)) if len(outside_shares) >= FRAMES_TO_JUDGE else None


def _outside_share(body: Mask, seen: Mask) -> float:
    return float((body & ~seen).sum()) / max(1, int(body.sum()))


def _hidden(body: Mask, seen: Mask, depth: float) -> tuple[Mask, float]:
    """Returns what is hidden of the body at least `depth` pixels inside its outline, and its share of that core."""
    core = _shrunk(body, depth)
    hidden, size = _without_specks(core & ~seen, depth), int(core.sum())
    return hidden, float(hidden.sum()) / size if size else 0.0


def _hidden_part(hidden: Mask, body: Mask, seen: Mask, size: float) -> Mask:
    """Returns the hidden part of the body up to its outline."""
    return _grown(hidden, GROWTH * CORE * size) & body & ~seen


def _maybe_hidden(body: Mask, seen: Mask, size: float, fits: bool) -> Mask:
    """Returns what may be hidden, in doubt rather more: also what lies between hidden parts.

    What is hidden of a person close together is hidden by one thing, and so is what lies between. Where poses fit, no
    core is needed: all of the body that is not seen is hidden.
    """
    if fits:
        part = body & ~seen
        occluded = _outside_share(body, seen) > SLIVER_SHARE
    else:
        hidden, share = _hidden(body, seen, THIN_CORE * size)
        part = _hidden_part(hidden, body, seen, size)
        occluded = share > HIDDEN_SHARE and bool(part.any())
    if not occluded:
        return np.zeros_like(seen)
    between = _grown(_hulls(part, REACH * size), AROUND * size)
    return _unknown(part, seen, size) | (between & ~seen)


def _hulls(mask: Mask, reach: float) -> Mask:
    """Returns the convex hull of each cluster of a mask, whose pixels are at most about `2 * reach` pixels apart."""
    count, labels = cv2.connectedComponents(_grown(mask, reach).astype(np.uint8))
    hulls = np.zeros(mask.shape, np.uint8)
    for label in range(1, count):
        rows, columns = np.nonzero(mask & (labels == label))
        corners = cv2.convexHull(np.stack([columns, rows], axis=1).astype(np.int32))
        cv2.fillConvexPoly(hulls, corners, 1)
    return hulls.astype(bool)


def _unknown(part: Mask, seen: Mask, size: float) -> Mask:
    """Returns what may be hidden: the hidden part of the body and what lies nearer to it than to what is seen."""
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
