"""Runs the first half of the refinement stage: decides which frames are inpainted, inpaints them, hands them over."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.data.module import HumanDataModule
from occfusion.errors import ConfigError
from occfusion.human import Avatar
from occfusion.human.rendering import Renderer
from occfusion.inpaint.accumulation import accumulate, paint_unseen
from occfusion.inpaint.build_inpainter import make_inpainter
from occfusion.inpaint.partial import CoarsePictures, Inpainter, TruthPictures
from occfusion.observation.frames import ObservedFrame
from occfusion.settings.schema import Settings
from occfusion.stages.framewise import predict_frames
from occfusion.stages.inpaint import InpaintStage
from occfusion.stages.interruption import Interrupted
from occfusion.stages.references import References
from occfusion.types import Frame

FOLDER = "inpainted"


def make_references(
    settings: Settings,
    folder: Path,
    data: HumanDataModule,
    avatar: Avatar,
    observed_frames: Sequence[ObservedFrame],
    identity: dict[str, str],
    renderer: Renderer,
    device: torch.device,
) -> tuple[References, float]:
    """Writes the references of a run into `inpainted/`; returns them and the seconds that it took.

    Args:
        settings: of the run.
        folder: the run folder.
        data: with the complete masks.
        avatar: the coarse avatar; what no frame shows of it is given the colours of what is seen nearby.
        observed_frames: of all training frames.
        identity: what the references depend on besides the inpainter: hashes of data and avatar.
        renderer: draws the avatar.
        device: where the inpainter runs.

    Raises:
        Interrupted: a signal stopped it; what is written stays.
    """
    started = time.monotonic()
    if not any(observed_frame.evidence.occluded for observed_frame in observed_frames):
        print(f"refine: none of {len(observed_frames)} frames is occluded, none is inpainted")
        return References(folder / FOLDER, frozenset()), 0.0

    def read(position: int) -> Frame:
        return data.train_frame(position, truth=False, complete=True)

    inpainter = _make_inpainter(settings, data, device)
    place, pixels = folder / FOLDER, settings.refine.references.pixels
    stage = InpaintStage(inpainter, avatar.eval(), observed_frames, place, identity, renderer, pixels)
    frames = (data.train_frame(k, truth=False) for k in range(len(observed_frames)))
    stage.accumulated = accumulate(avatar, frames, renderer)
    paint_unseen(avatar, stage.accumulated)
    wanted = stage.wanted
    if settings.trainer.fast_dev_run:  # the one frame that the trial step will see
        wanted = [k for k in wanted if k == data.position_at(0)]
    if wanted:
        signal = predict_frames(stage, read, wanted, progress=settings.trainer.enable_progress_bar)
        if signal is not None and stage.wanted:
            raise Interrupted(signal, str(stage.folder))
    seconds = time.monotonic() - started
    print(
        f"refine: {len(wanted)} of {len(observed_frames)} frames inpainted in {seconds:.1f} s; {stage.counted}"
    )
    return stage.references, seconds


def own_outlines(avatar: Avatar, frames: Iterable[Frame], renderer: Renderer) -> dict[int, NDArray[np.bool_]]:
    """Returns what an avatar covers by more than half in each frame, by its number, bool `[H, W]`."""
    avatar.eval()
    return {frame.index: renderer.outline(avatar, frame).cpu().numpy() for frame in frames}


def file_digest(path: Path) -> str:
    """Returns a short hash of a file's content."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def _make_inpainter(settings: Settings, data: HumanDataModule, device: torch.device) -> Inpainter:
    if settings.refine.references.source == "prior":
        return make_inpainter(asdict(settings.prior), device)
    if settings.refine.references.source == "coarse":
        return CoarsePictures()
    known = {}
    for frame in data.train_frames():
        if frame.truth is None:
            raise ConfigError(
                f"refine.references.source=truth: this data set does not know what is hidden in {frame.name}; use "
                "refine.references.source=prior"
            )
        known[frame.name] = frame.truth.rgb.numpy()
    return TruthPictures(known)
