"""Nothing that a configuration names is called unless a plugin registered it: hostile files, overrides and targets."""

import itertools
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from hydra.errors import ConfigCompositionException
from lightning.pytorch.accelerators import MPSAccelerator
from omegaconf import OmegaConf

from app.conftest import CONF
from app.test_command_line import ENVIRONMENT, ROOT
from occfusion.cli.guarded import check_arguments, check_composed, guarded_hydra
from occfusion.errors import ConfigError
from occfusion.run import environment
from occfusion.run.prepare import make_renderer
from occfusion.settings.schema import Settings, TrainerSettings, load_settings

CALLS = (
    "torch.load", "os.system", "builtins.eval", "builtins.exec", "pickle.loads", "subprocess.run", "logging.os.system",
    "occfusion.cli.train.hydra.utils.instantiate", "occfusion.cli.multirun.shutil.rmtree", "numpy.load",
    "hydra_plugins.hydra_joblib_launcher.joblib_launcher.logging.os.system", "${oc.env:HOME}", "${dataset.name}", "",
)  # fmt: skip
PLACES = (
    "hydra.callbacks.x", "hydra.callbacks.end_table", "hydra.launcher", "hydra.sweeper.sampler", "hydra.run", "hydra",
    "dataset", "optim.sds", "x",
)  # fmt: skip
FIRST_WORD = 2.0
"""Seconds of the processor after which a command says something at the latest; importing torch alone takes 1.5."""
LOGGING = ("hydra.job_logging", "hydra.hydra_logging")


def settings(key: str, value: Any) -> Any:
    whole = OmegaConf.create({"hydra": {"callbacks": {}, "launcher": {}}, "dataset": {"name": "zju"}})
    OmegaConf.update(whole, key, value, force_add=True)
    return whole


def test_no_target_in_no_place_of_any_form_is_let_through() -> None:
    forms: list[Any] = [
        lambda call: {"_target_": call},
        lambda call: {"_target_": call, "_args_": ["touch x"], "_partial_": True},
        lambda call: {"inner": {"_target_": call}},
        lambda call: {"list": [[{"deep": {"_target_": call, "_convert_": "all"}}]]},
        lambda call: "${oc.create:'{_target_: " + (call or "x") + "}'}",
        lambda call: "${oc.decode:${oc.env:EVIL,'{_target_: " + (call or "x") + "}'}}",
        lambda call: "${oc.${dataset.name}:" + (call or "x") + "}",
    ]
    tried = 0
    for place, call, form in itertools.product(PLACES, CALLS, forms):
        with pytest.raises(ConfigError, match=r"setting .*: (no code|of resolvers)"):
            check_composed(settings(place, form(call) if place != "hydra" else {"x": form(call)}))
        tried += 1
    for place, call, name in itertools.product(LOGGING, CALLS, ("()", "class", "factory")):
        if call:
            handlers = {"handlers": {"a": {name: call, "command": "touch x"}}}
            with pytest.raises(ConfigError, match="setting hydra"):
                check_composed(settings(place, handlers))
            tried += 1
    assert tried > 900


def test_hydra_refuses_them_when_it_composes() -> None:
    hostile = (
        "+hydra.callbacks.x={_target_: logging.os.system, command: touch touched}",
        "+hydra.job_logging.handlers={a: {class: logging.os.system, command: touch touched}}",
        "+hydra.job.env_set.PATH=.",
        "hydra.sweep.dir=${nowhere}",
    )
    with initialize_config_dir(str(CONF), version_base="1.3"), guarded_hydra():
        for override in hostile:
            with pytest.raises(ConfigCompositionException):
                compose("config", [override], return_hydra_config=True)
        known = ["hydra/launcher=submitit_slurm", "hydra.sweep.dir=${oc.env:HOME}"]
        compose("config", known, return_hydra_config=True)


def test_flags_that_execute_files_are_refused() -> None:
    for flag in (
        "--experimental-rerun=a.pickle",
        "--exp=a.pickle",
        "--e",
        "--config-dir=pkg://os",
        "--config-path=x",
        "--config-n=x",
        "-cp",
    ):
        with pytest.raises(ConfigError, match="execut"):
            check_arguments([flag])
    check_arguments(["seed=1", "-m", "--config-dir=mine", "dataset.root=--e"])


