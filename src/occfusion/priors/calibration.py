"""Fits a prior's answers to the scene at hand, on what the scene itself shows.

Parts of the person that are seen are hidden on purpose, the prior completes them, and a logistic regression learns
how its answer and the body mesh, with the clothes worn over it, are best combined to predict what is there. An exact
body then counts for much, a poor one for little, and loose clothes are met where they are worn.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.data.sampling import spread
from occfusion.human.body import Body
from occfusion.observation.clothes import CLOTHES_VIEWS, NEAR, measure_thickness, outline_of
from occfusion.observation.evidence import Evidence, person_size
from occfusion.observation.frames import ObservedFrame, ObservedFrames
from occfusion.priors.logistic import fit_logistic, sigmoid
from occfusion.priors.masks import MaskPrior, checked_probability
from occfusion.types import Camera, Frame

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

FRAMES = 16
"""On which the calibration is fitted."""
SHIFT = 0.25
"""Of the person's size: how far a borrowed occluder may stand from where it was."""
SCALE = 0.02
"""Metres: the unit of distance in the regression."""
MAX_LOGIT = 6.0
STRENGTH = 30.0
"""Of the prior belief that the prior's answer alone is right, in pixels."""
STILL = (1.0, 0.0, 0.0)


@dataclass(frozen=True)
class Calibration:
    """How an answer is corrected: `sigmoid(w0 logit(p) + w1 s / SCALE + w2)`, s the distance into the clothed body.

    Attributes:
        weights: w0, w1, w2.
        thickness: how far clothes stand off at each vertex of the body, `[V]`, metres.
        pixels: hidden on purpose, that it was fitted to.
        before: IoU on those pixels of the answer alone.
        after: IoU of the corrected answer; of the same pixels, so it is no figure of quality.
    """

    weights: tuple[float, float, float]
    thickness: Floats
    pixels: int = 0
    before: float | None = None
    after: float | None = None

    def describe(self) -> dict[str, Any]:
        """Returns what was fitted, for the manifest."""
        return {
            "weights": [round(w, 4) for w in self.weights],
            "thickness_mm": round(1000.0 * float(self.thickness.mean()), 2),
            "pixels": self.pixels,
            "iou_before": self.before,
            "iou_after": self.after,
        }

    def apply(
        self, probability: NDArray[np.float32], observed_frame: ObservedFrame, camera: Camera, body: Body
    ) -> NDArray[np.float32]:
        """Returns the corrected probability, `[H, W]`."""
        if self.weights == STILL:
            return probability
        outline = outline_of(observed_frame, camera, body)
        scores = _features(probability, outline.depth_inside(self.thickness)) @ np.array(self.weights)
        return sigmoid(scores).astype(np.float32)


def _features(probability: NDArray[np.floating], depth_inside: Floats) -> Floats:
    p = np.clip(np.asarray(probability, np.float64), 1e-6, 1.0 - 1e-6)
    logit = np.clip(np.log(p / (1.0 - p)), -MAX_LOGIT, MAX_LOGIT)
    return np.stack([logit, np.clip(depth_inside, -NEAR, NEAR) / SCALE, np.ones_like(p)], axis=-1)


def calibrate(
    prior: MaskPrior, observed_frames: ObservedFrames, read: Callable[[int], Frame], body: Body
) -> Calibration:
    """Returns the calibration of a prior to a scene; the prior's answer is left as it is where nothing can be learnt.

    Args:
        prior: to be calibrated.
        observed_frames: of all training frames, in order.
        read: gives the training frame at a position.
        body: of the scene.
    """
    looks = spread(len(observed_frames), CLOTHES_VIEWS)
    thickness = measure_thickness(observed_frames, read, body, looks)
    judged = observed_frames.sample
    occluded = [k for k in judged if observed_frames[k].evidence.occluded]
    shown = sorted(judged, key=lambda k: observed_frames[k].evidence.hidden_share)
    shown = sorted(shown[: 2 * FRAMES])
    chosen = shown[:: max(1, len(shown) // FRAMES)][:FRAMES]
    rng = np.random.default_rng(0)
    rows, labels = [], []
    for position in chosen:
        observed_frame, frame = observed_frames[position], read(position)
        borrowed = observed_frames[int(rng.choice(occluded))]
        hidden = _borrowed(borrowed, observed_frame, rng)
        visible = frame.visible_mask.cpu().numpy()
        known = visible | observed_frame.evidence.background
        observation = observed_frame.observation(frame, body)
        observation = replace(
            observation, visible=visible & ~hidden, background=observed_frame.evidence.background & ~hidden
        )
        answer = checked_probability(prior, observation)
        depth = outline_of(observed_frame, frame.camera, body).depth_inside(thickness)
        asked = hidden & known & (np.abs(depth) < NEAR)
        rows.append(_features(answer[asked], depth[asked]))
        labels.append(visible[asked])
    x, y = np.concatenate(rows), np.concatenate(labels)
    if len(y) < 100 or y.all() or not y.any():
        return Calibration(STILL, thickness, len(y))
    weights = fit_logistic(x, y, np.array(STILL), STRENGTH)
    return Calibration(
        weights=(float(weights[0]), float(weights[1]), float(weights[2])),
        thickness=thickness,
        pixels=len(y),
        before=_iou(x[:, 0] > 0.0, y),
        after=_iou(x @ weights > 0.0, y),
    )


def _borrowed(occluded: ObservedFrame, observed_frame: ObservedFrame, rng: np.random.Generator) -> Mask:
    """Returns what is unknown of one frame, moved with the body to about where it is in another."""
    unknown = _unknown(occluded.evidence)
    places = [each.projected.pixels for each in (occluded, observed_frame)]
    middle = [0.5 * (pixels.min(axis=0) + pixels.max(axis=0)) for pixels in places]
    size = person_size(observed_frame.evidence.hidden | ~observed_frame.evidence.background)
    shift = middle[1] - middle[0] + SHIFT * size * rng.uniform(-1.0, 1.0, 2)
    move = np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]]])
    moved = cv2.warpAffine(unknown.astype(np.uint8), move, unknown.shape[::-1], flags=cv2.INTER_NEAREST)
    return moved.astype(bool)


def _unknown(evidence: Evidence) -> Mask:
    return cv2.dilate(evidence.hidden.astype(np.uint8), np.ones((3, 3), np.uint8), iterations=3).astype(bool)


def _iou(a: Mask, b: Mask) -> float:
    return round(float((a & b).sum() / max(1, (a | b).sum())), 4)
