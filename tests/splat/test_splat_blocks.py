"""Sets of blocks of a tile, against looking at every pixel."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import pytest

from occfusion.splat.backends.numba import bins as blocks
from occfusion.splat.backends.numba import layout
from occfusion.splat.backends.numba.blend_backward import sum_lanes

MARGIN = 0.01
"""Pixels around a block within which an ellipse may count as reaching it."""


@numba.njit
def call_reached(group: Any, left: Any, top: Any, shapes: Any, out: Any) -> None:
    blocks.reached_blocks(group, left, top, shapes, out)


@numba.njit
def call_lowest(bits: int) -> Any:
    return blocks.lowest_block(bits)


@numba.njit
def call_sums(x: Any, quarters: Any, out: Any) -> None:
    sum_lanes(x, 2, quarters, out)


def splat_row(centre: tuple[float, float], cov: tuple[float, float, float], reach: float) -> np.ndarray:
    """A splat's row from its centre (pixels of the picture) and covariance a, b, c."""
    a, b, c = cov
    det = a * c - b * b
    row = np.zeros(layout.SPLAT_SIZE)
    row[layout.X_WHOLE], row[layout.Y_WHOLE] = np.floor(centre)
    row[layout.X_PART], row[layout.Y_PART] = np.array(centre) - np.floor(centre)
    row[layout.L1], row[layout.M], row[layout.L2] = np.sqrt(c / det), -b / np.sqrt(c * det), 1 / np.sqrt(c)
    row[layout.REACH], row[layout.HALF_HEIGHT] = reach, np.sqrt(reach * c)
    row[layout.TURN], row[layout.INVERSE_L1] = b * np.sqrt(reach / a), np.sqrt(det / c)
    return row.astype(np.float32)


def form(row: np.ndarray, dx: np.ndarray, dy: np.ndarray) -> np.ndarray:
    """u^2 + v^2 in double precision."""
    l1, m, l2 = (float(row[k]) for k in (layout.L1, layout.M, layout.L2))
    value: np.ndarray = (l1 * dx + m * dy) ** 2 + (l2 * dy) ** 2
    return value


def least_in_box(row: np.ndarray, x0: float, y0: float, x1: float, y1: float) -> float:
    """The smallest u^2 + v^2 in a box relative to the centre: by its edges, finely, and the centre itself."""
    if x0 <= 0 <= x1 and y0 <= 0 <= y1:
        return 0.0
    x, y = np.linspace(x0, x1, 4001), np.linspace(y0, y1, 4001)
    edges = [
        (x, np.full_like(x, y0)),
        (x, np.full_like(x, y1)),
        (np.full_like(y, x0), y),
        (np.full_like(y, x1), y),
    ]
    return float(min(form(row, dx, dy).min() for dx, dy in edges))


def random_splat(generator: np.random.Generator, kind: str) -> np.ndarray:
    size = {"small": 0.4, "usual": 3.0, "large": 60.0, "needle": 20.0}[kind]
    thin = 1e-4 if kind == "needle" else generator.uniform(0.3, 1)
    angle = generator.uniform(0, np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    cov = turn @ np.diag([size**2, (size * thin) ** 2]) @ turn.T + 0.3 * np.eye(2)
    centre = generator.uniform(-10, 45), generator.uniform(-10, 30)
    return splat_row(centre, (cov[0, 0], cov[0, 1], cov[1, 1]), generator.uniform(0.01, 11))


@pytest.mark.parametrize("kind", ["small", "usual", "large", "needle"])
def test_reached_blocks_are_those_that_pixels_show(kind: str) -> None:
    """None that has a pixel inside the ellipse is missing; none that the ellipse stays clear of is there."""
    generator = np.random.default_rng(0)
    group = np.stack([random_splat(generator, kind) for _ in range(blocks.GROUP)])
    shapes = np.empty((blocks.SHAPE_SIZE, blocks.GROUP), np.float32)
    reached = np.empty(blocks.GROUP, np.int32)
    left, top = 100.0, 40.0
    group[:, layout.X_WHOLE] += left
    group[:, layout.Y_WHOLE] += top
    call_reached(group, np.float32(left), np.float32(top), shapes, reached)
    seen = 0
    for row, found in zip(group, reached.view(np.uint32), strict=True):
        centre_x = row[layout.X_WHOLE] - left + row[layout.X_PART] - 0.5
        centre_y = row[layout.Y_WHOLE] - top + row[layout.Y_PART] - 0.5
        for block in range(layout.TILE_BLOCKS):
            x = block % layout.BLOCK_COLUMNS * layout.BLOCK - centre_x
            y = block // layout.BLOCK_COLUMNS * layout.BLOCK - centre_y
            dx, dy = np.meshgrid(x + np.arange(layout.BLOCK), y + np.arange(layout.BLOCK))
            has_pixel = bool((form(row, dx, dy) <= row[layout.REACH]).any())
            last = layout.BLOCK - 1 + MARGIN
            is_near = (
                least_in_box(row, x - MARGIN, y - MARGIN, x + last, y + last) <= row[layout.REACH] * 1.001
            )
            is_set = bool(found >> block & 1)
            assert not (has_pixel and not is_set), (row, block)
            assert not (is_set and not is_near), (row, block)
            seen += has_pixel
    assert seen > 5


def test_splats_of_any_size_stay_inside_the_set() -> None:
    """A splat of a million pixels covers all, one far away nothing; neither overflows."""
    far = splat_row((1e7, -1e7), (1.0, 0.0, 1.0), 5.0)
    huge = splat_row((16.0, 8.0), (1e12, 0.0, 1e12), 11.0)
    group = np.tile(far, (blocks.GROUP, 1))
    group[3] = huge
    reached = np.empty(blocks.GROUP, np.int32)
    shapes = np.empty((blocks.SHAPE_SIZE, blocks.GROUP), np.float32)
    call_reached(group, np.float32(0), np.float32(0), shapes, reached)
    assert reached.view(np.uint32)[3] == 2**layout.TILE_BLOCKS - 1
    assert not reached[np.arange(blocks.GROUP) != 3].any()


def test_lowest_block_takes_a_set_apart() -> None:
    generator = np.random.default_rng(0)
    for bits in [1, 1 << 31, 2**32 - 1, *generator.integers(1, 2**32, 200).tolist()]:
        rest, found = bits, []
        while rest:
            block, rest = call_lowest(rest)
            found.append(block)
        assert found == [k for k in range(32) if bits >> k & 1]


def test_sum_lanes_is_the_sum_of_sixteen() -> None:
    x = np.random.default_rng(0).standard_normal(40).astype(np.float32)
    out = np.zeros(3, np.float32)
    call_sums(x, np.empty(8, np.float32), out)
    assert out[0] == pytest.approx(float(x[:16].astype(np.float64).sum()), rel=1e-6)
    assert out[1] == pytest.approx(float(x[16:32].astype(np.float64).sum()), rel=1e-6)
    assert out[2] == 0
