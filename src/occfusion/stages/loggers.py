"""Lightning's loggers beside `losses.csv`: TensorBoard and Weights & Biases, with pictures; imported where chosen."""

from __future__ import annotations

import importlib.util
import secrets
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from lightning.pytorch.loggers import Logger
from numpy.typing import NDArray
from torch import Tensor

from occfusion.errors import ConfigError
from occfusion.evaluation.pictures import to_uint8
from occfusion.files.atomic import write_bytes
from occfusion.files.run_folder import RunFolder
from occfusion.settings.schema import Settings
from occfusion.settings.stages import LoggerSettings
from occfusion.stages.base import Stage
from occfusion.stages.losses_log import LossLog
from occfusion.types import Frame, Rendering


def check_logger(settings: LoggerSettings) -> None:
    """Refuses a logger whose package is missing.

    Raises:
        ConfigError: with what to do.
    """
    if settings.name != "csv" and importlib.util.find_spec(settings.name) is None:
        raise ConfigError(
            f"logger={settings.name} needs the extra `{settings.name}`: pip install -e '.[{settings.name}]'; or leave "
            f"logger=csv, which needs nothing"
        )


@dataclass(frozen=True)
class Pictured:
    """What pictures are made of.

    Attributes:
        views: gives the frames, by the names of the pictures; asked where a logger takes pictures.
        render: renders a frame with the avatar as it is.
    """

    views: Callable[[], Mapping[str, Frame]]
    render: Callable[[Frame], Rendering]


def make_logs(
    settings: Settings,
    folder: RunFolder,
    stage: str,
    checkpoint: Path | None,
    pictured: Pictured | None = None,
) -> tuple[list[Logger], list[L.Callback]]:
    """Returns what logs a stage: `losses.csv` always, and the chosen logger, which a trial leaves alone.

    These are loggers for the trainer, and callbacks that come before the one that saves checkpoints.

    Args:
        settings: of the run; checked by `check_logger`.
        folder: of the run.
        stage: name of the stage.
        checkpoint: that the stage continues from; None where it starts.
        pictured: for pictures; None: there are none.

    Raises:
        ConfigError: Weights & Biases cannot begin.
    """
    chosen = settings.logger
    table = LossLog(folder.losses, chosen.every)
    if chosen.name == "csv" or settings.trainer.fast_dev_run:
        return [], [table]
    if chosen.name == "tensorboard":
        logger = _tensorboard(folder, stage, checkpoint)
    else:
        logger = _wandb(settings, folder, stage, checkpoint)
    callbacks: list[L.Callback] = [table, EndOfLoggers()]
    if pictured is not None and chosen.pictures_every:
        callbacks.append(LoggedPictures(pictured.views(), pictured.render, chosen.pictures_every))
    return [logger], callbacks


def _tensorboard(folder: RunFolder, stage: str, checkpoint: Path | None) -> Logger:
    from lightning.pytorch.loggers import TensorBoardLogger

    # points of steps that will be done again are hidden; a folder a stage, for their steps count from 0 each
    first = 0
    if checkpoint is not None:
        first = torch.load(checkpoint, map_location="cpu", weights_only=True, mmap=True)["global_step"] + 1
    parent, name = folder.tensorboard.parent, folder.tensorboard.name
    return TensorBoardLogger(parent, name=name, version=stage, default_hp_metric=False, purge_step=first)


def _wandb(settings: Settings, folder: RunFolder, stage: str, checkpoint: Path | None) -> Logger:
    import wandb
    from lightning.pytorch.loggers import WandbLogger

    known = folder.wandb_id(stage)
    if checkpoint is None or not known.is_file():
        write_bytes(known, secrets.token_hex(8).encode())
    logger = WandbLogger(
        name=f"{folder.path.name} {stage}",
        save_dir=folder.path,
        id=known.read_text(encoding="ascii"),
        project=settings.logger.project,
        mode="offline" if settings.logger.offline else None,
        group=str(folder.path),
        job_type=stage,
        config={**asdict(settings), "stage": stage},
    )
    try:
        _ = logger.experiment  # now, not when the trainer is halfway through its own start
    except wandb.Error as error:
        raise ConfigError(
            f"logger=wandb: {str(error).splitlines()[0]} (`wandb login` once, or logger.offline=true)"
        ) from error
    return logger


class EndOfLoggers(L.Callback):
    """Ends the runs of Weights & Biases, or the next stage would be logged into this one's."""

    def teardown(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        """At the end of a stage."""
        end_loggers(trainer.loggers)

    def on_exception(
        self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException
    ) -> None:
        """After the last rows before a fault."""
        end_loggers(trainer.loggers)


def end_loggers(loggers: list[Logger]) -> None:
    """Ends what a logger would leave open; TensorBoard's files are closed by the trainer."""
    for logger in loggers:
        finish = getattr(getattr(logger, "experiment", None), "finish", None)
        if finish is not None:
            finish()


class LoggedPictures(L.Callback):
    """Gives the trainer's loggers a few renderings, each beside the truth.

    The training clock stands still meanwhile.

    Args:
        frames: to be rendered, by the name of the picture.
        render: renders a frame with the avatar as it is.
        every: steps from one picture to the next.
    """

    def __init__(self, frames: Mapping[str, Frame], render: Callable[[Frame], Rendering], every: int) -> None:
        self._frames, self._render, self._every = frames, render, every

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        """Renders when it is time."""
        assert isinstance(pl_module, Stage)
        if trainer.global_step % self._every:
            return
        with pl_module.clock.paused(), torch.inference_mode():
            was_training = pl_module.training
            pl_module.eval()
            pictures = {
                name: beside_truth(self._render(frame).rgb, frame) for name, frame in self._frames.items()
            }
            pl_module.train(was_training)
            for logger in trainer.loggers:
                for name, picture in pictures.items():
                    _log_picture(logger, f"pictures/{name}", picture, trainer.global_step)


def beside_truth(rgb: Tensor, frame: Frame) -> NDArray[np.uint8]:
    """Returns a rendering, `[H, W, 3]` in 0..1, with the truth to its right, `[H, 2 W, 3]`.

    Where the truth is not known, what the camera saw stands in its place.
    """
    truth = (frame.rgb if frame.truth is None else frame.truth.rgb).to(rgb)
    return to_uint8(torch.cat([rgb, truth], dim=1))


def _log_picture(logger: Any, name: str, picture: NDArray[np.uint8], step: int) -> None:
    if hasattr(logger, "log_image"):
        logger.log_image(key=name, images=[picture], step=step)
    else:
        logger.experiment.add_image(name, picture, step, dataformats="HWC")
