"""Results of stages that several variants share: computed once, then linked into each run folder."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import occfusion
from occfusion.errors import CheckpointError
from occfusion.files.digest import digest_of_values
from occfusion.files.lock import only_one
from occfusion.files.run_folder import RunFolder, StageFolder, read_json

RESULTS = "results"
"""In a shared folder: the stage's files, beside its record."""


def shared_folder(folder: RunFolder, chosen: str | None, stage: str, identity: Mapping[str, Any]) -> Path:
    """Returns where a stage's result of this identity is shared, among runs of the same version of the program.

    Args:
        folder: of the run that asks; variants of a scene lie beside each other by default.
        chosen: the setting `shared_dir`; None for a folder beside the run folder.
        stage: name of the stage.
        identity: all that the result depends on; must be writable as JSON.
    """
    root = folder.shared if chosen is None else Path(chosen)
    return root / stage / digest_of_values({**identity, "occfusion": occfusion.__version__})


def take_or_make(
    shared: Path,
    results: Path,
    record: Path,
    *,
    is_whole: Callable[[], bool],
    make: Callable[[], None],
    without: Collection[str] = (),
) -> dict[str, Any] | None:
    """Takes a stage's shared results, or makes and shares them; one run at a time, while the others wait.

    Args:
        shared: from `shared_folder`.
        results: the folder for the stage's files; those of the same name are replaced.
        record: of the finished stage, written by `make`.
        is_whole: whether what was put into `results` is all that is needed.
        make: does the stage.
        without: names of files that nobody else needs.

    Returns:
        The record of the stage that made them; None where they were made here.
    """
    with sole_maker(shared):
        if shared.is_dir():
            made = take(shared, results)
            if made is not None and is_whole():
                return made
            discard(shared)  # incomplete: what is made now takes its place
        make()
        offer(shared, results, record, without)
    return None


@contextlib.contextmanager
def sole_maker(shared: Path) -> Iterator[None]:
    """Lets one run at a time make what is shared; the others wait, and then find it made."""
    stage = shared.parent.name

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
        record: of the finished stage.
        without: names of files that nobody else needs.
    """
    if shared.exists():
        return
    with contextlib.suppress(OSError):
        shared.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{shared.name}.", dir=shared.parent))
        try:
            _link_tree(results, partial / RESULTS, without)
            shutil.copy2(record, StageFolder(partial).record)
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
        record = read_json(StageFolder(shared).record)
        _link_tree(shared / RESULTS, results)
    except (OSError, CheckpointError):
        return None
    return record


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
