"""One installation for all tests of it."""

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from built_package import Installed, build, copy_sources, install, run


@pytest.fixture(scope="session")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Installed:
    """A wheel that was built from an unpacked source distribution, installed."""
    folder = tmp_path_factory.mktemp("packaging")
    copy_sources(folder / "copy")
    sdist = build("build_sdist", folder / "copy", folder / "sdist")
    shutil.unpack_archive(sdist, folder / "unpacked", filter="data")
    (source,) = (folder / "unpacked").iterdir()
    wheel = build("build_wheel", source, folder / "wheel")
    return Installed(sdist, wheel, install(wheel, folder / "venv"))


@pytest.fixture
def occfusion(installed: Installed, tmp_path: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Runs the installed command in an empty folder."""
    return lambda *arguments: run([str(installed.commands / "occfusion"), *arguments], cwd=tmp_path)
