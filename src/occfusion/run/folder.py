"""Run folders: claimed for one configuration, kept to one process, and recognised when they are finished."""

from __future__ import annotations

import hashlib
import os
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

import occfusion
from occfusion.cpu.processes import helped_folder, is_helper
from occfusion.errors import CheckpointError, ConfigError
from occfusion.files.atomic import create_bytes, json_bytes, write_bytes, write_json
from occfusion.files.digest import changed, digest_of_values, digests
from occfusion.files.jsonfile import parse_json
from occfusion.files.lock import Taken, only_one
from occfusion.files.run_folder import RunFolder, read_json
from occfusion.run.environment import describe_environment
from occfusion.settings.schema import HELD_OUT_SETTINGS, PRIOR_STAGE, Settings, settings_hash, stages_to_run

MAX_SIBLINGS = 1000
MARKER_PATIENCE = 1.0
"""Seconds in which a marker that another process is writing may still be empty (disks without links)."""
TRIAL_SUFFIX = "-trial"

# --- claiming ----------------------------------------------------------------------------------------------


def claim_run_folder(
    settings: Settings, data_hash: str, *, chosen_by_user: bool, data: Mapping[str, str] | None = None
) -> RunFolder:
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
        data_hash: of all that is trained on.
        chosen_by_user: whether the user named the folder.
        data: what the reader took of the data folder, for whoever finds the run later.

    Raises:
        ConfigError: the named folder holds another run, or cannot be written.
    """
    if (helped := helped_folder()) is not None:
        return RunFolder(helped)
    wanted, is_trial = Path(settings.output_dir), settings.trainer.fast_dev_run
    if is_trial and not chosen_by_user:
        wanted = wanted.with_name(wanted.name + TRIAL_SUFFIX)
    description = {
        "identity": {"settings": settings_hash(settings), "data": data_hash},
        **describe_environment(),
        "data": dict(data or {}),
    }
    for folder in _candidates(wanted, chosen_by_user):
        try:
            if _claim(folder, settings, description):
                if is_trial:
                    _forget(folder)
                return folder
        except OSError as error:
            raise ConfigError(f"output_dir={folder.path} cannot be written: {error.strerror}") from error
        if chosen_by_user:
            raise ConfigError(
                f"output_dir={folder.path} holds a run with other settings or data (see {folder.config}); "
                f"name another folder, or move that one away"
            )
    raise ConfigError(f"output_dir={wanted}: {MAX_SIBLINGS} numbered folders are taken; name another")


@contextmanager
def at_work(folder: RunFolder) -> Iterator[None]:
    """Keeps a run folder to this process for the length of a `with` block.

    Raises:
        ConfigError: another process, which this one does not help, is at work on this very run.
    """
    with ExitStack() as stack:
        try:
            if not is_helper():
                stack.enter_context(only_one(folder.lock, wait=False))
        except Taken as holder:
            raise ConfigError(
                f"output_dir={folder.path}: {holder} is at work on this very run; wait for it, or name another folder"
            ) from None
        yield


def _candidates(wanted: Path, chosen_by_user: bool) -> Iterator[RunFolder]:
    """Yields the wanted folder and, unless the user named it, its numbered siblings."""
    yield RunFolder(wanted)
    if not chosen_by_user:
        yield from (
            RunFolder(wanted.with_name(f"{wanted.name}-{number}")) for number in range(2, MAX_SIBLINGS)
        )


def _claim(folder: RunFolder, settings: Settings, description: dict[str, Any]) -> bool:
    """Makes a folder this run's own where it is nobody's or its own already; returns whether it is."""
    path, marker = folder.path, folder.environment
    if path.exists() and not path.is_dir():
        return False
    path.mkdir(parents=True, exist_ok=True)
    if not marker.exists():
        # looked for again, since another process may have come between
        if any(not _is_unfinished(there, folder) for there in path.iterdir()) and not marker.exists():
            return False
        create_bytes(marker, json_bytes(description))
    if _identity_in(marker) != description["identity"]:
        return False
    config = OmegaConf.create(asdict(settings))
    write_bytes(folder.config, OmegaConf.to_yaml(config).encode())
    write_json(marker, description | {"settings_sha256": digest_of_values(OmegaConf.to_container(config))})
    return True


def _forget(folder: RunFolder) -> None:
    """Removes what an earlier trial left, unless that one is at work still."""
    with suppress(Taken), only_one(folder.lock, wait=False):
        for path in folder.taken_over:
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)


def _is_unfinished(path: Path, folder: RunFolder) -> bool:
    """Returns whether a file is one that another process is about to write, or was when it was killed."""
    return path == folder.lock or (path.name.startswith(".") and path.name.endswith(".partial"))


def _identity_in(marker: Path) -> Any:
    deadline = time.monotonic() + MARKER_PATIENCE
    while True:
        text = marker.read_text(encoding="utf-8", errors="replace")
        try:
            return parse_json(text)["identity"]
        except (ValueError, KeyError, TypeError) as error:
            if text or time.monotonic() > deadline:
                raise CheckpointError(
                    f"{marker} is not readable as a run's description; move the folder away"
                ) from error
        time.sleep(0.02)


# --- recognising what is finished --------------------------------------------------------------------------


@dataclass(frozen=True)
class Identity:
    """What the results of a call belong to, worked out once from its settings; the data's hash comes beside it.

    Attributes:
        asked: settings, stages and evaluation, as far as they decide results, and the program's version.
        is_reusable: whether a result can stand for running; a trial of the code and a prior's training cannot.
        sources: folders and files that are read; empty where the scene has no folder of its own under
            `dataset.root`, so that this cannot be told.
    """

    asked: dict[str, Any]
    is_reusable: bool
    sources: tuple[Path, ...]

    @cached_property
    def source(self) -> str | None:
        """Fingerprint of names, sizes and times of change of all files that are read; None where they are not known."""
        state = hashlib.sha256()
        for path in self.sources:
            for line in sorted(_states(path)):
                state.update(line.encode())
        return state.hexdigest()[:16] if self.sources else None


def identify(settings: Settings) -> Identity:
    """Returns what the results of a call with these settings belong to."""
    evaluation, stages = asdict(settings.evaluation), stages_to_run(settings)
    again = evaluation.pop("again")
    asked = {
        "settings": settings_hash(settings),
        "stages": stages,
        "evaluation": evaluation,
        "held_out": {key: getattr(settings.dataset, key, None) for key in HELD_OUT_SETTINGS},
        "occfusion": occfusion.__version__,
    }
    evaluates = settings.stage.name != PRIOR_STAGE and stages != ["init"]
    is_reusable = evaluates and not again and not settings.trainer.fast_dev_run
    return Identity(asked, is_reusable, _sources(settings))


def record_finished(folder: RunFolder, identity: Identity, data_hash: str) -> None:
    """Writes down what a run folder's results belong to; the last thing that a run does."""
    files, tables = digests(folder.path, folder.results), digests(folder.path, folder.measured_in_training)
    record = {"identity": identity.asked, "data": data_hash, "source": identity.source}
    write_json(folder.finished, record | {"sha256": files, "tables": tables})


