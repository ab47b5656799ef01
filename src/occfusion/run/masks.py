"""Runs the initialisation stage: decides which frames need a complete mask, completes them, hands them over."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import torch

from occfusion.cpu.processes import is_helper
from occfusion.data.module import HumanDataModule
from occfusion.errors import ConfigError
from occfusion.files.atomic import write_json
from occfusion.human import Body
from occfusion.observation.frames import ObservedFrame, observe_frames
from occfusion.priors.build_prior import make_mask_prior
from occfusion.priors.calibration import calibrate
from occfusion.priors.masks import MaskPrior, TruthMasks
from occfusion.run.sharing import discard, offer, shared_folder, sole_maker, take
from occfusion.settings.schema import Settings
from occfusion.stages.framewise import predict_frames
from occfusion.stages.init import InitStage, mask_path
from occfusion.stages.interruption import Interrupted
from occfusion.types import Frame


def observe_training_frames(data: HumanDataModule, body: Body) -> list[ObservedFrame]:
    """Returns what masks and poses say of all training frames."""
    return observe_frames((data.train_frame(k, truth=False) for k in range(len(data.train_indices))), body)


def run_init(
    settings: Settings,
    folder: Path,
    data: HumanDataModule,
    body: Body,
    observed_frames: Sequence[ObservedFrame],
    data_hash: str,
    device: torch.device,
) -> None:
    """Writes the complete masks of a run into `masks/` and has the training frames carry them.

    Masks that another run on the same data with the same prior and settings made are taken from it; the time
    that they took there counts as this run's.

    Raises:
        Interrupted: a signal stopped it; what is written stays.
    """
    masks = folder / "masks"
    if is_helper():  # they are complete before the helpers are started
        data.use_complete_masks(lambda frame: mask_path(masks, frame))
        return

    def read(position: int) -> Frame:
        return data.train_frame(position, truth=False)

    prior = _make_prior(settings, data, device)
    stage = InitStage(prior, body, observed_frames, read, settings.init, masks, {"data": data_hash})
    record = folder / "init" / "stage.json"

    def complete(wanted: Sequence[int]) -> None:
        if wanted and settings.init.calibrate and settings.init.source == "prior":
            stage.calibration = calibrate(prior, observed_frames, read, body)
        if wanted:
            signal = predict_frames(stage, read, wanted, progress=settings.trainer.enable_progress_bar)
            if signal is not None and stage.wanted:
                raise Interrupted(signal, str(stage.folder))

    if settings.trainer.fast_dev_run:  # the one frame that the trial step of each process will see
        seen = {data.position_at(step) for step in range(settings.trainer.devices)}
        complete([k for k in stage.wanted if k in seen])
    elif stage.wanted or not record.is_file():
        shared = shared_folder(folder, settings.shared_dir, "init", stage.identity)
        with sole_maker(shared, "init"):
            wanted = stage.wanted
            if not (wanted and _taken(stage, shared, record)):
                started = time.monotonic()
                complete(wanted)
                _finish(stage, record, started)
                offer(shared, masks, record)
    data.use_complete_masks(lambda frame: mask_path(masks, frame))


def _finish(stage: InitStage, record: Path, started: float) -> None:
    """Writes what came of the stage; the record says "done"."""
    consistency = stage.consistency()
    stage.write_manifest(consistency=consistency)
    completed = sum(r["status"].startswith("completed") for r in stage.records.values())
    record.parent.mkdir(parents=True, exist_ok=True)
    seconds, frames = time.monotonic() - started, len(stage.observed_frames)
    write_json(
        record,
        {"train_seconds": seconds, "completed": completed, "frames": frames, "consistency": consistency},
    )
    print(
        f"init: {completed} of {frames} masks completed in {seconds:.1f} s"
        + ("" if consistency is None else f", consistency {consistency:.3f} (warped IoU)")
    )


def _taken(stage: InitStage, shared: Path, record: Path) -> bool:
    """Takes over shared masks, if there are any for all frames; returns whether it did."""
    if not shared.is_dir():
        return False
    made = take(shared, stage.folder)
    stage.read_again()
    if made is None or stage.wanted:
        discard(shared)  # incomplete: what is computed now takes its place
        return False
    record.parent.mkdir(parents=True, exist_ok=True)
    write_json(record, {**made, "shared": str(shared)})
    print(
        f"init: {made.get('completed')} of {len(stage.observed_frames)} masks completed before, taken from {shared}"
    )
    return True


def _make_prior(settings: Settings, data: HumanDataModule, device: torch.device) -> MaskPrior:
    if settings.init.source == "prior":
        return make_mask_prior(asdict(settings.prior), device)
    known = {}
    for frame in data.train_frames():
        if frame.truth is None:
            raise ConfigError(
                f"init.source=truth: this data set does not know what is hidden in {frame.name}; use init.source=prior"
            )
        known[frame.name] = frame.truth.mask.numpy()
    return TruthMasks(known)
