"""A profile of training: the stages of a run are trained as always, with probes around the parts of a step."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import lightning as L
import torch

import occfusion.human.avatar as avatar_module
import occfusion.stages.avatar as avatar_stage_module
import occfusion.stages.optim as optim_module
import occfusion.stages.refine as refine_module
from occfusion.bench.probes import BACKWARD, FORWARD, Probes, Spent
from occfusion.bench.steps import PERCEPTUAL, RASTERISER, PartTime, StepProfile
from occfusion.data.module import HumanDataModule
from occfusion.quality import losses
from occfusion.run.prepare import build, claim, decide, observe, run_stage
from occfusion.settings.schema import Settings
from occfusion.stages.avatar import AvatarStage
from occfusion.stages.losses_log import LossLog

LIGHTNING = "Lightning: loop, hooks, batch"
BLOCK = 16
"""Steps with probes, then as many without: a multiple of the steps between two perceptual terms and of all other turns
but those of densification and of looking up vertices, which fall where they fall."""


class StepWatch(L.Callback):
    """Measures blocks of steps with and without probes in turn; the last of the callbacks.

    Args:
        size: of the pictures, pixels, for the record.
        rounds: pairs of blocks; two blocks more come first and are not counted.
        block: steps of a block.
    """

    def __init__(self, size: int, rounds: int, block: int = BLOCK) -> None:
        self.size, self.rounds, self.block = size, rounds, block
        self.profiles: list[StepProfile] = []
        self._probes = Probes(LIGHTNING)
        self._plain, self._began = Spent(), (0.0, 0.0)

    @property
    def steps(self) -> int:
        """Steps that a stage needs for it."""
        return (2 * self.rounds + 2) * self.block

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Puts the probes around this stage's parts."""
        assert isinstance(pl_module, AvatarStage)
        self._probes, self._plain = Probes(LIGHTNING), Spent()
        put_probes(self._probes, trainer, pl_module)

    def on_train_batch_end(self, trainer: L.Trainer, *_: Any) -> None:
        """Turns the probes on and off; the time from here to the same place of the next step is a step."""
        done, within = divmod(trainer.global_step, self.block)
        if within or done < 2:
            return
        if self._probes.active:
            self._probes.stop()
        elif done > 2:
            cpu, wall = self._began
            self._plain.cpu += time.process_time() - cpu
            self._plain.wall += time.perf_counter() - wall
        if done == 2 * self.rounds + 2:
            return
        if done % 2 == 0:
            self._probes.start()
        else:
            self._began = time.process_time(), time.perf_counter()

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Keeps the profile and takes the probes away."""
        assert isinstance(pl_module, AvatarStage)
        self._probes.remove()
        steps = self.rounds * self.block
        spent = self._probes.totals()
        parts = []
        for name in dict.fromkeys(name for name, _ in spent):
            forward, backward = (spent.get((name, which), Spent()) for which in (FORWARD, BACKWARD))
            cpu = (1e3 * forward.cpu / steps, 1e3 * backward.cpu / steps)
            parts.append(PartTime(name, *cpu, 1e3 * (forward.wall + backward.wall) / steps))
        plain = PartTime("measured", 1e3 * self._plain.cpu / steps, 0.0, 1e3 * self._plain.wall / steps)
        self.profiles.append(
            StepProfile(
                pl_module.name,
                pl_module.num_gaussians,
                self.size,
                torch.get_num_threads(),
                steps,
                tuple(sorted(parts, key=lambda part: -part.cpu)),
                plain,
            )
        )


def put_probes(probes: Probes, trainer: L.Trainer, stage: AvatarStage) -> None:
    """Puts probes around all parts of a stage's step."""
    avatar, surface = "avatar: pose, skinning, covariances", "surface held to the body"
    optimizer = trainer.optimizers[0]
    bounds = "bounds, rates, turns"
    probes.around(stage, "on_train_batch_start", bounds)
    probes.around(stage.avatar, "refresh_vertex_index", "nearest body vertices")
    probes.around(stage.avatar, "forward", avatar)
    probes.around(stage.avatar, "_binding", "skinning weights and maps to rest")
    probes.around(stage.avatar, "_corrected", "pose corrections")
    probes.around(stage.avatar, "_shaped", "joints at rest, blend shapes")
    probes.around(avatar_module, "posed_colors", "harmonics and light")
    probes.around(avatar_stage_module, "person_box", "the person's box")
    probes.around(stage._renderer, "draw", RASTERISER, not_in=surface)
    probes.around(stage, "training_step", "sum of the terms")
    probes.around(stage, "colour_terms", "L1 and SSIM")
    probes.around(losses, "l2", "L2 of the mask")
    probes.around(losses, "ssim_loss", "L1 and SSIM", not_in="L1 and SSIM")
    probes.around(losses, "l1", "L1 towards references", not_in="L1 and SSIM")
    targets = "frame and references cropped"
    for module in (optim_module, refine_module):
        probes.around(module, "crop_frame", targets)
        probes.around(module, "mask_weights", targets)
    probes.around(refine_module, "with_outline", targets)
    if (references := getattr(stage, "references", None)) is not None:
        probes.around(references, "get", targets)
    probes.around(stage, "perceptual_box", PERCEPTUAL)
    if stage._perceptual[0] is not None:
        probes.around(stage._perceptual[0], "forward", PERCEPTUAL)
    if stage.surface is not None:
        probes.around(stage.surface, "terms", surface)
        probes.around(stage.surface, "hold", surface)
    checks = "checks for what is not finite"
    probes.around(avatar_stage_module, "check_finite_terms", checks)
    probes.around(stage, "on_before_optimizer_step", checks)
    if stage.densifier is not None:
        probes.around(stage.densifier, "observe", "densification: gradients collected")
        probes.around(stage.densifier, "step", "densification: rounds")
    if (distiller := getattr(stage, "distiller", None)) is not None:
        probes.around(distiller, "terms", "distillation")
    probes.around_backward(stage, "backward")
    probes.around_closure(optimizer, "step", "Adam")
    for callback in trainer.callbacks:  # type: ignore[attr-defined]
        if isinstance(callback, LossLog):
            probes.around(callback, "on_train_batch_end", "log of the losses")
    data = trainer.datamodule  # type: ignore[attr-defined]
    assert isinstance(data, HumanDataModule)
    probes.beside(data.views, "train_frame", "frames unpacked, ahead of the step")


