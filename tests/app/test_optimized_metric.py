"""What a job returns to Hydra's sweepers, through Hydra itself; no sweeper that optimises is needed."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest
from hydra.core.plugins import Plugins
from hydra.plugins.sweeper import Sweeper

from occfusion.cli.multirun import JobRecord
from occfusion.cli.optimized import KNOWN, answer, check_optimized_metric, is_asked, read_metric
from occfusion.cli.train import main
from occfusion.errors import ConfigError
from run_folders import write_run

PLUGIN = "hydra_plugins.maximiser"
"""Hydra takes plugins from this package alone; the sweeper is given that name."""
CONF = Path(__file__).parents[2] / "conf"


class Maximiser(Sweeper):
    """Asks every job for its figure, as sweepers that optimise do; runs the jobs that Hydra's own would."""

    answers: list[float] = []  # noqa: RUF012

    def __init__(self, **options: Any) -> None:
        self._options = options

    def setup(self, **context: Any) -> None:
        # imported late, since Hydra loads its own plugins anew
        from hydra._internal.core_plugins.basic_sweeper import BasicSweeper

        self._plain = BasicSweeper(**self._options)
        self._plain.setup(**context)

    def sweep(self, arguments: list[str]) -> Any:
        self.answers.clear()
        batches = self._plain.sweep(arguments)
        self.answers.extend(job.return_value for batch in batches for job in batch)
        return batches


@pytest.fixture
def sweep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Runs `train.py -m` with jobs that are done at once: seed k has a PSNR of 20 + k."""

    def job(config: Any, *, folder_chosen_by_user: bool, given: Any) -> tuple[Path, dict[str, Any]]:
        folder = tmp_path / f"run-{config.seed}"
        write_run(folder, seed=config.seed, psnr=20.0 + config.seed)
        return folder, json.loads((folder / "metrics.json").read_text())

    monkeypatch.setattr(Maximiser, "__module__", PLUGIN)
    monkeypatch.setitem(sys.modules, PLUGIN, sys.modules[__name__])
    Plugins.instance().register(Maximiser)

    def run(*overrides: str) -> int:
        monkeypatch.setattr("occfusion.run.app.run_in_folder", job)
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(
            sys,
            "argv",
            ["train.py", "-m", "seed=0,2", f"hydra.sweeper._target_={PLUGIN}.Maximiser", *overrides],
        )
        return main(CONF)

    return run


def test_jobs_return_the_figure_that_is_asked_for(sweep: Any) -> None:
    assert sweep() == 0
    assert Maximiser.answers == [20.0, 22.0]


def test_another_figure_is_asked_for_by_its_name(sweep: Any, tmp_path: Path) -> None:
    assert sweep("optimized_metric=train_seconds.total") == 0
    assert Maximiser.answers == [30.0, 30.0]


def test_a_figure_that_could_not_be_computed_is_an_error_where_a_sweeper_asks(
    sweep: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    assert sweep("optimized_metric=regions.hidden.psnr") == 1
    said = capsys.readouterr()
    assert "no regions.hidden.psnr for the sweeper" in said.err and "has null there" in said.err


def test_nobody_minds_it_where_no_sweeper_asks(sweep: Any, capsys: pytest.CaptureFixture[str]) -> None:
    plain = "hydra.sweeper._target_=hydra._internal.core_plugins.basic_sweeper.BasicSweeper"
    assert sweep("optimized_metric=regions.hidden.psnr", plain) == 0
    assert "for the sweeper" not in capsys.readouterr().err


def test_a_misspelt_name_is_said_before_anything_is_trained(
    sweep: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert sweep("optimized_metric=regions.ful.psnr") == 1
    assert "'regions.ful.psnr' is not one of regions.full.psnr" in capsys.readouterr().err
    assert not list(tmp_path.glob("run-*"))


def test_the_known_figures_are_those_that_a_run_writes(tmp_path: Path) -> None:
    metrics = json.loads((write_run(tmp_path / "a") / "metrics.json").read_text())
    for group in ("regions", "train_seconds"):
        names = {name.split(".")[1] for name in KNOWN if name.startswith(f"{group}.")}
        assert names == set(metrics[group])
    assert read_metric(tmp_path / "a", "gaussians") == metrics["gaussians"]
    assert read_metric(tmp_path / "a", "regions.hidden.psnr") is None
    check_optimized_metric("regions.visible.lpips")
    with pytest.raises(ConfigError, match="optimized_metric"):
        check_optimized_metric("regions.full")


def test_a_job_without_a_result_tells_the_sweeper_why() -> None:
    failed = JobRecord(3, "variant=C", error="no weights", exit_code=1)
    assert answer(failed, "regions.full.psnr", is_asked=False) is None
    with pytest.raises(ConfigError, match=r"variant=C: no regions\.full\.psnr for the sweeper: no weights"):
        answer(failed, "regions.full.psnr", is_asked=True)
    assert not is_asked({"_target_": "hydra._internal.core_plugins.basic_sweeper.BasicSweeper"})
    assert is_asked({"_target_": "hydra_plugins.hydra_optuna_sweeper.optuna_sweeper.OptunaSweeper"})
