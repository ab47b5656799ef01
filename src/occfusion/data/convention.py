"""Body parameters as EasyMocap writes them, in the convention of smplx.

EasyMocap (and so ZJU-MoCap) poses the body with an upright root, then turns the result about the *origin
of the body's own frame* and shifts it: `x = R(Rh) M(poses, betas) + Th`. smplx turns about the pelvis J0:
`x = G (m - J0) + J0 + transl`. The two agree when `G = R(Rh) R(poses[:3])` and
`transl = Th + (R(Rh) - I) J0(betas)`.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


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
    turn = rotation_matrix(Rh)
    transl = Th + turn @ pelvis - pelvis
    if not root.any():
        return Rh.copy(), transl
    combined, _ = cv2.Rodrigues(turn @ rotation_matrix(root))
    return np.asarray(combined, dtype=np.float64).reshape(3), transl
