"""How well a fitted body lies on key points and masks, which frames are doubtful, and pictures that show it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.fitting.anchors import landmark_places
from occfusion.fitting.batch import BodyBatch, rotations_of
from occfusion.fitting.solver import Solution
from occfusion.footage.landmarks import BONES, KeyPoints
from occfusion.geometry.zbuffer import rasterize_mesh
from occfusion.human import Body

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Picture = NDArray[np.uint8]

PREVIEW = 256
"""Longer side, pixels, at which projected body and mask are compared."""
TRUSTED_IOU, TRUSTED_PIXELS = 0.7, 4.0
"""A fit is trusted from this median overlap on, and up to this median error, in hundredths of the person's height."""
DOUBTFUL_IOU, DOUBTFUL_PIXELS = 0.55, 6.0
"""Frames beyond these are named."""
MIN_POINTS = 6
"""Fewer sure key points say nothing about a frame."""


@dataclass(frozen=True)
class Quality:
    """Figures of a fit.

    Attributes:
        pixels: median distance of sure key points from the body's, hundredths of the person's height, `[N]`; NaN where
            there are too few.
        iou: of projected body and mask, `[N]`; NaN where there is no mask.
        inside: share of the mask inside the body, `[N]`; NaN where there is no mask.
        partial: frames whose person is partly hidden, where `inside` counts and not `iou`, `[N]`.
    """

    pixels: Floats
    iou: Floats
    inside: Floats
    partial: NDArray[np.bool_]

    @property
    def overlap(self) -> Floats:
        """What counts of mask and body, `[N]`: the IoU, or the share inside where the person is partly hidden."""
        return np.where(self.partial, self.inside, self.iou)

    @property
    def doubtful(self) -> list[int]:
        """Frames whose body misses key points or mask, or about which nothing is known."""
        nothing = np.isnan(self.pixels) & np.isnan(self.iou)
        with np.errstate(invalid="ignore"):
            misses = (self.pixels > DOUBTFUL_PIXELS) | (self.overlap < DOUBTFUL_IOU)
        return [int(k) for k in np.flatnonzero(nothing | misses)]

    @property
    def trusted(self) -> bool:
        """Whether the fit as a whole lies on what was seen."""
        pixels, overlap = _median(self.pixels), _median(self.overlap)
        return (pixels is None or pixels <= TRUSTED_PIXELS) and (overlap is None or overlap >= TRUSTED_IOU)

    def summary(self) -> dict[str, float | None]:
        """Returns the medians, None where nothing was known."""
        return {
            "median_reprojection_percent_of_height": _median(self.pixels),
            "median_mask_iou": _median(self.iou),
            "median_mask_inside_body": _median(self.inside),
        }


def _median(values: Floats) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None


def covered_share(quality: Quality) -> float | None:
    """Returns which share of the projected body the masks cover, median over frames; None without masks."""
    iou, inside = quality.iou, quality.inside
    with np.errstate(divide="ignore", invalid="ignore"):
        # of IoU i and recall r of the mask: both / shown = 1 / (1 / i - 1 / r + 1)
        share = 1.0 / (1.0 / iou - 1.0 / inside + 1.0)
    known = share[np.isfinite(share)]
    return float(np.median(known)) if len(known) else None


def posed(body: Body, solution: Solution) -> Iterator[tuple[Floats, Floats]]:
    """Yields vertices `[V, 3]` and joints `[24, 3]` of each frame, in the camera, metres."""
    betas = torch.tensor(solution.betas, dtype=torch.float32)
    with torch.no_grad():
        for rows in zip(solution.global_orient, solution.body_pose, solution.transl, strict=True):
            vertices, joints = body(betas, *(torch.tensor(row, dtype=torch.float32) for row in rows))
            yield vertices.double().numpy(), joints.double().numpy()


def landmarks_of(body: Body, solution: Solution) -> Floats:
    """Returns where the landmarks of a fitted body are, `[N, 33, 3]`, metres."""
    betas, orient, pose, transl = (
        torch.tensor(part, dtype=torch.float32)
        for part in (solution.betas, solution.global_orient, solution.body_pose, solution.transl)
    )
    batch = BodyBatch(body, np.zeros(1, dtype=np.int64))
    return landmark_places(*batch.transforms(betas, rotations_of(orient, pose), transl)).double().numpy()


