from __future__ import annotations

import argparse
import csv
import dataclasses
import math

import pytest
import torch

from occfusion.__main__ import main
from occfusion.bench.contestants import Contestant, available_backends, backend
from occfusion.bench.cost import extra_memory_mb, interleaved
from occfusion.bench.measure import Conditions, accuracy, errors_of
from occfusion.bench.plan import PARTS, QUICK
from occfusion.bench.reference import dense_reference
from occfusion.bench.scenes import SceneSize, make_scene
from occfusion.cli import bench
from occfusion.errors import ConfigError
from occfusion.splat import Limits
from oracles import splat as oracle

SMALL = SceneSize(40, 16)
CPU = torch.device("cpu")


def test_scenes_are_seeded_and_show_a_person_of_known_size():
    first, again, other = make_scene(SMALL), make_scene(SMALL), make_scene(SMALL, seed=1)
    assert all(torch.equal(first.inputs[name], again.inputs[name]) for name in first.inputs)
    assert not torch.equal(first.inputs["means"], other.inputs["means"])
    scene = make_scene(SceneSize(3000, 100))
    rows = (backend("torch").forward(scene)[1] > 0.5).any(dim=1).nonzero()
    assert 55 <= int(rows[-1] - rows[0]) <= 72
    # finer Gaussians cover the same body
    sizes = [make_scene(SceneSize(n, 20)).inputs["scales"].median() for n in (1000, 4000)]
    assert float(sizes[0] / sizes[1]) == pytest.approx(2, rel=0.05)


def test_spacing_is_that_of_the_nearest_three():
    means = make_scene(SceneSize(4000, 20)).inputs["means"]
    nearest = torch.cdist(means, means).topk(4, largest=False).values[:, 1:].mean()
    sizes = make_scene(SceneSize(4000, 20)).inputs["scales"].median()
    assert float(sizes / nearest) == pytest.approx(1, rel=0.1)


@pytest.mark.parametrize(
    "limits", [Limits(), Limits(alpha_min=1e-9, stop=0.0), Limits(alpha_min=1 / 32, stop=0.03)]
)
def test_reference_agrees_with_the_independent_oracle(limits, monkeypatch):
    scene = make_scene(dataclasses.replace(SMALL, footprint=2.0))
    reference = dense_reference(scene, limits)
    names = {"ALPHA_MAX": limits.alpha_max, "ALPHA_MIN": limits.alpha_min, "STOP": limits.stop}
    for name, value in names.items():
        monkeypatch.setattr(oracle, name, value)
    leaves = scene.leaves(torch.float64)
    rgb, alpha, depth = oracle.render(**scene.arguments(leaves))
    for ours, theirs in zip(
        (reference.rgb, reference.alpha, reference.depth), (rgb, alpha, depth), strict=True
    ):
        torch.testing.assert_close(ours, theirs.detach(), rtol=0, atol=1e-12)
    pictures = zip(scene.cotangents, (rgb, alpha, depth), strict=True)
    torch.stack([(w.to(p) * p).sum() for w, p in pictures]).sum().backward()
    for name, gradient in reference.gradients.items():
        torch.testing.assert_close(gradient, leaves[name].grad, rtol=1e-9, atol=1e-9)


def test_errors_see_a_wrong_gradient_that_the_picture_hides():
    scene = make_scene(SMALL)
    reference = dense_reference(scene)
    honest = backend("torch", torch.float64)
    assert errors_of(honest, scene, reference).worst_gradient < 1e-12

    def render(scene, inputs):
        held = inputs | {"quats": inputs["quats"].detach()}
        return honest.render(scene, held)

    errors = errors_of(Contestant("no turning", render, torch.float64), scene, reference)
    assert errors.rgb < 1e-12
    assert errors.gradients["quats"] == 1
    assert errors.gradients["means"] < 1e-12


def test_a_gradient_that_is_not_a_number_is_the_worst():
    scene = make_scene(SMALL)
    honest = backend("torch", torch.float64)

    def render(scene, inputs):
        turned = inputs["quats"] * 1.0
        turned.register_hook(lambda gradient: gradient * math.nan)
        return honest.render(scene, inputs | {"quats": turned})

    errors = errors_of(Contestant("broken", render, torch.float64), scene, dense_reference(scene))
    assert errors.gradients["means"] < 1e-12 and math.isnan(errors.worst_gradient)


