"""OcMotion as released, and as Wild2Avatar cut it, written from an embedded scene.

Read, and where (nothing is copied):

- boycehbz/CHOMP@5da9f5b7 `vis_OcMotion.py`: `annot/train.pkl` and `annot/test.pkl`, read with `encoding='latin1'`;
  lists of sequences, of cameras, of frames; `h_w` is height, width; `img_path` is joined to the data set's folder; all
  other keys are people and go through `int(key)`; `bbox` reshaped from 2 x 2, `lsp_joints_2d` sliced to two columns,
  `pose`, `betas`, `trans` through `np.array(...).reshape`, so that lists and rows of one do; `extri[:3, :3]`,
  `extri[:3, 3]`, `intri`. `render_multiperson` gives the picture alone where nobody is in it. `utils/module_utils.py`:
  limbs between the 14 points, counted from 0, in LSP's order. `utils/smpl_torch_batch.py`: `LBS + trans`.
- boycehbz/GroupRec@c6f8258c `datasets/relation_feature_data.py`, by the same authors: the same rows in lists of frames
  without a level of cameras; empty lists are passed over. `utils/FileLoaders.py`: pickles of protocol 2.
- geminiXiao/temp@07867a5f `README.md`, a reader's notes on such annotations: `images/0000/Camera00/000000.jpg`, `h_w`
  (1536, 2048), `mask_path`, `smpl_joints_3d` and more beside the keys above.
- tiangexiang/OccFusion@94f3aba7 `scene/dataset_readers.py` (readCamerasOcMotion): pictures in `images/` in sorted order
  decide, every second one; `metadata.json` by the name without suffix; the mask has the picture's very name, channel 0,
  `!= 0`; the root's rotation is `Rh` of `mesh_infos.pkl`; `SMPL(poses, betas) + trans`; K and picture halved, sides cut
  to whole numbers. `stage0_oc.py`: the same with `poses[:3]`.
- tiangexiang/OccNeRF@8c4223a6 `tools/prepare_wild/prepare_dataset.py`, `prepare_all_cameras.py`: `cameras.pkl`,
  `mesh_infos.pkl`, `canonical_joints.pkl` of every row of `metadata.json`, whether it has a picture or not; float32
  from the table, joints float64; `trans` put into the extrinsics; `all_cameras.pkl`, `all_mesh_infos.pkl` of six
  `metadata_{0..5}.json`.
- tiangexiang/Wild2Avatar@daefb62a `README.md`: six sequences of 100 frames. A picture's number is that of the whole
  sequence: OccFusion's `stage3.py` names 00355 as one's last.
"""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from data.layout_writers import Source, save_picture

PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)

LSP = (8, 5, 2, 1, 4, 7, 21, 19, 17, 16, 18, 20, 12, 15)
"""SMPL's joints nearest to LSP's 14 points: right and left leg from the ankle up, arms from the wrist, neck, head."""


class UpstreamSmpl:
    """The body file, and SMPL as upstream computes it, in float64, with pose blend shapes.

    Args:
        source: gives all but the pose blend shapes, which are made up.
        path: the body file to write.
    """

    def __init__(self, source: Source, path: Path) -> None:
        self.path = path
        self.values = dict(np.load(source.folder / "body.npz"))
        bent = np.random.default_rng(3).normal(size=(len(self.values["v_template"]), 3, 207))
        self.values["posedirs"] = (0.002 * bent).astype(np.float32)
        np.savez(path, **self.values)

    def __call__(self, poses: Any, betas: Any) -> tuple[np.ndarray, np.ndarray]:
        """Returns vertices and joints, metres, the root turned about its own place."""
        values, betas = self.values, np.asarray(betas, float).reshape(-1)
        turns = [cv2.Rodrigues(v)[0] for v in np.asarray(poses, float).reshape(24, 3)]
        shaped = values["v_template"] + values["shapedirs"][..., : len(betas)] @ betas
        rest = values["J_regressor"] @ shaped
        shaped = shaped + values["posedirs"] @ (np.stack(turns[1:]) - np.eye(3)).reshape(-1)
        places: list[np.ndarray] = []
        for joint, parent in enumerate(PARENTS):
            own = np.eye(4)
            own[:3, :3] = turns[joint]
            own[:3, 3] = rest[joint] - (rest[parent] if parent >= 0 else 0)
            places.append(places[parent] @ own if parent >= 0 else own)
        world = np.stack(places)
        joints = world[:, :3, 3].copy()
        world[:, :3, 3] -= np.einsum("jab,jb->ja", world[:, :3, :3], rest)
        each = np.einsum("vj,jab->vab", values["weights"], world)
        return np.einsum("vab,vb->va", each[:, :3, :3], shaped) + each[:, :3, 3], joints


