"""Checks of cameras and body parameters: cheap, before training, each naming file, key and cure."""

from __future__ import annotations

import logging
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from occfusion.data.scene import Array, Calibration
from occfusion.errors import DataError
from occfusion.files.resolve import Unresolved

_log = logging.getLogger(__name__)

REPAIRABLE = 1e-3
"""A rotation this near to orthonormal has lost digits in writing; it is replaced by the nearest rotation."""

_EXACT = 1e-6
MAX_SKEW = 1e-3
"""Largest skew in pixels: the rasteriser's pinhole has none."""

METRES_BELOW = 100.0
"""No studio camera is nearer to the world's origin than 10 cm: smaller `T` in millimetres are metres."""

NEAREST, FARTHEST = 0.1, 100.0
"""Plausible distances from camera to person, metres."""

DISTORTION_COUNTS = (4, 5, 8)
"""k1 k2 p1 p2, with k3, with k4 to k6."""

MAX_ANGLE = 50.0
"""Radians; several whole turns, which root orientations that are followed through time may have."""
MAX_SHAPES = 300
"""Most shape coefficients that a body of SMPL's family has."""


def numbers(value: Any, size: int | tuple[int, ...], where: str) -> Array:
    """Returns `value` as float64 numbers of a given shape (an int: that many numbers in any shape).

    Raises:
        DataError: not numbers, another shape, or NaN or infinite entries.
    """
    if isinstance(value, Unresolved):
        raise DataError(f"{where} is a {value.name} that cannot be read safely: {value.reason}.")
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise DataError(f"{where} holds no numbers.") from None
    fits = array.size == size if isinstance(size, int) else array.shape == size
    if not fits:
        raise DataError(f"{where} has shape {array.shape}, expected {size} numbers.")
    if not np.isfinite(array).all():
        raise DataError(f"{where} holds NaN or infinite values.")
    return array.reshape(-1) if isinstance(size, int) else array


def count_of(value: Any) -> int:
    """Returns how many entries a value has, 0 for lists that are no array because their rows differ."""
    try:
        return int(np.size(value))
    except (TypeError, ValueError):
        return 0


def shape_numbers(value: Any, where: str) -> Array:
    """Returns shape coefficients `[B]`, B from 1 to `MAX_SHAPES`.

    Raises:
        DataError: none or too many, not numbers, or not finite.
    """
    count = count_of(value)
    if not 1 <= count <= MAX_SHAPES:
        raise DataError(f"{where} has {count} coefficients, expected 1 to {MAX_SHAPES} (usually 10).")
    return numbers(value, count, where)


def distortion(value: Any, where: str) -> Array:
    """Returns OpenCV's 4, 5 or 8 distortion coefficients.

    Raises:
        DataError: another number of them, not numbers, or not finite.
    """
    count = count_of(value)
    if count not in DISTORTION_COUNTS:
        raise DataError(f"{where} has {count} numbers, expected 5.")
    return numbers(value, count, where)


def rotation(matrix: Array, where: str) -> Array:
    """Returns the rotation, the nearest one where digits were lost.

    Raises:
        DataError: it is a mirror, or further than `REPAIRABLE` from orthonormal.
    """
    error = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    if error > REPAIRABLE:
        raise DataError(
            f"{where} is not a rotation: R R^T differs from 1 by {error:.3g}. Check that it is the "
            "3 x 3 world-to-camera rotation and not a Rodrigues vector, a projection or scaled."
        )
    if np.linalg.det(matrix) < 0:
        raise DataError(
            f"{where} mirrors (det = -1); one camera axis has the wrong sign (OpenCV: y down, z forward)."
        )
    if error < _EXACT:
        return matrix
    _report_repair(where, error)
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ right)


@lru_cache(maxsize=256)
def _report_repair(where: str, error: float) -> None:
    """Says once for each place that digits were lost."""
    _log.warning("%s: R R^T differs from 1 by %.1g; replaced by the nearest rotation.", where, error)


def turn_between(first: Array, second: Array) -> float:
    """Returns the angle between two axis-angle rotations `[3]`, radians, 0 to pi."""
    a, b = (cv2.Rodrigues(np.asarray(v, dtype=np.float64).reshape(3, 1))[0] for v in (first, second))
    return float(np.arccos(np.clip((np.trace(a.T @ b) - 1) / 2, -1.0, 1.0)))


