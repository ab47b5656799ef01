"""The run folder: claimed for one configuration, described for whoever finds it later."""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf

import occfusion
from occfusion.cpu.processes import helped_folder, is_helper
from occfusion.errors import CheckpointError, ConfigError
from occfusion.files.atomic import create_bytes, json_bytes, write_bytes, write_json
from occfusion.files.lock import Taken, only_one
from occfusion.settings.schema import STAGES, Settings, settings_hash

PACKAGES = (
    "torch", "lightning", "hydra-core", "kornia", "trimesh", "opencv-contrib-python-headless",
    "torchmetrics", "numpy", "numba", "safetensors",
)  # fmt: skip
MAX_SIBLINGS = 1000
MARKER = "environment.json"
"""The file whose creation makes a folder a run's own."""
MARKER_PATIENCE = 1.0
"""Seconds in which a marker that another process is writing may still be empty (disks without links)."""
LOCK = ".at_work"
TRIAL_SUFFIX = "-trial"
TAKEN_OVER = (*STAGES, "masks", "inpainted", "metrics.json", "error_vs_time.csv", "losses.csv")
"""What a later call on the same folder would take over instead of doing it."""


def claim_run_folder(
    settings: Settings, data_hash: str, *, chosen_by_user: bool, data: Mapping[str, str] | None = None
) -> Path:
    """Returns the folder for this run, made ready: new, or one that the same settings and data left off.

    A default folder that holds another run is left alone and a numbered sibling is used; a folder that the user
    named is refused instead, since scripts look into the folder that they name. Of several processes that ask for
    one folder with different settings at the same time, exactly one gets it.

    A trial (`trainer.fast_dev_run`) goes beside the default folder, under its name with `-trial`, so that the whole
    run finds its own free; what an earlier trial with the same settings left there is removed, since a trial that
    took a result over would try nothing.

    A process that helps another to train is given that one's folder.

    Args:
        settings: of the run.
        data_hash: of all that is read.
        chosen_by_user: whether the user named the folder.
        data: what the reader took of the data folder, for whoever finds the run later.

    Raises:
        ConfigError: the named folder holds another run, or cannot be written.
    """
    if (helped := helped_folder()) is not None:
        return helped
    wanted, is_trial = Path(settings.output_dir), settings.trainer.fast_dev_run
    if is_trial and not chosen_by_user:
        wanted = wanted.with_name(wanted.name + TRIAL_SUFFIX)
    description = {
        "identity": {"settings": settings_hash(settings), "data": data_hash},
        **describe_environment(),
        "data": dict(data or {}),
    }
    for number in range(1, MAX_SIBLINGS):
        folder = wanted if number == 1 else wanted.with_name(f"{wanted.name}-{number}")
        try:
            if _claim(folder, settings, description):
                if is_trial:
                    _forget(folder)
                return folder
        except OSError as error:
            raise ConfigError(f"output_dir={folder} cannot be written: {error.strerror}") from error
        if chosen_by_user:
            raise ConfigError(
                f"output_dir={folder} holds a run with other settings or data (see {folder / 'config.yaml'}); "
                f"name another folder, or move that one away"
            )
    raise ConfigError(f"output_dir={wanted}: {MAX_SIBLINGS} numbered folders are taken; name another")


@contextmanager
def at_work(folder: Path) -> Iterator[None]:
    """Keeps a run folder to this process for the length of a `with` block.

    Raises:
        ConfigError: another process, which this one does not help, is at work on this very run.
    """
    with ExitStack() as stack:
        try:
            if not is_helper():
                stack.enter_context(only_one(folder / LOCK, wait=False))
        except Taken as holder:
            raise ConfigError(
                f"output_dir={folder}: {holder} is at work on this very run; wait for it, or name another folder"
            ) from None
        yield


def _claim(folder: Path, settings: Settings, description: dict[str, Any]) -> bool:
    """Makes a folder this run's own where it is nobody's or its own already; returns whether it is."""
    if folder.exists() and not folder.is_dir():
        return False
    folder.mkdir(parents=True, exist_ok=True)
    marker = folder / MARKER
    if not marker.exists():
        # looked for again, since another process may have come between
        if any(not _is_unfinished(path) for path in folder.iterdir()) and not marker.exists():
            return False
        create_bytes(marker, json_bytes(description))
    if _identity_in(marker) != description["identity"]:
        return False
    write_bytes(folder / "config.yaml", OmegaConf.to_yaml(OmegaConf.create(asdict(settings))).encode())
    write_json(marker, description)
    return True


def _forget(folder: Path) -> None:
    """Removes what an earlier trial left, unless that one is at work still."""
    with suppress(Taken), only_one(folder / LOCK, wait=False):
        for name in TAKEN_OVER:
            path = folder / name
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)


def _is_unfinished(path: Path) -> bool:
    """Returns whether a file is one that another process is about to write, or was when it was killed."""
    return path.name == LOCK or (path.name.startswith(".") and path.name.endswith(".partial"))


def _identity_in(marker: Path) -> Any:
    deadline = time.monotonic() + MARKER_PATIENCE
    while True:
        text = marker.read_text(encoding="utf-8")
        try:
            return json.loads(text)["identity"]
        except (json.JSONDecodeError, KeyError, TypeError) as error:
            if text or time.monotonic() > deadline:
                raise CheckpointError(
                    f"{marker} is not readable as a run's description; move the folder away"
                ) from error
        time.sleep(0.02)


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