def test_a_file_of_somebody_elses_is_one_plain_message(tmp_path: Path) -> None:
    """Also that the first word comes at once, and that a signal then ends the command with 130 and no traceback."""
    call = "{_target_: logging.os.system, command: touch touched}"
    hostile = f"# @package _global_\nhydra:\n  callbacks:\n    x: {call}\n"
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "evil.yaml").write_text(hostile)
    command = [sys.executable, str(ROOT / "train.py")]
    done = subprocess.run(
        [*command, "--config-dir=.", "+mine=evil"], cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True,
        check=False, timeout=60,
    )  # fmt: skip
    assert "ConfigError: setting hydra.callbacks.x._target_=logging.os.system" in done.stderr
    assert done.returncode == 1 and "Traceback" not in done.stderr and not (tmp_path / "touched").exists()
    with subprocess.Popen(
        command, cwd=tmp_path, env=ENVIRONMENT, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a shell's background job would ignore it
    ) as process:  # fmt: skip
        assert process.stderr is not None
        assert "settings" in process.stderr.readline()
        assert busy_seconds(process.pid) < FIRST_WORD
        process.send_signal(signal.SIGINT)
        errors = process.stderr.read()
        assert process.wait(60) == 130
    assert "Traceback" not in errors and "the same command continues" in errors


def busy_seconds(process: int) -> float:
    """Processor time so far: that others are busy on the machine is no part of it."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="Linux tells the time of other processes")
@pytest.mark.parametrize("verb", ["replay", "stability"])
def test_the_first_word_of_a_verb_comes_before_its_libraries(verb: str, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "occfusion", verb, "nowhere"]
    with subprocess.Popen(
        command, cwd=tmp_path, env=ENVIRONMENT, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a shell's background job would ignore it
    ) as process:  # fmt: skip
        assert process.stderr is not None
        assert process.stderr.readline() == f"occfusion {verb}: the program is loaded\n"
        assert busy_seconds(process.pid) < FIRST_WORD
        process.kill()


def test_compiled_code_is_cached_in_one_place_that_can_do_without(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no folder can be written, numba refuses to cache, and everything must work all the same."""
    import numba

    from occfusion.cpu import compilation

    package = ROOT / "src" / "occfusion"
    own = [path.relative_to(package) for path in package.rglob("*.py") if "njit(" in path.read_text()]
    assert own == [Path("cpu/compilation.py")]
    original = numba.njit

    def refuse(*functions: Any, **options: Any) -> Any:
        if options.get("cache"):
            raise RuntimeError("cannot cache function: no locator available")
        return original(*functions, **options)

    monkeypatch.setattr(numba, "njit", refuse)
    assert compilation.serial(lambda x: x + 1)(2) == 3


@pytest.mark.parametrize(
    "bad", ["trainer.accelerator=tpu", "trainer.max_time=foo", "trainer.max_time=1:2", "x=${foo.bar}"]
)
def test_what_the_trainer_would_refuse_later_is_refused_with_the_settings(bad: str) -> None:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", [bad.replace("x=", "dataset.root=")])
    with pytest.raises(ConfigError, match=r"setting (trainer|dataset)\."):
        load_settings(config)


@pytest.mark.parametrize("asked", ["auto", "cpu", "cuda"])
def test_training_and_pictures_are_on_one_device_where_there_is_another_kind_of_gpu(
    monkeypatch: pytest.MonkeyPatch, asked: str
) -> None:
    """Lightning's `auto` takes Apple's GPU; pictures and float64 are not there."""
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    monkeypatch.setattr(MPSAccelerator, "is_available", staticmethod(lambda: True))
    made = Settings(trainer=TrainerSettings(accelerator=asked))
    assert environment.accelerator_of(made) == "cpu" == make_renderer(made).device.type
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    expected = "cpu" if asked == "cpu" else "cuda"
    assert environment.accelerator_of(made) == expected == make_renderer(made).device.type


def test_a_missing_gpu_and_a_full_disk_are_told_before_any_work(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    made = Settings(output_dir=str(tmp_path / "not" / "there"))
    environment.check_machine(made)
    with monkeypatch.context() as patch:
        patch.setattr("torch.cuda.device_count", lambda: 0)
        environment.check_machine(made)
        with pytest.raises(ConfigError, match="no GPUs are usable here"):
            environment.check_machine(replace(made, trainer=TrainerSettings(accelerator="gpu")))
        patch.setattr("torch.cuda.device_count", lambda: 1)
        with pytest.raises(ConfigError, match="1 GPUs"):
            environment.check_machine(replace(made, trainer=TrainerSettings(accelerator="gpu", devices=2)))
    with monkeypatch.context() as patch:
        patch.setattr(environment.os, "access", lambda path, _: path != tmp_path)
        with pytest.raises(ConfigError, match=r"cannot be written .*; name another folder"):
            environment.check_machine(made)
    usage = environment.shutil.disk_usage(tmp_path)._replace(free=3_000_000)
    monkeypatch.setattr(environment.shutil, "disk_usage", lambda _: usage)
    with pytest.raises(ConfigError, match="3 MB are free there"):
        environment.check_machine(made)
