"""Results of stages that several variants share: computed once, then linked into each run folder."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from occfusion.files.lock import only_one

SHARED = ".shared"
STAGE_RECORD = "stage.json"
"""In a shared folder: the record of the stage that made it, beside its files."""


def shared_folder(run_folder: Path, chosen: str | None, stage: str, identity: Mapping[str, Any]) -> Path:
    """Returns where a stage's result of this identity is shared.

    Args:
        run_folder: the run that asks; variants of a scene lie beside each other by default.
        chosen: the setting `shared_dir`; None for a folder beside the run folder.
        stage: name of the stage.
        identity: all that the result depends on; must be writable as JSON.
    """
    root = Path(chosen) if chosen is not None else run_folder.parent / SHARED
    key = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:16]
    return root / stage / key


@contextlib.contextmanager
def sole_maker(shared: Path, stage: str) -> Iterator[None]:
    """Lets one run at a time make what is shared; the others wait, and then find it made.

    Args:
        shared: from `shared_folder`.
        stage: its name, for the message to whoever waits.
    """

    def say() -> None:
        print(f"{stage}: another run is making the same; waiting for it", flush=True)

    with only_one(shared.parent.parent / f".{stage}-{shared.name}.lock", on_wait=say):
        yield


def offer(shared: Path, results: Path, record: Path, without: Collection[str] = ()) -> None:
    """Shares a finished stage's results, unless they are shared already or the disk refuses.

    Sharing saves time and nothing else, so a failure to do so is no error.

    Args:
        shared: from `shared_folder`; appears whole or not at all.
        results: the folder with the stage's files.
        record: its `stage.json`.
        without: names of files that nobody else needs.
    """
    if shared.exists():
        return
    with contextlib.suppress(OSError):
        shared.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{shared.name}.", dir=shared.parent))
        try:
            _link_tree(results, partial / "results", without)
            shutil.copy2(record, partial / STAGE_RECORD)
            os.rename(partial, shared)  # fails where another run was faster
        finally:
            shutil.rmtree(partial, ignore_errors=True)


def take(shared: Path, results: Path) -> dict[str, Any] | None:
    """Puts shared results into a run's folder; returns the record of the stage that made them, or None.

    Args:
        shared: from `shared_folder`.
        results: the folder for the stage's files; those of the same name are replaced.

    Returns:
        None where nothing is shared or what is shared cannot be read; the stage then computes.
    """
    try:
        record = json.loads((shared / STAGE_RECORD).read_text(encoding="utf-8"))
        _link_tree(shared / "results", results)
    except (OSError, ValueError):
        return None
    return record if isinstance(record, dict) else None


def discard(shared: Path) -> None:
    """Removes shared results that turned out to be incomplete; files in run folders stay."""
    with contextlib.suppress(OSError):
        # under another name first, so that nobody finds half of it
        doomed = Path(tempfile.mkdtemp(prefix=f".{shared.name}.", dir=shared.parent))
        try:
            os.rename(shared, doomed)
        finally:
            shutil.rmtree(doomed, ignore_errors=True)


def _link_tree(source: Path, target: Path, without: Collection[str] = ()) -> None:
    """Links all files of a folder into another; copies them where links are not possible.

    Files are replaced, never written into, everywhere in this package, so that links do no harm.
    """
    for file in sorted(path for path in source.rglob("*") if path.is_file() and path.name not in without):
        there = target / file.relative_to(source)
        there.parent.mkdir(parents=True, exist_ok=True)
        there.unlink(missing_ok=True)
        try:
            os.link(file, there)
        except OSError:
            shutil.copy2(file, there)
