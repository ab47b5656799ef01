"""Body files as their publishers and the usual tools write them; nothing in them is executed."""

from __future__ import annotations

import contextlib
import io
import pickle
import pickletools
import tarfile
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import sparse

from occfusion.__main__ import main
from occfusion.errors import DataError
from occfusion.files.bodyfile import load_body_arrays
from occfusion.human import load_body
from occfusion.run.prepare import make_body
from occfusion.settings.schema import BodySettings
from upstream import chumpy_objects as chumpy
from upstream import smpl_files as files

REAL = Path(__file__).parent / "chumpy_0_70.tar.xz"
EXACT = 1e-5
"""Largest vertex error, metres: the body computes in float32."""


def rotation(axis_angle: np.ndarray) -> np.ndarray:
    """Rodrigues' formula."""
    angle = float(np.linalg.norm(axis_angle))
    x, y, z = axis_angle / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def upstream_vertices(content: dict, betas: np.ndarray, pose: np.ndarray, transl: np.ndarray) -> np.ndarray:
    """smplx's `lbs` in float64: shape, joints, pose blend shapes, the chain joint by joint, skinning, shift."""
    regressor = content["J_regressor"]
    regressor = regressor.toarray() if sparse.issparse(regressor) else regressor
    shaped = content["v_template"] + content["shapedirs"][:, :, : len(betas)] @ betas
    joints = regressor @ shaped
    turns = [rotation(part) for part in pose.reshape(24, 3)]
    feature = np.concatenate([(turn - np.eye(3)).ravel() for turn in turns[1:]])
    posed = shaped + content["posedirs"] @ feature
    chain: list[np.ndarray] = []
    for joint in range(24):
        parent = int(content["kintree_table"][0, joint]) if joint else None
        step = np.eye(4)
        step[:3, :3] = turns[joint]
        step[:3, 3] = joints[joint] if parent is None else joints[joint] - joints[parent]
        chain.append(step if parent is None else chain[parent] @ step)
    vertices = np.zeros_like(posed)
    for joint, world in enumerate(chain):
        moved = (posed - joints[joint]) @ world[:3, :3].T + world[:3, 3]
        vertices += content["weights"][:, joint, None] * moved
    return vertices + transl


def vertex_error(path: Path, content: dict) -> float:
    """Greatest distance in metres between the body that was read and upstream's formula on the given arrays."""
    rng = np.random.default_rng(3)
    shapes = content["shapedirs"].shape[2]
    betas, pose, transl = rng.normal(size=shapes), 0.4 * rng.normal(size=72), rng.normal(size=3)
    given = (torch.tensor(part, dtype=torch.float32) for part in (betas, pose[:3], pose[3:], transl))
    read = load_body(path)(*given)[0].double().numpy()
    return float(np.linalg.norm(read - upstream_vertices(content, betas, pose, transl), axis=1).max())


@lru_cache
def real_files() -> dict[str, bytes]:
    """The files that the real chumpy wrote."""
    with tarfile.open(REAL) as archive:
        return {item.name: archive.extractfile(item).read() for item in archive if item.isfile()}


REAL_NAMES = [
    f"{python}_{kind}.pkl"
    for python in ("python2.7_p0", "python2.7_p2", "python3.8_p4")
    for kind in (
        *("plain", "ch", "select", "select_used", "concatenate", "concatenate_used", "reshape"),
        "transpose_used",
    )
]


@pytest.mark.parametrize("name", REAL_NAMES)
def test_what_the_real_chumpy_wrote(tmp_path, name):
    content = real_files()
    truth = dict(np.load(io.BytesIO(content["truth.npz"])))
    path = tmp_path / name
    path.write_bytes(content[name])
    body = load_body_arrays(path)
    for key in ("v_template", "shapedirs", "posedirs", "J_regressor", "weights"):
        np.testing.assert_array_equal(getattr(body, key), truth[key])
    np.testing.assert_array_equal(body.parents, files.PARENTS)
    assert vertex_error(path, truth) < EXACT


def words(content: bytes) -> set[str]:
    """Names of classes, modules and attributes in a pickle."""
    found = {argument for _, argument, _ in pickletools.genops(content) if isinstance(argument, str)}
    names = {word for word in found if 1 < len(word) < 80 and word.isprintable()}
    return {word.replace("scipy.sparse._csc", "scipy.sparse.csc") for word in names}  # SciPy 1.8 renamed it


