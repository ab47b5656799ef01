"""The fit itself: all frames of a clip at once, from the trunk to the whole body to its outline.

Robust errors are those of Geman and McClure, as in SMPLify (Bogo et al. 2016, eq. 2): what lies far off counts less
and less.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from occfusion.errors import DataError
from occfusion.fitting.anchors import SPREADS, landmark_places
from occfusion.fitting.batch import BodyBatch, height_at_rest, rotations_of, spread_vertices
from occfusion.fitting.heading import (
    MIN_CONFIDENCE,
    TRUNK,
    facing,
    flat_turn,
    heights,
    hidden_headings,
    trunk_turn,
    upright,
)
from occfusion.fitting.outline import mask_field
from occfusion.fitting.prior import beyond_limits, mean_pose, unlikely
from occfusion.footage.landmarks import INDEX, KeyPoints
from occfusion.human import Body

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

NEAR = 2
"""Frames whose trunk is hidden, up to so far from one that shows it, are started from it alone."""
POINTS = 900
"""Vertices that stand for the body's outline."""


@dataclass(frozen=True)
class Weights:
    """Weights of the terms; pixel errors are in hundredths of the person's height in the picture.

    Attributes:
        pixels: of key points in the picture.
        scale: distance, in hundredths of the height, at which a key point is half believed.
        world: of key points in space, per decimetre squared.
        pose: of the learned pose prior.
        limits: of joints beyond their limits.
        smooth: of the accelerations of joints, per decimetre a frame squared, squared.
        turning: of changes of rotations between frames.
        shape: of the shape components.
        feet: of standing feet that move.
        outside: of the body outside of the mask.
        edge: of the mask's outline away from the body's.
        focal: of the focal length's logarithm, where it was guessed.
        height: of the body's height away from the person's, in hundredths, squared; where that is known.
    """

    pixels: float = 1.0
    scale: float = 3.0
    world: float = 4.0
    pose: float = 0.1
    limits: float = 20.0
    smooth: float = 1.0
    turning: float = 0.3
    shape: float = 0.1
    feet: float = 2.0
    outside: float = 2.0
    edge: float = 2.0
    focal: float = 20.0
    height: float = 1.0


SEEN_IN_SPACE = Weights(smooth=5.0)
"""Where a landmark model says places in space: such key points are about 1 % of the height off, more than files of
key points alone, and a fit that follows them closely follows their noise."""


@dataclass(frozen=True)
class Problem:
    """What a body is fitted to.

    Attributes:
        points: key points of N frames, left and right put right.
        masks: of the visible person, `[H, W]` each; None without.
        K: intrinsics, `[3, 3]`.
        focal_known: whether the focal length is to stay as it is.
        seconds: time of each frame; frames a tenth of a second apart count as neighbours.
        hidden: where something stands before the person, as masks; None where nothing is known.
        height: of the person, metres; None: not known, and told by the shape that most people have.
    """

    points: KeyPoints
    masks: Sequence[Mask] | None
    K: Floats
    focal_known: bool
    seconds: Sequence[float]
    hidden: Sequence[Mask] | None = None
    height: float | None = None


@dataclass
class Solution:
    """A fitted body.

    Attributes:
        betas: `[10]`.
        global_orient: `[N, 3]`, radians.
        body_pose: `[N, 69]`, radians.
        transl: `[N, 3]`, metres, in the camera.
        K: intrinsics, `[3, 3]`.
        losses: the loss at the end of each stage.
    """

    betas: Floats
    global_orient: Floats
    body_pose: Floats
    transl: Floats
    K: Floats
    losses: dict[str, float] = field(default_factory=dict)


@dataclass
class _State:
    betas: Tensor
    orient: Tensor
    pose: Tensor
    transl: Tensor
    log_focal: Tensor


