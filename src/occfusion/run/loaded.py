"""Reading a run folder, finished or not, for whoever shows its avatar or takes it away."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path

import torch
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from torch import Tensor
from yaml import YAMLError

from occfusion.errors import CheckpointError
from occfusion.files.checkpoint import read_checkpoint
from occfusion.files.digest import digest_of_values
from occfusion.files.run_folder import STAGES, RunFolder
from occfusion.human import Avatar, load_avatar
from occfusion.human.avatar_file import make_avatar
from occfusion.motion import Clip, read_sequence
from occfusion.run.bodies import make_body
from occfusion.run.folder import read_if_whole
from occfusion.run.sequence import ensure_sequence
from occfusion.settings.names import without_old_names
from occfusion.settings.schema import Settings, load_settings
from occfusion.show.views import TRAIN, View, read_views
from occfusion.types import Camera

_PREFIX = "avatar."
"""Of the avatar's tensors in a stage's checkpoint."""


@dataclass(frozen=True)
class LoadedRun:
    """What a run folder holds for whoever shows it.

    Attributes:
        folder: the run folder.
        settings: of the run.
        avatar: of one of its stages.
        stage: which.
        step: of the checkpoint that the avatar is from; None: the stage is done.
    """

    folder: RunFolder
    settings: Settings
    avatar: Avatar
    stage: str
    step: int | None

    @cached_property
    def clip(self) -> Clip:
        """The motion of its own sequence."""
        ensure_sequence(self.folder, self.settings)
        return read_sequence(self.folder.motion, "sequence")

    @cached_property
    def betas(self) -> Tensor:
        """Shape of its person, `[B]`."""
        assert self.clip.betas is not None
        return torch.tensor(self.clip.betas).float()

    def views(self, group: str) -> list[View]:
        """Returns its views: `show.views.TRAIN` or `HELD_OUT`."""
        ensure_sequence(self.folder, self.settings)
        return read_views(self.folder.cameras, group)

    @cached_property
    def pixel(self) -> float:
        """What a pixel of the training pictures covers at the person, metres."""
        camera = self.views(TRAIN)[0].camera
        return float(distance_to(camera, self.clip)) / float(camera.K[0, 0])

    @property
    def remark(self) -> str:
        """A sentence where the avatar is not what the run will end with, else nothing."""
        if self.step is not None:
            return f"{self.folder.path}: stage {self.stage} is not done; its checkpoint of step {self.step} is taken"
        return ""


def distance_to(camera: Camera, clip: Clip) -> float:
    """Returns the median distance from a camera to the person of a sequence, metres."""
    return float((torch.tensor(clip.transl).float() - camera.centre).norm(dim=1).median())


def load_run(folder: Path, stage: str | None = None) -> LoadedRun:
    """Returns a run with the avatar of its furthest stage, else with that of the last checkpoint.

    Args:
        folder: of the run.
        stage: take that stage's avatar.

    Raises:
        CheckpointError: not a run folder, or no avatar of that stage in it yet.
    """
    own = RunFolder(folder)
    settings = read_settings(own)
    for name in reversed(STAGES) if stage is None else (stage,):
        left = own.stage(name)
        if (damage := left.damage) is not None:
            print(
                f"{name}: {damage}; its last checkpoint is taken, or the stage before; the same command mends it"
            )
        if left.has_avatar:
            return LoadedRun(own, settings, load_avatar(left.avatar, make_body(settings.body)), name, None)
        if left.checkpoint.is_file():
            avatar, step = _from_checkpoint(left.checkpoint, settings)
            if avatar is not None:
                return LoadedRun(own, settings, avatar, name, step)
    if stage is not None:
        there = [name for name in STAGES if own.stage(name).has_avatar]
        raise CheckpointError(f"{folder}: no avatar of stage {stage}; there are {', '.join(there) or 'none'}")
    raise CheckpointError(f"{folder} holds no avatar yet: let `python train.py output_dir={folder}` go on")


def read_settings(folder: RunFolder) -> Settings:
    """Returns the settings of a run.

    Raises:
        CheckpointError: not a run folder, or its configuration is damaged.
        ConfigError: a setting in it cannot be one.
    """
    folder.check_is_run()
    known = read_if_whole(folder.environment).get("settings_sha256")
    changed = CheckpointError(f"{folder.config} is not as the run wrote it; let the same command go on")
    try:
        config = OmegaConf.to_container(OmegaConf.load(folder.config))
        if not isinstance(config, dict) or not config:
            raise ValueError("no settings in it")
    except (OmegaConfBaseException, OSError, RecursionError, ValueError, YAMLError) as error:
        why = (str(error) or type(error).__name__).splitlines()[0]
        damaged = CheckpointError(f"{folder.config} is damaged ({why}); let the same command go on")
        raise (damaged if known is None else changed) from error
    written = {str(key): value for key, value in config.items()}
    kept = without_old_names(written)
    is_changed = known is not None and known not in (digest_of_values(written), digest_of_values(kept))
    if is_changed and {field.name for field in fields(Settings)} - kept.keys():
        raise changed  # cut short: the last of what is left may be no setting at all
    settings = load_settings(kept)
    if is_changed:
        raise changed
    return settings


def stages_with_avatar(folder: RunFolder) -> list[str]:
    """Returns the stages of a run that are done and left an avatar."""
    return [name for name in STAGES if folder.stage(name).has_avatar]


def _from_checkpoint(path: Path, settings: Settings) -> tuple[Avatar | None, int]:
    """Returns the avatar of a checkpoint and its step; None where the stage trains none."""
    content = read_checkpoint(path)
    state, step = content["state_dict"], int(content["global_step"])
    own = {name.removeprefix(_PREFIX): value for name, value in state.items() if name.startswith(_PREFIX)}
    if not own:
        return None, step
    if "avatar" not in content:
        raise CheckpointError(
            f"{path}: of an older release, it does not say enough of its avatar; let the same command go on"
        )
    return make_avatar(path, make_body(settings.body), content["avatar"], own), step
