"""Motions as three sources write them.

* tijiang13/InstantAvatar@82a6c09f, `animate.py`: reads `poses` (the first 72 numbers) and `trans` of
  `data/animation/aist_demo.npz`; the person stands before a camera at the origin with OpenCV's axes, so that up is -y.
  The avatar's own betas are used.
* google/aistplusplus_api@3b5b8f91, `aist_plusplus/loader.py` and `processing/run_estimate_smpl.py` (@0432ed57): a
  pickle of `smpl_poses` N x 72 (the loader's comment says N x 24 x 3), `smpl_scaling` (1,), `smpl_trans` N x 3, all
  float32, and `smpl_loss`, a Python float; `pickle.HIGHEST_PROTOCOL`; `demos/run_vis.py`: vertices are
  `smpl_scaling * M(poses) + smpl_trans` in the units of its cameras, 60 frames a second, y up. No betas: the mean man.
* AMASS, as nghorbani/amass and its users load it: `trans` N x 3, `gender` a 0-d array of text (bytes in files that
  Python 2 wrote), `mocap_framerate` 0-d float64, `betas` (16,), `dmpls` N x 8, `poses` N x 156; z up. Its SMPL-X
  release `*_stageii.npz`: `gender`, `surface_model_type`, `mocap_frame_rate`, `mocap_time_length`, `markers_latent`,
  `latent_labels`, `markers_latent_vids` (a dict, pickled), `trans`, `poses` N x 165, `betas` (16,), `num_betas`,
  `root_orient`, `pose_body`, `pose_hand`, `pose_jaw`, `pose_eye`.
"""

from __future__ import annotations

import pickle  # what is read here was written by the same test
from pathlib import Path

import numpy as np

HANDS, FACE = 90, 9


def write_aist_demo(path: Path, orient: np.ndarray, pose: np.ndarray, transl: np.ndarray) -> Path:
    np.savez(path, poses=np.concatenate([orient, pose], axis=1), trans=transl - transl[:1])
    return path


def write_aistplusplus(
    path: Path,
    orient: np.ndarray,
    pose: np.ndarray,
    transl: np.ndarray,
    scaling: float = 93.78,
    protocol: int = 4,
) -> Path:
    """Translations in metres of a body of SMPL's size become `smpl_trans` in centimetres of the dancer."""
    content = {
        "smpl_poses": np.concatenate([orient, pose], axis=1).astype(np.float32),
        "smpl_scaling": np.array([scaling], dtype=np.float32),
        "smpl_trans": (np.float32(scaling) * transl).astype(np.float32),
        "smpl_loss": 1.25,
    }
    path.write_bytes(pickle.dumps(content, protocol=protocol))
    return path


def write_amass(
    path: Path,
    orient: np.ndarray,
    pose: np.ndarray,
    transl: np.ndarray,
    betas: np.ndarray,
    gender: np.ndarray,
) -> Path:
    frames, rng = len(orient), np.random.default_rng(1)
    hands = rng.normal(0, 0.2, (frames, HANDS))
    np.savez(
        path, trans=transl.astype(np.float64), gender=gender, mocap_framerate=np.array(120.0), betas=betas,
        dmpls=rng.normal(size=(frames, 8)),
        poses=np.concatenate([orient, pose[:, :63], hands], axis=1).astype(np.float64),
    )  # fmt: skip
    return path


def write_amass_smplx(
    path: Path, orient: np.ndarray, pose: np.ndarray, transl: np.ndarray, betas: np.ndarray
) -> Path:
    frames, rng = len(orient), np.random.default_rng(1)
    face, hands = rng.normal(0, 0.2, (frames, FACE)), rng.normal(0, 0.2, (frames, HANDS))
    np.savez(
        path, gender=np.array("neutral"), surface_model_type=np.array("smplx"), mocap_frame_rate=np.array(120.0),
        mocap_time_length=np.array(frames / 120), markers_latent=rng.normal(size=(67, 3)),
        latent_labels=np.array(["ARIEL", "C7"]), markers_latent_vids=np.array({"ARIEL": 3}, dtype=object),
        trans=transl.astype(np.float64), betas=betas, num_betas=np.array(16), root_orient=orient,
        pose_body=pose[:, :63],
        poses=np.concatenate([orient, pose[:, :63], face, hands], axis=1).astype(np.float64), pose_hand=hands,
        pose_jaw=face[:, :3], pose_eye=face[:, 3:],
    )  # fmt: skip
    return path