def finished_in(folder: RunFolder, identity: Identity, data_hash: str) -> dict[str, Any] | None:
    """Returns the figures of the same settings, data and evaluation in a folder, or None.

    Tables of an earlier end that are damaged are put aside, and said: the folder must be kept to this process.
    """
    _set_aside(folder.altered_tables())
    record = read_if_whole(folder.finished)
    is_same = record.get("identity") == identity.asked and record.get("data") == data_hash
    return _figures(folder) if identity.is_reusable and is_same else None


def find_finished(settings: Settings, *, chosen_by_user: bool) -> tuple[Path, dict[str, Any]] | None:
    """Returns folder and figures of a finished run of the same settings on files unchanged since, or None.

    Looks where `claim_run_folder` would, without opening the data or building anything. None does not mean that
    there is no such run, only that the data must be opened to know.
    """
    identity = identify(settings)
    if not identity.is_reusable or not identity.sources:
        return None
    for folder in _candidates(Path(settings.output_dir), chosen_by_user):
        if not folder.path.is_dir():
            return None
        record = read_if_whole(folder.finished)
        if record.get("identity") == identity.asked:
            is_whole = record.get("source") == identity.source and not folder.altered_tables()
            figures = _figures(folder) if is_whole else None
            return None if figures is None else (folder.path, figures)
    return None


def _sources(settings: Settings) -> tuple[Path, ...]:
    root, scene = settings.dataset.root, settings.dataset.scene
    if not root or not scene:
        return ()
    own = Path(root) / str(scene)
    # embedded scenes lie one level deeper, in a folder for each size and length; settings of the turn lengthen the name
    turns = any(getattr(settings.dataset, key, None) is not None for key in ("turn", "facing"))
    pattern = f"{scene}*" if turns else scene
    folders = (
        [own] if own.is_dir() else sorted(path for path in Path(root).glob(f"*/{pattern}") if path.is_dir())
    )
    if not folders:
        return ()
    others = [settings.body.path, settings.dataset.occlusion.folder]
    return (*folders, *(Path(other) for other in others if other))


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


def _figures(folder: RunFolder) -> dict[str, Any] | None:
    """Returns the figures of a finished run; None, which is said, where any of its results is damaged or missing."""
    try:
        gone = changed(folder.path, dict(read_if_whole(folder.finished).get("sha256", {})))
    except (TypeError, ValueError):
        gone = [folder.finished]
    gone += [*folder.masks.altered(), *folder.inpainted.altered()]  # a finished run may be without them
    if gone:
        print(f"{gone[0]} is missing, or not as the run left it; what it needs is made again")
        return None
    metrics = read_if_whole(folder.metrics)
    return metrics if "regions" in metrics else None


def _set_aside(tables: Sequence[Path]) -> None:
    for path in tables:
        said = f"{path} is missing, or not as the run left it; only training could make it again"
        if path.is_file():
            aside = path.with_name(f"{path.name}.damaged")
            path.replace(aside)
            said += f". It lies in {aside.name} now, and the report goes without it"
        print(said)


def read_if_whole(path: Path) -> dict[str, Any]:
    """Returns the content of a record; empty where it is missing or damaged."""
    with suppress(CheckpointError):
        return read_json(path)
    return {}
