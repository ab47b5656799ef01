"""`occfusion stability`: the quick sweep holds, and what is wrong is seen."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from occfusion.__main__ import main
from occfusion.stability.axes import Answer, Axis, Bound, Method, sweep
from occfusion.stability.motion import motion_axes
from occfusion.stability.page import curves
from occfusion.stability.pictures import picture_axes


@pytest.mark.stiff
@pytest.mark.slow
def test_the_quick_sweep_holds_and_writes_its_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["stability", "--quick", "--output", str(tmp_path)]) == 0
    with (tmp_path / "stability.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len({row["axis"] for row in rows}) == 14 and len(rows) > 100
    assert all(row["verdict"] == "holds" for row in rows)
    methods = {row["method"] for row in rows}
    assert {"torch float32", "numba float32", "torch float64", "float32", "float64", "bfloat16"} <= methods
    page = (tmp_path / "stability.html").read_text()
    assert page.count("<tr") == len(rows) + 1 and page.count("<polyline") == (
        tmp_path / "stability.svg"
    ).read_text().count("<polyline")
    assert "src=" not in page and "href=" not in page  # one file, nothing beside it
    assert f"{len(rows)} of {len(rows)} cases on 14 axes hold" in capsys.readouterr().out


def test_what_is_wrong_is_no_longer_in_bounds() -> None:
    axis = next(axis for axis in motion_axes() if axis.name.startswith("rotation"))

    def off(place: float) -> Answer:
        values, gradients = axis.methods[0].answer(place)
        return values, {name: gradient * 1.001 for name, gradient in gradients.items()}

    def fails(_: float) -> Answer:
        raise ValueError("at this place")

    def nothing(place: float) -> Answer:
        values, gradients = axis.methods[0].answer(place)
        return {name: value * float("nan") for name, value in values.items()}, gradients

    bound = Bound(1e-5, 1e-5)
    wrong = replace(
        axis,
        methods=[Method("off", off, bound), Method("fails", fails, bound), Method("nan", nothing, bound)],
    )
    rows = sweep(wrong, quick=True)
    assert {(row.method, row.verdict) for row in rows} == {
        ("off", "exceeds"), ("fails", "ValueError: at this place"), ("nan", "exceeds"),
    }  # fmt: skip
    assert curves(rows).count("<polyline") == 6


def test_one_value_of_several_that_is_not_a_number_exceeds() -> None:
    right = {"first": torch.ones(3), "second": torch.ones(3)}

    def broken(_: float) -> Answer:
        return right | {"second": torch.full((3,), torch.nan)}, right

    axis = Axis("any", (1.0,), (1.0,), [Method("nan", broken, Bound(1.0, 1.0))], lambda _: (right, right))
    (row,) = sweep(axis, quick=True)
    assert row.verdict == "exceeds"


def test_axes_begin_and_end_where_they_are_said_to() -> None:
    found: dict[str, Axis] = {
        axis.name: axis for axis in [*motion_axes(), *picture_axes(torch.device("cpu"))]
    }
    wanted = {
        "anisotropy, longest to thinnest": (1, 1e6), "screen size, px": (0.01, 1000), "Gaussians": (0, 2e5),
        "depth, farthest to nearest": (1e-2, 1e5), "picture, px": (1, 2048), "frames": (1, 2000),
        "diffusion time": (0, 1), "opposed weights, degrees": (0, 180), "ratio of loss weights": (1, 1e8),
    }  # fmt: skip
    for name, ends in wanted.items():
        assert (found[name].places[0], found[name].places[-1]) == ends
    assert all(set(axis.quick) <= set(axis.places) for axis in found.values())


def test_axes_of_the_optimisation_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It has none; nothing runs."""
    with pytest.raises(SystemExit, match="2"):
        main(["stability", "--optimisation", "--axes", "rotation", "--output", str(tmp_path)])
    assert "not allowed with argument" in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


def test_an_unknown_axis_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["stability", "--axes", "colour", "--output", str(tmp_path)]) == 1
    assert "there are rotation angle" in capsys.readouterr().err
