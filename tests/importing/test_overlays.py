"""A person written by each tool's own rule lies, once imported, on the pixels where that tool draws them.

The rule of each is in `test_bodies.py`, with the file of the tool that says it.
"""

from __future__ import annotations

import json
import pickle

import joblib
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from occfusion.files.video import write_frames
from occfusion.fitting.solver import Solution
from occfusion.footage.camera import Intrinsics
from occfusion.footage.clip import open_clip, read_clip
from occfusion.footage.landmarks import KeyPoints
from occfusion.human import embedded_body
from occfusion.importing.adopt import adopt, stood
from occfusion.importing.bodies import read_bodies
from occfusion.importing.sources import Sources

WIDTH, HEIGHT, FRAMES = 640, 480, 8
FOCAL = {
    "4d-humans": 5000 / 256 * WIDTH,
    "vibe": 5000 / 224 * WIDTH,
    "nlf": 0.5 * WIDTH / np.tan(np.radians(27.5)),
    "wham": 800.0,
}


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    path = tmp_path_factory.mktemp("clip") / "clip.mp4"
    rng = np.random.default_rng(0)
    write_frames(path, [rng.integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8) for _ in range(FRAMES)], 10.0)
    return open_clip(path)


def person(away: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Turn `[N, 3]`, pose `[N, 69]` with straight hands, place `[N, 3]` of somebody who turns and moves an arm."""
    rng = np.random.default_rng(1)
    upside = Rotation.from_rotvec([np.pi, 0.0, 0.0])
    orient = np.stack([(upside * Rotation.from_rotvec([0, 0.2 * k, 0.1])).as_rotvec() for k in range(FRAMES)])
    pose = 0.2 * rng.normal(size=(FRAMES, 69))
    pose[:, 63:] = 0
    return (
        orient,
        pose,
        np.column_stack([np.linspace(-0.2, 0.2, FRAMES), np.full(FRAMES, 0.1), np.full(FRAMES, away)]),
    )


def meshes(orient, pose, transl) -> np.ndarray:
    """Vertices `[N, V, 3]` of the embedded body by its own skinning, one frame after the other."""
    body, betas = embedded_body(), torch.zeros(10)
    rows = (torch.tensor(part, dtype=torch.float32) for part in (orient, pose, transl))
    return np.stack([body(betas, *row)[0].numpy() for row in zip(*rows, strict=True)]).astype(np.float64)


def on_screen(points: np.ndarray, focal: float) -> np.ndarray:
    return points[..., :2] / points[..., 2:] * focal + [WIDTH / 2, HEIGHT / 2]


def matrices(vectors: np.ndarray) -> np.ndarray:
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape[:-1], 3, 3)


def smplx_file(folder, tool, orient, pose, transl, focal):
    block = "smpl_params_incam" if tool == "gvhmr" else "body_params_incam"
    part = {
        "global_orient": orient,
        "body_pose": pose[:, :63],
        "betas": np.zeros((FRAMES, 10)),
        "transl": transl,
    }
    K = np.tile([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1.0]], (FRAMES, 1, 1))
    tensors = {key: torch.tensor(value).float() for key, value in part.items()}
    torch.save({block: tensors, "K_fullimg": torch.tensor(K).float()}, folder / "r.pt")
    return folder / "r.pt"


def wham_file(folder, tool, orient, pose, transl, focal):
    rows = {
        "pose": np.concatenate([orient, pose], axis=1), "trans": transl, "betas": np.zeros((FRAMES, 10)),
        "frame_ids": np.arange(FRAMES),
    }  # fmt: skip
    joblib.dump({0: rows}, folder / "wham_output.pkl")
    return folder / "wham_output.pkl"


def tram_file(folder, tool, orient, pose, transl, focal):
    (folder / "hps").mkdir()
    rotations = matrices(np.concatenate([orient, pose], axis=1).reshape(FRAMES, 24, 3))
    content = {
        "pred_rotmat": rotations, "pred_shape": np.zeros((FRAMES, 10)), "pred_trans": transl[:, None],
        "frame": np.arange(FRAMES),
    }  # fmt: skip
    np.save(folder / "hps" / "hps_track_0.npy", content)
    np.save(folder / "camera.npy", {"img_focal": focal, "img_center": np.array([WIDTH / 2, HEIGHT / 2])})
    return folder / "hps" / "hps_track_0.npy"


def vibe_file(folder, tool, orient, pose, transl, focal):
    scale = 2 * focal / transl[:, 2] / np.array([[WIDTH], [HEIGHT]])
    rows = {
        "pose": np.concatenate([orient, pose], axis=1), "betas": np.zeros((FRAMES, 10)), "frame_ids": np.arange(FRAMES),
        "orig_cam": np.column_stack([*scale, transl[:, :2]]),
    }  # fmt: skip
    joblib.dump({1: rows}, folder / "vibe_output.pkl")
    return folder / "vibe_output.pkl"


def phalp_file(folder, tool, orient, pose, transl, focal):
    turns, joints, frames = matrices(orient), matrices(pose.reshape(FRAMES, 23, 3)), {}
    for k in range(FRAMES):
        smpl = {"global_orient": turns[k][None], "body_pose": joints[k], "betas": np.zeros(10)}
        frames[f"{k:06d}.jpg"] = {
            "tid": [1],
            "smpl": [smpl],
            "camera": [transl[k]],
            "size": [[HEIGHT, WIDTH]],
        }
    joblib.dump(frames, folder / "demo_v.pkl", compress=3)
    return folder / "demo_v.pkl"


def prompthmr_file(folder, tool, orient, pose, transl, focal):
    cam = {
        "pose": np.concatenate([orient, pose[:, :63], np.zeros((FRAMES, 9))], axis=1),
        "shape": np.zeros((FRAMES, 10)), "trans": transl,
    }  # fmt: skip
    camera = {"img_focal": np.float32(focal), "img_center": np.array([WIDTH / 2, HEIGHT / 2])}
    people = {1: {"frames": np.arange(FRAMES), "smplx_cam": cam}}
    joblib.dump({"camera": camera, "people": people}, folder / "results.pkl")
    return folder / "results.pkl"


def nlf_file(folder, tool, orient, pose, transl, focal):
    poses = np.concatenate([orient, pose], axis=1)
    frames = [
        {"pose_rotvecs": poses[k][None], "shape_betas": np.zeros((1, 10)), "trans": transl[k][None]}
        for k in range(FRAMES)
    ]
    (folder / "v_smoothfits.pkl").write_bytes(pickle.dumps(frames))
    return folder / "v_smoothfits.pkl"


def easymocap_file(folder, tool, orient, pose, transl, focal):
    # EasyMocap turns about the origin: R (x - j) + j + t = R x + Th
    joint = embedded_body().joint_template[0].double().numpy()
    places = transl + joint - np.einsum("nij,j->ni", matrices(orient), joint)
    (folder / "smpl").mkdir()
    for k in range(FRAMES):
        row = {
            "id": 0, "Rh": [orient[k].tolist()], "Th": [places[k].tolist()],
            "poses": [[0.0] * 3 + pose[k].tolist()], "shapes": [[0.0] * 10],
        }  # fmt: skip
        (folder / "smpl" / f"{k:06d}.json").write_text(json.dumps([row]))
    return folder / "smpl"


def smplcodec_file(folder, tool, orient, pose, transl, focal):
    with (folder / "a.smpl").open("wb") as stream:
        np.savez_compressed(
            stream, codecVersion=2, smplVersion=0, shapeParameters=np.zeros(10), bodyTranslation=transl,
            bodyPose=np.concatenate([orient, pose], axis=1).reshape(FRAMES, 24, 3),
        )  # fmt: skip
    return folder / "a.smpl"


def amass_file(folder, tool, orient, pose, transl, focal):
    np.savez(
        folder / "amass.npz", trans=transl, gender=np.array("neutral"), mocap_framerate=np.array(10.0),
        betas=np.zeros(16), dmpls=np.zeros((FRAMES, 8)),
        poses=np.concatenate([orient, pose[:, :63], np.zeros((FRAMES, 90))], axis=1),
    )  # fmt: skip
    return folder / "amass.npz"


def aist_file(folder, tool, orient, pose, transl, focal):
    content = {
        "smpl_poses": np.concatenate([orient, pose], axis=1), "smpl_scaling": np.array([90.0]),
        "smpl_trans": 90.0 * transl, "smpl_loss": 1.0,
    }  # fmt: skip
    (folder / "gBR.pkl").write_bytes(pickle.dumps(content))
    return folder / "gBR.pkl"


def instantavatar_file(folder, tool, orient, pose, transl, focal):
    np.savez(
        folder / "poses_optimized.npz",
        betas=np.zeros(10),
        global_orient=orient,
        body_pose=pose,
        transl=transl,
    )
    return folder / "poses_optimized.npz"


WRITERS = {
    "gvhmr": smplx_file, "gem": smplx_file, "wham": wham_file, "vibe": vibe_file, "tram": tram_file,
    "4d-humans": phalp_file, "prompthmr": prompthmr_file, "nlf": nlf_file, "easymocap": easymocap_file,
    "smpl": smplcodec_file, "amass": amass_file, "aist": aist_file, "instantavatar": instantavatar_file,
}  # fmt: skip


@pytest.mark.parametrize("tool", WRITERS)
def test_the_body_lies_where_the_tool_draws_it(tmp_path, clip, tool):
    focal = FOCAL.get(tool, 700.0)
    truth = person(away=4.0 * focal / 700.0)
    vertices = meshes(*truth)
    pixels = on_screen(vertices, focal)
    points = landmarks_of(truth, focal)
    shot = read_clip(clip)
    K = np.array([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1.0]])
    sources = Sources(
        clip, shot, points, [np.zeros((HEIGHT, WIDTH), bool)] * FRAMES, Intrinsics(K, True, "given")
    )
    _, fit = adopt(
        WRITERS[tool](tmp_path, tool, *truth, focal), None, sources, embedded_body(), embedded=True
    )
    s = fit.solution
    ours = on_screen(meshes(s.global_orient, s.body_pose, s.transl), s.K[0, 0])
    # files of a world have no camera: one is found from the key points
    assert np.abs(ours - pixels).max() < (0.02 if tool in ("smpl", "easymocap", "amass", "aist", "instantavatar")
                                          else 0.01)  # fmt: skip
    assert fit.quality.trusted and np.nanmax(fit.quality.pixels) < 0.1


def landmarks_of(truth, focal: float) -> KeyPoints:
    from occfusion.fitting.anchors import landmark_places
    from occfusion.fitting.batch import BodyBatch, rotations_of

    orient, pose, transl = (torch.tensor(part, dtype=torch.float32) for part in truth)
    batch = BodyBatch(embedded_body(), np.zeros(1, dtype=np.int64))
    marks = landmark_places(*batch.transforms(torch.zeros(10), rotations_of(orient, pose), transl)).numpy()
    return KeyPoints(on_screen(marks.astype(np.float64), focal), np.ones((FRAMES, 33)), None, np.ones(FRAMES))


def test_weak_perspective_draws_the_body_as_its_tool_does(tmp_path):
    """VIBE's `WeakPerspectiveCamera` leaves depth out: the long lens is off by depth over distance, about 1 pixel."""
    focal = FOCAL["vibe"]
    truth = person(away=4.0 * focal / 700.0)
    found = read_bodies(
        vibe_file(tmp_path, "vibe", *truth, focal), None, (WIDTH, HEIGHT), lambda betas: np.zeros(3)
    )
    vertices, away = meshes(truth[0], truth[1], np.zeros((FRAMES, 3))), truth[2][:, None, 2:]
    offset = (vertices[..., :2] + truth[2][:, None, :2]) * focal / away
    ours = on_screen(meshes(found.global_orient, found.body_pose, found.transl), found.K[0, 0])
    apart = np.abs(ours - offset - [WIDTH / 2, HEIGHT / 2])
    assert (apart <= 1.02 * np.abs(vertices[..., 2:] / away * offset) + 1e-3).all() and 0.1 < apart.max() < 2


def test_a_camera_that_is_wrong_is_seen(tmp_path):
    """The other way round: bodies of a world, turned away, come back to where the key points are."""
    truth = person(away=4.0)
    away = Rotation.from_rotvec([0.3, 0.4, 0.1])
    body = embedded_body()
    joint = body.joint_template[0].double().numpy()
    orient = (away * Rotation.from_rotvec(truth[0])).as_rotvec()
    transl = (truth[2] + joint) @ away.as_matrix().T + [0.5, 0.2, 1.0] - joint
    K = np.array([[700.0, 0, WIDTH / 2], [0, 700.0, HEIGHT / 2], [0, 0, 1.0]])
    turned = Solution(np.zeros(10), orient, truth[1], transl, K)
    before = on_screen(meshes(orient, truth[1], transl), 700.0)
    back = stood(body, turned, landmarks_of(truth, 700.0))
    after = on_screen(meshes(back.global_orient, back.body_pose, back.transl), 700.0)
    wanted = on_screen(meshes(*truth), 700.0)
    assert np.abs(before - wanted).max() > 50 and np.abs(after - wanted).max() < 0.05