def check_intrinsics(K: Array, size: tuple[int, int], where: str) -> None:
    """Raises DataError unless K is a pinhole whose principal point lies in a picture of `size`."""
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        raise DataError(
            f"{where} has the focal lengths {K[0, 0]:g} and {K[1, 1]:g}; they must be positive pixels."
        )
    if abs(K[0, 1]) > MAX_SKEW or np.abs(K[1, 0]) > MAX_SKEW or not np.allclose(K[2], (0, 0, 1)):
        raise DataError(f"{where} is no pinhole matrix (skew {K[0, 1]:g}, last row {K[2].tolist()}).")
    width, height = size
    if not (0 <= K[0, 2] <= width and 0 <= K[1, 2] <= height):
        raise DataError(
            f"{where} has its principal point at ({K[0, 2]:.1f}, {K[1, 2]:.1f}), outside the picture of "
            f"{width} x {height}; were the pictures scaled or cropped after the calibration?"
        )


def check_angles(angles: Array, where: str) -> None:
    """Refuses joint angles that no person ever turned by, though their sine exists.

    Raises:
        DataError: naming the place and the largest.
    """
    largest = float(np.abs(angles).max(initial=0.0))
    if largest > MAX_ANGLE:
        raise DataError(
            f"{where}: a joint is turned by {largest:.3g}, more than {MAX_ANGLE} radians; are these degrees? "
            "Give axis-angles in radians."
        )


def check_millimetres(translations: Array, where: str) -> None:
    """Raises DataError when camera translations `[C, 3]`, meant as millimetres, look like metres."""
    largest = float(np.linalg.norm(translations, axis=1).max(initial=0.0))
    if 0.0 < largest < METRES_BELOW:
        raise DataError(
            f"{where}: the largest translation is {largest:.3g}; ZJU-MoCap gives T in millimetres, and this "
            "looks like metres. Multiply T by 1000."
        )


def check_metres(translations: Array, where: str) -> None:
    """Raises DataError when camera translations `[C, 3]`, meant as metres, look like millimetres."""
    largest = float(np.linalg.norm(translations, axis=-1).max(initial=0.0))
    if largest > FARTHEST:
        raise DataError(
            f"{where}: the largest translation is {largest:.4g}; this layout has metres, and this looks like "
            "millimetres. Divide it by 1000."
        )


def project(vertices: Array, camera: Calibration) -> tuple[Array, Array]:
    """Returns pixels `[N, 2]` in the stored, distorted picture, and depths `[N]` in metres."""
    seen = vertices @ camera.R.T + camera.t
    depth = seen[:, 2]
    ahead = np.where(depth > 1e-6, depth, 1.0)
    plane = np.column_stack([seen[:, 0] / ahead, seen[:, 1] / ahead, np.ones(len(seen))])
    pixels, _ = cv2.projectPoints(plane, np.zeros(3), np.zeros(3), camera.K, camera.distortion)
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2), depth


def check_in_view(vertices: Array, camera: Calibration, size: tuple[int, int], where: str) -> None:
    """Raises DataError when the body is behind the camera, implausibly far, or out of the picture."""
    pixels, depth = project(vertices, camera)
    middle = float(np.median(depth))
    if middle <= 0:
        raise DataError(
            f"{where}: the body lies {-middle:.2f} m behind camera {camera.name}. Check R and T "
            "(x_cam = R x_world + T), and Rh and Th."
        )
    if not NEAREST <= middle <= FARTHEST:
        raise DataError(
            f"{where}: the body is {middle:.3g} m from camera {camera.name}; check the unit of T "
            "(millimetres) and of Th (metres)."
        )
    inside = (pixels >= 0).all(axis=1) & (pixels < np.array(size)).all(axis=1) & (depth > 0)
    if not inside.any():
        x, y = np.median(pixels, axis=0)
        raise DataError(
            f"{where}: the body projects to about ({x:.0f}, {y:.0f}), outside camera {camera.name}'s picture "
            f"of {size[0]} x {size[1]}. Check the unit of T (millimetres), K, and Rh and Th."
        )
