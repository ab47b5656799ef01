"""Body files in each format SMPL's family comes in, and what is wrong with those that are refused."""

from __future__ import annotations

import pickle
import sys
import types

import numpy as np
import pytest

from occfusion.errors import DataError
from occfusion.files.bodyfile import load_body_arrays, save_body_arrays

PARENTS = np.array([-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21])
VERTICES = 40


def content(shapes: int = 10) -> dict[str, np.ndarray]:
    """A body's keys with the types of the official files."""
    rng = np.random.default_rng(0)
    weights = rng.random((VERTICES, 24)) ** 8
    regressor = rng.random((24, VERTICES)) * (rng.random((24, VERTICES)) < 0.3) + 1e-3
    template = rng.random((VERTICES, 3)) * (0.5, 1.7, 0.3)
    template[:2, 1] = 0.0, 1.7
    return {
        "v_template": template,
        "shapedirs": 0.01 * rng.normal(size=(VERTICES, 3, shapes)),
        "posedirs": 0.01 * rng.normal(size=(VERTICES, 3, 207)),
        "J_regressor": regressor / regressor.sum(axis=1, keepdims=True),
        "weights": weights / weights.sum(axis=1, keepdims=True),
        "kintree_table": np.stack([PARENTS.astype(np.uint32), np.arange(24, dtype=np.uint32)]),
        "f": rng.integers(0, VERTICES, (30, 3)).astype(np.uint32),
    }


def write_npz(path, values):
    np.savez(path, **values)
    return path


def joints_by_hand(values, betas):
    """The definition: shape the vertices, then regress."""
    shaped = values["v_template"] + sum(b * values["shapedirs"][:, :, i] for i, b in enumerate(betas))
    return values["J_regressor"] @ shaped


@pytest.mark.parametrize("shapes", [10, 16, 300])
def test_npz(tmp_path, shapes):
    values = content(shapes)
    body = load_body_arrays(write_npz(tmp_path / "b.npz", values))
    for key in ("v_template", "shapedirs", "posedirs", "J_regressor"):
        np.testing.assert_array_equal(getattr(body, key), values[key])
    np.testing.assert_allclose(body.weights, values["weights"], atol=1e-15)
    np.testing.assert_array_equal(body.parents, PARENTS)
    np.testing.assert_array_equal(body.faces, values["f"])
    betas = np.random.default_rng(1).normal(size=shapes)
    np.testing.assert_allclose(
        body.J_template + body.J_dirs @ betas, joints_by_hand(values, betas), atol=1e-13
    )


def official_pickle(path, values, protocol):
    """Writes as the official files are: chumpy and scipy objects, which the reader must not need."""
    sparse = pytest.importorskip("scipy.sparse")
    module = types.ModuleType("chumpy.ch")
    module.Ch = type("Ch", (), {"__module__": "chumpy.ch"})
    sys.modules["chumpy"], sys.modules["chumpy.ch"] = types.ModuleType("chumpy"), module
    try:
        wrapped = dict(
            values, J_regressor=sparse.csc_matrix(values["J_regressor"]), bs_style="lbs", bs_type="lrotmin"
        )
        for key in ("shapedirs", "v_template"):
            wrapped[key] = module.Ch()
            wrapped[key].x = values[key]
        path.write_bytes(pickle.dumps(wrapped, protocol))
    finally:
        del sys.modules["chumpy"], sys.modules["chumpy.ch"]
    return path


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_official_pickle_without_chumpy(tmp_path, protocol):
    values = content()
    body = load_body_arrays(official_pickle(tmp_path / "b.pkl", values, protocol))
    same = load_body_arrays(write_npz(tmp_path / "b.npz", values))
    for key in same.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(body, key), getattr(same, key))


@pytest.mark.parametrize("suffix", [".npz", ".safetensors"])
def test_written_bodies_come_back(tmp_path, suffix):
    body = load_body_arrays(write_npz(tmp_path / "a.npz", content()))
    save_body_arrays(tmp_path / f"b{suffix}", body)
    again = load_body_arrays(tmp_path / f"b{suffix}")
    for key in body.__dataclass_fields__:
        np.testing.assert_allclose(getattr(again, key), getattr(body, key), atol=1e-6)


