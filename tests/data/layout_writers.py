"""Writes an embedded scene, as it lies on disk in the original layout, in each of the other layouts.

Nothing here calls a reader of the package; conversions are written out again.
"""

from __future__ import annotations

import json
import pickle  # what is read here was written by the same test
import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from occfusion.human import load_body

HALF = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])


@dataclass
class Source:
    """An embedded scene in the original layout, written by this test session: trusted."""

    folder: Path

    def __post_init__(self) -> None:
        self.annots = np.load(self.folder / "annots.npy", allow_pickle=True).item()
        self.frames = len(self.annots["ims"])
        self.body = load_body(self.folder / "body.npz")

    @property
    def cams(self) -> dict:
        return self.annots["cams"]

    def path(self, frame: int, camera: int) -> str:
        return self.annots["ims"][frame]["ims"][camera]

    def picture(self, frame: int, camera: int = 0) -> np.ndarray:
        return cv2.imread(str(self.folder / self.path(frame, camera)))

    def mask(self, frame: int, camera: int = 0) -> np.ndarray:
        path = self.folder / "mask" / self.path(frame, camera).replace(".jpg", ".png")
        return (cv2.imread(str(path), cv2.IMREAD_UNCHANGED) > 0).astype(np.uint8)

    def parameters(self, frame: int) -> dict[str, np.ndarray]:
        return np.load(self.folder / "new_params" / f"{frame}.npy", allow_pickle=True).item()

    def vertices(self, frame: int) -> np.ndarray:
        return np.load(self.folder / "new_vertices" / f"{frame}.npy")

    def extrinsics(self, camera: int) -> np.ndarray:
        view = np.eye(4)
        view[:3, :3] = self.cams["R"][camera]
        view[:3, 3] = self.cams["T"][camera].reshape(3) / 1000
        return view

    def pelvis(self, betas: np.ndarray) -> np.ndarray:
        joints = self.rest_joints(betas)
        return joints[0]

    def rest_joints(self, betas: np.ndarray) -> np.ndarray:
        import torch

        zeros = torch.zeros(3), torch.zeros(69), torch.zeros(3)
        return self.body(torch.tensor(betas, dtype=torch.float32), *zeros)[1].double().numpy()

    def smplx(self, frame: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """betas, global_orient, body_pose, transl."""
        values = {key: value.reshape(-1).astype(float) for key, value in self.parameters(frame).items()}
        R, J = cv2.Rodrigues(values["Rh"])[0], self.pelvis(values["shapes"])
        return values["shapes"], values["Rh"], values["poses"][3:], values["Th"] + R @ J - J


def save_object(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    box = np.empty((), dtype=object)
    box[()] = content
    np.save(path, box, allow_pickle=True)


def save_pickle(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(content, protocol=4))


def save_picture(path: Path, picture: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), picture)


def write_original(source: Source, target: Path) -> Path:
    shutil.copytree(source.folder, target)
    return target


def write_stamped(source: Source, root: Path, subject: int = 313) -> Path:
    """313 and 315: `Camera (1)`, time stamps in names, numbers from 1, an older fit beside the newer one."""
    target, rows = root / f"CoreView_{subject}", []
    for frame in range(source.frames):
        row = []
        for camera in range(len(source.cams["K"])):
            stamp = f"2019-08-23_16-08-50.{592 + frame}"
            name = f"CoreView_{subject}_Camera_({camera + 1})_{frame + 1:04d}_{stamp}.jpg"
            row.append(f"Camera ({camera + 1})/{name}")
            _copy(source.folder / source.path(frame, camera), target / row[-1])
            save_picture(
                (target / "mask_cihp" / row[-1]).with_suffix(".png"), 13 * source.mask(frame, camera)
            )
            save_picture((target / "mask" / row[-1]).with_suffix(".png"), source.mask(frame, camera))
        rows.append({"ims": row})
        save_object(target / "new_params" / f"{frame + 1}.npy", source.parameters(frame))
    # the older fit beside it, which is not to be used
    save_object(target / "params" / "1.npy", dict(source.parameters(0), Th=np.full((1, 3), 9.0)))
    save_object(target / "annots.npy", {"cams": source.cams, "ims": rows})
    return target


def write_refined(source: Source, root: Path, subject: int = 377) -> Path:
    target, rows = root / f"my_{subject}", []
    for frame in range(source.frames):
        row = [f"images/{camera:02d}/{frame:06d}.jpg" for camera in range(len(source.cams["K"]))]
        for camera, name in enumerate(row):
            _copy(source.folder / source.path(frame, camera), target / name)
            mask = name.replace("images", "mask").replace("jpg", "png")
            save_picture(target / mask, source.mask(frame, camera) * np.uint8(255))
        rows.append({"ims": row})
        save_object(target / "smpl_params" / f"{frame}.npy", source.parameters(frame))
    save_object(target / "annots.npy", {"cams": source.cams, "ims": rows})
    return target


def write_humannerf(source: Source, target: Path, camera: int = 0) -> Path:
    cameras, meshes = {}, {}
    for frame in range(source.frames):
        name = f"frame_{frame:06d}"
        values = {key: value.reshape(-1) for key, value in source.parameters(frame).items()}
        _write_pair(source, target, frame, camera, name)
        cameras[name] = {
            "intrinsics": source.cams["K"][camera].astype(np.float32),
            "extrinsics": source.extrinsics(camera).astype(np.float32),
            "distortions": source.cams["D"][camera].reshape(-1).astype(np.float32),
        }
        meshes[name] = {
            "Rh": values["Rh"], "Th": values["Th"], "poses": values["poses"], "betas": values["shapes"],
            "joints": np.zeros((24, 3)), "tpose_joints": source.rest_joints(values["shapes"]),
        }  # fmt: skip
    save_pickle(target / "cameras.pkl", cameras)
    save_pickle(target / "mesh_infos.pkl", meshes)
    save_pickle(target / "canonical_joints.pkl", {"joints": np.zeros((24, 3)), "avg_betas": np.zeros(10)})
    return target


def write_humannerf_wild(source: Source, target: Path) -> Path:
    """Its form for other footage: rotation about the pelvis, the translation put into the camera."""
    write_humannerf(source, target)
    with (target / "cameras.pkl").open("rb") as stream:
        cameras = pickle.load(stream)
    with (target / "mesh_infos.pkl").open("rb") as stream:
        meshes = pickle.load(stream)
    for frame, name in enumerate(cameras):
        betas, orient, _, transl = source.smplx(frame)
        moved = np.eye(4)
        moved[:3, 3] = transl
        cameras[name]["extrinsics"] = source.extrinsics(0) @ moved
        pelvis = source.pelvis(betas)
        rest = source.rest_joints(betas) - pelvis
        meshes[name] |= {"Rh": orient, "Th": pelvis, "tpose_joints": rest}
    save_pickle(target / "cameras.pkl", cameras)
    save_pickle(target / "mesh_infos.pkl", meshes)
    return target


def write_w2a(source: Source, root: Path, name: str = "0013_02", camera: int = 0) -> Path:
    target, rows = root / f"{name}_w2a", {}
    for frame in range(source.frames):
        _write_pair(source, target, frame, camera, f"{frame:05d}")
        betas, orient, pose, transl = source.smplx(frame)
        rows[f"{frame:05d}.png"] = {
            "poses": [*orient.tolist(), *pose.tolist()],
            "betas": betas.tolist(),
            "trans": transl.tolist(),
            "cam_intrinsics": source.cams["K"][camera].tolist(),
            "cam_extrinsics": source.extrinsics(camera).tolist(),
        }
    (target / "metadata.json").write_text(json.dumps(rows))
    return target


def write_chomp(source: Source, root: Path, name: str = "0013_02", person: int = 1) -> Path:
    """Two sequences, of which the second is the scene; someone else is annotated in its first frame."""
    cameras = []
    for camera in range(len(source.cams["K"])):
        frames = []
        for frame in range(source.frames):
            path = f"images/{name}/Camera{camera:02d}/{frame:05d}.jpg"
            _copy(source.folder / source.path(frame, camera), root / path)
            mask = source.mask(frame, camera) * np.uint8(person)
            mask[:2, :2] = 7  # somebody else
            save_picture((root / "mask" / path).with_suffix(".png"), mask)
            betas, orient, pose, transl = source.smplx(frame)
            row = {
                "bbox": np.zeros((2, 2)), "lsp_joints_2d": np.zeros((14, 3)),
                "pose": np.concatenate([orient, pose]), "betas": betas, "trans": transl,
                "intri": source.cams["K"][camera], "extri": source.extrinsics(camera),
            }  # fmt: skip
            content = {"h_w": source.mask(frame, camera).shape, "img_path": path, str(person): row}
            if frame == 0:
                content["7"] = dict(row, trans=transl + 1)
            frames.append(content)
        cameras.append(frames)
    other = [[{"h_w": (96, 96), "img_path": "images/0001_01/Camera00/00000.jpg", "0": {}}]]
    save_pickle(root / "annot" / "train.pkl", [other, cameras])
    return root


def write_video(source: Source, target: Path, camera: int = 0) -> Path:
    rows = [source.smplx(frame) for frame in range(source.frames)]
    for frame in range(source.frames):
        _write_pair(
            source, target, frame, camera, f"image_{frame + 1:04d}", mask_name=f"mask_{frame + 1:04d}"
        )
    height, width = source.mask(0, camera).shape
    np.savez(
        target / "cameras.npz",
        intrinsic=source.cams["K"][camera] + HALF, extrinsic=source.extrinsics(camera), height=height, width=width,
    )  # fmt: skip
    betas, orient, pose, transl = (np.stack(part) for part in zip(*rows, strict=True))
    np.savez(target / "poses.npz", betas=betas[:1], global_orient=orient, body_pose=pose, transl=transl)
    return target


def _write_pair(source, target, frame, camera, name, mask_name=None) -> None:
    save_picture(target / "images" / f"{name}.png", source.picture(frame, camera))
    mask = np.repeat(source.mask(frame, camera)[..., None] * np.uint8(255), 3, axis=2)
    save_picture(target / "masks" / f"{mask_name or name}.png", mask)


def _copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(source, target)
