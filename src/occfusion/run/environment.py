"""The machine of a run: whether it can end what is asked, and what it was, down to versions and threads."""

from __future__ import annotations

import logging
import os
import platform
import shutil
import subprocess
import sys
import warnings
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

import occfusion
from occfusion.errors import ConfigError
from occfusion.settings.schema import Settings

PACKAGES = (
    "torch", "lightning", "hydra-core", "kornia", "trimesh", "opencv-contrib-python-headless",
    "torchmetrics", "numpy", "numba", "safetensors",
)  # fmt: skip
ROOM_MB = 48
"""A run writes three checkpoints and avatars of some 5 MB each at least, and pictures."""


def quiet_lightning() -> None:
    """Leaves out what Lightning says of each training, and advice that does not apply here."""
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    # worker counts and missing loggers: these loaders have neither
    warnings.filterwarnings("ignore", module="lightning.*")
    # DDP's on the memory layout of small gradients
    warnings.filterwarnings("ignore", message="Grad strides do not match bucket view strides")


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


def accelerator_of(settings: Settings) -> str:
    """Returns what a run trains on, `cuda` or `cpu`.

    Lightning's own `auto` would take Apple's GPUs, which have no float64.
    """
    on_gpu = settings.trainer.accelerator != "cpu" and torch.cuda.is_available()
    return "cuda" if on_gpu else "cpu"


def describe_environment() -> dict[str, Any]:
    """Returns versions, hardware, threads, revision and command of this process."""
    # an installed package may lie in a folder of somebody else's repository, whose revision says nothing of it
    is_tracked = _git("ls-files", "--error-unmatch", Path(__file__).name) is not None
    return {
        "occfusion": occfusion.__version__,
        "command": " ".join([Path(sys.argv[0]).name.replace("__main__.py", "occfusion"), *sys.argv[1:]]),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in PACKAGES},
        "system": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "accelerator": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "git_revision": _git("rev-parse", "HEAD") if is_tracked else None,
        "git_changed": bool(_git("status", "--porcelain")) if is_tracked else None,
    }


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor()


def _git(*arguments: str) -> str | None:
    here = Path(__file__).parent
    try:
        done = subprocess.run(
            ["git", *arguments], cwd=here, capture_output=True, text=True, timeout=10, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None