STAND_INS = {
    "plain": lambda s, t: s,
    "ch": lambda s, t: chumpy.ch(s),
    "select": lambda s, t: chumpy.select(np.concatenate([s, s], 2), np.s_[:, :, :10]),
    "select_used": lambda s, t: chumpy.used(chumpy.select(np.concatenate([s, s], 2), np.s_[:, :, :10])),
    "concatenate": lambda s, t: chumpy.concatenate([s[..., :4], s[..., 4:]], 2),
    "concatenate_used": lambda s, t: chumpy.used(chumpy.concatenate([s[..., :4], s[..., 4:]], 2)),
    "reshape": lambda s, t: chumpy.reshaped(s.reshape(-1, 10), s.shape),
    "transpose_used": lambda s, t: chumpy.used(chumpy.transposed(t)),
}


@pytest.mark.parametrize(("real", "python", "protocol"), [("python2.7_p2", 2, 2), ("python3.8_p4", 3, 4)])
@pytest.mark.parametrize("kind", STAND_INS)
def test_the_stand_ins_write_what_chumpy_writes(real, python, protocol, kind):
    """The same names of classes, modules, attributes and parts, none more and none less."""
    content = files.smpl(files.RELEASES[0])
    made = STAND_INS[kind](content["shapedirs"], content["v_template"].T)
    content["v_template" if "transpose" in kind else "shapedirs"] = made
    assert words(chumpy.dumps(content, python, protocol)) == words(real_files()[f"{real}_{kind}.pkl"])


@pytest.mark.parametrize(("python", "protocol"), [(2, 0), (2, 2), (3, 2), (3, 3), (3, 4), (3, 5)])
@pytest.mark.parametrize("release", files.RELEASES, ids=lambda release: release.file)
@pytest.mark.parametrize("kind", files.WRAPPED)
def test_every_release_in_every_pickle(tmp_path, release, kind, python, protocol):
    content = files.smpl(release)
    path = tmp_path / release.file
    path.write_bytes(chumpy.dumps(files.WRAPPED[kind](content), python, protocol))
    assert load_body(path).num_betas == release.shapes
    assert vertex_error(path, content) < EXACT


@pytest.mark.parametrize(("python", "protocol"), [(2, 0), (3, 4)])
def test_files_that_clean_ch_writes(tmp_path, python, protocol):
    content = files.smpl(files.RELEASES[3])
    path = tmp_path / "SMPL_MALE.pkl"
    path.write_bytes(chumpy.dumps(content, python, protocol))
    assert vertex_error(path, content) < EXACT


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_an_archive_of_all_keys(tmp_path, save):
    """`SMPL_NEUTRAL.npz`: dense regressors, texts as 0-d arrays, the table of the training as an object."""
    content = files.smpl(files.RELEASES[5])
    path = tmp_path / "SMPL_NEUTRAL.npz"
    save(path, **files.dense(content))
    assert vertex_error(path, content) < EXACT


def test_sixteen_shape_components_for_a_file_with_ten(tmp_path):
    """AMASS's `betas` has 16 numbers, SMPL 1.0 has 10 components: left out when the settings say so."""
    content, path = files.smpl(files.RELEASES[0]), tmp_path / files.RELEASES[0].file
    path.write_bytes(chumpy.dumps(files.WRAPPED["as released"](content), 2, 2))
    betas, pose = np.random.default_rng(0).normal(size=16), 0.4 * np.random.default_rng(1).normal(size=72)
    given = [torch.tensor(part, dtype=torch.float32) for part in (betas, pose[:3], pose[3:], np.zeros(3))]
    with pytest.raises(DataError, match=r"16 shape components, and the body has 10.*body\.cut_betas=true"):
        make_body(BodySettings(name="smpl", path=str(path)))(*given)
    cut = make_body(BodySettings(name="smpl", path=str(path), cut_betas=True))(*given)[0].numpy()
    assert np.abs(cut - upstream_vertices(content, betas[:10], pose, np.zeros(3))).max() < EXACT


def test_an_archive_with_a_matrix_as_an_object_is_refused(tmp_path):
    path = tmp_path / "SMPL_NEUTRAL.npz"
    np.savez(path, **files.smpl(files.RELEASES[5]))
    with pytest.raises(DataError, match=r"npz\[J_regressor\]: holds Python objects.*\.toarray\(\)"):
        load_body_arrays(path)


