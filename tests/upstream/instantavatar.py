"""Folders as InstantAvatar's scripts leave them, written from an embedded scene.

tijiang13/InstantAvatar@82a6c09f, and `datasets/custom.py` of tijiang13/InstantAvatar@7c16309e. Read there:

* `scripts/peoplesnapshot/preprocess_PeopleSnapshot.py`: K and the view from `camera.pkl` in OpenCV's convention, as
  float64; `height` and `width` as Python ints; pictures `images/image_0000.png` of the video and masks
  `masks/mask_0000.npy`, uint8 of 0 and 1 from `masks.hdf5`, both through `cv2.undistort`; `poses.npz` of float32 with
  `betas` (10,), `thetas` N x 72, `transl` N x 3 from `reconstructed_poses.hdf5`.
* `instant_avatar/datasets/{peoplesnapshot,custom}.py`: rays of pixel (x, y) are `K^-1 (x, y, 1)` with whole numbers;
  pictures, masks and rows of the first estimate are taken `[start:end + 1:skip]`; rows of `poses/anim_nerf_{split}.npz`
  or `poses/{split}.npz` one after the other. PeopleSnapshot's falls back on `poses.npz`, the other on
  `poses_optimized.npz`.
* `scripts/custom/run-romp.py`, `refine-smpl.py`, `extract-largest-connected-components.py`: `poses.npz` of ROMP with
  `betas` (10,), `global_orient`, `body_pose`, `transl`; `cameras.npz` of 60 degrees across the longer side, the view
  the identity, sizes as Python ints; `poses_optimized.npz` under the same keys; masks 0 and 255 under the names of the
  pictures.
* `fit.py`: `poses/train.npz` with `betas` (1, 10), `global_orient`, `transl`, `body_pose`, float32.
* what else `process-sequence.sh` leaves: `keypoints.npy` N x 25 x 3, `masks_sam/`, `masked_images/`, `output.mp4`.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from data.layout_writers import Source, save_picture

FRESH = 0.15
"""How far the first estimate stands from the refined one, metres."""


def smplx_rows(source: Source) -> dict[str, np.ndarray]:
    rows = [source.smplx(frame) for frame in range(source.frames)]
    betas, orient, pose, transl = (np.stack(part).astype(np.float32) for part in zip(*rows, strict=True))
    return {"betas": betas[0], "global_orient": orient, "body_pose": pose, "transl": transl}


def first_estimate(source: Source) -> dict[str, np.ndarray]:
    """Poses as a regressor finds them: near the true ones, and not the same."""
    rows, rng = smplx_rows(source), np.random.default_rng(5)
    rows["body_pose"] = rows["body_pose"] + rng.normal(0, 0.03, rows["body_pose"].shape).astype(np.float32)
    rows["transl"] = rows["transl"] + np.float32([FRESH, 0, 0])
    return rows


def write_peoplesnapshot(
    source: Source, target: Path, *, exact: bool = True, extra_pictures: int = 0
) -> Path:
    """As `preprocess_PeopleSnapshot.py`; `exact`: the first estimate is the truth."""
    K, k = source.cams["K"][0], np.zeros(5)
    height, width = source.mask(0).shape
    (target / "masks").mkdir(parents=True)
    np.savez(
        str(target / "cameras.npz"),
        intrinsic=K,
        extrinsic=source.extrinsics(0),
        height=int(height),
        width=int(width),
    )
    for frame in range(source.frames + extra_pictures):
        picture = cv2.undistort(source.picture(min(frame, source.frames - 1)), K, k)
        save_picture(target / "images" / f"image_{frame:04d}.png", picture)
    for frame in range(source.frames):
        mask = cv2.undistort(source.mask(frame).astype(np.uint8), K, k)
        np.save(target / "masks" / f"mask_{frame:04d}.npy", mask)
    rows = smplx_rows(source) if exact else first_estimate(source)
    np.savez(
        str(target / "poses.npz"),
        betas=rows["betas"],
        thetas=np.concatenate([rows["global_orient"], rows["body_pose"]], axis=1),
        transl=rows["transl"],
    )
    return target


def write_track(source: Source, target: Path, name: str, start: int, end: int, skip: int) -> None:
    """A refined track, `end` being the last picture that may be in it."""
    rows = smplx_rows(source)
    path = target / "poses" / f"{name}.npz"
    path.parent.mkdir(exist_ok=True)
    kept = {key: rows[key][start : end + 1 : skip] for key in ("global_orient", "transl", "body_pose")}
    np.savez(str(path), betas=rows["betas"][None], **kept)


def write_neuman(source: Source, target: Path, *, optimized: bool = True, camera: dict | None = None) -> Path:
    """As `process-sequence.sh` leaves a folder of NeuMan's pictures."""
    height, width = source.mask(0).shape
    for frame in range(source.frames):
        name = f"{frame:05d}.png"
        mask = source.mask(frame) * np.uint8(255)
        save_picture(target / "images" / name, source.picture(frame))
        save_picture(target / "masks_sam" / name, 255 - mask)  # not what is trained on
        save_picture(target / "masks" / name, mask)
        save_picture(target / "masked_images" / name, source.picture(frame))
    np.save(target / "keypoints.npy", np.zeros((source.frames, 25, 3)))
    np.savez(target / "poses.npz", **first_estimate(source))
    if optimized:
        np.savez(str(target / "poses_optimized.npz"), **smplx_rows(source))
    given = {
        "intrinsic": source.cams["K"][0],
        "extrinsic": source.extrinsics(0),
        "height": height,
        "width": width,
    }
    np.savez(target / "cameras.npz", **(camera or given))
    (target / "output.mp4").write_bytes(b"\0\0\0\x18ftypmp42")
    return target


def romp_camera(width: int, height: int) -> dict[str, object]:
    focal = max(height, width) / 2 * 1 / np.tan(np.radians(60 / 2))
    K = np.eye(3)
    K[0, 0] = K[1, 1] = focal
    K[0, 2], K[1, 2] = width / 2, height / 2
    return {"intrinsic": K, "extrinsic": np.eye(4), "height": height, "width": width}
