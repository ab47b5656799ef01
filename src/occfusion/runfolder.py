"""The run folder: claimed for one configuration, described for whoever finds it later."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from dataclasses import asdict
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf

import occfusion
from occfusion.config import Settings, settings_hash
from occfusion.errors import CheckpointError, ConfigError
from occfusion.files.atomic import write_bytes, write_json

PACKAGES = (
    "torch", "lightning", "hydra-core", "kornia", "trimesh", "opencv-contrib-python-headless",
    "torchmetrics", "numpy", "numba", "safetensors",
)  # fmt: skip
MAX_SIBLINGS = 1000


def claim_run_folder(settings: Settings, data_hash: str, *, chosen_by_user: bool) -> Path:
    """Returns the folder for this run, made ready: new, or one that the same settings and data left off.

    A default folder that holds another run is left alone and a numbered sibling is used; a folder that the user
    named is refused instead, since scripts look into the folder that they name.

    Raises:
        ConfigError: the named folder holds another run, or cannot be written.
    """
    wanted = Path(settings.output_dir)
    identity = {"settings": settings_hash(settings), "data": data_hash}
    for number in range(1, MAX_SIBLINGS):
        folder = wanted if number == 1 else wanted.with_name(f"{wanted.name}-{number}")
        if _is_free_or_same(folder, identity):
            _prepare(folder, settings, identity)
            return folder
        if chosen_by_user:
            raise ConfigError(
                f"output_dir={folder} holds a run with other settings or data (see {folder / 'config.yaml'}); "
                f"name another folder, or move that one away"
            )
    raise ConfigError(f"output_dir={wanted}: {MAX_SIBLINGS} numbered folders are taken; name another")


def _is_free_or_same(folder: Path, identity: dict[str, str]) -> bool:
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return True
    marker = folder / "environment.json"
    if not marker.is_file():
        return False
    try:
        return bool(json.loads(marker.read_text(encoding="utf-8"))["identity"] == identity)
    except (json.JSONDecodeError, KeyError) as error:
        raise CheckpointError(
            f"{marker} is not readable as a run's description; move the folder away"
        ) from error


def _prepare(folder: Path, settings: Settings, identity: dict[str, str]) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_bytes(folder / "config.yaml", OmegaConf.to_yaml(OmegaConf.create(asdict(settings))).encode())
        write_json(folder / "environment.json", {"identity": identity, **describe_environment()})
    except OSError as error:
        raise ConfigError(f"output_dir={folder} cannot be written: {error.strerror}") from error


def describe_environment() -> dict[str, Any]:
    """Returns versions, hardware, threads, revision and command of this process."""
    return {
        "occfusion": occfusion.__version__,
        "command": " ".join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in PACKAGES},
        "system": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "accelerator": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "git_revision": _git("rev-parse", "HEAD"),
        "git_changed": bool(_git("status", "--porcelain")),
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
