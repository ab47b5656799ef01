"""Files of other tools, written here by the calls with which the tools write them."""

from __future__ import annotations

import json
import pickle
from collections import defaultdict

import joblib
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from occfusion.errors import ConfigError, DataError
from occfusion.files.joblibfile import load_joblib
from occfusion.importing.bodies import read_bodies

SIZE = (640, 480)
PELVIS = np.array([0.0, -0.24, 0.03])


def read(path, tool=None, person=None):
    return read_bodies(path, tool, SIZE, lambda betas: PELVIS, person)


@pytest.mark.parametrize(("tool", "block"), [("gvhmr", "smpl_params_incam"), ("gem", "body_params_incam")])
def test_gvhmr_and_gem(tmp_path, tool, block):
    """`torch.save(pred, paths.hmr4d_results)`: zju3dv/GVHMR `tools/demo/demo.py`; GENMO's demo keeps the form."""
    part = {
        "body_pose": torch.randn(5, 63), "betas": torch.randn(5, 10), "global_orient": torch.randn(5, 3),
        "transl": torch.randn(5, 3),
    }  # fmt: skip
    K = torch.tensor([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]]).repeat(5, 1, 1)
    torch.save({block: part, block.replace("incam", "global"): part, "K_fullimg": K}, tmp_path / "r.pt")
    found = read(tmp_path / "r.pt")
    assert found.tool == tool and found.K is not None and found.K[0, 0] == 700
    np.testing.assert_allclose(found.body_pose[:, :63], part["body_pose"].numpy())
    assert not found.body_pose[:, 63:].any()
    np.testing.assert_allclose(found.betas, np.median(part["betas"].numpy(), axis=0))
    np.testing.assert_allclose(found.transl, part["transl"].numpy())


@pytest.mark.parametrize("compress", [0, 3])
def test_wham(tmp_path, compress):
    """`joblib.dump(results, "wham_output.pkl")` of a defaultdict(dict): yohanshin/WHAM `demo.py`."""
    rng, results = np.random.default_rng(0), defaultdict(dict)
    for person, count in ((0, 3), (4, 6)):
        results[person]["pose"] = rng.normal(size=(count, 72)).astype(np.float32)
        results[person]["trans"] = rng.normal(size=(count, 3)).astype(np.float32)
        results[person]["betas"] = rng.normal(size=(count, 10)).astype(np.float32)
        results[person]["verts"] = np.asfortranarray(rng.normal(size=(count, 7, 3)))
        results[person]["frame_ids"] = np.arange(count) + 2
    joblib.dump(results, tmp_path / "wham_output.pkl", compress=compress)
    found = read(tmp_path / "wham_output.pkl")
    assert found.tool == "wham" and list(found.frames) == [2, 3, 4, 5, 6, 7]
    np.testing.assert_array_equal(found.global_orient, results[4]["pose"][:, :3])
    assert found.K is not None and found.K[0, 0] == pytest.approx(800)
    assert len(read(tmp_path / "wham_output.pkl", person=0).frames) == 3
    with pytest.raises(DataError, match="no person 9"):
        read(tmp_path / "wham_output.pkl", person=9)
    again = load_joblib(tmp_path / "wham_output.pkl")
    np.testing.assert_array_equal(again[4]["verts"], results[4]["verts"])


def test_tram(tmp_path):
    """`np.save(f'{hps_folder}/hps_track_{k}.npy', results)`: yufu-wang/tram `scripts/estimate_humans.py`."""
    vectors = np.random.default_rng(0).normal(size=(4, 24, 3))
    matrices = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(4, 24, 3, 3)
    hps = tmp_path / "hps"
    hps.mkdir()
    content = {
        "pred_rotmat": matrices, "pred_shape": np.ones((4, 10)), "pred_trans": np.full((4, 1, 3), 2.0),
        "frame": np.arange(4),
    }  # fmt: skip
    np.save(hps / "hps_track_0.npy", content)
    np.save(
        tmp_path / "camera.npy",
        {"pred_cam_R": np.zeros((4, 3, 3)), "img_focal": 555.0, "img_center": np.array([320.0, 240.0])},
    )
    found = read(hps / "hps_track_0.npy")
    assert found.tool == "tram" and found.K is not None and found.K[0, 0] == 555
    back = Rotation.from_rotvec(found.body_pose.reshape(-1, 3)).as_matrix()
    np.testing.assert_allclose(back.reshape(4, 23, 3, 3), matrices[:, 1:], atol=1e-12)


def test_4d_humans(tmp_path):
    """`joblib.dump(final_visuals_dic, pkl_path, compress=3)`: brjathu/PHALP `phalp/trackers/PHALP.py`."""
    frames = {}
    for k in range(4):
        smpl = {
            "global_orient": np.eye(3, dtype=np.float32)[None], "body_pose": np.tile(np.eye(3), (23, 1, 1)),
            "betas": np.full(10, float(k)),
        }  # fmt: skip
        frames[f"outputs/img/{k:06d}.jpg"] = {
            "tid": [7], "smpl": [smpl], "camera": [np.array([0.1, 0.2, 30.0])], "size": [[480, 640]],
        }  # fmt: skip
    joblib.dump(frames, tmp_path / "demo_v.pkl", compress=3)
    found = read(tmp_path / "demo_v.pkl")
    assert found.tool == "4d-humans" and list(found.frames) == [0, 1, 2, 3]
    assert found.K is not None and found.K[0, 0] == pytest.approx(5000 / 256 * 640)
    np.testing.assert_allclose(found.betas, 1.5)


