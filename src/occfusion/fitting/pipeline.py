"""From key points and masks to a measured fit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from occfusion.fitting.heading import exchanged, swapped_frames
from occfusion.fitting.quality import Quality, measure
from occfusion.fitting.solver import Problem, Solution, solve
from occfusion.footage.landmarks import KeyPoints
from occfusion.human import Body


@dataclass(frozen=True)
class Fit:
    """A fitted body with its figures.

    Attributes:
        solution: the body.
        quality: how well it lies on what was seen.
        points: the key points as used.
        swapped: frames whose left and right were exchanged.
    """

    solution: Solution
    quality: Quality
    points: KeyPoints
    swapped: list[int]


def fit_body(
    body: Body,
    points: KeyPoints,
    masks: Sequence[NDArray[np.bool_]] | None,
    K: NDArray[np.float64],
    seconds: Sequence[float],
    *,
    focal_known: bool = True,
    hidden: Sequence[NDArray[np.bool_]] | None = None,
    height: float | None = None,
    seed: int = 0,
    advance: Callable[[str], None] = lambda _: None,
) -> Fit:
    """Returns the body fitted to key points and masks.

    Args:
        body: with 24 joints and shape components.
        points: of N frames.
        masks: of the visible person; None without.
        K: intrinsics, `[3, 3]`.
        seconds: time of each frame.
        focal_known: whether the focal length is to stay as it is.
        hidden: where something stands before the person; None where nothing is known.
        height: of the person, metres, where it is known: pictures of one camera do not tell it.
        seed: of the little chance there is.
        advance: called at each step with the stage's name.

    Raises:
        DataError: too few frames show the trunk.
    """
    swapped = swapped_frames(points)
    used = exchanged(points, swapped)
    problem = Problem(used, masks, K, focal_known, seconds, hidden, height)
    solution = solve(body, problem, seed=seed, advance=advance)
    quality = measure(body, solution, used, masks, hidden)
    return Fit(solution, quality, used, [int(k) for k in np.flatnonzero(swapped)])
