"""What a run ran on: versions, hardware, threads, revision and command."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

import occfusion

PACKAGES = (
    "torch", "lightning", "hydra-core", "kornia", "trimesh", "opencv-contrib-python-headless",
    "torchmetrics", "numpy", "numba", "safetensors",
)  # fmt: skip


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
