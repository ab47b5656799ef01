"""Trains the coarse avatars that the embedded inpainter learns from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import lightning as L

from occfusion.errors import ConfigError
from occfusion.prior_training.appearance_task import Coarse, CoarseScene
from occfusion.run.objects import compose_run
from occfusion.run.stages import run_stages
from occfusion.settings.datasets import SyntheticSettings
from occfusion.settings.schema import Settings, StageChoice


def train_coarse(settings: Settings, scene: CoarseScene, folder: Path) -> Coarse:
    """Trains the coarse avatar of a scene of the inpainter's corpus, or takes up one trained before.

    Args:
        settings: of the training of the prior; variant and plan are those whose coarse avatars it learns from.
        scene: whose avatar.
        folder: of its run.

    Raises:
        OccfusionError: as `run_stages`; the variant completes no masks, so nothing would be inpainted after it;
            or the data set is not the embedded one.
    """
    if "init" not in settings.variant.stages:
        raise ConfigError(
            f"stage=prior prior_training=appearance: variant {settings.variant.name} completes no masks, so nothing is "
            f"inpainted after it; leave variant unset, or choose one of B to E"
        )
    if not isinstance(settings.dataset, SyntheticSettings):
        raise ConfigError(
            f"stage=prior prior_training=appearance dataset={settings.dataset.name}: its corpus is of embedded people; "
            "leave dataset unset"
        )
    occlusion = replace(
        settings.dataset.occlusion, kind=scene.occlusion, share=scene.share, fraction=scene.fraction
    )
    own = replace(
        settings,
        stage=StageChoice("optim"),
        dataset=replace(
            settings.dataset,
            scene=scene.scene,
            cameras=2,
            train_frames=[0, scene.frames, 1],
            occlusion=occlusion,
        ),
        evaluation=replace(settings.evaluation, curve=False, perceptual=False),
        seed=scene.seed,
        output_dir=str(folder),
    )
    L.seed_everything(own.seed, verbose=False)  # whatever was trained before it in this process
    run_ = compose_run(own, folder_chosen_by_user=True)
    assert run_.observed_frames is not None
    run_stages(run_)
    positions = range(len(run_.data.train_indices))
    frames = [run_.data.train_frame(k, complete="init" in run_.plan.stages) for k in positions]
    return Coarse(run_.avatar.eval(), frames, run_.observed_frames, run_.renderer)