def project(points: np.ndarray, K: np.ndarray, view: np.ndarray) -> np.ndarray:
    """Upstream's pixels: `K (R x + T)`, divided by the depth."""
    seen = (points @ view[:3, :3].T + view[:3, 3]) @ np.asarray(K).T
    return seen[:, :2] / seen[:, 2:]


def dump(path: Path, content: object, protocol: int = 4) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as stream:
        pickle.dump(content, stream, protocol=protocol)


# --- Wild2Avatar's cut -------------------------------------------------------------------------------


def metadata_row(source: Source, frame: int, camera: int = 0) -> dict[str, list]:
    betas, orient, pose, transl = source.smplx(frame)
    return {
        "poses": [*orient.tolist(), *pose.tolist()],
        "betas": betas.tolist(),
        "trans": transl.tolist(),
        "cam_intrinsics": np.asarray(source.cams["K"][camera]).tolist(),
        "cam_extrinsics": source.extrinsics(camera).tolist(),
    }


def write_cut(
    source: Source, smpl: UpstreamSmpl, root: Path, name: str = "0013_02", first: int = 256, spare: int = 3
) -> Path:
    """As it is published: pictures from number `first` on; `spare` rows of the sequence before and after them."""
    target = root / f"{name}_w2a"
    rows = {}
    for number in range(first - spare, first + source.frames + spare):
        frame = min(max(number - first, 0), source.frames - 1)
        rows[f"{number:05d}"] = metadata_row(source, frame)
        if 0 <= number - first < source.frames:
            save_picture(target / "images" / f"{number:05d}.png", source.picture(frame))
            mask = np.repeat(source.mask(frame)[..., None] * np.uint8(255), 3, axis=2)
            save_picture(target / "masks" / f"{number:05d}.png", mask)
    (target / "metadata.json").write_text(json.dumps(rows))
    for camera in range(6):
        (target / f"metadata_{camera}.json").write_text(json.dumps(rows))
    prepare(target, smpl)
    return target


def prepare(target: Path, smpl: UpstreamSmpl) -> None:
    """What OccNeRF's preparation makes of `metadata.json`."""
    rows = json.loads((target / "metadata.json").read_text())
    cameras, meshes, everything, every_mesh, shapes = {}, {}, {}, {}, []
    for name, row in rows.items():
        table = {key: np.array(value, dtype=np.float32) for key, value in row.items()}
        poses, betas = table["poses"], table["betas"]
        rest, Rh = smpl(np.zeros(72), betas)[1], poses[:3].copy()
        upright = poses.copy()
        upright[:3] = 0
        meshes[name] = {
            "Rh": Rh, "Th": rest[0].copy(), "poses": upright, "betas": betas,
            "joints": smpl(upright, betas)[1] - rest[0], "tpose_joints": rest - rest[0],
        }  # fmt: skip
        moved = np.zeros((4, 4))
        moved[:3, :3], moved[3, 3], moved[:3, 3] = np.eye(3), 1.0, table["trans"]
        cameras[name] = {
            "intrinsics": table["cam_intrinsics"],
            "extrinsics": table["cam_extrinsics"] @ moved,
        }
        everything[name] = {key: np.stack([value] * 6) for key, value in cameras[name].items()}
        every_mesh[name] = {key: np.stack([value] * 6) for key, value in meshes[name].items()}
        shapes.append(betas)
    mean = np.mean(np.stack(shapes), axis=0)
    dump(target / "cameras.pkl", cameras)
    dump(target / "mesh_infos.pkl", meshes)
    dump(target / "canonical_joints.pkl", {"joints": smpl(np.zeros(72), mean)[1], "avg_betas": mean})
    dump(target / "all_cameras.pkl", everything)
    dump(target / "all_mesh_infos.pkl", every_mesh)


