"""A signal after a stage's last step: the stage hands over what it made, then the command stops."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from app.conftest import CONF
from app.test_command_line import ENVIRONMENT
from app.test_init import CountingPrior, Make
from app.test_init import body as body
from app.test_init import data as data
from app.test_init import make as make
from app.test_init import observed_frames as observed_frames
from occfusion.cli.train import main
from occfusion.data.zju.zju_data import ZjuDataModule
from occfusion.errors import OccfusionError
from occfusion.run.folder import RunFolder
from occfusion.stages.checkpointing import Checkpointing
from occfusion.stages.init import InitStage
from occfusion.stages.interruption import Interrupted


def test_after_the_last_step_of_training(
    train: Callable[..., tuple[Path, dict[str, Any]]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    original = Checkpointing.on_train_end

    def late(self: Checkpointing, *rest: Any) -> None:
        original(self, *rest)
        signal.raise_signal(signal.SIGINT)

    light = ("stage=optim", "optim.steps=1", "evaluation.curve=false", "evaluation.held_out=false")
    with monkeypatch.context() as patch:
        patch.setattr(Checkpointing, "on_train_end", late)
        with pytest.raises(Interrupted, match="the same command continues") as stopped:
            train(*light)
    assert stopped.value.exit_code == 130
    left = RunFolder(tmp_path / "run").stage("optim")
    assert left.has_avatar and json.loads(left.record.read_text())["steps"] == 1
    assert not RunFolder(tmp_path / "run").metrics.exists()


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_while_the_trainer_prepares_itself(
    train: Callable[..., tuple[Path, dict[str, Any]]],
    monkeypatch: pytest.MonkeyPatch,
    number: signal.Signals,
    code: int,
) -> None:
    """Lightning alone would exit with 1 on the first and with 0 on the second."""

    def early(*_: Any, **__: Any) -> None:
        signal.raise_signal(number)

    monkeypatch.setattr(Checkpointing, "setup", early)
    before = signal.getsignal(number)
    with pytest.raises(Interrupted, match="the same command continues") as stopped:
        train("stage=optim", "optim.steps=9", "evaluation.curve=false", "evaluation.held_out=false")
    assert stopped.value.exit_code == code and signal.getsignal(number) is before


def test_with_the_last_frame(make: Make, data: ZjuDataModule, monkeypatch: pytest.MonkeyPatch) -> None:
    stage = make(CountingPrior(), smoothing=0.0)
    original = InitStage.predict_step

    def last(self: InitStage, *arguments: Any) -> Any:
        record = original(self, *arguments)
        if not self.wanted:
            signal.raise_signal(signal.SIGTERM)
        return record

    monkeypatch.setattr(InitStage, "predict_step", last)
    with pytest.raises(Interrupted) as stopped:
        stage.treat(lambda k: data.train_frame(k, truth=False), stage.wanted, progress=False)
    assert stopped.value.exit_code == 143 and stage.wanted == []
    assert make(CountingPrior(), smoothing=0.0).wanted == []


def test_ctrl_c_outside_of_training_is_one_plain_message(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """While the data are read, pictures are evaluated or a report is written."""

    def stopped(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("occfusion.run.app.run_in_folder", stopped)
    assert main(CONF, ["variant=A", f"dataset.root={tmp_path}", f"output_dir={tmp_path / 'run'}"]) == 130
    said = capsys.readouterr()
    assert "stopped by SIGINT: the same command continues" in said.err
    assert "Traceback" not in said.err + said.out


def test_ctrl_c_ends_a_multirun_with_its_own_code(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Also where a job before it had failed; the job that was stopped says so in the table."""
    runs = []

    def stopped(*_: Any, **__: Any) -> None:
        runs.append(1)
        if len(runs) == 1:
            raise OccfusionError("no")
        raise KeyboardInterrupt

    monkeypatch.setattr("occfusion.run.app.run_in_folder", stopped)
    words = ["-m", "variant=A,B,C", f"dataset.root={tmp_path}", f"hydra.sweep.dir={tmp_path / 'sweep'}"]
    assert main(CONF, words) == 130 and len(runs) == 2
    text = (tmp_path / "sweep" / "table.md").read_text()
    assert "2 jobs" in text and "stopped by SIGINT: the same command continues" in text
    assert "Traceback" not in "".join(capsys.readouterr())


