"""Random occluders for training: what may stand between a camera and a person, as masks of the crop."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.synth.disturb import disturb_mask

Mask = NDArray[np.bool_]

KINDS = ("strip", "half", "box", "blob", "sticks", "nothing", "everything")
CHANCES = (0.30, 0.25, 0.15, 0.15, 0.08, 0.04, 0.03)
RAGGED_CHANCE = 0.4
NOMINAL_PERSON = 440.0
"""Pixels a side of the person's crop in a 512 px picture: what the errors of masks are in proportion to."""


def draw_hidden(person: Mask, rng: np.random.Generator) -> Mask:
    """Returns what an occluder hides of the crop, bool `[S, S]`; it meets the person unless that is `nothing`."""
    kind = rng.choice(KINDS, p=CHANCES)
    if kind == "nothing" or not person.any():
        return np.zeros_like(person)
    if kind == "everything":
        return np.ones_like(person)
    rows, columns = np.nonzero(person)
    pick = rng.integers(len(rows))
    at = np.array([columns[pick], rows[pick]], float)
    middle = np.array([columns.mean(), rows.mean()])
    extent = np.array([np.ptp(columns), np.ptp(rows)]) + 1.0
    if kind == "strip":
        return _strip(person.shape[0], 0.5 * (at + middle), extent, rng)
    if kind == "half":
        return half_plane(
            person.shape[0], middle + 0.2 * extent * rng.normal(0.0, 1.0, 2), rng.uniform(0, 2 * np.pi)
        )
    hidden = np.zeros(person.shape, np.uint8)
    if kind == "box":
        half = extent * rng.uniform(0.15, 0.6, 2)
        cv2.fillPoly(hidden, [_turned(at, half, rng.normal(0.0, 0.3))], 1)
    elif kind == "blob":
        for _ in range(rng.integers(1, 4)):
            angles = np.sort(rng.uniform(0.0, 2 * np.pi, 9))
            reach = max(extent) * rng.uniform(0.1, 0.4) * rng.uniform(0.6, 1.3, 9)
            points = at + reach[:, None] * np.stack([np.cos(angles), np.sin(angles)], 1)
            cv2.fillPoly(hidden, [points.round().astype(np.int32)], 1)
            at = at + rng.normal(0.0, 0.2, 2) * extent
    else:
        for _ in range(rng.integers(2, 6)):
            start = middle + extent * rng.uniform(-0.6, 0.6, 2)
            reach = max(extent) * rng.uniform(0.2, 1.0)
            turn = rng.uniform(0, 2 * np.pi)
            end = start + reach * np.array([np.cos(turn), np.sin(turn)])
            ends = [tuple(int(v) for v in p.round()) for p in (start, end)]
            cv2.line(hidden, ends[0], ends[1], 1, int(rng.integers(3, 14)))
    return hidden.astype(bool)


def half_plane(size: int, through: NDArray[np.floating], angle: float) -> Mask:
    """Returns the half plane on the side `angle` points to of a point, bool `[size, size]`; pixels, radians."""
    rows, columns = np.mgrid[:size, :size] + 0.5
    return np.asarray((columns - through[0]) * np.cos(angle) + (rows - through[1]) * np.sin(angle) > 0.0)


def random_half(person: Mask, rng: np.random.Generator) -> Mask:
    """Returns a half plane of random direction whose edge runs through the middle of the person's bounding box."""
    rows, columns = np.nonzero(person)
    middle = 0.5 * np.array([columns.min() + columns.max() + 1.0, rows.min() + rows.max() + 1.0])
    return half_plane(person.shape[0], middle, rng.uniform(0.0, 2.0 * np.pi))


def centre_strip(person: Mask, share: float) -> Mask:
    """Returns the upright strip about the person's middle column that hides a share of the person's pixels."""
    per_column = person.sum(axis=0)
    middle = int(np.average(np.arange(len(per_column)), weights=per_column))
    hidden = np.zeros_like(person)
    for half in range(len(per_column)):
        hidden[:, max(0, middle - half) : middle + half + 1] = True
        if (person & hidden).sum() >= share * person.sum():
            break
    return hidden


def _strip(
    size: int, at: NDArray[np.floating], extent: NDArray[np.floating], rng: np.random.Generator
) -> Mask:
    rows, columns = np.mgrid[:size, :size] + 0.5
    turn = rng.normal(0.0, 0.05) if rng.uniform() < 0.7 else rng.uniform(0.0, np.pi)
    across = (columns - at[0]) * np.cos(turn) + (rows - at[1]) * np.sin(turn)
    reach = abs(np.cos(turn)) * extent[0] + abs(np.sin(turn)) * extent[1]
    return np.asarray(np.abs(across) < 0.5 * reach * rng.uniform(0.15, 0.8))


def _turned(at: NDArray[np.floating], half: NDArray[np.floating], turn: float) -> NDArray[np.int32]:
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
    c, s = np.cos(turn), np.sin(turn)
    return (at + corners @ np.array([[c, s], [-s, c]])).round().astype(np.int32)


def observed(coverage: NDArray[np.float32], rng: np.random.Generator) -> Mask:
    """Returns the mask that a segmentation would give of a person: often exact, at times with ragged edges."""
    if rng.uniform() >= RAGGED_CHANCE:
        return coverage > 0.5
    nominal = 512.0 * coverage.shape[0] / NOMINAL_PERSON
    return disturb_mask(coverage, int(nominal * rng.uniform(0.5, 1.5)), rng)[0]
