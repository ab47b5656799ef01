"""Body files of SMPL's family with the keys and types of the releases, small and with made-up numbers.

Read for it:

* the key sets and types that users of CalciferZh/SMPL printed from `basicModel_m_lbs_10_207_0_v1.0.0.pkl` and others,
  and `save_model` of smpl_webuser's `serialization.py`, which wrote them: `shapedirs` alone is left as a chumpy array,
  the regressors are SciPy's `csc_matrix`, `f` and `kintree_table` are uint32 with 2^32 - 1 for the root's parent; the
  neutral file of 1.0 has no `vert_sym_idxs`; 1.1 has 300 shape components and, at 247 MB, must be of protocol 0 (1.0
  with 10 components has 39 MB, which is protocol 2);
* vchoutas/smplx@1265df7b `smplx/body_models.py`: what each of its models reads; `smplx/lbs.py`: the formula;
* vchoutas/smplx@b3f647ae `tools/clean_ch.py`: chumpy's arrays become plain ones, all else stays, `pickle.dump` without
  a protocol. As published it runs in neither Python (`pickle.load(encoding=)`, `iteritems`): the files that go round
  are of protocol 0 or of Python 3's default;
* vchoutas/smplx@2dff3ce4 `tools/merge_smplh_mano.py`: SMPL-H with hands, `savez_compressed`;
* ahmedosman/STAR@14149914 `star/pytorch/star.py`: 24 joints, `posedirs` of 93.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse

from upstream import chumpy_objects as chumpy

VERTICES = 16
PARENTS = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21]


@dataclass(frozen=True)
class Release:
    """One file of a download."""

    file: str
    gender: str
    shapes: int
    symmetry: bool = True
    """Whether it has `vert_sym_idxs`."""


RELEASES = (
    Release("basicmodel_m_lbs_10_207_0_v1.0.0.pkl", "male", 10),
    Release("basicModel_f_lbs_10_207_0_v1.0.0.pkl", "female", 10),
    Release("basicModel_neutral_lbs_10_207_0_v1.0.0.pkl", "neutral", 10, symmetry=False),
    Release("basicmodel_m_lbs_10_207_0_v1.1.0.pkl", "male", 300),
    Release("basicmodel_f_lbs_10_207_0_v1.1.0.pkl", "female", 300),
    Release("basicmodel_neutral_lbs_10_207_0_v1.1.0.pkl", "neutral", 300),
)


def smpl(release: Release) -> dict[str, Any]:
    """The dict of a release with plain arrays, in the order in which Python 2 gave its keys."""
    rng = np.random.default_rng(sum(release.file.encode()))
    weights = rng.random((VERTICES, 24)) ** 8
    weights /= weights.sum(axis=1, keepdims=True)
    regressor = rng.random((24, VERTICES)) * (rng.random((24, VERTICES)) < 0.3) + 1e-3 * np.eye(24, VERTICES)
    regressor[:, 0] += 1e-3
    regressor /= regressor.sum(axis=1, keepdims=True)
    template = rng.random((VERTICES, 3)) * (0.5, 1.7, 0.3)
    template[:2, 1] = -1.0, 0.72
    prior = {
        **{"expid": "tj10smooth", "J_regressor_prior_wt": 10.0, "restpose_type": "t", "bs_style": "lbs"},
        **{"gender": release.gender, "bs_type": "lrotmin"},
    }
    content = {
        "J_regressor_prior": sparse.csc_matrix(regressor),
        "f": rng.integers(0, VERTICES, (20, 3)).astype(np.uint32),
        "J_regressor": sparse.csc_matrix(regressor),
        "kintree_table": np.array([[2**32 - 1, *PARENTS[1:]], range(24)], dtype=np.uint32),
        "J": regressor @ template,
        "weights_prior": weights.copy(),
        "weights": weights,
        "vert_sym_idxs": rng.permutation(VERTICES),
        "posedirs": 0.01 * rng.normal(size=(VERTICES, 3, 207)),
        "pose_training_info": prior,
        "bs_style": "lbs",
        "v_template": template,
        "shapedirs": 0.01 * rng.normal(size=(VERTICES, 3, release.shapes)),
        "bs_type": "lrotmin",
    }
    if not release.symmetry:
        del content["vert_sym_idxs"]
    return content


def _with(content: dict[str, Any], **changed: Any) -> dict[str, Any]:
    return {**content, **changed}


def _selected(content: dict[str, Any]) -> chumpy.Ch:
    """The first half of a longer array, as in the hands of MANO."""
    shapes = content["shapedirs"]
    return chumpy.select(np.concatenate([shapes, 1 + shapes], axis=2), np.s_[:, :, : shapes.shape[2]])


def _joined(content: dict[str, Any]) -> chumpy.Ch:
    shapes = content["shapedirs"]
    return chumpy.concatenate([shapes[:, :, :4], shapes[:, :, 4:]], axis=2)


WRAPPED = {
    "plain": dict,
    "as released": lambda c: _with(c, shapedirs=chumpy.ch(c["shapedirs"])),
    "all chumpy": lambda c: _with(
        c, **{k: chumpy.ch(c[k]) for k in ("v_template", "shapedirs", "posedirs", "weights", "J")}
    ),
    "all chumpy, used": lambda c: _with(
        c,
        **{k: chumpy.used(chumpy.ch(c[k])) for k in ("v_template", "shapedirs", "posedirs", "weights", "J")},
    ),
    "Select": lambda c: _with(c, shapedirs=_selected(c)),
    "Select, used": lambda c: _with(c, shapedirs=chumpy.used(_selected(c))),
    "Concatenate": lambda c: _with(c, shapedirs=_joined(c)),
    "Concatenate, used": lambda c: _with(c, shapedirs=chumpy.used(_joined(c))),
    "Reshape": lambda c: _with(
        c,
        shapedirs=chumpy.reshaped(c["shapedirs"].reshape(-1, c["shapedirs"].shape[2]), c["shapedirs"].shape),
    ),
    "transpose": lambda c: _with(
        c,
        v_template=chumpy.transposed(c["v_template"].T.copy()),
        J=chumpy.used(chumpy.transposed(c["J"].T.copy())),
    ),
}
"""The dict with chumpy's objects in place of some arrays; the numbers are the same."""


