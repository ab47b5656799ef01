"""One step of a run alone, as it was when it was not finite."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import lightning as L
import numpy as np

from occfusion.errors import CheckpointError, NumericsError
from occfusion.files.arrays import load_npz
from occfusion.files.run_folder import STAGES, RunFolder
from occfusion.run.loaded import read_settings
from occfusion.run.prepare import build, decide, observe
from occfusion.settings.schema import StageChoice


@dataclass(frozen=True)
class Replayed:
    """What came of a step.

    Attributes:
        stage: whose step it is.
        step: how many were done before it.
        frame: name of its frame.
        was: what it ended with.
        now: what it ends with now; None: it is finite.
        same_frame: whether the data are those that were kept.
    """

    stage: str
    step: int
    frame: str
    was: str
    now: str | None
    same_frame: bool


def replay(path: Path) -> Replayed:
    """Repeats the one step that a file was kept of, from the checkpoint beside it, in a copy of the run folder.

    Args:
        path: `bad_step.npz` in the folder of a stage.

    Raises:
        CheckpointError: no kept step, or the checkpoint beside it is of another step.
    """
    kept = load_npz(path)
    missing = [name for name in ("stage", "step", "frame", "why", "rgb") if name not in kept]
    if missing:
        raise CheckpointError(
            f"{path}: no kept step, {', '.join(missing)} missing; a run writes it when it stops at one"
        )
    stage, step = str(kept["stage"]), int(kept["step"])
    folder = RunFolder(path.absolute().parent.parent)
    settings = read_settings(folder)
    if stage not in STAGES:
        raise CheckpointError(f"{path}: no stage of that name: {stage!r}")
    L.seed_everything(settings.seed, verbose=False)
    asked = replace(
        settings, stage=StageChoice(stage), trainer=replace(settings.trainer, enable_progress_bar=False)
    )
    observed = observe(asked)
    plan = decide(asked, observed)
    frame = observed.data.frame_at(step)
    same = frame.name == str(kept["frame"]) and np.array_equal(frame.rgb.numpy(), kept["rgb"])
    with tempfile.TemporaryDirectory(prefix="occfusion-replay-") as place:
        copy = RunFolder(Path(place) / "run")
        shutil.copytree(folder.path, copy.path)
        one = replace(asked.trainer, max_steps=step + 1)
        run = build(replace(asked, trainer=one, shared_dir=str(Path(place) / "shared")), observed, plan, copy)
        now = None
        try:
            run.run_stages()
        except NumericsError as error:
            now = str(error)
    return Replayed(stage, step, str(kept["frame"]), str(kept["why"]), now, same)
