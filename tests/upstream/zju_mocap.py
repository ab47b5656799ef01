"""ZJU-MoCap's folders as their makers and readers have them, written from an embedded scene.

What was read, and where (nothing is copied):

- zju3dv/neuralbody@05a0628a `lib/datasets/light_stage/multi_view_dataset.py` and @3f9c2ca6 `can_smpl.py`: the tree,
  `annots.npy`, masks `!= 0`, the fifth word of 313's and 315's names, which counts from 1;
  @71c84519 `zju_smpl/extract_vertices.py` and @e654b304 `zju_smpl/smplmodel/{body_model,lbs}.py`: `params` were fitted
  without pose blend shapes, folders with `new` in their name with them; vertices are `R(Rh) M(poses, shapes) + Th`.
- taconite/arah-release@e591e31b `preprocess_datasets/preprocess_ZJU-MoCap.py`: `new_params/{i}` for 313 and 315 too;
  of these two, `cams` holds Python lists, of the others arrays; moments without a body file occur.
- skhu101/GauHuman@72ea9381 `scene/dataset_readers.py`: the refined tree, `mask` `!= 0`, `smpl_vertices`.
- The reader that zju3dv/instant-nvr@d72d66f2 `configs/inb/inb_377.yaml` names (`tpose_dataset`): `schp` holds the
  labels of a parser, painted; black is nobody. The palette is that of PASCAL VOC, as PeikeLi's
  Self-Correction-Human-Parsing writes it: the label's bits, three by three, from the top of red, green and blue.
"""

from __future__ import annotations

import shutil
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np

from data.layout_writers import Source, save_object, save_picture

PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)


class SmplBody:
    """A body file with pose blend shapes, and its vertices by the rule of `zju_smpl`, in float64.

    Args:
        source: gives everything but the pose blend shapes, which are made up: some millimetres at bent joints.
        path: the file to write, SMPL's keys.
    """

    def __init__(self, source: Source, path: Path) -> None:
        self.path = path
        self.values = dict(np.load(source.folder / "body.npz"))
        directions = np.random.default_rng(3).normal(size=(len(self.values["v_template"]), 3, 207))
        self.values["posedirs"] = (0.002 * directions).astype(np.float32)
        np.savez(path, **self.values)

    def vertices(self, params: dict, *, new_params: bool) -> np.ndarray:
        """Returns `[6890, 3]`, world, metres; pose blend shapes are added for a newer fit alone."""
        values = self.values
        rotations = [cv2.Rodrigues(v)[0] for v in np.asarray(params["poses"], float).reshape(24, 3)]
        shaped = values["v_template"] + values["shapedirs"] @ np.asarray(params["shapes"], float).reshape(-1)
        joints = values["J_regressor"] @ shaped
        if new_params:
            feature = np.stack(rotations[1:]) - np.eye(3)
            shaped = shaped + values["posedirs"] @ feature.reshape(-1)
        chain = []
        for joint, parent in enumerate(PARENTS):
            own = np.eye(4)
            own[:3, :3] = rotations[joint]
            own[:3, 3] = joints[joint] - (joints[parent] if joint else 0)
            chain.append(own if joint == 0 else chain[parent] @ own)
        moved = np.stack(chain)
        moved[:, :3, 3] -= np.einsum("jab,jb->ja", moved[:, :3, :3], joints)
        blended = np.einsum("vj,jab->vab", values["weights"], moved)
        posed = np.einsum("vab,vb->va", blended[:, :3, :3], shaped) + blended[:, :3, 3]
        turn = cv2.Rodrigues(np.asarray(params["Rh"], float).reshape(3))[0]
        return posed @ turn.T + np.asarray(params["Th"], float).reshape(3)


def older(params: dict) -> dict:
    """Returns another fit of the same moment: a little off, as an older program gave it."""
    bend = 0.05 * np.random.default_rng(1).normal(size=69)
    poses = np.array(params["poses"], np.float32)
    poses[0, 3:] += bend
    return {**params, "poses": poses, "Th": np.asarray(params["Th"], np.float32) + np.float32(0.01)}


def as_stored(params: dict) -> dict:
    """Returns a fit in the types of the release: float32, a row each."""
    return {key: np.asarray(value, np.float32).reshape(1, -1) for key, value in params.items()}


def write_fits(source: Source, target: Path, body: SmplBody, first: int, folders: tuple[str, ...]) -> None:
    for frame in range(source.frames):
        params = as_stored(source.parameters(frame))
        for name in folders:
            kept = older(params) if name == "params" else params
            save_object(target / name / f"{frame + first}.npy", kept)
            vertices = body.vertices(kept, new_params=name != "params").astype(np.float32)
            beside = target / {"smpl_params": "smpl_vertices"}.get(name, name.replace("params", "vertices"))
            beside.mkdir(exist_ok=True)
            np.save(beside / f"{frame + first}.npy", vertices)


def cameras_of(source: Source, *, lists: bool) -> dict:
    """`K` and `R` 3 x 3, `T` 3 x 1 in millimetres, `D` 5 x 1: arrays, or lists as in 313 and 315."""
    shapes = {"K": (3, 3), "R": (3, 3), "T": (3, 1), "D": (5, 1)}
    arrays = {
        key: [np.asarray(v, np.float64).reshape(shape) for v in source.cams[key]]
        for key, shape in shapes.items()
    }
    return {key: [v.tolist() for v in values] if lists else values for key, values in arrays.items()}


def parser_labels(mask: np.ndarray) -> np.ndarray:
    """Labels from 1 to 19 in stripes over the person, 0 elsewhere."""
    return (mask * (np.arange(mask.shape[0])[:, None] % 19 + 1)).astype(np.uint8)


