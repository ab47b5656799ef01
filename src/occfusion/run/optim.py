"""The optimisation stage of a run: trained, or taken over from a run whose plan agrees on it."""

from __future__ import annotations

import contextlib
import time
from dataclasses import asdict

from occfusion.cpu.processes import is_helper
from occfusion.files.atomic import write_bytes
from occfusion.files.run_folder import RunFolder
from occfusion.files.sharing import shared_folder, take_or_make
from occfusion.files.table import read_table, write_table
from occfusion.human import Avatar, load_avatar, write_gaussians_ply
from occfusion.inpaint.accumulation import paint_observed
from occfusion.priors.build_prior import make_score_prior
from occfusion.run.training import LOOKED_AT, AvatarTraining, tell_damage
from occfusion.settings.schema import optim_hash
from occfusion.stages.distil import Distiller
from occfusion.stages.optim import OptimStage

OPACITY = 0.95
"""Of discs on the body that are to hide what lies behind them."""


def optimise(training: AvatarTraining, avatar: Avatar) -> Avatar:
    """Fits the avatar of the body to what is seen, and to a prior's score where the plan has a term of it.

    What follows it does not change it: variants whose plans agree on it share it.

    Returns:
        the avatar trained, that of an earlier call, or that of another run.

    Raises:
        Interrupted: a signal stopped it; the same command continues.
    """
    folder, settings = training.folder, training.settings
    own = folder.stage("optim")
    if own.has_avatar:
        print(f"optim: finished before, taken from {own.path}")
        _keep_tables(folder, RunFolder(own.path))
        return load_avatar(own.avatar, avatar.body)
    tell_damage(own)
    if settings.trainer.fast_dev_run or is_helper():
        _train(training, avatar)
        return avatar

    def make() -> None:
        _train(training, avatar)
        _copy_tables(folder, RunFolder(own.path))

    chosen = settings.evaluation
    curve = (chosen.curve, chosen.curve_images, chosen.curve_first_second, training.held_out_hash)
    identity = {"settings": optim_hash(training.planned), "data": training.data_hash, "curve": curve}
    shared = shared_folder(folder, settings.shared_dir, "optim", identity)
    made = take_or_make(
        shared,
        own.path,
        own.record,
        is_whole=lambda: own.has_avatar,
        make=make,
        without=[own.checkpoint.name, own.earlier_checkpoint.name],
    )
    if made is None:
        return avatar
    print(f"optim: trained before, taken from {shared}")
    _copy_tables(RunFolder(own.path), folder)
    taken = load_avatar(own.avatar, avatar.body)
    write_gaussians_ply(folder.point_cloud, taken.gaussians)
    return taken


def _train(training: AvatarTraining, avatar: Avatar) -> None:
    settings, renderer = training.planned, training.renderer
    optim, checkpoint = settings.optim, training.folder.stage("optim").checkpoint
    training.warm_up("optim")
    distiller = None
    if optim.sds.is_used:
        distiller = Distiller(
            make_score_prior(asdict(settings.prior), renderer.device),
            optim.sds,
            steps=optim.steps,
            observed_frames=training.observed_frames,
            body=avatar.body,
            renderer=renderer,
            seed=settings.seed,
        )
    stage = OptimStage(
        avatar,
        optim,
        distiller=distiller,
        uncertain=training.uncertain,
        **training.shared(optim, training.surface_prior(optim, avatar)),
    )
    if optim.observed_colors and (settings.trainer.fast_dev_run or not checkpoint.is_file()):
        stage.clock.restore(start_as_observed(avatar, training))
    training.train(stage, optim.steps, seconds_before=0.0)


def start_as_observed(avatar: Avatar, training: AvatarTraining) -> float:
    """Gives the Gaussians of a body the colours that the video shows there; returns the seconds that it took.

    Those that hardly any frame shows get the colours of what is seen nearby, or those that a network expects there.
    Begun grey, they would stay it, and shine through in every frame that hides their like.

    Args:
        avatar: before training, its Gaussians on the body; changed in place.
        training: whose training frames.
    """
    started = time.monotonic()
    shown = training.accumulate(avatar, LOOKED_AT, OPACITY)
    paint_observed(avatar, training.complete(avatar, shown))
    return time.monotonic() - started


def _keep_tables(source: RunFolder, target: RunFolder) -> None:
    """Copies the stage's tables where the process that trained it was killed before it did."""
    for table, place in ((source.curve, target.curve), (source.losses, target.losses)):
        if place.is_file():
            continue
        with contextlib.suppress(ValueError):  # damaged
            # once another stage has begun, its rows and columns are among them
            if {row.get("stage") for row in read_table(table)} == {"optim"}:
                write_bytes(place, table.read_bytes())


def _copy_tables(source: RunFolder, target: RunFolder) -> None:
    """Copies what a stage leaves in the run folder besides its own folder; rows of later stages stay there."""
    for table, place in ((source.curve, target.curve), (source.losses, target.losses)):
        if not table.is_file():
            continue
        try:
            own = [row for row in read_table(place) if row["stage"] != "optim"]
        except (KeyError, ValueError):  # damaged: nothing in it is known to be a row
            own = []
        if not own:
            write_bytes(place, table.read_bytes())
            continue
        rows = read_table(table)
        columns = dict.fromkeys(name for row in (*own, *rows) for name in row)  # of all stages, as they stood
        write_table(place, list(columns), [*rows, *own])
