"""The body of 6890 vertices against the full one it was made from."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from occfusion.synth.fullbody import asset_arrays, bone_transforms, load_full_body, load_model_body, skin

SCRIPT = Path(__file__).parents[2] / "scripts" / "build_free_body.py"


def test_keys_and_shapes_are_smpl_s() -> None:
    data = asset_arrays("free_body.npz")
    shapes = {
        k: data[k].shape for k in ("v_template", "shapedirs", "J_regressor", "weights", "kintree_table")
    }
    assert shapes == {
        "v_template": (6890, 3),
        "shapedirs": (6890, 3, 10),
        "J_regressor": (24, 6890),
        "weights": (6890, 24),
        "kintree_table": (2, 24),
    }
    assert data["kintree_table"][0, 0] == 2**32 - 1


def test_regressor_gives_the_full_body_s_joints_for_any_shape() -> None:
    full, small = load_full_body(), load_model_body()
    rng = np.random.default_rng(0)
    for betas in (np.zeros(10), *(2.0 * rng.standard_normal((20, 10)))):
        rest = small.template + small.shapedirs @ betas
        np.testing.assert_allclose(small.regressor @ rest, full.J_template + full.J_dirs @ betas, atol=1e-5)
    np.testing.assert_allclose(small.regressor.sum(1), 1.0, atol=1e-6)


def test_regressor_is_local() -> None:
    small = load_model_body()
    for row, joint in zip(small.regressor, load_full_body().J_template, strict=True):
        used = np.flatnonzero(row)
        assert len(used) <= 400
        assert np.linalg.norm(small.template[used] - joint, axis=1).max() < 0.35


def test_mesh_is_closed_and_its_vertices_are_the_full_body_s() -> None:
    data = asset_arrays("free_body.npz")
    faces = data["f"].astype(np.int64)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert len(np.unique(edges, axis=0)) == len(edges)  # each directed edge once ...
    keys = {tuple(e) for e in edges.tolist()}
    assert all((b, a) in keys for a, b in keys)  # ... with its opposite
    assert len(np.unique(faces)) == 6890
    full = asset_arrays("free_body_full.npz")
    np.testing.assert_array_equal(data["v_template"], full["v_template"][data["full_vertex"]])
    assert len(np.unique(data["full_vertex"])) == 6890


def test_small_body_moves_as_the_full_one() -> None:
    full, small = load_full_body(), load_model_body()
    numbers = asset_arrays("free_body.npz")["full_vertex"].astype(np.int64)  # skin comes first in both
    pose = 0.4 * np.random.default_rng(1).standard_normal(72)
    moved = [
        skin(b.template, b.weights, bone_transforms(pose, full.J_template, full.parents))
        for b in (full, small)
    ]
    np.testing.assert_allclose(moved[1], moved[0][numbers], atol=1e-5)


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("build_free_body", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_script_rebuilds_the_file(script: ModuleType) -> None:
    built, stored = script.build(script.ASSETS / "free_body_full.npz"), asset_arrays("free_body.npz")
    assert built.keys() == stored.keys()
    for key, value in built.items():
        if key != "f":
            np.testing.assert_allclose(value, stored[key], rtol=1e-4, atol=1e-6, err_msg=key)
    # the sums have one order on every machine: exactly these, wherever it runs
    assert len(script.triangles(built["f"]) - script.triangles(stored["f"])) == script.TIES
    assert script.differing_keys(built, stored) == []


def test_check_sees_another_vertex_and_another_triangle(script: ModuleType) -> None:
    stored = asset_arrays("free_body.npz")
    assert script.differing_keys(stored, stored) == []
    assert script.differing_keys({**stored, "f": np.roll(stored["f"], 1, axis=1)}, stored) == []
    assert script.differing_keys({**stored, "f": stored["f"][:, ::-1]}, stored) == ["f"]
    assert script.differing_keys({**stored, "v_template": stored["v_template"] + 1e-3}, stored) == [
        "v_template"
    ]