def test_errors_count_flipped_pixels_and_missing_depth():
    scene = make_scene(SMALL)
    reference = dense_reference(scene)
    honest = backend("torch", torch.float64)

    def render(scene, inputs):
        rgb, alpha, _ = honest.render(scene, inputs)
        spot = torch.zeros_like(rgb)
        spot[3, 4:9, 0] = 0.01
        return rgb + spot, alpha, None

    errors = errors_of(Contestant("spotty", render, torch.float64), scene, reference)
    assert errors.rgb == pytest.approx(0.01)
    assert errors.flips == pytest.approx(5 / 256)
    assert errors.depth is None


def test_interleaved_calls_take_turns():
    log = []
    timings = interleaved({"a": lambda: log.append("a"), "b": lambda: log.append("b")}, seconds=0.0)
    assert "".join(log) == "abab" + "ab" * timings["a"].rounds
    assert timings["a"].cpu_min <= timings["a"].cpu_median
    assert timings["b"].wall_min <= timings["b"].wall_median


def test_processor_time_tells_who_works_more():
    def work(times):
        return lambda: sum(math.sqrt(i) for i in range(2000 * times))

    timings = interleaved({"once": work(1), "many": work(20)}, seconds=0.2)
    assert 8 < timings["many"].cpu_min / timings["once"].cpu_min < 40


def test_extra_memory_is_what_the_call_holds_at_its_peak():
    measured = extra_memory_mb(lambda: torch.ones(25_000_000).sum() + torch.ones(5_000_000).sum(), CPU)
    if measured is None:
        pytest.skip("this system does not tell the peak of a process")
    assert 95 < measured < 130


def test_backends_that_cannot_run_are_left_out_unless_asked_for():
    assert available_backends(CPU)[0] == "torch"
    with pytest.raises(ConfigError, match="no-such"):
        available_backends(CPU, ["torch", "no-such"])


@pytest.mark.slow
def test_the_verb_measures_everything_and_writes_it(tmp_path, capsys):
    before = torch.get_num_threads()
    assert main(["bench", "--quick", "--backends", "torch", "--output", str(tmp_path / "out")]) == 0
    assert torch.get_num_threads() == before
    text = capsys.readouterr().out
    assert "threads used" in text and "revision" in text
    for picture in ("scaling.png", "precision.png"):
        assert (tmp_path / "out" / picture).stat().st_size > 10_000
    assert (tmp_path / "out" / "bench.md").read_text().strip() in text
    with (tmp_path / "out" / "bench.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["part"].split()[0] for row in rows} == set(PARTS)
    exact = next(r for r in rows if r["part"] == "accuracy" and r["contestant"] == "torch float64")
    assert float(exact["error_gradient"]) < 1e-11
    floors = [r for r in rows if r["case"].startswith("alpha floor") and r["contestant"] == "torch float64"]
    errors = [float(r["error_rgb"]) for r in floors]
    assert errors == sorted(errors, reverse=True) and errors[-1] < 1e-2 * errors[0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["--threads", "0"], "--threads 0"), (["--backends", "fast"], "'fast' is unknown")],
)
def test_bad_arguments_end_with_one_line(arguments, message, capsys, tmp_path):
    assert main(["bench", "--quick", "--output", str(tmp_path / "out"), *arguments]) == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_steps_are_measured_on_the_cpu_whatever_the_device(monkeypatch):
    """As on a machine with a CUDA device, whose backend takes nothing from the CPU."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    known = {"cuda": ["torch", "gsplat"], "cpu": ["torch", "numba"]}
    monkeypatch.setattr(bench, "available_backends", lambda device, wanted=None: wanted or known[device.type])
    for part in ("race", "accuracy", "precision"):
        monkeypatch.setattr(bench, part, lambda *_: iter(()))
    monkeypatch.setattr(bench, "step", lambda name, *_: iter([(name, _[-1].device.type)]))

    def measured(*words):
        parser = argparse.ArgumentParser()
        bench.add_arguments(parser)
        args = parser.parse_args(["--device", "cuda", *words])
        return list(bench._measure(args, QUICK, bench._prepare(args)))

    assert measured() == [("numba", "cpu")]
    assert measured("--backends", "torch", "gsplat") == [("torch", "cpu")]
    with pytest.raises(ConfigError, match="leave step out of --parts"):
        measured("--backends", "gsplat")


def test_who_gives_no_depth_is_not_blamed_for_its_gradient():
    honest = backend("torch", torch.float64)

    def render(scene, inputs):
        return *honest.render(scene, inputs)[:2], None

    flat = Contestant("flat", render, torch.float64, has_depth=False)
    rows = list(accuracy([SMALL], [honest, flat], Conditions(CPU, seed=0, seconds=0.0)))
    assert [row.contestant for row in rows] == ["torch float64", "flat"]
    assert all(row.error_gradient < 1e-12 for row in rows)
    assert rows[1].error_depth is None