def silhouette(vertices: Floats, K: Floats, faces: NDArray[np.integer], shape: tuple[int, int]) -> Mask:
    """Returns what a body covers of a picture of `shape`, on a preview of at most `PREVIEW` pixels."""
    scale = min(1.0, PREVIEW / max(shape))
    height, width = (max(1, round(length * scale)) for length in shape)
    depth = vertices[:, 2]
    pixels = (
        vertices[:, :2] / np.where(depth > 0.05, depth, 1.0)[:, None] * [K[0, 0], K[1, 1]] + K[:2, 2]
    ) * scale
    return rasterize_mesh(pixels, depth, faces, width, height).face >= 0


def measure(
    body: Body,
    solution: Solution,
    points: KeyPoints,
    masks: Sequence[Mask] | None,
    hidden: Sequence[Mask] | None = None,
) -> Quality:
    """Returns how well the body lies on key points and masks."""
    K, marks = solution.K, landmarks_of(body, solution)
    flat = marks[..., :2] / np.maximum(marks[..., 2:], 0.05) * [K[0, 0], K[1, 1]] + K[:2, 2]
    tall = np.maximum(np.ptp(flat, axis=1).max(axis=1), 1.0)
    apart = np.linalg.norm(flat - points.pixels, axis=2) / tall[:, None] * 100.0
    sure = (points.confidence > 0.5) & (points.presence > 0)[:, None]
    count = len(points)
    pixels = np.array(
        [np.median(apart[k][sure[k]]) if sure[k].sum() >= MIN_POINTS else np.nan for k in range(count)]
    )
    iou, inside, partial = np.full(count, np.nan), np.full(count, np.nan), np.zeros(count, dtype=bool)
    if masks is not None:
        faces = body.faces.numpy()
        for k, (vertices, _) in enumerate(posed(body, solution)):
            if not masks[k].any():
                continue
            shown = silhouette(vertices, K, faces, masks[k].shape)
            mask = preview(masks[k], shown.shape)
            if hidden is not None and hidden[k].any():
                cover = preview(hidden[k], shown.shape)
                partial[k] = (shown & cover).sum() > 0.05 * shown.sum()
                shown = shown & ~cover
            both = float((shown & mask).sum())
            iou[k] = both / max(float((shown | mask).sum()), 1.0)
            inside[k] = both / max(float(mask.sum()), 1.0)
    return Quality(pixels, iou, inside, partial)


def preview(mask: Mask, shape: tuple[int, ...]) -> Mask:
    """Returns a mask made smaller, `shape`: where at least half of a pixel is in it."""
    small = cv2.resize(mask.astype(np.uint8) * 255, shape[::-1], interpolation=cv2.INTER_AREA)
    return np.asarray(small >= 128)


def overlay(
    picture: Picture,
    mask: Mask | None,
    vertices: Floats,
    K: Floats,
    faces: NDArray[np.integer],
    points: KeyPoints,
    frame: int,
) -> Picture:
    """Returns a picture with the mask's outline (green), the body (red, shaded by depth) and key points (yellow)."""
    shown = silhouette(vertices, K, faces, picture.shape[:2])
    large = cv2.resize(shown.astype(np.uint8), picture.shape[1::-1], interpolation=cv2.INTER_NEAREST) > 0
    out = picture.copy()
    out[large] = (0.55 * out[large] + 0.45 * np.array([230, 40, 40])).astype(np.uint8)
    thick = max(1, round(max(picture.shape[:2]) / 500))
    if mask is not None:
        contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(out, contours, -1, (40, 230, 40), thick)
    places = points.pixels[frame]
    sure = points.confidence[frame] > 0.5
    for a, b in BONES:
        if sure[a] and sure[b]:
            ends = [tuple(int(v) for v in places[k]) for k in (a, b)]
            cv2.line(out, ends[0], ends[1], (250, 220, 40), thick)
    return out
