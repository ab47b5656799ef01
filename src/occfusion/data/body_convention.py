"""Body parameters as EasyMocap writes them, in the convention of smplx.

EasyMocap (and so ZJU-MoCap) poses the body with an upright root, then turns the result about the *origin
of the body's own frame* and shifts it: `x = R(Rh) M(poses, betas) + Th`. smplx turns about the pelvis J0:
`x = G (m - J0) + J0 + transl`. The two agree when `G = R(Rh) R(poses[:3])` and
`transl = Th + (R(Rh) - I) J0(betas)`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import cv2
import numpy as np

from occfusion.data.checking import checks
from occfusion.data.folder_contents import need
from occfusion.data.scene import Array, BodyParameters
from occfusion.errors import DataError


def rotation_matrix(axis_angle: Array) -> Array:
    """Returns the rotation about `axis_angle` by its length in radians, `[3, 3]`."""
    return np.asarray(cv2.Rodrigues(np.asarray(axis_angle, dtype=np.float64).reshape(3, 1))[0])


def easymocap_to_smplx(Rh: Array, Th: Array, root: Array, pelvis: Array) -> tuple[Array, Array]:
    """Returns (global_orient, transl) of smplx, each `[3]`.

    Args:
        Rh: rotation about the origin as axis-angle, `[3]`, radians.
        Th: translation, `[3]`, metres.
        root: the first three entries of `poses`, zero in files EasyMocap wrote.
        pelvis: the pelvis at rest for the same betas, `[3]`, metres.
    """
    return turned_about(Rh, Th, root, pelvis, pelvis)


def carried(orient: Array, transl: Array, motion: Array, pelvis: Array) -> tuple[Array, Array]:
    """Returns (global_orient, transl) of the same body in a world that is moved by `motion`.

    smplx turns about the pelvis J0: `x = G (m - J0) + J0 + transl`. A rigid motion `x' = W x + w` gives
    `G' = W G` and `transl' = W (J0 + transl) + w - J0`.

    Args:
        orient: global_orient, `[3]`.
        transl: `[3]`, metres.
        motion: rigid motion of the world, `[4, 4]`, metres.
        pelvis: J0, the pelvis at rest, `[3]`, metres.
    """
    turn, shift = motion[:3, :3], motion[:3, 3]
    moved = turn @ (pelvis + transl) + shift - pelvis
    if np.array_equal(turn, np.eye(3)):
        return orient.copy(), moved
    combined, _ = cv2.Rodrigues(turn @ rotation_matrix(orient))
    return np.asarray(combined, dtype=np.float64).reshape(3), moved


def turned_about(Rh: Array, Th: Array, root: Array, centre: Array, pelvis: Array) -> tuple[Array, Array]:
    """Returns (global_orient, transl) of smplx for `x = R(Rh) (R(root) (m - J0) + centre) + Th`.

    HumanNeRF's preparation writes the pelvis of its rest pose beside `Rh` and `Th`: J0 itself for
    ZJU-MoCap (the rule of EasyMocap), 0 for other footage (rotation about the pelvis).

    Args:
        Rh: axis-angle, `[3]`, radians.
        Th: translation, `[3]`, metres.
        root: the first three entries of `poses`, zero in files that the preparation wrote.
        centre: where the rest pose has its pelvis, `[3]`, metres.
        pelvis: J0 of the body at rest, `[3]`, metres.
    """
    turn = rotation_matrix(Rh)
    transl = Th + turn @ centre - pelvis
    if not root.any():
        return Rh.copy(), transl
    combined, _ = cv2.Rodrigues(turn @ rotation_matrix(root))
    return np.asarray(combined, dtype=np.float64).reshape(3), transl


_KEYS = {"Rh": 3, "Th": 3}

_POSES = (72, 69)
"""With the root's rotation, and without: EasyMocap's own results leave out its three zeros, and the script that makes
ZJU-MoCap's layout of them hands them on."""


def read_body(content: Any, pelvis: Callable[[Array], Array], where: str) -> BodyParameters:
    """Returns the body of one frame, checked.

    Args:
        content: what the file holds.
        pelvis: gives the pelvis at rest, `[3]` in metres, for shape coefficients `[B]`.
        where: what messages call it.

    Raises:
        DataError: no dict, a key is missing, or its numbers cannot be.
    """
    if not isinstance(content, Mapping):
        raise DataError(f"{where}: holds a {type(content).__name__}, not a dict.")
    for key in ("poses", *_KEYS, "shapes"):
        need(content, key, where)
    values = {key: checks.numbers(content[key], size, f"{where}, {key}") for key, size in _KEYS.items()}
    betas = checks.shape_numbers(content["shapes"], f"{where}, shapes")
    count = checks.count_of(content["poses"])
    poses = checks.numbers(content["poses"], count if count in _POSES else max(_POSES), f"{where}, poses")
    poses = np.concatenate([np.zeros(max(_POSES) - len(poses)), poses])
    orient, transl = easymocap_to_smplx(values["Rh"], values["Th"], poses[:3], pelvis(betas))
    return BodyParameters(betas, orient, poses[3:], transl)
