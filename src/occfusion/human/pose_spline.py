"""Corrections of a sequence's poses frame by frame: what an estimator got wrong, as smooth functions of time."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from occfusion.files.bodyfile import NUM_JOINTS
from occfusion.geometry.rotation import axis_angle_to_matrix

ROUNDING = 1e-9
"""Of a place counted in knots: the last frame belongs to the range whatever a division makes of it."""


class PoseSpline(nn.Module):
    """Turns of all 24 joints and a shift of the whole body along a sequence, uniform cubic B-splines.

    `PoseRefiner` corrects a pose by what the pose is, so that it serves poses of other sequences too; the errors of
    an estimator, though, belong to frames, wander from one to the next, and have the root's among them. A spline
    starts at no correction at all, is twice continuously differentiable, and lets frames that show a limb speak for
    their neighbours that do not. Frames outside its range are left as given.

    Args:
        first: number of the first frame of the range.
        spacing: frames between two knots.
        knots: how many, at least 4; the range is `knots - 3` spacings long.
        aligned: it begins at what `start_at` gives it, and each number learns as fast as its reach lets it: Adam moves
            all parameters alike, angles that the video tells and angles that it does not.
    """

    base_turns: Tensor | None
    base_places: Tensor | None
    turn_reach: Tensor | None
    place_reach: Tensor | None

    def __init__(self, first: float, spacing: float, knots: int, aligned: bool = False) -> None:
        super().__init__()
        if not spacing > 0 or knots < 4:
            raise ValueError(
                f"a cubic spline needs 4 knots and a positive spacing, got {knots} and {spacing:g}"
            )
        self.first = first
        self.spacing = spacing
        self.turns = nn.Parameter(torch.zeros(knots, NUM_JOINTS, 3))
        self.places = nn.Parameter(torch.zeros(knots, 3))
        for name, like in (("turn", self.turns), ("place", self.places)):
            self.register_buffer(f"base_{name}s", torch.zeros_like(like) if aligned else None)
            self.register_buffer(f"{name}_reach", torch.ones_like(like) if aligned else None)

    @property
    def aligned(self) -> bool:
        """Whether it began at something else than nothing, with reaches."""
        return self.base_turns is not None

    def start_at(self, turns: Tensor, places: Tensor, turn_reach: Tensor, place_reach: Tensor) -> None:
        """Gives an aligned spline its beginning, `[K, 24, 3]` and `[K, 3]`, and how fast each may learn, 0 to 1."""
        own = (self.base_turns, self.base_places, self.turn_reach, self.place_reach)
        for buffer, value in zip(own, (turns, places, turn_reach, place_reach), strict=True):
            if buffer is None:
                raise ValueError("a spline that was not made as `aligned` begins at nothing")
            buffer.copy_(value)

    @classmethod
    def over(cls, frames: Sequence[int], every: int) -> PoseSpline:
        """Returns the spline whose range is exactly that of `frames`, with a knot for about every `every`-th of them.

        Args:
            frames: numbers of the frames that are trained on, ascending, at least one.
            every: frames of that list from one knot to the next.
        """
        pieces = max(math.ceil((len(frames) - 1) / every), 1)
        return cls(frames[0], (frames[-1] - frames[0]) / pieces or 1.0, pieces + 3)

    @property
    def knots(self) -> int:
        """How many knots there are."""
        return len(self.turns)

    def covers(self, frame_index: float) -> bool:
        """Returns whether a frame lies in the range."""
        return 0.0 <= (frame_index - self.first) / self.spacing <= self.knots - 3 + ROUNDING

    def weights_at(self, frame_index: float) -> tuple[int, tuple[float, ...]]:
        """Returns the first of the four knots that a frame of the range knows, and how much each of them counts."""
        place = (frame_index - self.first) / self.spacing
        start = min(int(place), self.knots - 4)  # the end of the range belongs to the last piece
        u = place - start
        parts = (1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, 1 + 3 * u + 3 * u**2 - 3 * u**3, u**3
        return start, tuple(part / 6 for part in parts)

    def at(self, frame_index: float) -> tuple[Tensor, Tensor]:
        """Returns the turns as axis-angles `[24, 3]`, radians, and the shift `[3]`, metres; zeros outside the range."""
        if not self.covers(frame_index):
            return torch.zeros_like(self.turns[0]), torch.zeros_like(self.places[0])
        start, shares = self.weights_at(frame_index)
        weights = self.turns.new_tensor(shares)
        turns, places = self.turns[start : start + 4], self.places[start : start + 4]
        if self.base_turns is not None:
            assert (
                self.base_places is not None and self.turn_reach is not None and self.place_reach is not None
            )
            turns = self.base_turns[start : start + 4] + self.turn_reach[start : start + 4] * turns
            places = self.base_places[start : start + 4] + self.place_reach[start : start + 4] * places
        return weights @ turns.transpose(0, 1), weights @ places

    def forward(self, frame_index: float, rotations: Tensor, transl: Tensor) -> tuple[Tensor, Tensor]:
        """Returns rotations with the turns multiplied from the right, and the translation with the shift added.

        Args:
            frame_index: number of the frame.
            rotations: of the joints, `[24, 3, 3]`; on the host or where the spline is, and so is what comes back.
            transl: of the body, `[3]`, metres.
        """
        turns, shift = self.at(frame_index)
        both = torch.cat([turns, shift[None]]).to(rotations)  # one copy: the host waits for each
        return rotations @ axis_angle_to_matrix(both[:-1], compiled=True), transl + both[-1]
