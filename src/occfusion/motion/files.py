"""Clips in files: AMASS, AIST++, smplx's names and our own `.npz`; and those that come with the package."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from occfusion.data.video.pose_table import read_motion
from occfusion.errors import ConfigError, DataError
from occfusion.fields import nearest
from occfusion.files.arrays import load_npz
from occfusion.files.atomic import write_bytes
from occfusion.motion.clip import Clip
from occfusion.synth.fullbody import asset_arrays
from occfusion.synth.motion import CLIP_RATE, MOVE_SECONDS
from occfusion.synth.moves import HELD_OUT_MOVES, TRAINING_MOVES

_WANTED = (
    "A motion is a file of AMASS (SMPL-H or SMPL-X) or AIST++, or a .npz with global_orient (N, 3), body_pose (N, 69) "
    "and transl (N, 3) of SMPL's skeleton, all finite; those of other skeletons have to be turned into it first"
)

_RECORDED = ("cmu_01_01", "cmu_01_03")
_MOVES = {move.__name__: move for move in (*TRAINING_MOVES, *HELD_OUT_MOVES)}

EMBEDDED_CLIPS = (*_MOVES, *_RECORDED)
"""Names of the clips that come with the package: six movements set by hand and two recordings."""


def read_clip(path: Path, fps: float | None = None) -> Clip:
    """Returns the motion of a file in any form that `pose_table` knows, or as `write_clip` wrote it.

    Args:
        path: the file.
        fps: frames a second; None: as the file says.

    Raises:
        DataError: missing, damaged, of no known form, with NaN, or of a body with other joints.
    """
    try:
        motion = read_motion(path)
    except DataError as error:
        raise DataError(f"{str(error).rstrip('.')}. {_WANTED}") from error
    own = fps if fps is not None else motion.fps
    up = motion.up
    if path.suffix.lower() == ".npz":
        said = load_npz(path, ("fps", "up"))
        if own is None and "fps" in said and np.size(said["fps"]) == 1:
            own = float(said["fps"])
        if "up" in said and str(said["up"]) in ("x", "y", "z", "-x", "-y", "-z"):
            up = str(said["up"])
    if own is not None and not (np.isfinite(own) and own > 0):
        raise DataError(f"{path}: {own:g} frames a second; give a positive number with --motion-fps")
    if up is None:
        raise DataError(
            f"{path}: no axis is up on average, and the file does not say which is; whoever lies all the time cannot "
            "be put on a floor. Add an array `up`, such as 'z'"
        )
    return Clip(path.stem, motion.global_orient, motion.body_pose, motion.transl, own, up)


def write_clip(path: Path, clip: Clip) -> None:
    """Writes a clip as `.npz` with smplx's names, and `fps`, `up`, `frames` beside them.

    Raises:
        DataError: the disk refuses.
    """
    arrays = {
        "global_orient": clip.global_orient,
        "body_pose": clip.body_pose,
        "transl": clip.transl,
        "up": np.array(clip.up),
    }
    if clip.betas is not None:
        arrays["betas"] = clip.betas
    if clip.fps is not None:
        arrays["fps"] = np.array(clip.fps)
    if clip.numbers is not None:
        arrays["frames"] = clip.numbers
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)  # type: ignore[arg-type]
    write_bytes(path, content.getvalue())


def read_sequence(path: Path, name: str) -> Clip:
    """Returns the clip of a run's own sequence, with the numbers of its frames.

    Raises:
        DataError: missing, damaged, or written by somebody else.
    """
    clip, said = read_clip(path), load_npz(path, ("frames", "betas"))
    if "frames" not in said or len(said["frames"]) != len(clip) or "betas" not in said:
        raise DataError(f"{path}: does not say which frames it has; it is not the motion of a run")
    betas, numbers = said["betas"].astype(np.float64).reshape(-1), said["frames"].astype(np.float64)
    return Clip(name, clip.global_orient, clip.body_pose, clip.transl, clip.fps, clip.up, betas, numbers)


def embedded_clip(name: str) -> Clip:
    """Returns an embedded clip, y up, 30 frames a second; whoever stands faces +z.

    Raises:
        ConfigError: there is none of that name.
    """
    if name in _MOVES:
        count = round(MOVE_SECONDS * CLIP_RATE)
        poses = _MOVES[name](np.linspace(0.0, 1.0, count), np.random.default_rng(0)).reshape(count, 72)
        transl = np.zeros((count, 3))
    elif name in _RECORDED:
        arrays = asset_arrays("motions_cmu.npz")
        # the first frame of a recording is the T-pose it was calibrated in
        poses = arrays[f"{name}_pose"][1:].astype(np.float64)
        transl = arrays[f"{name}_trans"][1:].astype(np.float64)
    else:
        raise ConfigError(f"motion {name}: no embedded clip of that name; {nearest(name, EMBEDDED_CLIPS)}")
    return Clip(name, poses[:, :3], poses[:, 3:], transl, CLIP_RATE, "y")