def dense(content: dict[str, Any]) -> dict[str, Any]:
    """The regressors in full, as those who convert a file to `.npz` do."""
    return {key: value.toarray() if sparse.issparse(value) else value for key, value in content.items()}


def _relative(joints: int, vertices: int, shapes: int, features: int) -> dict[str, Any]:
    parents = np.arange(joints) - 1
    parents[0] = 2**32 - 1
    return {
        "J_regressor": np.full((joints, vertices), 1 / vertices),
        "f": np.zeros((4, 3), np.uint32),
        "kintree_table": np.stack([parents, np.arange(joints)]),
        "weights": np.full((vertices, joints), 1 / joints),
        "posedirs": np.zeros((vertices, 3, features)),
        "v_template": np.linspace(0, 1.7, 3 * vertices).reshape(vertices, 3),
        "shapedirs": np.zeros((vertices, 3, shapes)),
    }


def smplh() -> dict[str, Any]:
    """SMPL-H of `merge_smplh_mano.py`: 52 joints, hands of MANO."""
    hands = {f"hands_{key}{side}": np.zeros(45) for key in ("mean", "coeffs") for side in "lr"}
    components = {f"hands_components{side}": np.eye(45) for side in "lr"}
    strings = {"bs_style": np.array("lbs"), "bs_type": np.array("lrotmin")}
    return {**_relative(52, VERTICES, 16, 51 * 9), **hands, **components, **strings}


def smplx() -> dict[str, Any]:
    """SMPL-X 1.1: 55 joints, 300 shapes and 100 expressions in one array, and tables of names as objects."""
    names = np.array({"Pelvis": 0, "L_Hip": 1}, dtype=object)
    return {
        **_relative(55, VERTICES, 400, 54 * 9),
        "joint2num": names,
        "part2num": names,
        "allow_pickle": True,
    }


def star() -> dict[str, Any]:
    """STAR: SMPL's joints and mesh, other blend shapes."""
    content = _relative(24, VERTICES, 300, 93)
    return {**content, "kintree_table": np.array([[0, *PARENTS[1:]], range(24)])}


def mano() -> dict[str, Any]:
    """MANO: one hand, 16 joints, 10 of 20 shape components by way of a `Select`."""
    content = _relative(16, VERTICES, 10, 15 * 9)
    return _with(content, shapedirs=_selected(content), J_regressor=sparse.csc_matrix(content["J_regressor"]))