def solve(
    body: Body,
    problem: Problem,
    *,
    seed: int = 0,
    advance: Callable[[str], None] = lambda _: None,
) -> Solution:
    """Returns the body that fits key points and masks best, with one shape for all frames.

    The terms have the weights of `Weights`, or `SEEN_IN_SPACE` where there are landmarks in space.

    Raises:
        DataError: fewer than two frames have a trunk to start from.
    """
    torch.manual_seed(seed)
    fit = _Fit(body, problem, Weights() if problem.points.world is None else SEEN_IN_SPACE)
    state = fit.start()
    losses = {}
    for name, steps, rate, free, terms in (
        ("place", 60, 0.05, ("orient", "transl"), ()),
        ("pose", 160, 0.04, ("orient", "transl", "pose", "betas"), ()),
        ("outline", 160, 0.02, ("orient", "transl", "pose", "betas", "log_focal"), ("masks",)),
        ("finish", 80, 0.006, ("orient", "transl", "pose", "betas", "log_focal"), ("masks",)),
    ):
        losses[name] = fit.descend(state, steps, rate, free, frozenset(terms), partial(advance, name))
    K = problem.K.copy()
    K[[0, 1], [0, 1]] *= float(state.log_focal.exp())
    betas, orient, pose, transl = (
        t.detach().double().numpy() for t in (state.betas, state.orient, state.pose, state.transl)
    )
    return Solution(betas, orient, pose, transl, K, losses)


