"""The person's shape in a video folder: from its pose files, or as the user says."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from occfusion.data.checking import checks
from occfusion.data.posing import USUAL_BETAS
from occfusion.data.scene import Array
from occfusion.data.video.pose_table import Motion
from occfusion.errors import ConfigError, DataError
from occfusion.files.arrays import load_npy, load_npz

ZEROS = "zeros"
BetasSetting = int | str | Sequence[float] | None
"""None: the pose file's; a count: the first so many of them; `zeros`; the numbers; or a file that has them."""


def choose_betas(
    setting: BetasSetting, motion: Motion, folder: Path, pelvis: Callable[[Array], Array]
) -> tuple[Array, str]:
    """Returns the shape coefficients of a pose file's rows, `[1 or N, B]`, and where they come from, in words.

    Args:
        setting: `dataset.betas`.
        motion: the pose file.
        folder: the sequence's folder, where a file of the setting may lie.
        pelvis: gives the pelvis at rest for shape coefficients `[B]`; raises DataError where they are too many.

    Raises:
        ConfigError: the setting is none of these.
        DataError: there are none, or more than the body takes.
    """
    where = f"{motion.path}, betas"
    if setting is not None and not isinstance(setting, int):
        betas, said = _as_asked(setting, folder)
    elif motion.betas is None:
        left_out = f" of SMPL's ({motion.left_out} left out)" if "betas" in motion.left_out else ""
        raise DataError(
            f"{motion.path}: has no betas{left_out}, and the body's shape must come from somewhere: "
            f"dataset.betas=FILE.npz of a file that has them, dataset.betas=[...] for numbers, or "
            f"dataset.betas={ZEROS} for the mean body."
        )
    else:
        betas, said = _cut(motion.betas, setting, where, motion.path.name)
    first = checks.shape_numbers(betas[0], where)
    try:
        pelvis(first)
    except DataError as error:
        if betas.shape[1] <= USUAL_BETAS:
            raise
        rest = float(np.abs(first[USUAL_BETAS:]).max())
        raise DataError(
            f"{where} are {len(first)}, which this body does not take: {str(error).rstrip('.')}. Or say "
            f"dataset.betas={USUAL_BETAS} to use the first {USUAL_BETAS} (the largest of the others is {rest:.2g})."
        ) from error
    return betas, said


def _cut(betas: Array, count: int | None, where: str, name: str) -> tuple[Array, str]:
    there = betas.shape[1]
    each = "one for each row" if len(betas) > 1 else "one for all"
    if count is None:
        used = np.flatnonzero((betas != 0).any(axis=0))  # coefficients of 0 change no body
        count = min(max(int(used[-1]) + 1 if len(used) else 0, USUAL_BETAS), there)
        rest_is_0 = f"; the other {there - count} are 0" if count < there else ""
        return betas[:, :count], f"betas of {name}, {count}, {each}{rest_is_0}"
    if isinstance(count, bool) or not 1 <= count <= there:
        raise ConfigError(f"dataset.betas={count!r}: {where} are {there}; choose 1 to {there}, or {ZEROS}.")
    rest = float(np.abs(betas[:, count:]).max(initial=0.0))
    said = f"betas of {name}, the first {count} of {there}, {each}; the largest left out is {rest:.2g}"
    return betas[:, :count], said


def _as_asked(setting: str | Sequence[float], folder: Path) -> tuple[Array, str]:
    if setting == ZEROS:
        return np.zeros((1, USUAL_BETAS)), f"{ZEROS}, as dataset.betas says: the mean body"
    if isinstance(setting, str):
        path = folder / setting
        if path.suffix.lower() == ".npy":
            value = load_npy(path)
        elif path.suffix.lower() == ".npz":
            content = load_npz(path, ("betas",))
            if "betas" not in content:
                raise DataError(f"{path}: has no betas, which dataset.betas asks of it.")
            value = content["betas"]
        else:
            raise ConfigError(
                f"dataset.betas={setting!r}: give a .npz or .npy file, a count, numbers, {ZEROS} or null."
            )
        if np.ndim(value) > 1 and len(value) > 1:
            raise DataError(
                f"{path}, betas has shape {np.shape(value)}, expected (1, 10): one person, one shape."
            )
        betas = checks.shape_numbers(value, f"{path}, betas")
        return betas[None], f"betas of {path.name}, as dataset.betas says"
    if not isinstance(setting, Sequence) or any(isinstance(b, (bool, str)) for b in setting):
        raise ConfigError(f"dataset.betas={setting!r}: give a count, numbers, a file, {ZEROS} or null.")
    return checks.shape_numbers(list(setting), "dataset.betas")[None], "dataset.betas"
