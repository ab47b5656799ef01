"""Finished runs: recorded when they end, and recognised without opening the data or building anything."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import occfusion
from occfusion.files.atomic import write_json
from occfusion.settings.schema import PRIOR_STAGE, Settings, settings_hash, stages_to_run

RECORD = "finished.json"
MAX_SIBLINGS = 1000


@dataclass(frozen=True)
class Finished:
    """A run that needs nothing more.

    Attributes:
        folder: the run folder.
        metrics: the content of its `metrics.json`.
    """

    folder: Path
    metrics: dict[str, Any]


def record_finished(folder: Path, settings: Settings, data_hash: str) -> None:
    """Writes down what a run folder's results belong to; the last thing that a run does."""
    write_json(
        folder / RECORD,
        {"identity": _identity(settings), "data": data_hash, "source": source_state(settings)},
    )


def finished_in(folder: Path, settings: Settings, data_hash: str) -> Finished | None:
    """Returns the result of the same settings, data and evaluation in `folder`, or None."""
    if not _may_be_taken_over(settings):
        return None
    record = _read(folder / RECORD)
    same = record.get("identity") == _identity(settings) and record.get("data") == data_hash
    return _result(folder) if same else None


def find_finished(settings: Settings, *, chosen_by_user: bool) -> Finished | None:
    """Returns a finished run of the same settings on files that have not changed since, or None.

    Looks where `claim_run_folder` would: at `output_dir` and, unless the user named it, at its numbered
    siblings. That files are the same is judged by their names, sizes and times of change; None does not mean
    that there is no such run, only that the data must be opened to know.
    """
    if not _may_be_taken_over(settings):
        return None
    wanted, identity = Path(settings.output_dir), _identity(settings)
    for number in range(1, 2 if chosen_by_user else MAX_SIBLINGS):
        folder = wanted if number == 1 else wanted.with_name(f"{wanted.name}-{number}")
        if not folder.is_dir():
            return None
        record = _read(folder / RECORD)
        if record.get("identity") == identity:
            state = source_state(settings)
            return _result(folder) if state is not None and record.get("source") == state else None
    return None


def source_state(settings: Settings) -> str | None:
    """Returns a fingerprint of names, sizes and times of change of all files that a run reads.

    None where the scene has no folder of its own under `dataset.root`, so that this cannot be told.
    """
    root, scene = settings.dataset.root, settings.dataset.scene
    if not root or not scene:
        return None
    own = Path(root) / str(scene)
    # embedded scenes lie one level deeper, in a folder for each size and length; settings of the turn lengthen the name
    turns = any(getattr(settings.dataset, key, None) is not None for key in ("turn", "facing"))
    pattern = f"{scene}*" if turns else scene
    folders = (
        [own] if own.is_dir() else sorted(path for path in Path(root).glob(f"*/{pattern}") if path.is_dir())
    )
    if not folders:
        return None
    others = [settings.body.path, settings.dataset.occlusion.folder]
    digest = hashlib.sha256()
    for path in [*folders, *(Path(other) for other in others if other)]:
        for line in sorted(_states(path)):
            digest.update(line.encode())
    return digest.hexdigest()[:16]


def _states(path: Path) -> Iterator[str]:
    if not path.is_dir():
        yield _state(path.name, path.stat()) if path.is_file() else f"{path.name} missing\n"
        return
    for folder, _, files in os.walk(path):
        for name in files:
            file = Path(folder, name)
            yield _state(file.relative_to(path).as_posix(), file.stat())


def _state(name: str, stat: os.stat_result) -> str:
    return f"{name} {stat.st_size} {stat.st_mtime_ns}\n"


def _may_be_taken_over(settings: Settings) -> bool:
    """Returns whether a result can stand for running; a trial of the code and a prior's training cannot."""
    evaluates = settings.stage.name != PRIOR_STAGE and stages_to_run(settings) != ["init"]
    return evaluates and not settings.evaluation.again and not settings.trainer.fast_dev_run


def _identity(settings: Settings) -> dict[str, Any]:
    evaluation = asdict(settings.evaluation)
    del evaluation["again"]
    return {
        "settings": settings_hash(settings),
        "stages": stages_to_run(settings),
        "evaluation": evaluation,
        "occfusion": occfusion.__version__,
    }


def _result(folder: Path) -> Finished | None:
    metrics = _read(folder / "metrics.json")
    return Finished(folder, metrics) if "regions" in metrics else None


def _read(path: Path) -> dict[str, Any]:
    """Returns the content of a JSON file; empty where it is missing or damaged."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