class _Fit:
    def __init__(self, body: Body, problem: Problem, weights: Weights) -> None:
        self.problem, self.weights, self.body = problem, weights, body
        points = problem.points
        self.batch = BodyBatch(body, spread_vertices(body, POINTS))
        self.count = len(points)
        self.components = min(10, body.num_betas)
        K = problem.K
        self.focal = torch.tensor([K[0, 0], K[1, 1]], dtype=torch.float32)
        self.middle = torch.tensor(K[:2, 2], dtype=torch.float32)
        self.pixels = torch.tensor(points.pixels, dtype=torch.float32)
        sure = (
            np.where(points.confidence > MIN_CONFIDENCE, points.confidence, 0.0)
            * (points.presence > 0)[:, None]
        )
        self.sure = (
            torch.tensor(sure, dtype=torch.float32) * (0.02 / torch.tensor(SPREADS)).clamp(max=2.0) ** 2
        )
        self.height = torch.tensor(heights(points), dtype=torch.float32)
        gaps = np.maximum(np.diff(np.asarray(problem.seconds, dtype=np.float64)), 1e-3)
        self.close = torch.tensor(np.clip(0.1 / gaps, 0.1, 3.0), dtype=torch.float32)
        self.world = None if points.world is None else torch.tensor(points.world, dtype=torch.float32)
        self.standing = self._standing()
        if problem.masks is not None:
            self._prepare_masks(problem.masks, problem.hidden)

    def start(self) -> _State:
        """Returns orientation and place of the trunk in each frame, from its landmarks in space or in the picture."""
        points = self.problem.points
        good = (points.confidence[:, TRUNK] > MIN_CONFIDENCE).all(axis=1) & (points.presence > 0)
        if good.sum() < 2:
            raise DataError(
                f"shoulders and hips are seen in {int(good.sum())} of {self.count} frames: there is nothing to start "
                "a fit from. Give frames that show the trunk."
            )
        from scipy.spatial.transform import Rotation, Slerp

        frames = np.flatnonzero(good)
        if points.world is not None:
            turns = np.stack([trunk_turn(points.world[k]) for k in frames])
        else:
            turns = np.stack([flat_turn(points, int(k)) for k in frames])
        focal = self.problem.K[0, 0]
        length = 0.5 * self.size()  # metres between the middles of shoulders and hips
        trunk = points.pixels[frames][:, TRUNK]
        seen = np.linalg.norm(trunk[:, :2].mean(axis=1) - trunk[:, 2:].mean(axis=1), axis=1)
        tilt = np.sqrt(np.clip(1 - turns[:, 2, 1] ** 2, 0.15, 1.0))
        depth = focal * length * tilt / np.maximum(seen, 1.0)
        depth = np.median(depth) * (0.3 + 0.7 * np.clip(depth / np.median(depth), 0.6, 1.6))
        hips = trunk[:, 2:].mean(axis=1)
        every = np.arange(self.count)
        if len(frames) < self.count:
            # of frames without a trunk the limbs say heading and place
            away = np.interp(every, frames, depth)
            known = {int(k): facing(turn) for k, turn in zip(frames, turns, strict=True)}
            shape = torch.zeros(self.components)
            headings, middles = hidden_headings(points, known, focal / away, self.batch, mean_pose(), shape)
            far = np.abs(every[:, None] - frames).min(axis=1) > NEAR
            told = np.flatnonzero(np.isfinite(headings) & far)
            order = np.argsort(np.concatenate([frames, told]))
            extra = [upright(headings[k]) for k in told]
            turns = np.concatenate([turns, np.reshape(extra, (-1, 3, 3))])[order]
            depth = np.concatenate([depth, away[told]])[order]
            hips = np.concatenate([hips, middles[told]])[order]
            frames = np.concatenate([frames, told])[order]
        rotation = Rotation.from_matrix(turns)
        orient = Slerp(frames, rotation)(np.clip(every, frames[0], frames[-1])).as_rotvec()
        place = np.column_stack([(hips - self.problem.K[:2, 2]) / focal * depth[:, None], depth])
        transl = np.stack([np.interp(every, frames, place[:, k]) for k in range(3)], axis=1)
        pelvis = self.batch.joints_at_rest(torch.zeros(self.components))[0].numpy()
        return _State(
            torch.zeros(self.components),
            torch.tensor(orient, dtype=torch.float32),
            mean_pose().repeat(self.count, 1),
            torch.tensor(transl - pelvis, dtype=torch.float32),
            torch.zeros(()),
        )

    def size(self) -> float:
        """Returns how much larger than the middle one the person is known to be."""
        if self.problem.height is None:
            return 1.0
        return self.problem.height / float(height_at_rest(self.body, torch.zeros(self.components)))

    def descend(
        self,
        state: _State,
        steps: int,
        rate: float,
        free: Sequence[str],
        terms: frozenset[str],
        advance: Callable[[], None],
    ) -> float:
        """Moves the named parts of a state downhill; returns the last loss."""
        if self.problem.focal_known:
            free = [name for name in free if name != "log_focal"]
        if self.problem.masks is None:
            terms = terms - {"masks"}
        parameters = [getattr(state, name).requires_grad_(True) for name in free]
        rates = [
            {"params": [p], "lr": rate * (0.3 if n == "log_focal" else 1.0)}
            for n, p in zip(free, parameters, strict=True)
        ]
        optimizer = torch.optim.Adam(rates, betas=(0.9, 0.98))
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps, eta_min=0.1 * rate)
        value = 0.0
        for step in range(steps):
            optimizer.zero_grad(set_to_none=True)
            loss = self.loss(state, terms, step)
            loss.backward()
            value = float(loss.detach())
            optimizer.step()
            schedule.step()
            advance()
        for parameter in parameters:
            parameter.requires_grad_(False)
        return value

    def loss(self, state: _State, terms: frozenset[str], step: int) -> Tensor:
        """Returns the weighted sum of all terms, a mean over frames."""
        w = self.weights
        rotations = rotations_of(state.orient, state.pose)
        turns, places = self.batch.transforms(state.betas, rotations, state.transl)
        marks = landmark_places(turns, places)
        gap = (self.project(marks, state) - self.pixels) / self.height[:, None, None] * 100.0
        squared = (gap**2).sum(dim=-1)
        total = w.pixels * (self.sure * w.scale**2 * squared / (squared + w.scale**2)).sum(dim=1).mean()
        if self.world is not None:
            total = total + w.world * self._in_space(marks)
        total = total + w.pose * unlikely(state.pose).mean() + w.limits * beyond_limits(state.pose).mean()
        total = total + w.shape * (state.betas**2).sum() + w.focal * state.log_focal**2
        if self.problem.height is not None:
            off = 100.0 * (height_at_rest(self.body, state.betas) / self.problem.height - 1.0)
            total = total + w.height * off**2
        total = total + self._motion(turns, places)
        if "masks" in terms:
            total = total + self._outline(state, turns, places, step)
        return total

    def project(self, points: Tensor, state: _State) -> Tensor:
        """Returns the pixels of camera points `[..., 3]`, `[..., 2]`."""
        depth = points[..., 2:].clamp(min=0.1)
        return points[..., :2] / depth * self.focal * state.log_focal.exp() + self.middle

    def _in_space(self, marks: Tensor) -> Tensor:
        """Landmarks relative to the middle of the hips, one scale for all frames, robust."""
        assert self.world is not None
        hips = [INDEX["left_hip"], INDEX["right_hip"]]
        ours = marks - marks[:, hips].mean(dim=1, keepdim=True)
        theirs = self.world
        sure = self.sure.clamp(max=1.0)[..., None]
        # the models' people are of middle size: the scale of this one is taken from the fit itself
        scale = (sure * ours * theirs).sum() / (sure * theirs * theirs).sum().clamp(min=1e-6)
        gap = (ours - scale.detach() * theirs) * 10.0
        squared = (gap**2).sum(dim=-1)
        return (sure[..., 0] * squared / (1 + squared / 4.0)).sum(dim=1).mean()

    def _motion(self, turns: Tensor, places: Tensor) -> Tensor:
        w = self.weights
        total = places.new_zeros(())
        if self.count > 2:
            close = torch.minimum(self.close[1:], self.close[:-1])[:, None, None]
            speed = (places[1:] - places[:-1]) * 10.0
            total = total + w.smooth * (close * (speed[1:] - speed[:-1]) ** 2).sum(dim=(1, 2)).mean() / 4.0
        if self.count > 1:
            change = turns[1:] - turns[:-1]
            total = (
                total
                + w.turning * (self.close[:, None, None, None] * change**2).sum(dim=(1, 2, 3)).mean() / 4.0
            )
            feet = places[:, [7, 8, 10, 11]]
            slide = ((feet[1:] - feet[:-1]) * 10.0).square().sum(dim=-1)
            total = total + w.feet * (self.standing * slide).sum(dim=1).mean()
        return total

    def _standing(self) -> Tensor:
        """How surely each of ankles and toes stays where it is from a frame to the next, `[N - 1, 4]`."""
        names = ("left_ankle", "right_ankle", "left_foot_index", "right_foot_index")
        chosen = [INDEX[name] for name in names]
        step = (
            (self.pixels[1:, chosen] - self.pixels[:-1, chosen]).norm(dim=-1) / self.height[1:, None] * 100.0
        )
        sure = torch.minimum(self.sure[1:, chosen], self.sure[:-1, chosen]).clamp(max=1.0)
        return sure * torch.exp(-((step / 0.8) ** 2))

    def _prepare_masks(self, masks: Sequence[Mask], hidden: Sequence[Mask] | None) -> None:
        """Keeps each mask's distance field about the person, and points of its outline."""
        covers: Sequence[Mask | None] = [None] * len(masks) if hidden is None else hidden
        fields, corners, steps, edges = zip(*map(mask_field, masks, covers), strict=True)
        self.fields = torch.tensor(np.stack(fields))[:, None]
        self.corners = torch.tensor(np.stack(corners), dtype=torch.float32)
        self.steps = torch.tensor(steps, dtype=torch.float32)
        self.edges = torch.tensor(np.stack(edges), dtype=torch.float32)
        self.has_mask = torch.tensor([float(mask.any()) for mask in masks], dtype=torch.float32)

    def _outline(self, state: _State, turns: Tensor, places: Tensor, step: int) -> Tensor:
        w = self.weights
        pixels = self.project(self.batch.points(state.betas, turns, places), state)
        unit = self.height[:, None] / 100.0
        side = self.fields.shape[-1]
        grid = (pixels - self.corners[:, None]) / self.steps[:, None, None] / side * 2 - 1
        away = (
            torch.nn.functional.grid_sample(
                self.fields, grid[:, None], padding_mode="border", align_corners=False
            )[:, 0, 0]
            / unit
        )
        outside = (away**2 / (1 + away**2 / 25.0)).mean(dim=1)
        if step % 4 == 0 or not hasattr(self, "_nearest"):
            with torch.no_grad():
                self._nearest = torch.cdist(self.edges, pixels).argmin(dim=2)
        chosen = torch.gather(pixels, 1, self._nearest[..., None].expand(-1, -1, 2))
        gap = ((chosen - self.edges) ** 2).sum(dim=-1).clamp(min=1e-6).sqrt() / unit
        edge = (gap**2 / (1 + gap**2 / 25.0)).mean(dim=1)
        return (self.has_mask * (w.outside * outside + w.edge * edge)).mean() * 10.0
