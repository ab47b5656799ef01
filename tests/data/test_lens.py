"""Undistortion and scaling against a pixel-by-pixel oracle."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from occfusion.data.cameras import Lens
from occfusion.data.scene import Calibration
from oracles.pictures import area_scaled, distort, undistorted

D = np.array([-0.25, 0.08, 0.002, -0.003, 0.01])


def lens(width: int, height: int, size: int, distortion=D) -> Lens:
    K = np.array([[1.1 * width, 0, width / 2 + 1.3], [0, 1.05 * width, height / 2 - 0.7], [0, 0, 1]])
    calibration = Calibration("B1", K, np.eye(3), np.array([0.0, 0.0, 3.0]), np.asarray(distortion))
    return Lens.fitted(calibration, (width, height), size)


@pytest.fixture
def smooth() -> np.ndarray:
    noise = np.random.default_rng(0).integers(0, 256, (48, 64, 3)).astype(np.float32)
    return np.clip(cv2.GaussianBlur(noise, (0, 0), 2) * 3 - 250, 0, 255).astype(np.uint8)


def test_undistortion(smooth):
    it = lens(64, 48, 64)
    wanted = undistorted(smooth.astype(float), it.calibration.K, D)
    # OpenCV places samples on a grid of 1/32 pixel
    assert np.abs(it.picture(smooth) - wanted).max() <= 2.0
    assert np.abs(it.picture(smooth) - wanted).mean() < 0.5


@pytest.mark.parametrize("size", [32, 40, 17])
def test_area_scaling(smooth, size):
    it = lens(64, 48, size, np.zeros(5))
    assert it.size == (size, round(48 * size / 64))
    assert np.abs(it.picture(smooth) - area_scaled(smooth.astype(float), *it.size)).max() <= 1.0


def test_pictures_are_never_enlarged(smooth):
    it = lens(64, 48, 512, np.zeros(5))
    assert it.size == (64, 48)
    np.testing.assert_array_equal(it.picture(smooth), smooth)


@pytest.mark.parametrize("size", [64, 32, 20])
def test_the_camera_sees_points_where_the_picture_shows_them(size):
    """A dot drawn by the distorting lens lies, in the frame, where the frame's pinhole camera puts it."""
    width, height = 640, 480
    it = lens(width, height, size * 10)
    camera = it.camera()
    for point in ([0.3, -0.2, 0.0], [-0.6, 0.4, 0.5], [0.0, 0.0, 0.0]):
        seen = np.array(point) + it.calibration.t
        u, v = distort(seen[0] / seen[2], seen[1] / seen[2], D)
        K = it.calibration.K
        rows, columns = np.mgrid[:height, :width] + 0.5
        dot = 255 * np.exp(
            -((columns - u * K[0, 0] - K[0, 2]) ** 2 + (rows - v * K[1, 1] - K[1, 2]) ** 2) / 200
        )
        shown = it.picture(dot.astype(np.uint8)).astype(float)
        rows, columns = np.mgrid[: shown.shape[0], : shown.shape[1]] + 0.5
        centroid = np.array([(shown * columns).sum(), (shown * rows).sum()]) / shown.sum()
        projected = camera.K.double().numpy() @ seen
        # the lens also bends the dot itself, by well under a tenth of a pixel
        np.testing.assert_allclose(centroid, projected[:2] / projected[2], atol=0.15)


def test_masks_are_majorities_and_rectangles_leak_nothing():
    it = lens(64, 64, 32, np.zeros(5))
    mask = np.zeros((64, 64), bool)
    mask[10:20, 10:21] = True  # columns 10..20: the last new column is half covered
    small = it.mask(mask)
    assert small[5:10, 5:11].all() and small.sum() == 5 * 6
    hidden = it.hidden((11, 0, 4, 64))  # columns 11..14 touch the new columns 5, 6, 7
    assert hidden[:, 5:8].all() and hidden.sum() == 3 * 32


def test_camera_matrix_is_scaled_exactly():
    it = lens(1024, 1024, 512, np.zeros(5))
    wanted = it.calibration.K.copy()
    wanted[:2] /= 2
    np.testing.assert_allclose(it.camera().K.numpy(), wanted.astype(np.float32), rtol=1e-7)
    np.testing.assert_allclose(it.camera().viewmat.numpy()[:3, 3], [0, 0, 3])
