"""The first half of the refinement stage: each occluded frame is inpainted once (paper §4.3)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from occfusion.files.atomic import write_png
from occfusion.files.run_folder import FrameFolder, frame_name
from occfusion.human.avatar import Avatar
from occfusion.human.rendering import Renderer
from occfusion.inpaint.accumulation import Accumulated
from occfusion.inpaint.partial import CoarsePictures, Inpainter, checked_picture, take_partial
from occfusion.observation.frames import ObservedFrames
from occfusion.stages.framewise import FramewiseStage
from occfusion.stages.references import References
from occfusion.types import Frame


class InpaintStage(FramewiseStage):
    """Inpaints the frames whose person is occluded, and writes them; run by `Trainer.predict`.

    Frames of a whole person are not touched. A frame of which no pixel counts keeps the coarse avatar's colours where
    the person is hidden. What is written already by the same inpainter for the same coarse avatar on the same data is
    not computed again.

    Args:
        inpainter: paints what is hidden.
        avatar: the coarse avatar.
        observed_frames: of all training frames, in order.
        folder: where pictures, regions and the manifest go.
        identity: what the pictures depend on besides the inpainter: hashes of data and avatar.
        renderer: draws the avatar.
        pixels: where the pictures count: `unseen` or `hidden`; see `ReferenceSettings`.

    Attributes:
        accumulated: what the video shows of the avatar; needed as soon as a frame is inpainted.
    """

    name = "inpaint"

    def __init__(
        self,
        inpainter: Inpainter,
        avatar: Avatar,
        observed_frames: ObservedFrames,
        folder: FrameFolder,
        identity: dict[str, Any],
        renderer: Renderer,
        pixels: str,
    ) -> None:
        described = {"pixels": pixels, "unseen": "painted", "asked": "what counts", **inpainter.describe()}
        super().__init__(folder, {**identity, **described}, observed_frames)
        self._pixels = pixels
        # wrapped in tuples so that neither is part of this module's state
        self._inpainter, self._avatar = (inpainter,), (avatar,)
        self._renderer = renderer
        self.accumulated: Accumulated | None = None

    @property
    def wanted(self) -> list[int]:
        """Positions of the occluded frames that are not written yet."""
        missing = [k for index, k in self._positions.items() if frame_name(index) not in self.records]
        return [k for k in missing if self.observed_frames[k].evidence.occluded]

    @property
    def references(self) -> References:
        """What is written, for the refinement."""
        painted = {int(name) for name, record in self.records.items() if record["region_pixels"]}
        return References(self.folder, frozenset(painted))

    @property
    def counted(self) -> str:
        """How many frames were inpainted, and how many of the pixels the refinement will look at, in words."""
        painted, region = (
            sum(r[f"{part}_pixels"] for r in self.records.values()) for part in ("painted", "region")
        )
        asked = sum(r["inpainted"] for r in self.records.values())
        others = "; other frames show the rest" if region < painted else ""
        frames = f"of {len(self.observed_frames)} frames"
        if isinstance(self._inpainter[0], CoarsePictures):
            told = f"{len(self.records)} {frames} as the avatar shows them"
        else:
            told = f"{asked} {frames} inpainted, {len(self.records) - asked} left as the avatar shows them"
        return f"{told}; references count on {region} of {painted} hidden pixels{others}"

    @torch.no_grad()
    def predict_step(self, frame: Frame, _batch_idx: int) -> dict[str, Any]:
        """Inpaints and writes one frame; returns its record."""
        avatar, observed_frame = self._avatar[0], self.observed_frames[self._positions[frame.index]]
        assert self.accumulated is not None  # set by whoever starts the stage, once it is known to be needed
        observation = observed_frame.observation(frame, avatar.body)
        partial = take_partial(avatar, self.accumulated, frame, observation, self._renderer)
        painted = partial.region
        region = partial.unseen if self._pixels == "unseen" else painted
        # where no pixel will be looked at, nobody is asked to paint it
        is_asked = bool(region.any())
        inpainter = self._inpainter[0] if is_asked else CoarsePictures()
        picture = checked_picture(inpainter, partial)
        write_png(self.folder.second_picture(frame.index), region)
        write_png(self.folder.picture(frame.index), np.round(255.0 * picture).astype(np.uint8))
        moved = float(np.abs(picture - partial.coarse)[painted].mean()) if painted.any() else 0.0
        record = {
            "painted_pixels": int(painted.sum()),
            "region_pixels": int(region.sum()),
            "inpainted": is_asked,
            "moved": round(moved, 4),
        }
        self.records[frame_name(frame.index)] = record
        return record
