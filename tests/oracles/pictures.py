"""Slow, literal picture resampling: one pixel at a time, from the lens formula."""

from __future__ import annotations

import math

import numpy as np


def distort(x: float, y: float, coefficients: np.ndarray) -> tuple[float, float]:
    """Brown and Conrady's lens: where the ray (x, y, 1) is seen, in units of the focal length."""
    k1, k2, p1, p2, k3 = coefficients
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def undistorted(image: np.ndarray, K: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """The picture a lens without distortion would have taken; K has pixel centres at +0.5."""
    height, width = image.shape[:2]
    result = np.zeros(image.shape, dtype=np.float64)
    for row in range(height):
        for column in range(width):
            x = (column + 0.5 - K[0, 2]) / K[0, 0]
            y = (row + 0.5 - K[1, 2]) / K[1, 1]
            u, v = distort(x, y, coefficients)
            result[row, column] = bilinear(image, u * K[0, 0] + K[0, 2] - 0.5, v * K[1, 1] + K[1, 2] - 0.5)
    return result


def bilinear(image: np.ndarray, column: float, row: float) -> np.ndarray:
    """The value between four pixels; outside the picture is black."""
    left, top = math.floor(column), math.floor(row)
    total = np.zeros(image.shape[2:])
    for r in (top, top + 1):
        for c in (left, left + 1):
            if 0 <= r < image.shape[0] and 0 <= c < image.shape[1]:
                total = total + image[r, c] * (1 - abs(column - c)) * (1 - abs(row - r))
    return total


def area_scaled(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Each new pixel is the mean of what it covers of the old ones."""
    result = np.zeros((height, width, *image.shape[2:]))
    for row in range(height):
        for column in range(width):
            covered = 0.0
            top, bottom = row * image.shape[0] / height, (row + 1) * image.shape[0] / height
            left, right = column * image.shape[1] / width, (column + 1) * image.shape[1] / width
            for r in range(math.floor(top), math.ceil(bottom)):
                for c in range(math.floor(left), math.ceil(right)):
                    part = (min(r + 1, bottom) - max(r, top)) * (min(c + 1, right) - max(c, left))
                    result[row, column] = result[row, column] + part * image[r, c]
                    covered += part
            result[row, column] /= covered
    return result