def frayed(mask: np.ndarray, side: str) -> np.ndarray:
    """A segmentation that misses one half of the person: the union of both halves is whole."""
    columns = np.flatnonzero(mask.any(axis=0))
    middle, kept = int(columns.mean()), mask.copy()
    kept[:, middle + 2 :] *= side == "right"
    kept[:, : middle - 2] *= side == "left"
    return kept


def write_original(source: Source, root: Path, body: SmplBody, subject: int = 377) -> Path:
    """`CoreView_377`: both fits, both masks, and what else lies in the release."""
    target, rows = root / f"CoreView_{subject}", []
    for frame in range(source.frames):
        row = [f"Camera_B{camera + 1}/{frame:06d}.jpg" for camera in range(len(source.cams["K"]))]
        for camera, name in enumerate(row):
            _picture(source, target / name, frame, camera)
            mask = source.mask(frame, camera)
            save_picture((target / "mask" / name).with_suffix(".png"), frayed(mask, "left"))
            labels = parser_labels(frayed(mask, "right"))
            save_picture((target / "mask_cihp" / name).with_suffix(".png"), labels)
        rows.append({"ims": row, "kpts2d": np.zeros((len(row), 25, 3))})
    write_fits(source, target, body, 0, ("new_params", "params"))
    save_object(target / "annots.npy", {"cams": cameras_of(source, lists=False), "ims": rows})
    for stray in ("intri.yml", "extri.yml", "annots_old.npy"):
        (target / stray).write_bytes(b"%YAML:1.0\n")
    (target / "lbs" / "bweights").mkdir(parents=True)
    np.save(target / "lbs" / "joints.npy", np.zeros((24, 3), np.float32))
    return target


def write_stamped(
    source: Source,
    root: Path,
    body: SmplBody,
    subject: int = 313,
    folders: tuple[str, ...] = ("new_params", "params"),
) -> Path:
    """`CoreView_313`: cameras in lists, stamped names, numbers from 1, one picture more than bodies."""
    target, rows = root / f"CoreView_{subject}", []
    for frame in range(source.frames + 1):
        row = []
        for camera in range(len(source.cams["K"])):
            stamp = f"2019-08-23_16-08-50.{592 + frame}"
            name = f"CoreView_{subject}_Camera_({camera + 1})_{frame + 1:04d}_{stamp}.jpg"
            row.append(f"Camera ({camera + 1})/{name}")
            shown = min(frame, source.frames - 1)
            _picture(source, target / row[-1], shown, camera)
            mask = source.mask(shown, camera)
            save_picture(target / "mask" / f"{row[-1][:-4]}.png", mask)
            save_picture(target / "mask_cihp" / f"{row[-1][:-4]}.png", parser_labels(mask))
        rows.append({"ims": row})
    write_fits(source, target, body, 1, folders)
    save_object(target / "annots.npy", {"cams": cameras_of(source, lists=True), "ims": rows})
    return target


def write_refined(source: Source, root: Path, body: SmplBody, subject: int = 377) -> Path:
    """`my_377`: soft masks, painted labels in a palette (even cameras) or in colours (odd ones)."""
    target, rows = root / f"my_{subject}", []
    for frame in range(source.frames):
        row = [f"images/{camera:02d}/{frame:06d}.jpg" for camera in range(len(source.cams["K"]))]
        for camera, name in enumerate(row):
            _picture(source, target / name, frame, camera)
            mask = source.mask(frame, camera)
            save_picture(target / name.replace("images", "mask").replace("jpg", "png"), softened(mask))
            painted = target / name.replace("images", "schp").replace("jpg", "png")
            if camera % 2 == 0:
                painted.parent.mkdir(parents=True, exist_ok=True)
                painted.write_bytes(palette_png(parser_labels(mask)))
            else:
                save_picture(painted, voc_palette()[parser_labels(mask)][..., ::-1])
        rows.append({"ims": row})
    write_fits(source, target, body, 0, ("smpl_params",))
    (target / "smpl_lbs").mkdir()
    np.save(target / "smpl_lbs" / "parents.npy", np.array([4294967295, *PARENTS[1:]], np.int64))
    np.save(target / "bigpose_uv.npy", np.zeros((2, 2, 2, 2), np.float32))
    save_object(target / "annots.npy", {"cams": cameras_of(source, lists=False), "ims": rows})
    return target


def softened(mask: np.ndarray) -> np.ndarray:
    """0 and 255 with soft edges of two pixels: values from 28 up, all of which are the person upstream."""
    return cv2.blur(mask * np.uint8(255), (3, 3))


def voc_palette(labels: int = 20) -> np.ndarray:
    """Returns the colours of `labels` labels, uint8 `[labels, 3]`, red first."""
    colours = np.zeros((labels, 3), np.uint8)
    for label in range(labels):
        for bit in range(8):
            colours[label, bit % 3] |= ((label >> bit) & 1) << (7 - bit // 3)
    return colours


def palette_png(places: np.ndarray) -> bytes:
    """Returns a PNG of the places in the palette, 8 bits each."""
    height, width = places.shape

    def chunk(kind: bytes, content: bytes) -> bytes:
        return (
            struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        )

    lines = b"".join(b"\0" + row.tobytes() for row in np.ascontiguousarray(places, np.uint8))
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0))
        + chunk(b"PLTE", voc_palette().tobytes())
        + chunk(b"IDAT", zlib.compress(lines))
        + chunk(b"IEND", b"")
    )


def _picture(source: Source, target: Path, frame: int, camera: int) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    original = source.folder / source.path(frame, camera)
    if original.suffix == target.suffix:
        shutil.copy(original, target)
    else:
        save_picture(target, source.picture(frame, camera))