def test_joints_given_directly_replace_the_regressor(tmp_path):
    values = content()
    regressor = values.pop("J_regressor")
    values["J_template"] = regressor @ values["v_template"]
    values["J_dirs"] = np.einsum("jv,vcb->jcb", regressor, values["shapedirs"])
    body = load_body_arrays(write_npz(tmp_path / "b.npz", values))
    assert body.J_regressor is None
    np.testing.assert_array_equal(body.J_dirs, values["J_dirs"])


def test_pose_blend_shapes_are_optional_and_may_be_flat(tmp_path):
    values = content()
    full = values.pop("posedirs")
    assert load_body_arrays(write_npz(tmp_path / "a.npz", values)).posedirs is None
    values["posedirs"] = full.reshape(-1, 207).T
    body = load_body_arrays(write_npz(tmp_path / "b.npz", values))
    np.testing.assert_array_equal(body.posedirs, full)


@pytest.mark.parametrize("key", ["v_template", "shapedirs", "J_regressor", "weights", "f"])
def test_a_missing_key_is_named(tmp_path, key):
    values = content()
    del values[key]
    with pytest.raises(DataError, match=rf"b\.npz: key '{'faces' if key == 'f' else key}' is missing"):
        load_body_arrays(write_npz(tmp_path / "b.npz", values))


def _other_joint_count(values):
    values["kintree_table"] = np.stack([np.arange(-1, 51), np.arange(52)])


def _cut_vertices(values):
    values["weights"] = values["weights"][:-1]


def _parent_after_child(values):
    values["kintree_table"] = values["kintree_table"].copy()
    values["kintree_table"][0, 3] = 7


BROKEN = {
    "52 joints": (_other_joint_count, "has 52 joints, expected 24"),
    "vertex counts": (_cut_vertices, r"'weights' has shape \(39, 24\), expected \(40, 24\)"),
    "parents": (_parent_after_child, "parent must come before"),
    "regressor": (lambda v: v.update(J_regressor=v["J_regressor"][:20]), "another number of joints"),
    "nan": (lambda v: v["shapedirs"].__setitem__((3, 0, 0), np.nan), "'shapedirs' holds NaN"),
    "text": (lambda v: v.update(v_template=np.full((VERTICES, 3), "x")), "not numbers"),
    "weights": (lambda v: v["weights"].__setitem__((5, 0), 3.0), "vertex 5 has the sum"),
    "faces": (lambda v: v["f"].__setitem__((0, 0), 40), r"outside 0\.\.39"),
    "millimetres": (lambda v: v["v_template"].__imul__(1000), "metres"),
    "few shapes": (lambda v: v.update(shapedirs=v["shapedirs"][..., :4]), "4 components; 10 to 300"),
    "many shapes": (lambda v: v.update(shapedirs=np.zeros((VERTICES, 3, 301))), "301 components"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_bodies_are_refused(tmp_path, name):
    values = content()
    change, message = BROKEN[name]
    change(values)
    with pytest.raises(DataError, match=rf"b\.npz: .*{message}"):
        load_body_arrays(write_npz(tmp_path / "b.npz", values))


def test_missing_and_unknown_files(tmp_path):
    with pytest.raises(DataError, match=r"smpl.is.tue.mpg.de.*dataset=synthetic"):
        load_body_arrays(tmp_path / "SMPL_NEUTRAL.pkl")
    (tmp_path / "b.obj").write_text("v 0 0 0")
    with pytest.raises(DataError, match=r"'.obj'"):
        load_body_arrays(tmp_path / "b.obj")
    (tmp_path / "b.safetensors").write_bytes(b"\xff" * 20)
    with pytest.raises(DataError, match="not a safetensors file"):
        load_body_arrays(tmp_path / "b.safetensors")
    (tmp_path / "b.pkl").write_bytes(pickle.dumps([1, 2]))
    with pytest.raises(DataError, match="holds a list"):
        load_body_arrays(tmp_path / "b.pkl")
