"""The initialisation stage: complete masks from partial ones (paper §4.1)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.data.sampling import evenly
from occfusion.files.atomic import write_png
from occfusion.files.images import read_mask
from occfusion.files.run_folder import FrameFolder, frame_name
from occfusion.human.body import Body
from occfusion.observation.consistency import body_flow, smoothed, warped_iou
from occfusion.observation.frames import ObservedFrames
from occfusion.priors.calibration import Calibration, calibrate
from occfusion.priors.masks import MaskPrior, checked_probability, with_what_is_known
from occfusion.settings.stages import InitSettings
from occfusion.stages.framewise import FramewiseStage
from occfusion.types import Frame

REMEMBERED = 3
"""Positions to either side whose probabilities are kept for smoothing."""


def frames_to_complete(observed_frames: ObservedFrames, most: int | None) -> list[int]:
    """Returns positions of the frames that are given complete masks: all, or of more occluded ones so many.

    Args:
        observed_frames: of all training frames, in order.
        most: occluded frames, evenly spread; frames of a whole person are left out then. None: all frames.
    """
    every = range(len(observed_frames))
    if most is None:
        return list(every)
    for positions in (observed_frames.sample, every):  # all are looked at where some do not suffice
        occluded = [k for k in positions if observed_frames[k].evidence.occluded]
        if len(occluded) > most:
            return evenly(occluded, most)
    return list(every)


class InitStage(FramewiseStage):
    """Completes the mask of each frame whose person is occluded, and writes it; run by `Trainer.predict`.

    Frames of a whole person are passed through: their mask is written as it is and no prior is asked. What is
    written already by the same prior on the same data is not computed again. Of a long sequence only some frames are
    treated: see `frames_to_complete`.

    Args:
        prior: completes masks.
        body: the body of the data set.
        observed_frames: of all training frames, in order.
        read: gives the training frame at a position.
        settings: smoothing, threshold, and how many frames.
        folder: where masks, uncertainty maps and the manifest go.
        identity: what the masks depend on besides prior and settings: the hash of the data.
    """

    name = "init"

    def __init__(
        self,
        prior: MaskPrior,
        body: Body,
        observed_frames: ObservedFrames,
        read: Callable[[int], Frame],
        settings: InitSettings,
        folder: FrameFolder,
        identity: dict[str, Any],
    ) -> None:
        super().__init__(folder, {**identity, **vars(settings), **prior.describe()}, observed_frames)
        # wrapped in tuples so that neither is part of this module's state
        self._prior, self._body = (prior,), (body,)
        self.settings = settings
        self.calibration: Calibration | None = None
        self._read = read
        self._chosen = dict.fromkeys(frames_to_complete(observed_frames, settings.max_frames))
        self._probabilities: dict[int, NDArray[np.float32]] = {}

    @property
    def wanted(self) -> list[int]:
        """Positions of the frames that are not written yet."""
        indices = self.observed_frames.indices
        return [k for k in self._chosen if frame_name(indices[k]) not in self.records]

    @torch.no_grad()
    def predict_step(self, frame: Frame, _batch_idx: int) -> dict[str, Any]:
        """Completes and writes the mask of one frame; returns its record."""
        position = self._positions[frame.index]
        evidence = self.observed_frames[position].evidence
        visible = frame.visible_mask.cpu().numpy()
        record: dict[str, Any] = {"hidden_share": round(evidence.hidden_share, 4)}
        if evidence.occluded:
            probability = self._smoothed(position, visible)
            mask = visible | (probability > self.settings.threshold)
            uncertainty = 4.0 * probability * (1.0 - probability)
            record["status"] = "completed" if visible.any() else "completed, nothing seen"
            record["added_pixels"] = int((mask & ~visible).sum())
            picture = (255.0 * uncertainty + 0.5).astype(np.uint8)
            write_png(self.folder.second_picture(frame.index), picture)
        else:
            mask = visible
            record["status"] = "passed through"
        write_png(self.folder.picture(frame.index), mask)
        self.records[frame_name(frame.index)] = record
        return record

    def _probability(self, position: int) -> NDArray[np.float32]:
        """Returns the prior's answer for a frame by itself; the last few are remembered."""
        if position not in self._probabilities:
            observed_frame, frame = self.observed_frames[position], self._read(position)
            if observed_frame.evidence.occluded:
                observation = observed_frame.observation(frame, self._body[0])
                answer = checked_probability(self._prior[0], observation)
                if self.calibration is not None:
                    answer = self.calibration.apply(answer, observed_frame, frame.camera, self._body[0])
                    answer = with_what_is_known(answer, observation)
            else:
                answer = frame.visible_mask.cpu().numpy().astype(np.float32)
            self._probabilities[position] = answer
            for old in [k for k in self._probabilities if abs(k - position) > REMEMBERED]:
                del self._probabilities[old]
        return self._probabilities[position]

    def _smoothed(self, position: int, visible: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Returns the probability averaged along the body's motion with the frames beside it that have one."""
        own, observed_frame = self._probability(position), self.observed_frames[position]
        if self.settings.smoothing == 0.0:
            return own
        faces = self._body[0].faces.cpu().numpy()
        neighbours = []
        for other in (position - 1, position + 1):
            if other in self._chosen:
                flow = body_flow(
                    observed_frame.projected, self.observed_frames[other].projected, faces, *own.shape
                )
                neighbours.append((self._probability(other), flow))
        mean = smoothed(own, neighbours, self.settings.smoothing)
        # only what is not known is smoothed
        return np.where(observed_frame.evidence.background | visible, own, mean)

    def complete(self, positions: Sequence[int], *, progress: bool) -> None:
        """Completes the masks of the frames at some positions, the prior calibrated first where that is asked.

        Raises:
            Interrupted: a signal stopped it; what is written stays.
        """
        if (
            self.settings.calibrate and self.settings.source == "prior"
        ):  # also where all masks are there: it is told
            self.calibration = calibrate(self._prior[0], self.observed_frames, self._read, self._body[0])
        self.treat(self._read, positions, progress=progress)

    def finish(self) -> dict[str, Any]:
        """Writes the manifest of the finished stage; returns how many masks it completed, of how many, how steadily."""
        consistency = self.consistency()
        self.write_manifest(consistency=consistency)
        completed = sum(record["status"].startswith("completed") for record in self.records.values())
        return {"completed": completed, "frames": len(self.observed_frames), "consistency": consistency}

    def write_manifest(self, **more: Any) -> None:
        """Writes what was done, with what; the calibration too."""
        fitted = None if self.calibration is None else self.calibration.describe()
        super().write_manifest(calibration=fitted, **more)

    def consistency(self) -> float | None:
        """Returns the mean warped IoU of consecutive masks where something was completed; None without any.

        Each mask is compared, near its hidden pixels, with the mask of the frame before carried along the body's
        motion: 1 means that nothing flickers.
        """
        faces = self._body[0].faces.cpu().numpy()
        scores = []
        for k in self._chosen:
            if k - 1 not in self._chosen or not self.observed_frames[k].evidence.occluded:
                continue
            before, now = self.observed_frames[k - 1], self.observed_frames[k]
            mask, earlier = (
                read_mask(self.folder.picture(observed_frame.index)) for observed_frame in (now, before)
            )
            flow = body_flow(now.projected, before.projected, faces, *mask.shape)
            scores.append(warped_iou(mask, earlier, flow, ~now.evidence.background))
        known = [score for score in scores if score is not None]
        return float(np.mean(known)) if known else None