@pytest.mark.parametrize("kind", files.WRAPPED)
@pytest.mark.parametrize("suffix", [".npz", ".safetensors"])
def test_convert_body_takes_them_all(tmp_path, capsys, kind, suffix):
    content = files.smpl(files.RELEASES[5])
    source, target = tmp_path / files.RELEASES[5].file, tmp_path / f"smpl{suffix}"
    source.write_bytes(chumpy.dumps(files.WRAPPED[kind](content), 2, 0))
    assert main(["convert-body", str(source), str(target)]) == 0
    said = capsys.readouterr().out
    assert (
        "300 shape components, with pose blend shapes" in said and "nothing in the file was executed" in said
    )
    assert vertex_error(target, content) < EXACT


RELATIVES = {
    "SMPLH_MALE.npz": (files.smplh, "52 joints, expected 24.*SMPL-H"),
    "SMPLX_NEUTRAL.npz": (files.smplx, "55 joints, expected 24.*SMPL-X"),
    "SMPLX_NEUTRAL.pkl": (files.smplx, "55 joints, expected 24.*SMPL-X"),
    "SMPLH_male.pkl": (files.smplh, "52 joints, expected 24.*SMPL-H"),
    "MANO_RIGHT.pkl": (files.mano, "16 joints, expected 24.*MANO"),
    "model.npz": (files.star, "93 numbers, SMPL's 207.*STAR"),
}


@pytest.mark.parametrize("name", RELATIVES)
def test_relatives_are_refused_by_name(tmp_path, capsys, name):
    make, message = RELATIVES[name]
    path = tmp_path / name
    if path.suffix == ".npz":
        np.savez(path, **make())
    else:
        path.write_bytes(chumpy.dumps(make(), 2, 2))
    with pytest.raises(DataError, match=rf"{name}: .*{message}.*Use SMPL's own file.*smpl\.is\.tue"):
        load_body_arrays(path)
    assert main(["convert-body", str(path), str(tmp_path / "out.npz")]) == 1
    assert not (tmp_path / "out.npz").exists()


def test_an_expression_is_refused_by_key_and_class(tmp_path):
    """`v_shaped` of a loaded model is a sum; a template saved so has no array to read."""
    content = files.smpl(files.RELEASES[0])
    total = chumpy.ch(content["v_template"])
    total.__class__ = type("add", (chumpy.Ch,), {"__module__": "chumpy.ch"})
    total.__dict__.update(a=total.__dict__.pop("x"))
    chumpy.MODULES["chumpy.ch"] += (total.__class__,)
    try:
        path = tmp_path / "model.pkl"
        path.write_bytes(chumpy.dumps({**content, "v_template": total}, 2, 2))
    finally:
        chumpy.MODULES["chumpy.ch"] = chumpy.MODULES["chumpy.ch"][:-1]
    with pytest.raises(DataError, match=r"'v_template' is a chumpy\.ch\.add.*an expression"):
        load_body_arrays(path)


def test_a_body_with_code_in_its_set_is_refused(tmp_path):
    class Runs:
        def __reduce__(self):
            return (tmp_path / "ran").touch, ()

    content = files.smpl(files.RELEASES[0])
    wrapped = files.WRAPPED["as released"](content)
    wrapped["shapedirs"].__dict__["_dirty_vars"] = {Runs()}
    path = tmp_path / "model.pkl"
    with chumpy.chumpy_installed():
        path.write_bytes(pickle.dumps(wrapped, 4))
    with pytest.raises(DataError, match=r"not allowed: .*nothing was executed"):
        load_body_arrays(path)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    "name",
    ["python2.7_p0_select_used.pkl", "python2.7_p2_concatenate_used.pkl", "python3.8_p4_select_used.pkl"],
)
@pytest.mark.filterwarnings("ignore:invalid escape sequence")
@pytest.mark.filterwarnings("ignore:invalid octal escape")
def test_damage_to_a_real_file_gives_a_body_or_an_error(tmp_path, name):
    rng = np.random.default_rng(0)
    content = real_files()[name]
    names = [
        at
        for at in range(len(content))
        if content[at : at + 6] in (b"chumpy", b"_dirty", b"scipy.", b"idxs\x94")
    ]
    path = tmp_path / name
    read = 0
    for _ in range(40):
        changed = bytearray(content)
        at = int(rng.choice(names)) if rng.random() < 0.7 else int(rng.integers(len(content)))
        changed[min(at + int(rng.integers(-20, 40)), len(content) - 1)] = rng.integers(256)
        path.write_bytes(changed)
        with contextlib.suppress(DataError):
            read += load_body_arrays(path) is not None
    assert 0 < read < 40
