"""The refinement stage of a run: inpaints what is hidden, once, and trains the avatar on."""

from __future__ import annotations

import hashlib
import time
from dataclasses import asdict
from functools import partial

import torch

from occfusion.data.module import HumanDataModule
from occfusion.fields.bits import PackedMasks
from occfusion.human import Avatar, load_avatar
from occfusion.inpaint.accumulation import Accumulated, learning_shares, paint_unseen
from occfusion.inpaint.build_inpainter import make_inpainter
from occfusion.inpaint.partial import CoarsePictures, Inpainter, TruthPictures
from occfusion.plan.make import refined_sh_degree
from occfusion.run.training import AvatarTraining, tell_damage, training_truths
from occfusion.settings.schema import Settings, steps_of
from occfusion.stages.inpaint import InpaintStage
from occfusion.stages.references import References
from occfusion.stages.refine import RefineStage
from occfusion.stages.targets import Masks

GATHERED_FROM = 300
"""Frames at most that say which of the avatar's places the video shows, and in what colours."""


def refine(training: AvatarTraining, avatar: Avatar) -> Avatar:
    """Trains the avatar of the optimisation on, with references for what no frame shows.

    Returns:
        the avatar trained on, or that of an earlier call.

    Raises:
        Interrupted: a signal stopped it; the same command continues.
    """
    settings, folder = training.planned, training.folder
    own, chosen = folder.stage("refine"), settings.refine
    coarse = hashlib.sha256(folder.stage("optim").avatar.read_bytes()).hexdigest()[:16]
    identity = {"data": training.data_hash, "avatar": coarse}
    if own.has_avatar:
        if folder.inpainted.altered():
            make_references(training, avatar, repaint_unseen(training, avatar), identity)
        print(f"refine: finished before, taken from {own.path}")
        return load_avatar(own.avatar, avatar.body)
    tell_damage(own)
    training.warm_up("refine")
    started = time.monotonic()
    surface = training.surface_prior(chosen, avatar)
    is_held = surface is not None and chosen.surface.hold
    accumulated = repaint_unseen(training, avatar) if is_held or _is_any_occluded(training) else None
    references = make_references(training, avatar, accumulated, identity)
    colour_shares = learning_shares(avatar, accumulated) if is_held and accumulated is not None else None
    seconds = time.monotonic() - started
    is_outlined = chosen.hidden.target == "outline" and chosen.hidden.effective_weight > 0
    outlines = _outlines(training, avatar) if is_outlined else {}
    avatar.gaussians.allocate_bands(refined_sh_degree(settings))
    stage = RefineStage(
        avatar,
        chosen,
        references,
        training.uncertain,
        outlines,
        colour_shares=colour_shares,
        steps_before=steps_of(settings, settings.optim),
        **training.shared(chosen, surface),
    )
    training.train(stage, chosen.steps, seconds_before=seconds)
    return avatar


def _outlines(training: AvatarTraining, avatar: Avatar) -> Masks:
    """Returns what the avatar covers by more than half in the frames with a doubt, bool `[H, W]`."""
    outlines = PackedMasks()
    avatar.eval()
    visited = _visited(training)
    for position, index in enumerate(training.observed_frames.indices):
        if position in visited and index in training.uncertain.hidden:
            frame = training.data.train_frame(position, truth=False)
            outlines.put(frame.index, training.renderer.outline(avatar, frame).cpu().numpy())
    return outlines


def _visited(training: AvatarTraining) -> frozenset[int]:
    """Returns positions of the frames that the refinement sees: of a long sequence not all, but with `plan=full`."""
    settings, count = training.planned, len(training.data.train_indices)
    if settings.trainer.fast_dev_run:
        return training.data.positions_until(settings.trainer.devices)
    if settings.plan == "full":
        return frozenset(range(count))
    return training.data.positions_until(steps_of(settings, settings.refine) * settings.trainer.devices)


def _is_any_occluded(training: AvatarTraining) -> bool:
    return any(observed_frame.evidence.occluded for observed_frame in training.observed_frames.judged)


def repaint_unseen(training: AvatarTraining, avatar: Avatar) -> Accumulated:
    """Gives what no frame shows the colours of what is seen nearby, or completed ones; returns what frames show.

    It had them at the start. The optimisation has moved them since, by what little shines through in front.

    Args:
        training: of the run's avatar.
        avatar: the coarse avatar; its colours are changed in place.
    """
    accumulated = training.accumulate(avatar, GATHERED_FROM)
    paint_unseen(avatar, training.complete(avatar, accumulated, is_trained=True))
    return accumulated


def make_references(
    training: AvatarTraining, avatar: Avatar, accumulated: Accumulated | None, identity: dict[str, str]
) -> References:
    """Writes the references of a run; returns them.

    Args:
        training: of the run's avatar; the inpainter runs where its renderer draws.
        avatar: the coarse avatar, what no frame shows of it painted.
        accumulated: what the video shows of it; needed where a frame is occluded.
        identity: what the references depend on besides the inpainter: hashes of data and avatar.

    Raises:
        Interrupted: a signal stopped it; what is written stays.
    """
    started = time.monotonic()
    settings, folder, data = training.planned, training.folder, training.data
    observed_frames, renderer = training.observed_frames, training.renderer
    if not _is_any_occluded(training):
        print(f"refine: none of {len(observed_frames)} frames is occluded, none is inpainted")
        return References(folder.inpainted, frozenset())

    inpainter, pixels = _make_inpainter(settings, data, renderer.device), settings.refine.references.pixels
    stage = InpaintStage(
        inpainter, avatar.eval(), observed_frames, folder.inpainted, identity, renderer, pixels
    )
    stage.accumulated = accumulated
    visited = _visited(training)
    wanted = [k for k in stage.wanted if k in visited]
    read = partial(data.train_frame, truth=False, complete=True)
    stage.treat(read, wanted, progress=settings.trainer.enable_progress_bar)
    seconds = time.monotonic() - started
    print(f"refine: references made in {seconds:.1f} s; {stage.counted}")
    return stage.references


def _make_inpainter(settings: Settings, data: HumanDataModule, device: torch.device) -> Inpainter:
    if settings.refine.references.source == "prior":
        return make_inpainter(asdict(settings.prior), device)
    if settings.refine.references.source == "coarse":
        return CoarsePictures()
    truths = training_truths(data, "refine.references")
    return TruthPictures({name: truth.rgb.numpy() for name, truth in truths})
