"""`python -m occfusion report` on folders that training wrote."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from occfusion.__main__ import main
from occfusion.compare.grid import picture_grid
from occfusion.compare.reading import read_runs

Train = Callable[..., tuple[Path, dict[str, Any]]]


def test_trained_runs_side_by_side(train: Train, tmp_path: Path) -> None:
    folders = [train(f"variant={name}", "optim.steps=2", folder=name)[0] for name in ("gauhuman", "A")]
    runs, faults = read_runs(folders)
    assert not faults and [run.variant for run in runs] == ["gauhuman", "A"]
    assert all(len(run.curve) >= 2 and run.decisions for run in runs)
    rows, remarks = picture_grid(runs, ["gauhuman", "A"])
    assert not remarks and len(rows) == 4
    titles = ["input", "gauhuman", "A", "truth", "error of gauhuman", "error of A"]
    assert [title for title, _ in rows[0].cells] == titles
    output = tmp_path / "out"
    assert main(["report", *map(str, folders), "--output", str(output)]) == 0
    assert (output / "report.html").read_text().count("<img") == 24
    (folders[0] / "metrics.json").unlink()
    assert main(["report", *map(str, folders), "--output", str(output)]) == 1
    assert "is unfinished" in (output / "report.md").read_text()
