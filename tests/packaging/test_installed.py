"""What an installation from a wheel has and can do, outside of the repository."""

import json
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from built_package import FOLDERS, ROOT, Installed, build, copy_sources, run

from occfusion import __version__
from occfusion.__main__ import VERBS

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]  # the first one waits for the installation
Run = Callable[..., subprocess.CompletedProcess[str]]
COMPLETION = """
eval "$(occfusion train -sc install=bash)"
press_tab() {
    COMP_LINE="$1" COMP_WORDS=($1) COMP_CWORD=$2 COMP_POINT=${#1}
    hydra_bash_completion
    echo "${COMPREPLY[@]}"
}
"""
"""What a person's shell does with Hydra's rule when the last of so many words is to be completed."""


def files_under(*folders: str) -> set[str]:
    """Files of the repository that are no product of running or installing it, relative to it."""
    return {
        path.relative_to(ROOT).as_posix()
        for folder in folders
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and ".egg-info" not in str(path)
    }


def test_the_wheel_holds_the_package_its_assets_and_its_configuration(installed: Installed) -> None:
    package = {name.removeprefix("src/") for name in files_under("src")}
    configuration = {f"occfusion/{name}" for name in files_under("conf")}
    with zipfile.ZipFile(installed.wheel) as wheel:
        held = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert held == package | configuration
    assert installed.wheel.name == f"occfusion-{__version__}-py3-none-any.whl"


def test_an_editable_installation_has_no_second_configuration(tmp_path: Path) -> None:
    copy_sources(tmp_path / "copy")
    editable = build("build_editable", tmp_path / "copy", tmp_path / "editable")
    with zipfile.ZipFile(editable) as wheel:
        assert not [name for name in wheel.namelist() if "conf" in name]
        (pointer,) = [name for name in wheel.namelist() if name.endswith(".pth")]
        assert wheel.read(pointer).decode().strip() == str(tmp_path / "copy" / "src")


def test_the_source_distribution_holds_what_the_repository_does(installed: Installed) -> None:
    with tarfile.open(installed.sdist) as archive:
        held = {name.partition("/")[2] for name in archive.getnames()}
    wanted = files_under(*FOLDERS) | {"train.py", "setup.py", "pyproject.toml", "Makefile", "Dockerfile"}
    assert wanted | {"README.md", "LICENSE", "requirements.lock"} <= held
    assert not [name for name in held if "__pycache__" in name]


def test_the_default_job_runs_in_an_empty_folder(occfusion: Run, tmp_path: Path) -> None:
    done = occfusion("train", "trainer.fast_dev_run=true")
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "runs" / "synthetic" / "001-clean" / "E-trial"
    assert f"run folder: {folder.relative_to(tmp_path)}" in done.stdout
    assert json.loads((folder / "metrics.json").read_text())["variant"] == "E"
    environment = json.loads((folder / "environment.json").read_text())
    assert environment["command"] == "occfusion train trainer.fast_dev_run=true"
    assert environment["git_revision"] is None


def test_the_module_reads_the_configuration_that_was_installed(installed: Installed, tmp_path: Path) -> None:
    python = str(installed.commands / "python")
    there = run([python, "-m", "occfusion", "train", "--info", "searchpath"], cwd=tmp_path)
    assert str(installed.commands.parent) in there.stdout
    assert str(ROOT) not in there.stdout
    job = ["variant=B", "seed=3", "--cfg", "job"]
    there = run([python, "-m", "occfusion", "train", *job], cwd=tmp_path)
    here = run([sys.executable, str(ROOT / "train.py"), *job], cwd=tmp_path)
    assert (there.returncode, there.stdout) == (0, here.stdout)
    assert "seed: 3" in there.stdout


@pytest.mark.parametrize("verb", VERBS)
def test_each_verb_explains_itself(occfusion: Run, verb: str) -> None:
    done = occfusion(verb, "--help")
    assert done.returncode == 0, done.stderr
    assert ("Configuration groups" if verb == "train" else f"usage: occfusion {verb}") in done.stdout


def test_bash_completes_verbs_groups_and_their_values(installed: Installed, tmp_path: Path) -> None:
    lines = [("occfusion syn", 1), ("occfusion train varia", 2), ("occfusion train seed=1 variant=gau", 3)]
    script = COMPLETION + "\n".join(f'press_tab "{line}" {word}' for line, word in lines)
    done = run(["bash", "-c", f'PATH="{installed.commands}:$PATH"\n{script}'], cwd=tmp_path)
    assert done.stdout.split() == ["synth", "variant.", "variant=", "variant=gauhuman"], done.stderr
