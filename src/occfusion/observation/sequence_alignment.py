"""Alignment of the poses of a whole sequence, whatever its length.

A short one is one system of equations. Of a long one some parts are: they tell whether anything is to be corrected, how
far poses are off, and what is alike in all frames. The rest then follows piece by piece, so that memory does not grow
with the frames, and their time is that of two looks at some of them (docs/experiments/058-long-videos-again.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from occfusion.human.body import Body
from occfusion.human.pose_spline import PoseSpline
from occfusion.observation.aligner import LEAST_FRAMES, LOOKS_A_KNOT, Aligner, align_poses
from occfusion.observation.knot_spacing import frames_a_knot, likely_spacing, window
from occfusion.observation.pose_alignment import Alignment
from occfusion.observation.pose_witness import Look

ONE_SYSTEM = 240
"""Frames that are looked at, and a sequence with more is aligned piece by piece."""
PILOT, BLOCK = 48, 8
"""Looks of the parts that tell what is alike, and of one of them."""
PIECE, OVERLAP = 104, 4
"""Knots of a piece, and those beyond either end that are found with it and not taken."""


def align_sequence(
    look_at: Callable[[int], Look], frames: Sequence[int], body: Body, most: int, *, registered: bool
) -> Alignment | None:
    """Returns what outlines say of the poses of a sequence; None where they tell too little.

    Args:
        look_at: gives the look at a frame by its position.
        frames: numbers of the frames, ascending.
        body: of their poses.
        most: frames from one knot to the next, at most, but for long sequences.
        registered: shift and scale of the pictures are known.
    """
    count = len(frames)
    found = likely_spacing([look_at(k) for k in window(count)], body, most, registered=registered)
    every = frames_a_knot(count, found, most, (frames[-1] - frames[0]) / max(1, count - 1))
    positions, spline = positions_looked_at(count, every), PoseSpline.over(frames, every)
    if len(positions) <= ONE_SYSTEM:
        return align_poses([look_at(k) for k in positions], body, spline, registered=registered)
    pilot = Aligner(
        [look_at(positions[k]) for k in pilot_positions(len(positions))], body, spline, registered=registered
    )
    told = pilot.run(settling=1)  # pieces go on from there
    if told is None or not told.is_taken:
        return told
    turns, places, share = np.zeros_like(told.turns), np.zeros_like(told.places), np.zeros_like(told.told)
    for own, part in pieces(spline, [frames[k] for k in positions]):
        looks = [look_at(positions[k]) for k in part]
        piece = Aligner(looks, body, spline, registered=True, common=pilot.common)
        if piece.settle():
            piece.into(turns, places, share, own)
    return replace(told, turns=told.amount * turns, places=told.amount * places, told=share)


def positions_looked_at(count: int, every: int) -> list[int]:
    """Returns which of so many training frames are looked at: some of a long sequence, from its first to its last.

    Args:
        count: of the frames.
        every: frames from one knot to the next.
    """
    wanted = min(count, max(ONE_SYSTEM, LOOKS_A_KNOT * math.ceil(count / every)))
    return np.linspace(0, count - 1, wanted).round().astype(int).tolist()


def pilot_positions(count: int) -> list[int]:
    """Returns which of so many looks tell what is alike in all: blocks in a row, evenly spread, from first to last."""
    begins = np.linspace(0, count - BLOCK, PILOT // BLOCK).round().astype(int)
    return sorted({int(k) for begin in begins for k in range(begin, begin + BLOCK)})


def pieces(spline: PoseSpline, frames: Sequence[int]) -> Iterator[tuple[range, list[int]]]:
    """Yields the knots of each piece, and the positions of the frames by which they are found.

    Args:
        spline: of the sequence.
        frames: that are looked at, ascending.
    """
    first = [spline.weights_at(frame)[0] for frame in frames]
    for begin in range(0, spline.knots, PIECE):
        own = range(begin, min(begin + PIECE, spline.knots))
        near = [
            k
            for k, knot in enumerate(first)
            if own.start - OVERLAP <= knot and knot + 4 <= own.stop + OVERLAP
        ]
        if len(near) >= LEAST_FRAMES:
            yield own, near
