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


def vibe_results(count: int = 5) -> dict[int, dict[str, np.ndarray]]:
    """One person; the camera by `convert_crop_cam_to_orig_img`, VIBE's `lib/utils/demo_utils.py@731c2738`."""
    rng = np.random.default_rng(0)
    s, x, y = rng.uniform(0.8, 1.0, count), rng.normal(0, 0.05, count), rng.normal(0, 0.05, count)
    box = np.column_stack([rng.uniform(280, 360, (count, 2)), np.full((count, 2), 300.0)])
    wide, high = s * box[:, 2] / SIZE[0], s * box[:, 2] / SIZE[1]
    orig = [wide, high, (2 * box[:, 0] / SIZE[0] - 1) / wide + x, (2 * box[:, 1] / SIZE[1] - 1) / high + y]
    person = {
        "pred_cam": np.column_stack([s, x, y]), "orig_cam": np.column_stack(orig), "verts": np.zeros((count, 7, 3)),
        "pose": rng.normal(size=(count, 72)), "betas": rng.normal(size=(count, 10)), "joints2d": None, "bboxes": box,
        "frame_ids": np.arange(count) + 3,
    }  # fmt: skip
    return {2: {key: v if v is None else v.astype(np.float32) for key, v in person.items()}}


def test_vibe(tmp_path):
    """`joblib.dump(vibe_results, ... "vibe_output.pkl")`: mkocabas/VIBE `demo.py@1147b97e`. A point at the depth of the
    body's origin is drawn where the crop's camera draws it in its box."""
    results = vibe_results()
    joblib.dump(results, tmp_path / "vibe_output.pkl")
    found, rows = read(tmp_path / "vibe_output.pkl"), results[2]
    assert found.tool == "vibe" and list(found.frames) == list(rows["frame_ids"]) and not found.in_world
    np.testing.assert_array_equal(found.body_pose, rows["pose"][:, 3:])
    point = np.array([0.3, -0.5, 0.0]) + found.transl
    ours = point[:, :2] / point[:, 2:] * found.K[0, 0] + found.K[:2, 2]
    s, x, y = rows["pred_cam"].T
    theirs = (
        np.column_stack([s * (0.3 + x), s * (-0.5 + y)]) * rows["bboxes"][:, 2:] / 2 + rows["bboxes"][:, :2]
    )
    np.testing.assert_allclose(ours, theirs, atol=1e-3)


def test_weak_perspective_of_another_picture_is_refused(tmp_path):
    results = vibe_results()
    results[2]["orig_cam"][3, 1] *= 1.5
    joblib.dump(results, tmp_path / "vibe_output.pkl")
    with pytest.raises(DataError, match=r"row 3: a metre of .* is the file of this clip"):
        read(tmp_path / "vibe_output.pkl")


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


def test_prompthmr(tmp_path):
    """`joblib.dump(self.results, f'{seq_folder}/results.pkl')`: yufu-wang/PromptHMR `pipeline/pipeline.py@d8f40315`,
    `smplx_cam` of `pipeline/phmr_vid.py`; pictures of 1280 x 960 are made 896 high, the camera is that of these."""
    rng, people = np.random.default_rng(0), {}
    for person, count in ((1, 3), (2, 5)):
        cam = {
            "rotmat": np.zeros((count, 55, 3, 3)),
            "pose": rng.normal(size=(count, 75)).astype(np.float32),
            "shape": np.ones((count, 10)),
            "trans": rng.normal(size=(count, 3)),
            "contact": np.zeros((count, 6), bool),
        }
        people[person] = {"frames": np.arange(count) + 4, "track_id": person, "smplx_cam": cam}  # fmt: skip
    camera = {
        "pred_cam_R": np.zeros((9, 3, 3)),
        "img_focal": np.float32(700),
        "img_center": np.array([597.3, 448.0]),
    }
    results = {"camera": camera, "people": people, "timings": {}, "masks": None, "has_tracks": True}
    joblib.dump(results, tmp_path / "results.pkl")
    found = read_bodies(tmp_path / "results.pkl", None, (1280, 960), lambda betas: PELVIS)
    assert found.tool == "prompthmr" and list(found.frames) == [4, 5, 6, 7, 8]
    assert found.K is not None and found.K[0, 0] == pytest.approx(700 * 960 / 896, rel=1e-3)
    np.testing.assert_allclose(found.body_pose[:, :63], people[2]["smplx_cam"]["pose"][:, 3:66])
    assert len(read_bodies(tmp_path / "results.pkl", None, (1280, 960), lambda betas: PELVIS, 1).frames) == 3


