"""The error of depth: against an independent count, at its extremes, and the truth that it is measured against."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from occfusion.data.zju.zju_data import ZjuDataModule
from occfusion.data.zju.zju_layout import true_surface
from occfusion.evaluation.evaluate import evaluate_image, summarise
from occfusion.files.arrays import load_npy
from occfusion.human import embedded_body
from occfusion.quality.metrics import depth_error
from occfusion.synth import SceneSpec, write_scene
from occfusion.types import Rendering, Truth
from oracles import quality as oracle
from quality.test_evaluate import HEIGHT, PERSON, REGIONS, STRIP, WIDTH, by_region, frame, rectangle

NOWHERE = math.inf


def truth_depth() -> torch.Tensor:
    depth = 3.0 + 0.5 * torch.rand(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))
    return torch.where(PERSON, depth, NOWHERE)


def with_depth(depth: torch.Tensor | None):  # type: ignore[no-untyped-def]
    made = frame()
    assert made.truth is not None
    return replace(made, truth=Truth(made.truth.rgb, made.truth.mask, depth))


def drawn(depth: torch.Tensor, alpha: torch.Tensor) -> Rendering:
    return Rendering(torch.zeros(HEIGHT, WIDTH, 3), alpha, depth, torch.zeros(0, 2))


def test_each_region_agrees_with_an_independent_count() -> None:
    generator = torch.Generator().manual_seed(1)
    ours = 3.0 + 0.5 * torch.rand(HEIGHT, WIDTH, generator=generator)
    alpha = torch.rand(HEIGHT, WIDTH, generator=generator)
    rows = by_region(evaluate_image(drawn(ours, alpha), with_depth(truth_depth()), REGIONS, None))
    occupied, everywhere = (alpha > 0.5), torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    domains = {"full": everywhere, "box": everywhere, "visible": PERSON & ~STRIP, "hidden": PERSON & STRIP}
    for region, domain in domains.items():
        expected = oracle.depth_error_mm(ours.numpy(), truth_depth().numpy(), (occupied & domain).numpy())
        assert rows[region].depth_error_mm == pytest.approx(expected, rel=1e-9), region
    assert len({row.depth_error_mm for row in rows.values()}) == 3  # the regions differ; full and box do not


def test_a_shift_is_found_in_millimetres_and_a_perfect_depth_has_none() -> None:
    there = PERSON.float()
    for shift in (0.0, 0.0125, -0.0125):
        rendering = drawn(truth_depth().nan_to_num(posinf=0.0) + shift, there)
        (row,) = evaluate_image(rendering, with_depth(truth_depth()), ("full",), None)
        assert row.depth_error_mm == pytest.approx(abs(1000 * shift), abs=1e-3)


@pytest.mark.parametrize(
    ("alpha", "truth"),
    [
        (torch.zeros(HEIGHT, WIDTH), truth_depth()),  # nothing rendered
        (0.5 * PERSON.float(), truth_depth()),  # alpha must be above one half
        ((~PERSON).float(), truth_depth()),  # rendered beside the person
        (PERSON.float(), torch.full((HEIGHT, WIDTH), NOWHERE)),  # the surface is out of the picture
        (PERSON.float(), None),  # nobody knows the surface
    ],
)
def test_without_common_pixels_there_is_no_figure(alpha: torch.Tensor, truth: torch.Tensor | None) -> None:
    rows = evaluate_image(drawn(torch.full((HEIGHT, WIDTH), 3.0), alpha), with_depth(truth), REGIONS, None)
    assert [row.depth_error_mm for row in rows] == [None] * 4
    means = summarise(rows)
    assert means["full"]["depth_error_mm"] is None and means["full"]["depth_images"] == 0
    assert json.dumps(means)


def test_one_pixel_far_away_and_values_that_a_float_cannot_square() -> None:
    where = rectangle((20, 21), (15, 16))
    truth = torch.where(where, 3.0, NOWHERE)
    assert depth_error(torch.full_like(truth, 1e30), truth, PERSON) == pytest.approx(1e33)
    assert depth_error(torch.full_like(truth, 3.0), truth, ~where) is None


def test_images_without_truth_do_not_count_in_the_mean() -> None:
    rendering = drawn(torch.full((HEIGHT, WIDTH), 3.0), PERSON.float())
    known = with_depth(torch.where(PERSON, 3.01, NOWHERE))
    rows = [evaluate_image(rendering, f, ("full",), None)[0] for f in (known, with_depth(None))]
    mean = summarise(rows)["full"]
    assert mean["depth_error_mm"] == pytest.approx(10.0, abs=1e-3)
    assert (mean["images"], mean["depth_images"]) == (2, 1)


def rays_hit(vertices: np.ndarray, faces: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> float:
    """Möller and Trumbore's test of one ray against all triangles; the least distance in units of `direction`."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    first, second = b - a, c - a
    h = np.cross(direction, second)
    determinant = (first * h).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / determinant
        s = origin - a
        u = inverse * (s * h).sum(1)
        q = np.cross(s, first)
        v = inverse * (q * direction).sum(1)
        t = inverse * (second * q).sum(1)
    hit = (np.abs(determinant) > 1e-15) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0.01)
    return float(t[hit].min()) if hit.any() else math.inf


@pytest.mark.parametrize("name", ["002-clean", "003-hard", "001-hard-boxes"])
def test_the_truth_is_the_surface_in_the_pictures(tmp_path: Path, name: str) -> None:
    """Rays through the cameras as they stand on disk hit the surface at the depth that frames carry; masks agree."""
    spec = dataclasses.replace(SceneSpec.parse(name), image_size=96, frames=3, cameras=3)
    folder = write_scene(tmp_path, spec, progress=False)
    data = ZjuDataModule(
        tmp_path, name, embedded_body(), image_size=96, test_frames=[2, 3, 1], occlusion="none"
    )
    frame = data.test_frame(2, 1)
    assert frame.truth is not None and frame.truth.depth is not None
    depth = frame.truth.depth.numpy()
    surfaces = true_surface(folder)
    assert surfaces is not None
    vertices, faces = surfaces(2)
    camera = load_npy(folder / "annots.npy")["cams"]
    K, R, T = (np.asarray(camera[key][1], dtype=np.float64) for key in ("K", "R", "T"))
    centre = -R.T @ T[:, 0] / 1000.0
    mask = frame.truth.mask.numpy()
    compared = 0
    for row, column in np.argwhere(np.isfinite(depth))[::29]:
        ray = R.T @ np.linalg.solve(
            K, np.array([column, row, 1.0])
        )  # OpenCV's pixels: centres are whole numbers
        expected = rays_hit(vertices, faces, centre, ray)
        if math.isfinite(expected):
            compared += 1
            assert depth[row, column] == pytest.approx(expected, abs=1e-5)
    assert compared > 15
    both = (mask & np.isfinite(depth)).sum() / (mask | np.isfinite(depth)).sum()
    assert both > (0.93 if spec.level == "clean" else 0.88)


def test_other_data_have_no_surface(tmp_path: Path) -> None:
    assert true_surface(tmp_path) is None
    for content in ("{", "[]", '{"format": "occfusion embedded scene", "version": 999, "spec": {}}'):
        (tmp_path / "scene.json").write_text(content)
        assert true_surface(tmp_path) is None