IN_A_DESTRUCTOR = """
import signal, sys, time
from occfusion.cli.interrupts import keep_interrupts

class Held:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)  # Python notices it here, and has nobody to tell

signal.signal(signal.SIGINT, signal.default_int_handler)
if {kept}:
    keep_interrupts()
    keep_interrupts()
held = Held()
del held
try:
    time.sleep(1.0)
except KeyboardInterrupt:
    sys.exit(130)
"""


@pytest.mark.parametrize("kept", [True, False])
def test_ctrl_c_that_falls_into_a_destructor_is_not_lost(kept: bool) -> None:
    """Without it Python prints a traceback and goes on: as soon as it raises again, this is not needed any more."""
    code = IN_A_DESTRUCTOR.format(kept=kept)
    done = subprocess.run(
        [sys.executable, "-c", code], env=ENVIRONMENT, capture_output=True, text=True, check=False
    )
    assert (done.returncode, "Traceback" in done.stderr) == ((130, False) if kept else (0, True)), done.stderr
    assert not kept or done.stderr == ""


HALF_MADE = """
import signal, sys
from occfusion.cli.interrupts import keep_interrupts

class Held:
    def __init__(self, press):
        if press:
            signal.raise_signal(signal.SIGINT)  # as it would fall into a library's constructor
        self.made = True

    def __del__(self):
        if not self.made:
            raise ValueError

signal.signal(signal.SIGINT, signal.default_int_handler)
keep_interrupts()
if {pressed}:
    try:
        Held(True)
    except KeyboardInterrupt:
        pass
else:
    held = Held(False)
    del held.made
    del held
held = Held(False)
held.made = False
"""


@pytest.mark.parametrize("pressed", [True, False])
def test_what_an_interruption_left_half_made_goes_without_a_word(pressed: bool) -> None:
    """An error that is not of that kind is still told, and so is the same one where nobody pressed a key."""
    code = HALF_MADE.format(pressed=pressed)
    done = subprocess.run(
        [sys.executable, "-c", code], env=ENVIRONMENT, capture_output=True, text=True, check=False
    )
    assert done.stderr.count("AttributeError") == (0 if pressed else 1) and "ValueError" in done.stderr


DURING_COMPOSITION = """
import signal, sys
from pathlib import Path
import omegaconf.base
from occfusion.cli.train import main

is_pressed, found = False, omegaconf.base.Node._invalidate_flags_cache
def pressed(node):
    global is_pressed
    frame, names = sys._getframe(1), set()
    while frame:
        names.add(frame.f_code.co_name)
        frame = frame.f_back
    if not is_pressed and names >= {{"load_config", "append", "flag_override"}}:
        is_pressed = True
        signal.raise_signal(signal.SIGINT)
    return found(node)
omegaconf.base.Node._invalidate_flags_cache = pressed
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job would ignore it
sys.exit(main(Path({conf!r}), ["trainer.fast_dev_run=true", *{words!r}]))
"""


@pytest.mark.parametrize("words", [[], ["hydra.mode=RUN"]])
def test_ctrl_c_while_settings_are_composed_is_not_lost(words: list[str], tmp_path: Path) -> None:
    """OmegaConf, left half-way, fails in its clean-up: with an error of its own, which Hydra may swallow."""
    code = DURING_COMPOSITION.format(conf=str(CONF), words=words)
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=ENVIRONMENT,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 130, done.stderr
    assert "stopped by SIGINT" in done.stderr and not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("words", "composed"), [([], 1), (["hydra.verbose=false"], 2), (["--config-dir=."], 2)]
)
def test_settings_are_composed_once(
    words: list[str], composed: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Twice only where a configuration could say that there are many jobs."""
    from hydra._internal.config_loader_impl import ConfigLoaderImpl

    times, load = [], ConfigLoaderImpl.load_configuration

    def counted(self: ConfigLoaderImpl, *arguments: Any, **options: Any) -> Any:
        times.append(1)
        return load(self, *arguments, **options)

    monkeypatch.setattr(ConfigLoaderImpl, "load_configuration", counted)

    def refuse(*_: Any, **__: Any) -> None:
        raise OccfusionError("no")

    monkeypatch.setattr("occfusion.run.app.run_in_folder", refuse)
    monkeypatch.chdir(tmp_path)
    assert main(CONF, [f"dataset.root={tmp_path}", *words]) == 1
    assert len(times) == composed
