"""Reading a finished run folder."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import torch
from omegaconf import OmegaConf

from occfusion.errors import CheckpointError
from occfusion.human import Avatar, load_avatar
from occfusion.run.compose import make_body
from occfusion.settings.names import without_old_names
from occfusion.settings.schema import STAGES, Settings, load_settings
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
    if not (folder / "config.yaml").is_file():
        raise CheckpointError(f"{folder} is not a run folder: config.yaml is missing")
    config = OmegaConf.to_container(OmegaConf.load(folder / "config.yaml"))
    assert isinstance(config, dict)
    settings = load_settings(without_old_names({str(key): value for key, value in config.items()}))
    for stage in reversed(STAGES):
        file = folder / stage / "avatar.safetensors"
        if file.is_file():
            avatar = load_avatar(file, make_body(settings.body))
            return FinishedRun(folder, settings, avatar, _upright_pose(folder / stage / "stage.json"))
    raise CheckpointError(f"{folder} holds no avatar yet: let `python train.py output_dir={folder}` finish")


def _upright_pose(record: Path) -> Pose:
    """Returns the first training pose, standing at the origin and facing +z."""
    pose = json.loads(record.read_text(encoding="utf-8"))["first_pose"]
    return Pose(torch.tensor(pose["betas"]), torch.zeros(3), torch.tensor(pose["body_pose"]), torch.zeros(3))
