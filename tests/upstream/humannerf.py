"""Folders as HumanNeRF's and OccNeRF's own preparation scripts leave them, and their formula for what a camera sees.

Read in chungyiweng/humannerf @ 7389c4049c0d5b14afdbac41a605ddad9d51dd4a:

- `tools/prepare_zju_mocap/prepare_dataset.py`: one camera; `frame_%06d` counts from 0; K `[3, 3]` and D `[5]` float32,
  E `[4, 4]` float64 holding float32 numbers, the same three objects in every row; `Rh`, `Th`, `poses` as they are
  in `new_params/`; `joints` and `tpose_joints` float64, of SMPL at `poses` and at rest; no `betas`; masks of three
  channels, 0 and 255; the YAML file is copied to `config.yaml`; `canonical_joints.pkl` holds `joints` alone.
- `tools/prepare_wild/prepare_dataset.py`: writes beside `images/`, `masks/` and `metadata.json` what it makes of the
  latter: `Rh = poses[:3]`, `Th` = the pelvis at rest, `poses[:3] = 0`, both joint tables less the pelvis; no
  `distortions`, no `betas`; a key `trans` is not looked at.
- `core/data/human_nerf/train.py`: the `.png` files in `images/` say which frames there are; tables may have more.
- `core/utils/camera_util.py`: the body stands at `E [R(Rh) | Th]`; rays go through whole-number pixels.
- `third_parties/smpl/smpl_numpy.py`: rotations are float32, all else is as in the body file (float64).
- `README.md`: the sample's person stands at z = 47.504 with a focal length of 23043.9; in thread 1 of
  the tracker the authors give the rule: focal length 5000 for a crop of 224 pixels, so that K changes with the
  person's box in every frame.

Read in tiangexiang/OccNeRF @ 8c4223a6: `tools/prepare_zju_mocap/prepare_dataset.py`
(adds `betas`, `dapose_joints` and `avg_betas`), `prepare_dataset_eval.py` with `377_eval.yaml`
(`camera_%02d_frame_%06d`, cameras from 1, every 30th moment, E float32), `prepare_all_cameras.py`
(`all_cameras.pkl`), and
`tools/prepare_wild/prepare_dataset.py` (adds `betas`; puts `trans` of `metadata.json` into E).
"""

from __future__ import annotations

import json
import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from data.layout_writers import Source, save_picture

PROTOCOL = 3
"""`pickle.dump` without more in Python 3.7, which both repositories ask for."""


