"""What Hydra's launchers need: their packages, and an end of what only one process at a time can do."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping, Sequence
from typing import Any

EXTRAS = {
    "joblib": ("hydra_joblib_launcher", "fleet"),
    "submitit_local": ("hydra_submitit_launcher", "fleet"),
    "submitit_slurm": ("hydra_submitit_launcher", "fleet"),
    "ray": ("hydra_ray_launcher", "ray"),
}
"""By the name of the launcher: its plugin, and the extra that installs it."""
CHOICE = "hydra/launcher="
SERIAL = "BasicLauncher"


def missing_launcher(arguments: Sequence[str]) -> str | None:
    """Returns what to do where the command line asks for a launcher that is not installed, else None."""
    for argument in arguments:
        name = argument.removeprefix(CHOICE) if argument.startswith(CHOICE) else ""
        if name in EXTRAS and not _is_installed(EXTRAS[name][0]):
            return f'{argument} needs the extra `{EXTRAS[name][1]}`: pip install -e ".[{EXTRAS[name][1]}]"'
    return None


def is_parallel(launcher: Mapping[str, Any]) -> bool:
    """Returns whether jobs run beside each other, in processes of their own."""
    return not str(launcher.get("_target_", SERIAL)).endswith(SERIAL)


def _is_installed(plugin: str) -> bool:
    try:
        return importlib.util.find_spec(f"hydra_plugins.{plugin}") is not None
    except ModuleNotFoundError:
        return False
