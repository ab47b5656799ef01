"""Body poses of a whole video in one `.npz`: under smplx's names, or under those of AMASS and AIST.

| names | content |
|---|---|
| smplx | `betas` 1 x B, `global_orient` N x 3, `body_pose` N x 69, `transl` N x 3 |
| AIST | `poses` N x 72, `trans` N x 3, `betas` B |
| AMASS (SMPL-H) | `poses` N x 156, `trans` N x 3, `betas` 16; its fingers have no joints in SMPL and are left out |
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from occfusion.data.humannerf_layout import need
from occfusion.errors import DataError
from occfusion.files.arrays import load_npz

WIDTHS = {"global_orient": 3, "body_pose": 69, "transl": 3}
SMPL_NUMBERS, SMPLH_NUMBERS = 72, 156
_SHARED = 66
"""Numbers of SMPL-H that are SMPL's: the pelvis and the 21 joints up to the wrists."""


def read_pose_table(path: Path, frames: int, pictures: Path) -> dict[str, np.ndarray]:
    """Returns `betas` `[1 or N, B]` and the arrays of `WIDTHS`, one row a picture; numbers are not checked.

    Args:
        path: the file.
        frames: number of pictures.
        pictures: their folder, for messages.

    Raises:
        DataError: a key is missing or has another shape.
    """
    table = _under_smplx_names(load_npz(path), str(path))
    for key, width in WIDTHS.items():
        if table[key].shape != (frames, width):
            raise DataError(
                f"{path}, {key} has shape {table[key].shape}, expected ({frames}, {width}): one row for each of "
                f"the {frames} pictures in {pictures}."
            )
    betas = table["betas"]
    betas = betas[None] if betas.ndim == 1 else betas
    if betas.ndim != 2 or len(betas) not in (1, frames):
        raise DataError(f"{path}, betas has shape {betas.shape}, expected (1, 10): one person, one shape.")
    return {**table, "betas": betas}


def _under_smplx_names(content: Mapping[str, Any], where: str) -> dict[str, np.ndarray]:
    if "global_orient" in content or "poses" not in content:
        return {key: need(content, key, where) for key in (*WIDTHS, "betas")}
    poses = need(content, "poses", where)
    if (
        poses.ndim != 2
        or poses.shape[1] not in (SMPL_NUMBERS, SMPLH_NUMBERS)
        or poses.dtype.kind not in "fiu"
    ):
        raise DataError(
            f"{where}, poses has shape {poses.shape}, expected (N, {SMPL_NUMBERS}) or (N, {SMPLH_NUMBERS})."
        )
    body = poses[:, 3:]
    if poses.shape[1] == SMPLH_NUMBERS:
        body = np.concatenate([poses[:, 3:_SHARED], np.zeros((len(poses), SMPL_NUMBERS - _SHARED))], axis=1)
    return {
        "global_orient": poses[:, :3],
        "body_pose": body,
        "transl": need(content, "trans" if "trans" in content else "transl", where),
        "betas": need(content, "betas", where),
    }
