"""Reading a stage's checkpoints, for whoever continues or shows it; the trainer that wrote them is not needed."""

from __future__ import annotations

import pickle
import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import Any

import torch

from occfusion.errors import CheckpointError
from occfusion.files.run_folder import StageFolder

PARTS = ("state_dict", "global_step", "optimizer_states", "loops")


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Returns the content of a checkpoint; nothing in it is executed.

    Raises:
        CheckpointError: truncated, changed, or no checkpoint of a stage.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            if (wrong := archive.testzip()) is not None:
                raise CheckpointError(f"{path} is damaged (checksum of {wrong})")
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, EOFError, OSError, ValueError, zipfile.BadZipFile, pickle.UnpicklingError) as error:
        raise CheckpointError(f"{path} is damaged ({(str(error) or 'empty').splitlines()[0]})") from error
    missing = [part for part in PARTS if not isinstance(content, dict) or part not in content]
    if missing:
        raise CheckpointError(f"{path} is no checkpoint of a stage: {', '.join(missing)} missing")
    return content


def newest_whole(path: Path, wanted: Collection[str] = ()) -> tuple[Path | None, list[str]]:
    """Returns the newest checkpoint of a stage that is whole, or None, and what is wrong with those after it.

    Args:
        path: of the newest.
        wanted: names in the state that it must have.

    Raises:
        CheckpointError: there are some, and none is whole.
    """
    problems = []
    for candidate in (path, StageFolder(path.parent).earlier_checkpoint):
        if not candidate.is_file():
            continue
        try:
            missing = set(wanted) - set(read_checkpoint(candidate)["state_dict"])
            if missing:
                raise CheckpointError(f"{candidate} is of another stage or release: {min(missing)} missing")
        except CheckpointError as error:
            problems.append(str(error))
        else:
            return candidate, problems
    if problems:
        raise CheckpointError(f"{'; '.join(problems)}; remove {path.parent} to start the stage anew")
    return None, []