def occfusion_vertices(
    folder: Path, smpl: UpstreamSmpl, name: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices in the world, K at half size and the view, as `readCamerasOcMotion` has them."""
    row = json.loads((folder / "metadata.json").read_text())[name]
    meshes = pickle.loads((folder / "mesh_infos.pkl").read_bytes())
    poses = np.array(row["poses"])
    poses[:3] = meshes[name]["Rh"]
    K = np.array(row["cam_intrinsics"])
    K[:2] *= 0.5
    return smpl(poses, row["betas"])[0] + np.array(row["trans"]), K, np.array(row["cam_extrinsics"])


def occfusion_mask(folder: Path, name: str) -> np.ndarray:
    return cv2.imread(str(folder / "masks" / f"{name}.png"))[..., ::-1][:, :, 0] != 0


# --- as released -------------------------------------------------------------------------------------


def person(
    source: Source, smpl: UpstreamSmpl, frame: int, camera: int, *, as_rows: bool = False
) -> dict[str, Any]:
    """One annotated person; `as_rows`: arrays with a leading one, and lists."""
    betas, orient, pose, transl = source.smplx(frame)
    K, view = np.asarray(source.cams["K"][camera]), source.extrinsics(camera)
    poses = np.concatenate([orient, pose]).astype(np.float32)
    joints = smpl(poses, betas)[1] + transl
    points = project(joints[list(LSP)], K, view)
    low, high = points.min(axis=0), points.max(axis=0)
    row = {
        "bbox": np.stack([low, high]).astype(np.float32),
        "lsp_joints_2d": np.column_stack([points, np.ones(14)]).astype(np.float32),
        "pose": poses, "betas": betas.astype(np.float32), "trans": transl.astype(np.float32),
        "intri": K.astype(np.float32), "extri": view.astype(np.float32),
    }  # fmt: skip
    if as_rows:
        row |= {key: row[key].reshape(1, -1) for key in ("pose", "betas", "trans")}
        row |= {key: row[key].tolist() for key in ("bbox", "intri", "extri")}
        row |= {"mask_path": "mask/0013/Camera02/000000.png", "smpl_joints_3d": joints.astype(np.float32)}
    return row


def raw_frames(
    source: Source,
    smpl: UpstreamSmpl,
    root: Path,
    camera: int,
    sequence: str = "0013",
    key: Any = "0",
    separator: str = "/",
    *,
    as_rows: bool = False,
    masks: str | None = "mask",
) -> list[dict[Any, Any]]:
    """The rows of one camera, its pictures written."""
    frames = []
    for frame in range(source.frames):
        path = Path("images") / sequence / f"Camera{camera:02d}" / f"{frame:06d}.jpg"
        save_picture(root / path, source.picture(frame, camera))
        if masks is not None:
            save_picture(
                (root / masks / path).with_suffix(".png"), source.mask(frame, camera) * np.uint8(255)
            )
        height, width = source.mask(frame, camera).shape
        row = person(source, smpl, frame, camera, as_rows=as_rows)
        frames.append({"h_w": (int(height), int(width)), "img_path": separator.join(path.parts), key: row})
    return frames


def write_raw(
    source: Source, smpl: UpstreamSmpl, root: Path, *, cameras: int = 3, flat: bool = False, **form
) -> Path:
    """`annot/train.pkl` with sequence 0013 behind an empty list and another sequence; pickle protocol 2."""
    own = [raw_frames(source, smpl, root, camera, **form) for camera in range(cameras)]
    separator = form.get("separator", "/")
    path = separator.join(("images", "0001", "Camera00", "000000.jpg"))
    stranger = [{"h_w": (9, 9), "img_path": path}]
    content = [[], stranger, *own] if flat else [[], [stranger], own]
    dump(root / "annot" / "train.pkl", content, protocol=2)
    return root


def change_raw(root: Path, change) -> None:
    """Rewrites the annotations after `change` has worked on the cameras of 0013."""
    content = pickle.loads((root / "annot" / "train.pkl").read_bytes())
    change(content[2])
    dump(root / "annot" / "train.pkl", content, protocol=2)
