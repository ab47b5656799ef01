"""Masks of a person: the model's 256 x 256, steadied over time, with edges that follow the picture."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.footage.blazepose import Sighting

Mask = NDArray[np.bool_]
Picture = NDArray[np.uint8]
Floats = NDArray[np.float32]

FLOW_SIDE = 320
"""Longer side, in pixels, at which motion between neighbouring pictures is measured."""
NEIGHBOUR = 0.5
"""Weight of each neighbouring picture's mask, carried over by that motion, against the picture's own."""
BAND = 3.0 / 256.0
"""Half width of the band about the mask's edge in which the picture decides, against the region's side."""
SURROUNDINGS = 12.0 / 256.0
"""Reach within which colours of the person and of the background are gathered for a place of the band."""
LOOKS = 0.3
"""Weight of what the colours say against what the model says, both as log odds."""
MOST = 6.0
"""Largest log odds that colours may say."""
NOISE = 6e-4
"""Variance added to that of the colours, for values of 0..1."""
EPSILON = 1e-2
"""Regularisation of the guided filter (He et al. 2013, eq. 5), for colours of 0..1; its radius is 3 pixels."""
SMALL = 0.02
"""Pieces below this share of the largest are no parts of the person."""


def person_masks(pictures: Sequence[Picture], sightings: Sequence[Sighting | None]) -> list[Mask]:
    """Returns the mask of the visible person in each picture, `[H, W]`; empty where nobody was found."""
    soft = [_full(picture, sighting) for picture, sighting in zip(pictures, sightings, strict=True)]
    return [
        np.zeros(mask.shape, dtype=bool)
        if sighting is None
        else main_pieces(sharpened(picture, mask, sighting.region.side))
        for picture, mask, sighting in zip(pictures, steadied(pictures, soft), sightings, strict=True)
    ]


def _full(picture: Picture, sighting: Sighting | None) -> Floats:
    """Returns a region's mask in the picture, `[H, W]`, 0..1; 0 outside of the region."""
    if sighting is None:
        return np.zeros(picture.shape[:2], np.float32)
    warp = sighting.region.warp(len(sighting.mask))
    full = cv2.warpAffine(sighting.mask, warp, picture.shape[1::-1], flags=cv2.INTER_LINEAR)
    return np.asarray(full, dtype=np.float32)


def steadied(pictures: Sequence[Picture], masks: Sequence[Floats]) -> list[Floats]:
    """Returns each mask blended with its neighbours', carried over by the optical flow between the pictures."""
    small = [_small_grey(picture) for picture in pictures]
    reduced: list[Floats] = [
        np.asarray(cv2.resize(mask, grey.shape[::-1], interpolation=cv2.INTER_AREA), dtype=np.float32)
        for mask, grey in zip(masks, small, strict=True)
    ]
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    out = []
    for k, mask in enumerate(masks):
        change, weight = np.zeros_like(reduced[k]), 1.0
        for other in (k - 1, k + 1):
            if 0 <= other < len(masks) and masks[other].any():
                carried, trust = _carried(flow, small[k], small[other], reduced[other])
                change += NEIGHBOUR * trust * (carried - reduced[k])
                weight += NEIGHBOUR
        full = cv2.resize(
            np.asarray(change / weight, dtype=np.float32), mask.shape[::-1], interpolation=cv2.INTER_LINEAR
        )
        out.append(np.clip(mask + full, 0.0, 1.0) if mask.any() else mask)
    return out


