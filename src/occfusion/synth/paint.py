"""What the person looks like: colours of all texels, painted by where they lie on the body."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from occfusion.synth import regions
from occfusion.synth.atlas import SIZE, fill, halvings, load_atlas
from occfusion.synth.fullbody import HAIR, LEFT_EYE, RIGHT_EYE, SKIN, SKIRT
from occfusion.synth.noise import value_noise
from occfusion.synth.regions import band, step
from occfusion.synth.rotations import Floats
from occfusion.synth.subject import Subject

EDGE = 0.003  # metres over which one material gives way to the next
EYE_CENTRE = np.array([0.0305, 0.6875])
IRIS, PUPIL = 0.0062, 0.0026  # radii, metres
WEAVE = 0.045  # relative strength of the weave
FOLDS = 0.07  # relative strength of painted folds
LIP = np.array([0.62, 0.30, 0.28])
WHITE = np.array([0.93, 0.92, 0.90])
LOGO_CENTRE = np.array([0.0, 0.335])


def paint(subject: Subject, texel: float) -> NDArray[np.float32]:
    """Returns the person's texture, `[2, S, S, 3]` in 0..1, no finer than a picture needs.

    Painted at twice the resolution and averaged, where that is not beyond the full atlas.

    Args:
        subject: the person.
        texel: width of a texel wanted, in texels of the full atlas.
    """
    halve = halvings(texel)
    atlas = load_atlas(SIZE >> max(halve - 1, 0))
    return fill(atlas, paint_places(subject, atlas.points, atlas.group), min(halve, 1))


def paint_places(subject: Subject, points: Floats, group: NDArray[np.int64]) -> Floats:
    """Returns the person's colours at places of the template, `[N, 3]` in 0..1.

    Args:
        subject: the person.
        points: places, `[N, 3]`, metres.
        group: what each belongs to (`fullbody.GROUPS`), `[N]`.
    """
    colours = np.zeros((len(points), 3))
    painters = {
        SKIN: _paint_body,
        SKIRT: _paint_skirt,
        HAIR: _strands,
        LEFT_EYE: _paint_eye,
        RIGHT_EYE: _paint_eye,
    }
    for which, painter in painters.items():
        own = group == which
        colours[own] = painter(points[own], subject)
    return np.clip(colours, 0.0, 1.0)


def _over(colours: Floats, mask: Floats, paint_: Floats) -> Floats:
    return colours + mask[:, None] * (paint_ - colours)


def _paint_body(points: Floats, subject: Subject) -> Floats:
    colours = _face(points, subject, _skin(points, subject))
    colours = _over(colours, regions.hair(points, subject, EDGE), _strands(points, subject))
    colours = _over(colours, regions.socks(points, EDGE), _cloth(points, 0.92 * WHITE, 11))
    lower = _cloth(points, subject.bottom_colour, 12) * _seams(points, subject)[:, None]
    lower *= 0.7 if subject.bottom == "skirt" else 1.0
    colours = _over(colours, regions.bottom(points, subject, EDGE), lower)
    upper = _cloth(points, _pattern(points, subject), 13) * _hems(points, subject)[:, None]
    colours = _over(colours, regions.top(points, subject, EDGE), upper)
    leather = np.array([0.16, 0.10, 0.07]) * (1.0 + 0.1 * value_noise(points, 0.01, 14)[:, None])
    colours = _over(colours, regions.belt(points, subject, EDGE), leather)
    buckle = regions.belt(points, subject, EDGE) * (np.abs(points[:, 0]) < 0.022) * (points[:, 2] > 0)
    colours = _over(colours, buckle, np.array([0.75, 0.70, 0.55]))
    return _over(colours, regions.shoes(points, EDGE), _shoes(points, subject))


def _skin(points: Floats, subject: Subject) -> Floats:
    tone = 1.0 + 0.05 * value_noise(points, 0.05, 21, 3) + 0.03 * value_noise(points, 0.006, 22)
    colours = subject.skin * tone[:, None]
    side, y, z = np.abs(points[:, 0]), points[:, 1], points[:, 2]
    cheeks = np.exp(-((side - 0.042) ** 2 + (y - 0.645) ** 2) / 0.018**2) * step(z, 0.08, 0.02)
    flush = 0.35 * cheeks + 0.25 * step(side, 0.80, 0.05)
    return np.asarray(colours * (1.0 - flush[:, None] * [0.02, 0.16, 0.14]))


def _face(points: Floats, subject: Subject, colours: Floats) -> Floats:
    side, y, z = np.abs(points[:, 0]), points[:, 1], points[:, 2]
    front = step(z, 0.07, 0.01)
    arch = 0.708 + 0.006 * np.sin(np.clip((side - 0.012) / 0.042, 0.0, 1.0) * 2.4)
    brow = band(y, arch - 0.0035, arch + 0.0035, 0.002) * band(side, 0.012, 0.052, 0.006) * front
    colours = _over(colours, 0.85 * brow, 0.7 * subject.hair)
    half = 0.0095 * np.sqrt(np.clip(1.0 - (side / 0.025) ** 2, 0.0, 1.0))
    lips = band(y, 0.6155 - half, 0.6155 + 0.9 * half, 0.002) * front
    colours = _over(colours, 0.55 * lips, 0.5 * subject.skin + 0.5 * LIP)
    mouth = band(y, 0.6145, 0.6165, 0.002) * (side < 0.022) * front
    colours = _over(colours, 0.6 * mouth, 0.35 * subject.skin)
    away = np.hypot((side - EYE_CENTRE[0]) / 1.7, y - EYE_CENTRE[1])
    lashes = band(away, 0.006, 0.0095, 0.002) * front
    return _over(colours, 0.45 * lashes, 0.25 * subject.skin)


def _paint_eye(points: Floats, subject: Subject) -> Floats:
    away = np.hypot(np.abs(points[:, 0]) - EYE_CENTRE[0], points[:, 1] - EYE_CENTRE[1])
    front = points[:, 2] > 0.10
    colours = np.repeat(WHITE[None] * 0.95, len(points), axis=0)
    colours = _over(colours, (1.0 - step(away, IRIS, 0.0008)) * front, subject.eyes)
    return _over(colours, (1.0 - step(away, PUPIL, 0.0008)) * front, np.array([0.02, 0.02, 0.02]))


def _strands(points: Floats, subject: Subject) -> Floats:
    """Returns hair: noise drawn out downwards, with broad lighter and darker locks."""
    fine = value_noise(points, np.array([0.004, 0.05, 0.004]), 31)
    locks = value_noise(points, np.array([0.02, 0.12, 0.02]), 32, 2)
    return np.asarray(subject.hair * (1.0 + 0.30 * fine + 0.30 * locks)[:, None])


def _cloth(points: Floats, colour: Floats, seed: int) -> Floats:
    """Returns a colour with weave and with folds that hang down."""
    weave = value_noise(points, 0.0035, seed) + value_noise(points, 0.010, seed + 40)
    folds = value_noise(points, np.array([0.05, 0.11, 0.05]), seed + 80, 2)
    return np.asarray(colour * (1.0 + 0.5 * WEAVE * weave + FOLDS * folds)[:, None])


def _pattern(points: Floats, subject: Subject) -> Floats:
    side, y, z = np.abs(points[:, 0]), points[:, 1], points[:, 2]
    first, second = subject.top_colours
    width = subject.pattern_scale
    on_arm = step(side, regions.ARM_STARTS, 0.004)
    plain = np.repeat(first[None], len(points), axis=0)
    match subject.pattern:
        case "striped":
            # stripes go round trunk and sleeve alike
            along = np.where(side > regions.ARM_STARTS, side, y)
            return _over(plain, band(along % (2.0 * width), 0.25 * width, 1.25 * width, 0.003), second)
        case "plaid":
            rows = band(np.where(side > regions.ARM_STARTS, side, y) % (2.0 * width), 0.0, 0.7 * width, 0.003)
            across = np.where(side > regions.ARM_STARTS, y, points[:, 0])
            columns = band(across % (2.0 * width), 0.0, 0.7 * width, 0.003)
            mixed = _over(plain, 0.5 * rows, second)
            return _over(mixed, 0.5 * columns, second)
        case "logo":
            away = np.hypot(points[:, 0] - LOGO_CENTRE[0], y - LOGO_CENTRE[1])
            ring = band(away, 0.035, 0.065, 0.003) + (1.0 - step(away, 0.02, 0.003))
            bar = band(y, 0.315, 0.355, 0.003) * band(side, 0.0, 0.09, 0.003)
            number = np.maximum(band(side, 0.0, 0.045, 0.003) * band(y, 0.24, 0.40, 0.003) * (z < 0), 0.0)
            mask = np.where(z > 0, np.maximum(ring, bar if subject.number % 2 else 0.0), number)
            return _over(plain, np.clip(mask, 0.0, 1.0) * (side < 0.15), second)
        case "raglan":
            diagonal = step(side + 0.35 * (y - 0.30), 0.165, 0.004)
            return _over(plain, np.maximum(on_arm, diagonal * step(y, 0.28, 0.01)), second)
        case _:
            return plain


def _hems(points: Floats, subject: Subject) -> Floats:
    """Returns the darkening along hem, cuffs, neck and shoulder seams of the top, `[N]`."""
    side, y = np.abs(points[:, 0]), points[:, 1]
    away = np.linalg.norm((points - regions.NECK) * [1.0, 1.15, 1.0], axis=1)
    radius = regions.NECK_RADII[subject.neckline]
    lines = band(y, subject.top_hem + 0.010, subject.top_hem + 0.016, 0.003)
    cuffs = band(side, subject.sleeve_end - 0.016, subject.sleeve_end - 0.010, 0.003)
    collar = band(away, radius + 0.012, radius + 0.018, 0.003) * (y > 0.4)
    shoulder = band(side, regions.ARM_STARTS - 0.004, regions.ARM_STARTS, 0.003) * (y > 0.3)
    return np.asarray(1.0 - 0.3 * np.clip(lines + cuffs + collar + shoulder, 0.0, 1.0))


def _seams(points: Floats, subject: Subject) -> Floats:
    """Returns the darkening along side seams, hem, fly and pockets of trousers, `[N]`."""
    side, y, z = np.abs(points[:, 0]), points[:, 1], points[:, 2]
    outer = band(z, -0.004, 0.001, 0.003) * (side > 0.09)
    hem = band(y, subject.bottom_hem + 0.012, subject.bottom_hem + 0.018, 0.003)
    fly = band(side, 0.002, 0.005, 0.002) * band(y, -0.08, 0.03, 0.004) * (z > 0)
    pocket = band(y - 0.6 * (side - 0.13), -0.025, -0.019, 0.003) * band(side, 0.08, 0.17, 0.004) * (z > 0)
    patch = band(np.maximum(np.abs(side - 0.075) / 0.05, np.abs(y + 0.06) / 0.06), 0.93, 1.0, 0.05) * (z < 0)
    return np.asarray(1.0 - 0.28 * np.clip(outer + hem + fly + pocket + patch, 0.0, 1.0))


def _shoes(points: Floats, subject: Subject) -> Floats:
    y, z = points[:, 1], points[:, 2]
    colours = np.repeat(subject.shoe_colour[None], len(points), axis=0)
    lace = band(z % 0.018, 0.0, 0.008, 0.003) * band(z, 0.04, 0.11, 0.01) * step(y, -0.985, 0.01)
    colours = _over(colours, 0.8 * lace * (np.abs(np.abs(points[:, 0]) - 0.145) < 0.02), 0.95 * WHITE)
    return _over(colours, 1.0 - step(y, -1.003, 0.004), 0.85 * WHITE)


def _paint_skirt(points: Floats, subject: Subject) -> Floats:
    around = np.arctan2(points[:, 0], points[:, 2])
    pleats = 1.0 + 0.10 * np.sin(18.0 * around) * step(-points[:, 1], 0.0, 0.2)
    colour = subject.bottom_colour * pleats[:, None]
    border = band(points[:, 1], subject.bottom_hem + 0.03, subject.bottom_hem + 0.055, 0.004)
    waist = step(points[:, 1], regions.WAIST, 0.003)
    return _over(_cloth(points, colour, 15), np.clip(border + 0.6 * waist, 0, 1), subject.top_colours[1])