class Smpl:
    """SMPL as `smpl_numpy.py` computes it, written from its description."""

    def __init__(self, arrays: dict[str, np.ndarray]) -> None:
        self.template = arrays["v_template"].astype(float)
        self.shapes = arrays["shapedirs"].astype(float)[:, :, :10]
        self.poses = (
            arrays["posedirs"].astype(float)
            if "posedirs" in arrays
            else np.zeros((*self.template.shape, 207))
        )
        self.regressor = arrays["J_regressor"].astype(float)
        self.weights = arrays["weights"].astype(float)
        self.faces = arrays["f"]
        self.parents = [int(parent) for parent in arrays["kintree_table"][0]]

    @classmethod
    def of(cls, path: Path) -> Smpl:
        with np.load(path) as archive:
            return cls(dict(archive))

    def __call__(self, poses: np.ndarray, betas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Vertices and joints."""
        shaped = self.template + self.shapes @ betas
        rest = self.regressor @ shaped
        turns = [cv2.Rodrigues(turn)[0].astype(np.float32) for turn in poses.reshape(24, 3)]
        bends = np.concatenate([(turn - np.eye(3, dtype=np.float32)).ravel() for turn in turns[1:]])
        bent = shaped + self.poses @ bends
        place = []
        for joint, turn in enumerate(turns):
            own = np.eye(4)
            own[:3, :3] = turn
            own[:3, 3] = rest[joint] - (rest[self.parents[joint]] if joint else 0)
            place.append(place[self.parents[joint]] @ own if joint else own)
        joints = np.array([step[:3, 3] for step in place])
        moves = np.array(
            [np.c_[step[:3, :3], step[:3, 3] - step[:3, :3] @ j] for step, j in zip(place, rest, strict=True)]
        )
        blended = np.einsum("vj,jab->vab", self.weights, moves)
        return np.einsum("vab,vb->va", blended[:, :, :3], bent) + blended[:, :, 3], joints


@dataclass
class Row:
    """What one frame was written from: the oracle's side."""

    K: np.ndarray
    E: np.ndarray
    vertices: np.ndarray
    mask: np.ndarray

    def pixels(self) -> np.ndarray:
        """Where the vertices are, counting pixels from the middle of the first."""
        seen = self.vertices @ self.E[:3, :3].T + self.E[:3, 3]
        return (seen @ self.K.T)[:, :2] / seen[:, 2:]

    def in_camera(self) -> np.ndarray:
        return self.vertices @ self.E[:3, :3].T + self.E[:3, 3]


def dump(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(content, protocol=PROTOCOL))


def load(path: Path) -> Any:
    return pickle.loads(path.read_bytes())


def placed(vertices: np.ndarray, Rh: np.ndarray, Th: np.ndarray) -> np.ndarray:
    """`x = R(Rh) v + Th`: what putting `Rh` and `Th` into the camera amounts to."""
    return vertices @ cv2.Rodrigues(np.asarray(Rh, dtype=float))[0].T + Th


def write_zju(
    source: Source, target: Path, smpl: Smpl, *, occnerf: bool = False, camera: int = 0
) -> dict[str, Row]:
    """`prepare_zju_mocap/prepare_dataset.py`, of HumanNeRF or of OccNeRF."""
    cams, cameras, meshes, rows, all_betas = source.cams, {}, {}, {}, []
    K, E, D = _camera(cams, camera)
    E = E.astype(np.float64)
    for frame in range(source.frames):
        name = f"frame_{frame:06d}"
        cameras[name] = {"intrinsics": K, "extrinsics": E, "distortions": D}
        meshes[name], rows[name] = _mesh(source, smpl, frame, camera, K, E)
        all_betas.append(meshes[name]["betas"])
        if occnerf:
            apart = np.zeros((24, 3))
            apart[1, 2], apart[2, 2] = 1.0, -1.0
            meshes[name]["dapose_joints"] = smpl(apart.reshape(72), all_betas[-1])[1]
        else:
            del meshes[name]["betas"]
        _pictures(source, target, frame, camera, name)
    _finish(target, smpl, cameras, meshes, all_betas, occnerf=occnerf)
    (target / "config.yaml").write_text("dataset:\n  subject: '377'\n")
    if occnerf:
        every = [_camera(cams, index) for index in range(len(cams["K"]))]
        stacked = {key: np.stack(part) for key, part in zip(("intrinsics", "extrinsics", "distortions"),
                                                            zip(*every, strict=True), strict=True)}  # fmt: skip
        dump(target / "all_cameras.pkl", dict.fromkeys(cameras, stacked))
    return rows


def write_eval(source: Source, target: Path, smpl: Smpl, skip: int = 30) -> dict[str, Row]:
    """OccNeRF's `prepare_dataset_eval.py`: all cameras but the first, every `skip`-th moment, in one table."""
    cameras, meshes, rows, all_betas = {}, {}, {}, []
    for frame in range(0, source.frames, skip):
        for camera in range(1, len(source.cams["K"])):
            name = f"camera_{camera + 1:02d}_frame_{frame:06d}"
            K, E, D = _camera(source.cams, camera)
            cameras[name] = {"intrinsics": K, "extrinsics": E, "distortions": D}
            meshes[name], rows[name] = _mesh(source, smpl, frame, camera, K, E)
            all_betas.append(meshes[name]["betas"])
            _pictures(source, target, frame, camera, name)
    _finish(target, smpl, cameras, meshes, all_betas, occnerf=True)
    (target / "config.yaml").write_text("dataset:\n  subject: '377'\neval_view: 1-22\n")
    return rows


def weak_rows(source: Source, smpl: Smpl, size: int) -> dict[str, dict[str, Any]]:
    """`metadata.json` of footage whose bodies a regressor gave with a weak-perspective camera of a square box."""
    rows = {}
    for frame in range(source.frames):
        betas, orient, pose, _ = source.smplx(frame)
        turn = source.extrinsics(0)[:3, :3] @ cv2.Rodrigues(orient)[0]
        poses = np.concatenate([cv2.Rodrigues(turn)[0].ravel(), pose])
        side, centre = size * (0.8 + 0.05 * frame), np.array([size / 2 + frame, size / 2 - 1.0])
        scale = side / 224
        K = [[5000 * scale, 0.0, centre[0]], [0.0, 5000 * scale, centre[1]], [0.0, 0.0, 1.0]]
        middle = smpl(poses, betas)[0].mean(axis=0)
        away = 47.504 - 0.5 * frame  # 2 * 5000 / (224 * 0.94)
        E = [
            [1.0, 0.0, 0.0, -middle[0]],
            [0.0, 1.0, 0.0, -middle[1]],
            [0.0, 0.0, 1.0, away],
            [0.0, 0.0, 0.0, 1.0],
        ]
        rows[f"{frame:06d}"] = {
            "poses": poses.tolist(), "betas": (betas + 0.05 * frame).tolist(), "cam_intrinsics": K, "cam_extrinsics": E,
        }  # fmt: skip
    return rows


def write_wild(
    metadata: dict[str, dict[str, Any]], target: Path, smpl: Smpl, size: int, *, occnerf: bool = False
) -> dict[str, Row]:
    """`metadata.json`, pictures and masks of the person it describes, then `prepare_wild/prepare_dataset.py`."""
    cameras, meshes, rows, all_betas = {}, {}, {}, []
    target.mkdir(parents=True)
    (target / "metadata.json").write_text(json.dumps(metadata))
    for name, values in metadata.items():
        poses, betas = (np.array(values[key], dtype=np.float32) for key in ("poses", "betas"))
        K, E = (np.array(values[key], dtype=np.float32) for key in ("cam_intrinsics", "cam_extrinsics"))
        all_betas.append(betas)
        whole = smpl(poses, betas)[0]
        rest = smpl(np.zeros(72, dtype=np.float32), betas)[1]
        Th, Rh = rest[0].copy(), poses[:3].copy()
        poses[:3] = 0
        meshes[name] = {
            "Rh": Rh, "Th": Th, "poses": poses, "joints": smpl(poses, betas)[1] - Th, "tpose_joints": rest - Th,
        }  # fmt: skip
        if occnerf:
            meshes[name]["betas"] = betas
            if "trans" in values:
                moved = np.eye(4)
                moved[:3, 3] = np.array(values["trans"], dtype=np.float32)
                E = E @ moved
        cameras[name] = {"intrinsics": K, "extrinsics": E}
        rows[name] = Row(
            K.astype(float), E.astype(float), placed(smpl(poses, betas)[0] - Th, Rh, Th), np.zeros(0)
        )
        assert np.abs(rows[name].vertices - whole).max() < 1e-5
        rows[name].mask = silhouette(rows[name].pixels(), smpl.faces, size)
        mask = np.repeat(rows[name].mask[..., None] * np.uint8(255), 3, axis=2)
        save_picture(target / "masks" / f"{name}.png", mask)
        save_picture(target / "images" / f"{name}.png", np.where(mask > 0, np.uint8(140), np.uint8(30)))
    _finish(target, smpl, cameras, meshes, all_betas, occnerf=occnerf)
    return rows


def leave_strays(folder: Path) -> list[str]:
    """What people's folders hold among the pictures: a video made of them, what systems leave, smaller copies."""
    names = [
        "images/out.mp4",
        "images/.DS_Store",
        "masks/.DS_Store",
        "images/Thumbs.db",
        "images/thumbnail.jpg",
    ]
    for name in names:
        (folder / name).write_bytes(b"not a picture")
    first = sorted((folder / "images").glob("*.png"))[0]
    (folder / "images" / f"._{first.name}").write_bytes(b"\x00\x05\x16\x07")
    first.with_suffix(".jpg").write_bytes(b"a smaller copy")
    return [*names, f"images/._{first.name}", f"images/{first.stem}.jpg"]


def silhouette(pixels: np.ndarray, faces: np.ndarray, size: int) -> np.ndarray:
    """The triangles, filled, `[size, size]`."""
    canvas = np.zeros((size, size), np.uint8)
    for corners in np.round(pixels[faces] * 16).astype(np.int32):
        cv2.fillConvexPoly(canvas, corners, 1, cv2.LINE_8, 4)
    return canvas


def _camera(cams: dict, camera: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """K `[3, 3]`, E `[4, 4]`, D `[5]`, all float32."""
    E = np.zeros((4, 4), np.float32)
    E[:3, :3] = np.array(cams["R"])[camera].astype("float32")
    E[:3, 3] = (np.array(cams["T"])[camera].astype("float32") / 1000.0)[:, 0]
    E[3, 3] = 1.0
    return (
        np.array(cams["K"])[camera].astype("float32"),
        E,
        np.array(cams["D"])[camera].astype("float32")[:, 0],
    )


def _mesh(
    source: Source, smpl: Smpl, frame: int, camera: int, K: np.ndarray, E: np.ndarray
) -> tuple[dict[str, np.ndarray], Row]:
    values = {key: value[0] for key, value in source.parameters(frame).items()}
    poses, betas = values["poses"], values["shapes"]
    vertices, joints = smpl(poses, betas)
    mesh = {
        "Rh": values["Rh"], "Th": values["Th"], "poses": poses, "betas": betas, "joints": joints,
        "tpose_joints": smpl(np.zeros_like(poses), betas)[1],
    }  # fmt: skip
    world = placed(vertices, values["Rh"], values["Th"])
    return mesh, Row(K.astype(float), E.astype(float), world, source.mask(frame, camera))


def _pictures(source: Source, target: Path, frame: int, camera: int, name: str) -> None:
    save_picture(target / "images" / f"{name}.png", source.picture(frame, camera))
    mask = np.repeat(source.mask(frame, camera)[..., None] * np.uint8(255), 3, axis=2)
    save_picture(target / "masks" / f"{name}.png", mask)


def _finish(
    target: Path, smpl: Smpl, cameras: dict, meshes: dict, all_betas: list[np.ndarray], *, occnerf: bool
) -> None:
    dump(target / "cameras.pkl", cameras)
    dump(target / "mesh_infos.pkl", meshes)
    average = np.mean(np.stack(all_betas, axis=0), axis=0)
    content = {"joints": smpl(np.zeros(72), average)[1]}
    dump(target / "canonical_joints.pkl", content | ({"avg_betas": average} if occnerf else {}))