def _carried(
    flow: cv2.DISOpticalFlow, here: NDArray[np.uint8], there: NDArray[np.uint8], mask: Floats
) -> tuple[Floats, Floats]:
    """Returns another picture's mask as it would be here, and where that is to be trusted, 0..1."""
    field = flow.calc(here, there, np.zeros((*here.shape, 2), np.float32))
    rows, columns = np.mgrid[: here.shape[0], : here.shape[1]].astype(np.float32)
    places = columns + field[..., 0], rows + field[..., 1]
    carried = cv2.remap(mask, *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    looks = cv2.remap(there, *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    difference = cv2.GaussianBlur(np.abs(looks.astype(np.float32) - here.astype(np.float32)), (0, 0), 2.0)
    return np.asarray(carried, dtype=np.float32), np.exp(-((difference / 12.0) ** 2)).astype(np.float32)


def sharpened(picture: Picture, mask: Floats, side: float) -> Mask:
    """Returns a mask whose edge follows the picture's edges near where the soft mask has it.

    In a band about the edge the colour of a pixel is held against the colours of the person and of the background
    nearby, each a normal distribution, and the answer is smoothed along the picture's edges.

    Args:
        picture: `[H, W, 3]`, RGB.
        mask: `[H, W]`, 0..1.
        side: of the person's region, pixels.
    """
    height, width = mask.shape
    rows, columns = np.flatnonzero((mask > 0.02).any(axis=1)), np.flatnonzero((mask > 0.02).any(axis=0))
    if not len(rows):
        return np.zeros((height, width), dtype=bool)
    reach = int(np.ceil(SURROUNDINGS * side)) + 2
    part = (
        slice(max(0, rows[0] - reach), min(height, rows[-1] + reach + 1)),
        slice(max(0, columns[0] - reach), min(width, columns[-1] + reach + 1)),
    )
    colours, soft = picture[part].astype(np.float32) / 255.0, mask[part]
    inside = soft > 0.5
    within = cv2.distanceTransform(inside.astype(np.uint8), cv2.DIST_L2, 5)
    without = cv2.distanceTransform((~inside).astype(np.uint8), cv2.DIST_L2, 5)
    band = BAND * side
    window = 2 * round(SURROUNDINGS * side) + 1
    as_person, here = _misfit(colours, within > 0.6 * band, window)
    as_background, there = _misfit(colours, without > 0.6 * band, window)
    says = np.where(here & there, np.clip(as_background - as_person, -MOST, MOST), 0.0)
    certain = np.clip(soft, 1e-3, 1 - 1e-3)
    odds = np.log(certain / (1 - certain)) + LOOKS * says
    chance = (1.0 / (1.0 + np.exp(-odds))).astype(np.float32)
    smooth = cv2.ximgproc.guidedFilter(colours, chance, 3, EPSILON)
    out = np.zeros((height, width), dtype=bool)
    out[part] = np.where(np.maximum(within, without) < band, smooth > 0.5, inside)
    return out


def _misfit(colours: Floats, sure: Mask, window: int) -> tuple[Floats, Mask]:
    """Returns -log likelihood of each pixel's colour under those of `sure` pixels about it, and where there are any."""
    weight, size = sure.astype(np.float32), (window, window)
    count = cv2.boxFilter(weight, -1, size)
    known = count > 1e-3
    count = np.maximum(count, 1e-6)[..., None]
    mean = cv2.boxFilter(colours * weight[..., None], -1, size) / count
    squares = cv2.boxFilter(colours * colours * weight[..., None], -1, size) / count
    variance = np.maximum(squares - mean * mean, 0.0) + NOISE
    return 0.5 * ((colours - mean) ** 2 / variance + np.log(variance)).sum(axis=-1), known


def main_pieces(mask: Mask) -> Mask:
    """Returns a mask without its small pieces and its small holes."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    if count < 2:
        return mask
    areas = stats[:, cv2.CC_STAT_AREA].astype(np.int64)
    kept = areas >= SMALL * areas[1:].max()
    kept[0] = False
    out = kept[labels]
    count, labels, stats, _ = cv2.connectedComponentsWithStats((~out).astype(np.uint8), connectivity=4)
    holes = stats[:, cv2.CC_STAT_AREA] < 0.1 * SMALL * out.sum()
    holes[0] = False
    return np.asarray(out | holes[labels])


def _small_grey(picture: Picture) -> NDArray[np.uint8]:
    scale = min(1.0, FLOW_SIDE / max(picture.shape[:2]))
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    return np.asarray(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
