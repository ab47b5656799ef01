"""Builds `conf/`, which lies beside `src/`, into the package as `occfusion/conf`; all else is in pyproject.toml."""

import shutil
from pathlib import Path

from setuptools import Command, setup
from setuptools.command.build import build

SOURCE = Path("conf")
TARGET = Path("occfusion", "conf")


class BuildConf(Command):
    """Copies the configuration. An editable install needs none: there it is found beside `src/`."""

    description = "copy the configuration into the package"

    def initialize_options(self) -> None:
        """Declares what `build` and `editable_wheel` set."""
        self.build_lib: str | None = None
        self.editable_mode = False

    def finalize_options(self) -> None:
        """Takes the folder that modules are built into."""
        self.set_undefined_options("build_py", ("build_lib", "build_lib"))

    def run(self) -> None:
        """Copies every file, into a folder that holds none of an earlier build."""
        if self.editable_mode:
            return
        shutil.rmtree(Path(str(self.build_lib), TARGET), ignore_errors=True)
        for target, source in self.get_output_mapping().items():
            self.mkpath(str(Path(target).parent))
            self.copy_file(source, target, preserve_mode=False)

    def get_source_files(self) -> list[str]:
        """Returns what a source distribution needs."""
        return [path.as_posix() for path in sorted(SOURCE.rglob("*")) if path.is_file()]

    def get_outputs(self) -> list[str]:
        """Returns what `run` writes."""
        return list(self.get_output_mapping())

    def get_output_mapping(self) -> dict[str, str]:
        """Returns where each file that `run` writes comes from."""
        if self.editable_mode:
            return {}
        folder = Path(str(self.build_lib), TARGET)
        return {str(folder / Path(path).relative_to(SOURCE)): path for path in self.get_source_files()}


class Build(build):
    """Setuptools' own, and the configuration."""

    sub_commands = [*build.sub_commands, ("build_conf", None)]  # noqa: RUF012  # setuptools declares it so


setup(cmdclass={"build": Build, "build_conf": BuildConf})
