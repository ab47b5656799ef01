"""Which pictures the rows of a refined pose track belong to, by their nearness to a table of all pictures.

A refinement moves a pose a little; another moment's pose is far away. So the ranges `start + step * row` are
compared by the mean squared distance between the rotations of all joints.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.data.pose_table import Motion
from occfusion.data.scene import Array

MIN_ROWS = 8
"""A shorter track could lie anywhere; it also bounds the number of ranges to compare."""

NEAR, FAR = 1.5, 2.0
"""A range agrees when its distance is at most `NEAR` times the smallest; others must have `FAR` times as much."""

_COMPARED_ROWS = 64
_TINY = 1e-9


@dataclass(frozen=True)
class Nearest:
    """The best range of each step.

    Attributes:
        by_step: smallest distance of a range with this step.
    """

    by_step: dict[int, float]

    @property
    def best(self) -> float:
        """The smallest distance of all; infinite where nothing could be compared."""
        return min(self.by_step.values(), default=np.inf)

    def agrees(self, table: Array, asked: range) -> bool:
        """Whether no other range is clearly nearer."""
        return not self.by_step or _mean(table, asked) <= NEAR * self.best + _TINY

    def from_the_first(self, table: Array) -> range | None:
        """Returns the range from picture 0 on, where it is the one near and all other steps are far; else None."""
        if not self.by_step:
            return None
        step = min(self.by_step, key=lambda k: self.by_step[k])
        others = [far for other, far in self.by_step.items() if other != step]
        asked = range(0, step * (len(table) - 1) + 1, step)
        alone = all(far >= FAR * self.best + _TINY for far in others)
        return asked if alone and self.agrees(table, asked) else None


def distances(track: Motion, every: Motion) -> Array:
    """Returns the mean squared distance between the joints' rotations, `[rows, pictures]`.

    Args:
        track: the poses whose pictures are looked for.
        every: poses of all pictures.
    """
    a, b = _rotations(track), _rotations(every)
    squared = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1)[None] - 2 * a @ b.T
    return np.asarray(np.maximum(squared, 0.0) / a.shape[1])


def nearest(table: Array) -> Nearest:
    """Returns the smallest mean distance of each step, of a table as `distances` gives it."""
    rows, pictures = table.shape
    found: dict[int, float] = {}
    if rows >= MIN_ROWS and np.isfinite(table).all():
        compared = _compared(rows)
        for step in possible_steps(rows, pictures):
            starts = np.arange(pictures - step * (rows - 1))[:, None]
            found[step] = float(table[compared, starts + step * compared].mean(axis=1).min())
    return Nearest(found)


def possible_steps(rows: int, pictures: int) -> range:
    """Returns the steps with which `rows` rows fit into `pictures` pictures."""
    return range(1, (pictures - 1) // (rows - 1) + 1) if rows > 1 else range(1, 2)


def _compared(rows: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, rows - 1, _COMPARED_ROWS).round()).astype(np.int64)


def _mean(table: Array, asked: range) -> float:
    rows = _compared(len(table))
    return float(table[rows, asked.start + asked.step * rows].mean())


def _rotations(motion: Motion) -> Array:
    turns = np.concatenate([motion.global_orient, motion.body_pose], axis=1).reshape(-1, 3)
    matrices = [cv2.Rodrigues(turn)[0] for turn in turns]
    return np.asarray(matrices, dtype=np.float64).reshape(len(motion), -1)
