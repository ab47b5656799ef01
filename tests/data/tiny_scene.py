"""A hand-made scene of a few kilobytes in ZJU-MoCap's layout, and the body in it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import torch

PARENTS = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21]
# x, y (up), of each joint; z is 0
JOINTS = np.array(
    [
        *[(0.0, -0.2), (0.1, -0.3), (-0.1, -0.3), (0.0, -0.1), (0.1, -0.7), (-0.1, -0.7), (0.0, 0.05)],
        *[(0.1, -1.1), (-0.1, -1.1), (0.0, 0.1), (0.1, -1.15), (-0.1, -1.15), (0.0, 0.3), (0.08, 0.25)],
        *[(-0.08, 0.25), (0.0, 0.4), (0.18, 0.25), (-0.18, 0.25), (0.45, 0.25), (-0.45, 0.25)],
        *[(0.7, 0.25), (-0.7, 0.25), (0.78, 0.25), (-0.78, 0.25)],
    ]
)


class TinyBody:
    """Bones with points around them, each rigid to its joint; betas[0] stretches everything."""

    def __init__(self, points: int = 120) -> None:
        rng = np.random.default_rng(0)
        joints = np.column_stack([JOINTS, np.zeros(24)])
        vertices, owner = [], []
        for joint, parent in enumerate(PARENTS):
            start = joints[max(parent, 0)]
            along = start + rng.random((points, 1)) * (joints[joint] - start)
            around = rng.normal(size=(points, 3))
            around /= np.linalg.norm(around, axis=1, keepdims=True)
            vertices.append(along + 0.07 * around * rng.random((points, 1)) ** (1 / 3))
            owner += [max(parent, 0)] * points
        self.template = torch.tensor(np.concatenate(vertices))
        self.joints = torch.tensor(joints)
        self.owner = torch.tensor(owner)

    def __call__(self, betas, global_orient, body_pose, transl):
        stretch = 1.0 + 0.05 * betas[0].double()
        vertices, joints = self.template * stretch, self.joints * stretch
        turns = torch.cat([global_orient, body_pose]).double().reshape(24, 3)
        place = []
        for joint, parent in enumerate(PARENTS):
            R = torch.tensor(cv2.Rodrigues(turns[joint].numpy())[0])
            if parent < 0:
                place.append((R, joints[joint]))
            else:
                above, at = place[parent]
                place.append((above @ R, at + above @ (joints[joint] - joints[parent])))
        R = torch.stack([p[0] for p in place])
        t = torch.stack([p[1] for p in place])
        local = vertices - joints[self.owner]
        posed = torch.einsum("vij,vj->vi", R[self.owner], local) + t[self.owner]
        return (posed + transl.double()).float(), (t + transl.double()).float()


@dataclass
class TinyScene:
    """What was written, for tests to compare with."""

    root: Path
    name: str
    body: TinyBody
    K: np.ndarray
    R: list[np.ndarray]
    T: list[np.ndarray]
    parameters: list[dict[str, np.ndarray]]
    world: list[np.ndarray] = field(default_factory=list)

    @property
    def folder(self) -> Path:
        return self.root / self.name

    def picture(self, frame: int, camera: int = 0) -> Path:
        return self.folder / f"Camera_B{camera + 1}" / f"{frame:06d}.png"

    def mask(self, frame: int, camera: int = 0, folder: str = "mask") -> Path:
        return self.folder / folder / f"Camera_B{camera + 1}" / f"{frame:06d}.png"

    def annots(self) -> dict:
        return np.load(self.folder / "annots.npy", allow_pickle=True).item()

    def save_annots(self, content: object) -> None:
        np.save(self.folder / "annots.npy", content, allow_pickle=True)

    def save_parameters(self, frame: int, content: object, folder: str = "new_params") -> None:
        np.save(self.folder / folder / f"{frame}.npy", content, allow_pickle=True)


def write_tiny_scene(
    root: Path,
    name: str = "tiny",
    cameras: int = 3,
    frames: int = 6,
    size: int = 64,
    distortion: tuple[float, ...] = (0.0,) * 5,
    occluders: bool = False,
) -> TinyScene:
    """Writes the scene: cameras on a circle of 3 m, the person waving and turning."""
    rng = np.random.default_rng(1)
    body = TinyBody()
    K = np.array([[1.1 * size, 0, size / 2 + 0.3], [0, 1.1 * size, size / 2 - 0.4], [0, 0, 1]])
    R, T = [], []
    for camera in range(cameras):
        angle = 2 * np.pi * camera / cameras
        height = 0.25 if camera % 2 else -0.1
        away = np.array([np.sin(angle), height, np.cos(angle)])
        ahead = -away / np.linalg.norm(away)
        right = np.cross([0.0, -1.0, 0.0], ahead)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(ahead, right), ahead])
        R.append(rotation)
        T.append(-rotation @ (np.array([0.0, -0.35, 0.0]) - 3.0 * ahead))
    scene = TinyScene(root, name, body, K, R, T, [])
    D = np.array(distortion).reshape(-1, 1)
    names = [[f"Camera_B{c + 1}/{f:06d}.png" for c in range(cameras)] for f in range(frames)]
    scene.folder.mkdir(parents=True)
    (scene.folder / "new_params").mkdir()
    for frame in range(frames):
        poses = np.zeros((1, 72))
        poses[0, 3:] = 0.15 * rng.normal(size=69)
        values = {
            "poses": poses,
            "Rh": np.array([[0.1, 0.4 * frame, -0.05]]),
            "Th": np.array([[0.02 * frame, 0.03, -0.04]]),
            "shapes": np.full((1, 10), 0.3),
        }
        scene.parameters.append(values)
        scene.save_parameters(frame, values)
        upright, _ = body(
            torch.tensor(values["shapes"][0]), torch.zeros(3), torch.tensor(poses[0, 3:]), torch.zeros(3)
        )
        turn = cv2.Rodrigues(values["Rh"][0])[0]
        world = upright.double().numpy() @ turn.T + values["Th"][0]  # EasyMocap's rule, written out
        scene.world.append(world)
        for camera in range(cameras):
            _draw(scene, frame, camera, world, D, size, occluders)
    scene.save_annots(
        {
            "cams": {"K": [K] * cameras, "R": R, "T": [1000.0 * t[:, None] for t in T], "D": [D] * cameras},
            "ims": [{"ims": row} for row in names],
        }
    )
    return scene


def _draw(scene, frame, camera, world, D, size, occluders) -> None:
    cam = world @ scene.R[camera].T + scene.T[camera]
    pixels = cv2.projectPoints(cam, np.zeros(3), np.zeros(3), scene.K, D)[0].reshape(-1, 2)
    mask = np.zeros((size, size), np.uint8)
    for x, y in np.rint(pixels).astype(int):
        cv2.circle(mask, (int(x), int(y)), max(size // 64, 1), 1, -1)
    mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    rows, columns = np.mgrid[:size, :size]
    shade = np.stack([60 + columns * 150 // size, 200 - rows * 120 // size, 90 + 0 * rows], axis=2)
    image = np.where(mask[..., None] > 0, shade, 25).astype(np.uint8)
    folders = {"": image}
    masks = {"mask": mask}
    if occluders:
        pole = np.zeros_like(mask)
        pole[:, size // 2 - size // 16 : size // 2 + size // 16] = 1
        folders = {"": np.where(pole[..., None] > 0, np.uint8(230), image), "images_complete": image}
        masks = {"mask": mask * (1 - pole), "mask_complete": mask}
    for folder, picture in folders.items():
        _save(scene.folder / folder / scene.picture(frame, camera).relative_to(scene.folder), picture)
    for folder, content in masks.items():
        _save(scene.mask(frame, camera, folder), content)


def _save(path: Path, picture: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if picture.ndim == 3:
        picture = picture[..., ::-1]
    assert cv2.imwrite(str(path), picture)