def profile_stages(
    settings: Settings, gaussians: int, rounds: int, block: int = BLOCK
) -> Iterator[StepProfile]:
    """Yields the profiles of the stages that train an avatar, in a run like any other.

    Args:
        settings: of the run; the lengths of the stages are set here. All bands of harmonics and the perceptual term are
            in use from the first step on, as they are at the end of a usual run.
        gaussians: at the start of both stages, as far as the body has places for them.
        rounds: see `StepWatch`.
        block: see `StepWatch`.
    """
    size = settings.dataset.image_size
    assert size is not None  # of embedded scenes it is always known
    watch = StepWatch(size, rounds, block)
    settings = replace(
        settings,
        optim=replace(settings.optim, steps=watch.steps, sh_every=1, perceptual_from=0.0),
        refine=replace(settings.refine, steps=watch.steps, sh_every=1, perceptual_from=0.0),
        # the clock of training stands still meanwhile, too
        evaluation=replace(settings.evaluation, curve=False),
        trainer=replace(settings.trainer, checkpoint_every=2 * watch.steps),
    )
    L.seed_everything(settings.seed, verbose=False)
    observed = observe(settings)
    plan = decide(settings, observed)
    planned = replace(plan.settings, optim=replace(plan.settings.optim, gaussians=gaussians))
    plan = replace(plan, settings=planned)
    run = build(settings, observed, plan, claim(settings, observed, plan, folder_chosen_by_user=True))
    avatar, training = run.avatar, replace(run.training, watching=(watch,))
    for stage in plan.stages:
        known = len(watch.profiles)
        avatar = run_stage(stage, training, avatar)
        yield from watch.profiles[known:]
