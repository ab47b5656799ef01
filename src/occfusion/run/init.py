"""The initialisation stage of a run: masks are completed, or taken over from another run."""

from __future__ import annotations

import time
from dataclasses import asdict
from functools import partial

import torch

from occfusion.cpu.processes import is_helper
from occfusion.data.module import HumanDataModule
from occfusion.files.atomic import write_json
from occfusion.files.sharing import shared_folder, take_or_make
from occfusion.human import Avatar, Body
from occfusion.priors.build_prior import make_mask_prior
from occfusion.priors.masks import MaskPrior, TruthMasks
from occfusion.run.training import AvatarTraining, tell_damage, training_truths
from occfusion.settings.schema import Settings
from occfusion.stages.init import InitStage, frames_to_complete


def complete_masks(training: AvatarTraining, avatar: Avatar) -> Avatar:
    """Writes the complete masks of a run and has the training frames carry them; returns the avatar as it was given.

    Masks that another run on the same data with the same prior and settings made are taken from it; the time
    that they took there counts as this run's.

    Raises:
        Interrupted: a signal stopped it; what is written stays.
    """
    if not is_helper():  # masks are complete before the helpers are started
        _complete(training, avatar.body)
    frames = training.observed_frames
    chosen = frames_to_complete(frames, training.planned.init.max_frames)
    masked, path_of = {frames[k].index for k in chosen}, training.folder.masks.picture
    training.data.use_complete_masks(lambda frame: path_of(frame) if frame in masked else None)
    return avatar


def _complete(training: AvatarTraining, body: Body) -> None:
    settings, folder, data = training.settings, training.folder, training.data
    read, frames = partial(data.train_frame, truth=False), training.observed_frames
    prior = make_prior(settings, data, training.renderer.device)
    identity = {"data": training.data_hash} | ({"aligned": training.aligned} if training.aligned else {})
    stage = InitStage(prior, body, frames, read, training.planned.init, folder.masks, identity)
    progress, own = settings.trainer.enable_progress_bar, folder.stage(stage.name)
    record = own.record
    if settings.trainer.fast_dev_run:  # the one frame that the trial step of each process will see
        seen = data.positions_until(settings.trainer.devices)
        if positions := [k for k in stage.wanted if k in seen]:
            stage.complete(positions, progress=progress)
        return
    wanted = stage.wanted
    if not wanted and record.is_file() and own.damage is None:
        return
    tell_damage(own)

    def make() -> None:
        started = time.monotonic()
        # all of them, whatever of a damaged result was taken
        stage.complete(sorted({*wanted, *stage.wanted}), progress=progress)
        done = stage.finish()
        steady, seconds = done["consistency"], time.monotonic() - started
        write_json(record, {"train_seconds": seconds, **done})
        print(
            f"init: {done['completed']} of {done['frames']} masks completed in {seconds:.1f} s"
            + ("" if steady is None else f", consistency {steady:.3f} (warped IoU)")
        )

    def is_whole() -> bool:
        stage.read_again()
        return not stage.wanted

    shared = shared_folder(folder, settings.shared_dir, stage.name, stage.identity)
    made = take_or_make(shared, folder.masks.path, record, is_whole=is_whole, make=make)
    if made is not None:
        write_json(record, {**made, "shared": str(shared)})
        print(f"init: {made['completed']} of {made['frames']} masks completed before, taken from {shared}")


def make_prior(settings: Settings, data: HumanDataModule, device: torch.device) -> MaskPrior:
    """Returns what completes masks: a network, or the truth.

    Raises:
        ConfigError: the truth is asked for and not known.
    """
    if settings.init.source == "prior":
        return make_mask_prior(asdict(settings.prior), device)
    return TruthMasks({name: truth.mask.numpy() for name, truth in training_truths(data, "init")})
