"""What can be known of the machine before any work starts: its accelerator, and the room on its disk."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import torch

from occfusion.errors import ConfigError
from occfusion.settings.schema import Settings

ROOM_MB = 48
"""A run writes three checkpoints and avatars of some 5 MB each at least, and pictures."""


def check_machine(settings: Settings) -> None:
    """Refuses a machine that could not end what is asked of it.

    Raises:
        ConfigError: no such accelerator, or a full or read-only disk.
    """
    trainer = settings.trainer
    on_gpu = trainer.accelerator in ("gpu", "cuda")
    there = torch.cuda.device_count() if on_gpu or trainer.accelerator == "auto" else 0
    if on_gpu and trainer.devices > there:
        raise ConfigError(
            f"settings trainer.accelerator={trainer.accelerator} trainer.devices={trainer.devices}: "
            f"{there or 'no'} GPUs are usable here (torch {torch.__version__}); choose trainer.accelerator=cpu"
        )
    place = Path(settings.output_dir).absolute()
    exists = next(folder for folder in (place, *place.parents) if folder.exists())
    if not os.access(exists, os.W_OK | os.X_OK):
        raise ConfigError(
            f"output_dir={settings.output_dir}: {exists} cannot be written (rights, or a read-only disk); name another "
            "folder"
        )
    free = shutil.disk_usage(exists).free / 1e6
    if free < ROOM_MB:
        raise ConfigError(
            f"output_dir={settings.output_dir}: {free:.0f} MB are free there and a run needs {ROOM_MB} MB or more; "
            "make room, or name a folder on another disk"
        )