def test_easymocap(tmp_path):
    """`write_smpl`: a list of people a frame; zju3dv/EasyMocap `easymocap/mytools/file_utils.py`."""
    for k in range(3):
        row = {
            "id": 0,
            "Rh": [[0.0, 1.0, 0.2]],
            "Th": [[1.0, 2.0, 3.0]],
            "poses": [[0.0] * 72],
            "shapes": [[0.0] * 10],
        }
        (tmp_path / f"{k:06d}.json").write_text(json.dumps([row]))
    found = read(tmp_path)
    turn = Rotation.from_rotvec([0.0, 1.0, 0.2]).as_matrix()
    # about the origin: x = R p + Th; smplx's about the pelvis: R (p - j) + j + transl
    point = np.array([0.3, 0.5, 0.1])
    np.testing.assert_allclose(
        turn @ (point - PELVIS) + PELVIS + found.transl[0], turn @ point + [1.0, 2.0, 3.0], atol=1e-12
    )


class Evil:
    def __reduce__(self):
        return (print, ("ran",))


def test_nothing_of_a_file_is_run(tmp_path, capsys):
    joblib.dump({0: Evil()}, tmp_path / "a.pkl")
    torch.save({"smpl_params_incam": Evil()}, tmp_path / "b.pt")
    np.save(tmp_path / "c.npy", np.array({"pred_rotmat": Evil()}, dtype=object))
    for name in ("a.pkl", "b.pt", "c.npy"):
        with pytest.raises(DataError, match="executed"):
            read(tmp_path / name)
    assert capsys.readouterr().out == ""


def test_unknown_content_and_damage_are_named(tmp_path):
    (tmp_path / "x.pkl").write_bytes(pickle.dumps({"what": 1}))
    with pytest.raises(DataError, match="known tool"):
        read(tmp_path / "x.pkl")
    with pytest.raises(ConfigError, match="known are"):
        read(tmp_path / "x.pkl", tool="nothing")
    results = {0: {"pose": np.full((2, 72), np.nan), "trans": np.zeros((2, 3)), "betas": np.zeros((2, 10))}}
    results[0]["frame_ids"] = np.arange(2)
    joblib.dump(results, tmp_path / "w.pkl")
    with pytest.raises(DataError, match="NaN"):
        read(tmp_path / "w.pkl")
    content = (tmp_path / "w.pkl").read_bytes()
    (tmp_path / "cut.pkl").write_bytes(content[: len(content) // 2])
    with pytest.raises(DataError, match=r"cut\.pkl"):
        read(tmp_path / "cut.pkl")


def test_a_body_of_another_tool_is_laid_on_the_clip_and_measured(tmp_path):
    """A file as GVHMR writes it, of the very pose that the key points show: it is trusted; of another clip: not."""
    from occfusion.fitting.anchors import landmark_places
    from occfusion.fitting.batch import BodyBatch, rotations_of
    from occfusion.footage.camera import find_intrinsics
    from occfusion.footage.clip import Clip, Shot
    from occfusion.footage.landmarks import KeyPoints
    from occfusion.human import embedded_body
    from occfusion.importing.adopt import adopt
    from occfusion.importing.sources import Sources

    body, count = embedded_body(), 4
    part = {
        "global_orient": torch.tensor([[np.pi, 0.0, 0.0]]).repeat(count, 1).float(),
        "body_pose": torch.zeros(count, 63),
        "betas": torch.zeros(count, 10), "transl": torch.tensor([[0.0, 0.0, 4.0]]).repeat(count, 1),
    }  # fmt: skip
    K = torch.tensor([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]]).repeat(count, 1, 1)
    torch.save({"smpl_params_incam": part, "K_fullimg": K}, tmp_path / "hmr4d_results.pt")
    batch = BodyBatch(body, np.zeros(1, dtype=np.int64))
    pose = torch.cat([part["body_pose"], torch.zeros(count, 6)], dim=1)
    marks = landmark_places(
        *batch.transforms(torch.zeros(10), rotations_of(part["global_orient"], pose), part["transl"])
    ).numpy()
    pixels = marks[..., :2] / marks[..., 2:] * 600 + [320, 240]
    shot = Shot(
        [np.zeros((480, 640, 3), np.uint8)] * count, list(range(count)), [0.0, 0.1, 0.2, 0.3], 1.0, []
    )
    masks = [np.zeros((480, 640), bool)] * count
    for shift, trusted in ((0.0, True), (60.0, False)):
        points = KeyPoints(pixels + shift, np.ones((count, 33)), None, np.ones(count))
        sources = Sources(
            Clip(tmp_path, (), count, 10.0, 0),
            shot,
            points,
            masks,
            find_intrinsics((640, 480), 1.0, None, None),
        )
        kept, fit = adopt(tmp_path / "hmr4d_results.pt", None, sources, body, embedded=True)
        assert fit.solution.K[0, 0] == 600 and len(kept.shot) == count
        assert fit.quality.trusted is trusted
