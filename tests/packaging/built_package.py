"""The package as others get it: packed, built, installed into a virtual environment of its own."""

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
FOLDERS = (".ci", "conf", "docs", "scripts", "src", "tests")
GENERATED = shutil.ignore_patterns("__pycache__", "*.egg-info")


class Installed(NamedTuple):
    """What was built, and the folder of the commands of the environment that it was installed into."""

    sdist: Path
    wheel: Path
    commands: Path


def run(command: list[str], cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Runs a command that sees nothing of the repository."""
    kept = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONHOME")}
    return subprocess.run(
        command, cwd=cwd, env={**kept, "OMP_NUM_THREADS": "1", **environment}, capture_output=True, text=True,
        timeout=400, check=False,
    )  # fmt: skip


def copy_sources(target: Path) -> None:
    """Copies what a fresh clone would have; building in the repository itself would leave files there."""
    for folder in FOLDERS:
        shutil.copytree(ROOT / folder, target / folder, ignore=GENERATED)
    for file in ROOT.iterdir():
        if file.is_file():
            shutil.copy2(file, target)


def build(hook: str, source: Path, target: Path) -> Path:
    """Calls a hook through which `pip` and `build` ask setuptools for a distribution; returns the file."""
    target.mkdir()
    call = f"import sys, setuptools.build_meta as backend; backend.{hook}(sys.argv[1])"
    done = run([sys.executable, "-c", call, str(target)], cwd=source)
    assert done.returncode == 0, done.stderr
    (made,) = target.iterdir()
    return made


def install(wheel: Path, folder: Path) -> Path:
    """Installs a wheel beside the packages of this Python, from no index; returns the folder of its commands."""
    venv.create(folder, with_pip=True)
    python = folder / "bin" / "python"
    options = ["--no-index", "--no-deps", "--disable-pip-version-check"]
    done = run([str(python), "-m", "pip", "install", *options, str(wheel)], cwd=folder)
    assert done.returncode == 0, done.stderr
    (packages,) = (folder / "lib").glob("python*/site-packages")
    # lines of .pth files in a folder that is named by one are not read, so an editable install is not seen
    (packages / "others.pth").write_text(sysconfig.get_path("purelib") + "\n", encoding="utf-8")
    return python.parent