def test_nlf_follows_a_person_who_has_no_number(tmp_path):
    """`spu.dump_pickle(valid_fits_per_frame, fit_path)`, a dict of stacks a frame, `stack([], ...)` where nobody is:
    isarandi/nlf-pipeline `src/nlf_pipeline/run_smoothed_smplfitter.py@d216d447`."""
    frames = []
    for k in range(5):
        places = np.array([[0.0, 0, 4], [2.0, 0, 4]], np.float32)[:: 1 if k % 2 else -1] + 0.01 * k
        poses = np.stack([np.full(72, place[0]) for place in places]).astype(np.float32)
        row = {"pose_rotvecs": poses, "shape_betas": np.zeros((2, 10), np.float32), "trans": places}
        frames.append({key: value[:0] for key, value in row.items()} if k == 3 else row)
    (tmp_path / "v_smoothfits.pkl").write_bytes(pickle.dumps(frames))
    for person in (0, 1):
        found = read(tmp_path / "v_smoothfits.pkl", person=person)
        assert found.tool == "nlf" and list(found.frames) == [0, 1, 2, 4]
        np.testing.assert_allclose(found.transl[:, 0], 2.0 * (1 - person) + 0.01 * found.frames, atol=1e-6)
        np.testing.assert_allclose(found.global_orient[:, 0], found.transl[:, 0])
    assert found.K is not None and found.K[0, 0] == pytest.approx(320 / np.tan(np.radians(27.5)))


@pytest.mark.parametrize("version", [0, 2])
def test_smpl_zip(tmp_path, version):
    """`SMPLCodec.write`: `np.savez_compressed` of camelCase names, left out where None; Meshcapade/smplcodec
    `smplcodec/codec.py@0370cb2e` (SMPL has 24 joints in `bodyPose`, SMPL-X 22)."""
    pose = np.random.default_rng(0).normal(size=(6, 24 if version == 0 else 22, 3))
    data = {"codecVersion": 2, "smplVersion": version, "gender": 0, "shapeParameters": np.arange(10.0), "frameCount": 6,
            "frameRate": 30.0, "bodyTranslation": np.ones((6, 3)), "bodyPose": pose}  # fmt: skip
    with (tmp_path / "a.smpl").open("wb") as stream:
        np.savez_compressed(stream, **data)
    found = read(tmp_path / "a.smpl")
    assert found.tool == "smpl" and found.in_world and found.K is None
    np.testing.assert_array_equal(found.global_orient, pose[:, 0])
    np.testing.assert_array_equal(found.body_pose[:, :63], pose[:, 1:22].reshape(6, 63))
    assert found.betas[3] == (3 if version == 0 else 0)
    with (tmp_path / "a.smpl").open("wb") as stream:
        np.savez_compressed(stream, **{**data, "smplVersion": 5})
    with pytest.raises(DataError, match="smplVersion 5"):
        read(tmp_path / "a.smpl")


def test_aist_is_recognised(tmp_path):
    """google/aistplusplus_api `aist_plusplus/loader.py@3b5b8f91`."""
    content = {
        "smpl_poses": np.ones((4, 72), np.float32), "smpl_scaling": np.array([90.0], np.float32),
        "smpl_trans": np.full((4, 3), 180.0, np.float32), "smpl_loss": 1.0,
    }  # fmt: skip
    (tmp_path / "gBR.pkl").write_bytes(pickle.dumps(content))
    found = read(tmp_path / "gBR.pkl")
    assert found.tool == "motion" and found.in_world
    np.testing.assert_allclose(found.transl, 2.0)


