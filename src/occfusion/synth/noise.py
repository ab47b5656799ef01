"""Value noise in three dimensions: smooth, repeatable, without a table or a period."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from occfusion.cpu.compilation import serial
from occfusion.synth.rotations import Floats


@serial
def _lattice(x: int, y: int, z: int, seed: int) -> float:
    """Returns a number in -1..1 for a lattice point (an integer hash in the manner of murmur's mixer)."""
    h = np.uint32(x) * np.uint32(374761393) + np.uint32(y) * np.uint32(668265263)
    h = h + np.uint32(z) * np.uint32(2246822519) + np.uint32(seed) * np.uint32(3266489917)
    h = (h ^ (h >> np.uint32(15))) * np.uint32(2246822507)
    h = (h ^ (h >> np.uint32(13))) * np.uint32(3266489909)
    h = h ^ (h >> np.uint32(16))
    return (h & np.uint32(0xFFFFFF)) / 8388607.5 - 1.0


@serial
def _noise(points: NDArray[np.float64], seed: int, out: NDArray[np.float64]) -> None:
    for n in range(points.shape[0]):
        fx, fy, fz = np.floor(points[n, 0]), np.floor(points[n, 1]), np.floor(points[n, 2])
        ix, iy, iz = int(fx), int(fy), int(fz)
        tx, ty, tz = points[n, 0] - fx, points[n, 1] - fy, points[n, 2] - fz
        tx, ty, tz = tx * tx * (3 - 2 * tx), ty * ty * (3 - 2 * ty), tz * tz * (3 - 2 * tz)
        total = 0.0
        for dx in range(2):
            wx = tx if dx else 1.0 - tx
            for dy in range(2):
                wy = ty if dy else 1.0 - ty
                for dz in range(2):
                    wz = tz if dz else 1.0 - tz
                    total += wx * wy * wz * _lattice(ix + dx, iy + dy, iz + dz, seed)
        out[n] = total


def value_noise(points: Floats, size: float | Floats, seed: int, octaves: int = 1) -> Floats:
    """Returns noise in about -1..1 at each point, `[N]`.

    Args:
        points: `[N, 3]`, metres.
        size: width of a bump in metres, one for all axes or `[3]`.
        seed: another seed, another noise.
        octaves: layers, each half as wide and half as strong as the last.
    """
    scaled = np.ascontiguousarray(points / size, dtype=np.float64)
    total, weight = np.zeros(len(scaled)), 0.0
    layer = np.empty(len(scaled))
    for octave in range(octaves):
        _noise(scaled * 2.0**octave, seed + 101 * octave, layer)
        total += layer * 0.5**octave
        weight += 0.5**octave
    return total / weight
