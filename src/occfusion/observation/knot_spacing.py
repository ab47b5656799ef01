"""How far apart knots of the corrections of poses lie."""

from __future__ import annotations

import math
from collections.abc import Sequence

from occfusion.human.body import Body
from occfusion.human.pose_spline import PoseSpline
from occfusion.observation.aligner import LEAST_FRAMES, Aligner
from occfusion.observation.pose_witness import REACH, Look

WINDOW = 50
"""Frames in a row that are asked: enough to tell, and their cost is bounded."""
FULL_KNOTS, WIDEST, MOST_KNOTS = 120, 8, 500
"""Knots from which on they lie farther apart, up to so many frames of the video; knots from which on farther still.
What an estimator gets wrong changes within some frames: with 17 from knot to knot next to nothing of it was found."""


def window(count: int) -> range:
    """Returns the positions, among so many training frames, that tell the spacing: those in the middle."""
    begin = max(0, (count - WINDOW) // 2)
    return range(begin, min(begin + WINDOW, count))


def likely_spacing(looks: Sequence[Look], body: Body, most: int, *, registered: bool = False) -> int:
    """Returns how many frames lie from knot to knot as outlines make most likely: `most`, its half, its quarter.

    Frames that lie far apart in time are off in ways that have nothing to do with each other. A spline with few knots
    then swings between them, along the line of sight above all, and fits outlines as well as one with a knot a frame;
    what outlines would look like whatever the corrections are (their evidence) tells the two apart. It is asked of the
    first look, before anything is corrected.

    Args:
        looks: at frames in a row, in order of time.
        body: of their poses.
        most: frames from one knot to the next, at least 1.
        registered: shift and scale of the pictures are known.
    """
    asked = sorted({max(1, most // part) for part in (1, 2, 4)})
    if len(looks) < LEAST_FRAMES or len(asked) == 1:
        return most
    frames = [look.index for look in looks]
    aligners = {
        every: Aligner(looks, body, PoseSpline.over(frames, every), registered=registered) for every in asked
    }
    seen = aligners[asked[0]].observe(range(len(looks)), 2.0 * REACH)
    if len(seen) < LEAST_FRAMES:
        return most
    evidence, weighed = {}, None
    for every in asked:  # the finest fits best: where it does not, something else is wrong than poses
        evidence[every], weighed = aligners[every].likelihood(seen, weighed)
    return max(asked, key=lambda every: evidence[every])


def frames_a_knot(count: int, found: int, most: int, stride: float = 1.0) -> int:
    """Returns how many of so many frames lie between knots.

    Args:
        count: of the training frames.
        found: how many outlines make most likely.
        most: how many were asked at most; where they are likely, long sequences have more.
        stride: frames of the video from one training frame to the next.
    """
    widest = max(1, int(WIDEST / stride))
    least = math.ceil(count / MOST_KNOTS)
    return max(found, least) if found < most else max(most, min(widest, math.ceil(count / FULL_KNOTS)), least)