def test_sam_3d_body_gives_key_points_and_the_camera(tmp_path):
    """`process_one_image` returns a list of dicts a picture: facebookresearch/sam-3d-body
    `sam_3d_body/sam_3d_body_estimator.py`; places of `sam_3d_body/metadata/__init__.py@31ab9f7a` MHR70_TO_OPENPOSE."""
    from occfusion.footage.clip import Clip, Shot
    from occfusion.footage.landmarks import INDEX
    from occfusion.importing.keypoints import ORDERS, camera_in, read_keypoints
    from occfusion.importing.mhr import PLACES, is_mhr

    rng, K = np.random.default_rng(0), np.array([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]])
    for k in range(4):
        deep, away = rng.normal(0, 0.4, (70, 3)), np.array([0.1 * k, 0.2, 5.0])
        flat = (deep + away) @ K.T
        person = {
            "pred_keypoints_3d": deep.astype(np.float32), "pred_cam_t": away.astype(np.float32), "focal_length": None,
            "pred_keypoints_2d": (flat[:, :2] / flat[:, 2:]).astype(np.float32), "mhr_model_params": np.zeros(204),
        }  # fmt: skip
        np.save(tmp_path / f"{k:05d}.npy", [person])
    shot = Shot([np.zeros((360, 640, 3), np.uint8)] * 4, [0, 1, 2, 3], [0.0, 0.1, 0.2, 0.3], 0.5, [])
    assert is_mhr(tmp_path)
    found = read_keypoints(tmp_path, Clip(tmp_path, (), 4, 10.0, 0), shot)
    camera = camera_in(tmp_path, shot)
    assert camera is not None and camera.known
    np.testing.assert_allclose(camera.K, [[450, 0, 320], [0, 450, 180], [0, 0, 1]], atol=0.01)
    ankle = INDEX["left_ankle"]
    np.testing.assert_allclose(found.pixels[3, ankle], (flat[13, :2] / flat[13, 2:]) / 2, rtol=1e-5)
    np.testing.assert_allclose(found.world[3, ankle], deep[13] - deep[[9, 10]].mean(axis=0), atol=1e-6)
    theirs = {0: 0, 2: 6, 3: 8, 4: 41, 5: 5, 6: 7, 7: 62, 9: 10, 10: 12, 11: 14, 12: 9, 13: 11, 14: 13, 15: 2, 16: 1,
              17: 4, 18: 3, 19: 15, 21: 17, 22: 18, 24: 20}  # fmt: skip
    for openpose, place in theirs.items():
        assert PLACES[ORDERS[25][openpose]] == place


def test_bodies_of_a_world_are_put_before_the_camera(tmp_path):
    """By the turn and shift that their landmarks were seen from, a tenth of which are wrong."""
    from occfusion.fitting.anchors import landmark_places
    from occfusion.fitting.batch import BodyBatch, rotations_of
    from occfusion.fitting.solver import Solution
    from occfusion.footage.landmarks import KeyPoints
    from occfusion.human import embedded_body
    from occfusion.importing.adopt import stood

    rng, body, count = np.random.default_rng(0), embedded_body(), 5
    K = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
    orient, pose, transl = (
        rng.normal(0, 0.4, (count, 3)),
        rng.normal(0, 0.3, (count, 69)),
        rng.normal(0, 0.3, (count, 3)),
    )
    world = Solution(np.zeros(10), orient, pose, transl, K)

    def marks(solution):
        batch = BodyBatch(body, np.zeros(1, dtype=np.int64))
        parts = (torch.tensor(p).float() for p in (solution.global_orient, solution.body_pose))
        transl = torch.tensor(solution.transl).float()
        return (
            landmark_places(*batch.transforms(torch.zeros(10), rotations_of(*parts), transl)).double().numpy()
        )

    turn, shift = Rotation.from_rotvec([2.8, 0.3, 0.4]).as_matrix(), np.array([0.2, 0.1, 4.0])
    seen = marks(world) @ turn.T + shift
    pixels = seen[..., :2] / seen[..., 2:] * 600 + [320, 240]
    pixels[:, ::10] += 90
    found = stood(body, world, KeyPoints(pixels, np.ones((count, 33)), None, np.ones(count)))
    np.testing.assert_allclose(marks(found), seen, atol=2e-3)
    with pytest.raises(DataError, match="too few"):
        stood(body, world, KeyPoints(pixels, np.zeros((count, 33)), None, np.ones(count)))


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
    np.savez(tmp_path / "x.npz", poses=np.zeros((2, 72)))
    joblib.dump([{"pose": np.zeros(72)}], tmp_path / "list.pkl")
    for tool, name in (
        ("wham", "x.npz"),
        ("smpl", "x.npz"),
        ("prompthmr", "x.pkl"),
        ("4d-humans", "list.pkl"),
    ):
        with pytest.raises(DataError, match=rf"{name}: is not what {tool} writes"):
            read(tmp_path / name, tool=tool)
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
