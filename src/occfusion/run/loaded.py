"""Reading a finished run folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from omegaconf import OmegaConf

from occfusion.errors import CheckpointError
from occfusion.files.run_folder import STAGES, RunFolder, read_json
from occfusion.human import Avatar, load_avatar
from occfusion.run.prepare import make_body
from occfusion.settings.names import without_old_names
from occfusion.settings.schema import Settings, load_settings
from occfusion.types import Pose


@dataclass(frozen=True)
class FinishedRun:
    """What a run folder holds for whoever renders or exports it.

    Attributes:
        folder: the run folder.
        settings: of the run.
        avatar: of its furthest stage.
        upright_pose: the first training pose, standing at the origin and facing +z.
    """

    folder: Path
    settings: Settings
    avatar: Avatar
    upright_pose: Pose


def load_run(folder: Path) -> FinishedRun:
    """Returns the settings of a run and the avatar of its furthest stage.

    Raises:
        CheckpointError: not a run folder, or no stage has finished in it.
    """
    own = RunFolder(folder)
    own.check_is_run()
    config = OmegaConf.to_container(OmegaConf.load(own.config))
    assert isinstance(config, dict)
    settings = load_settings(without_old_names({str(key): value for key, value in config.items()}))
    for stage in reversed(STAGES):
        left = own.stage(stage)
        if left.avatar.is_file():
            avatar = load_avatar(left.avatar, make_body(settings.body))
            return FinishedRun(folder, settings, avatar, _upright_pose(read_json(left.record)["first_pose"]))
    raise CheckpointError(f"{folder} holds no avatar yet: let `python train.py output_dir={folder}` finish")


def _upright_pose(pose: dict[str, list[float]]) -> Pose:
    """Returns a pose that stands at the origin and faces +z."""
    return Pose(torch.tensor(pose["betas"]), torch.zeros(3), torch.tensor(pose["body_pose"]), torch.zeros(3))
