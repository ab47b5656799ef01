"""`occfusion train` is `python train.py`."""

import subprocess
import sys
from pathlib import Path

import pytest

from app.test_command_line import ROOT, run
from occfusion.__main__ import VERBS, main
from occfusion.cli import train
from occfusion.errors import ConfigError
from occfusion.run.environment import describe_environment

SCRIPT, VERB = (str(ROOT / "train.py"),), ("-m", "occfusion", "train")


def both(*arguments: str, cwd: Path) -> tuple[subprocess.CompletedProcess[str], ...]:
    return run(*SCRIPT, *arguments, cwd=cwd), run(*VERB, *arguments, cwd=cwd)


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["dataset=zju", "variant=A", "optim.steps=7", "--cfg", "job"], 0, "steps: 7"),
        (["--help"], 0, "variant: A, B, C, D, E, gauhuman"),
        (["optim.stepz=3"], 1, "stepz"),
    ],
)
def test_the_verb_says_and_returns_what_the_script_does(
    tmp_path: Path, arguments: list[str], code: int, said: str
) -> None:
    script, verb = both(*arguments, cwd=tmp_path)
    assert (verb.returncode, verb.stdout, verb.stderr) == (script.returncode, script.stdout, script.stderr)
    assert verb.returncode == code
    assert said in verb.stdout + verb.stderr


@pytest.mark.slow
def test_a_multirun_of_the_verb_ends_in_a_table_and_the_first_failures_code(tmp_path: Path) -> None:
    done = run(*VERB, "-m", "dataset=zju", "seed=0,1", cwd=tmp_path)
    assert done.returncode == 1
    table = (tmp_path / "runs" / "multirun" / "table.md").read_text()
    assert table.startswith("# 2 jobs, 0 finished runs, 2 without a result")


def test_hydra_reads_the_overrides_and_jobs_see_the_whole_command(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Lightning starts its helpers with `sys.argv`: without the verb they would be another program."""
    seen = []

    def job(config: object, overrides: list[str], number: int) -> train.JobRecord:
        seen.append((overrides, list(sys.argv)))
        return train.JobRecord(number, "", exit_code=7)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(train, "_job", job)
    monkeypatch.setattr(sys, "argv", ["occfusion", "train", "seed=5"])
    assert main() == 7
    assert seen == [(["seed=5"], ["occfusion", "train", "seed=5"])]
    assert sys.argv == ["occfusion", "train", "seed=5"]


@pytest.mark.parametrize("program", ["bin/occfusion", "occfusion/__main__.py"])
def test_a_run_keeps_a_command_that_can_be_typed(monkeypatch: pytest.MonkeyPatch, program: str) -> None:
    monkeypatch.setattr(sys, "argv", [program, "train", "seed=5"])
    assert describe_environment()["command"] == "occfusion train seed=5"


def test_the_configuration_within_the_package_goes_before_the_one_beside_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert train.find_config_dir() == ROOT / "conf"
    module = tmp_path / "root" / "src" / "occfusion" / "cli" / "train.py"
    monkeypatch.setattr(train, "__file__", str(module))
    with pytest.raises(ConfigError, match=r"occfusion/conf: config\.yaml is missing.*install it anew"):
        train.find_config_dir()
    for folder in (tmp_path / "root" / "conf", module.parents[1] / "conf"):
        folder.mkdir(parents=True)
        (folder / "config.yaml").touch()
        assert train.find_config_dir() == folder


@pytest.mark.parametrize(
    ("line", "choices"),
    [
        ("occfusion ", list(VERBS)),
        ("occfusion re", list(VERBS)),
        ("occfusion train variant=g", ["variant=gauhuman"]),
        ("  occfusion  train seed=1 prior=sd", ["prior=sd15", "prior=sd15_code"]),
        ("occfusion render dat", []),
    ],
)  # fmt: skip
def test_completion_of_a_verb_and_of_what_train_takes(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], line: str, choices: list[str]
) -> None:
    monkeypatch.setenv("COMP_LINE", line)
    monkeypatch.setattr(sys, "argv", ["occfusion", "-sc", "query=bash"])
    assert main() == 0
    assert capsys.readouterr().out.split() == choices
