"""Whom the completion of colours is learned from: people whose colours are known all round.

They are put together anew from the looks of embedded subjects below `HELD_OUT_FROM`. Some wear tops in patterns that no
embedded subject has, some bear marks on one side alone, and some wear no top.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from occfusion.geometry.normals import vertex_normals
from occfusion.synth import regions
from occfusion.synth.dress import dress
from occfusion.synth.fullbody import SKIN, load_model_body
from occfusion.synth.noise import value_noise
from occfusion.synth.paint import EDGE, paint_places
from occfusion.synth.regions import band, step
from occfusion.synth.rotations import Floats
from occfusion.synth.subject import PATTERNS, Subject, make_subject

VALIDATION = range(90, 100)
"""Subjects that are measured on, as they are; the others are what people are put together from."""
OUTWARDS = 0.03
"""Metres from the skin from where the nearest cloth or hair is what a camera sees."""
CHIN = 0.54
"""Height of the throat on the template, metres."""


@dataclass(frozen=True)
class Looks:
    """How many people look otherwise than embedded subjects, as shares.

    Attributes:
        other_pattern: of tops, with a pattern of no embedded subject.
        no_top: of people, without one.
        marked: of people, with marks on one side of the trunk alone: printed on the top, or tattooed.
        marked_behind: of marks, on the back.
        hairy: of bare trunks, with hair on chest and belly, which no back has.
    """

    other_pattern: float = 0.4
    no_top: float = 0.15
    marked: float = 0.4
    marked_behind: float = 0.25
    hairy: float = 0.6


TRAINED_ON = Looks()
UNCHANGED = Looks(other_pattern=0.0, no_top=0.0, marked=0.0, marked_behind=0.0, hairy=0.0)


def mixed_subject(rng: np.random.Generator) -> Subject:
    """Returns a person with the body, hair, top and bottom of four subjects, and some colours of its own."""
    body, hair, top, bottom = (make_subject(int(k)) for k in rng.integers(VALIDATION.start, size=4))
    return replace(
        body,
        hair=hair.hair,
        hair_style=hair.hair_style,
        pattern=str(rng.choice(PATTERNS)),
        top_colours=np.clip(
            rng.uniform(0.05, 0.95, (2, 3)) if rng.uniform() < 0.5 else top.top_colours, 0.0, 1.0
        ),
        pattern_scale=float(rng.uniform(0.03, 0.065)),
        sleeve_end=top.sleeve_end,
        neckline=top.neckline,
        top_hem=0.02 if bottom.has_belt or bottom.bottom == "skirt" else min(top.top_hem, -0.03),
        bottom=bottom.bottom,
        bottom_colour=rng.uniform(0.05, 0.9, 3) if rng.uniform() < 0.5 else bottom.bottom_colour,
        bottom_hem=bottom.bottom_hem,
        has_belt=bottom.has_belt,
        shoe_colour=top.shoe_colour,
    )


def vertex_colours(subject: Subject, rng: np.random.Generator | None, looks: Looks = TRAINED_ON) -> Floats:
    """Returns what cameras see at each vertex of the body, `[V, 3]`, 0..1: skin, cloth or the hair above it.

    What is hairy or marked is drawn last: with the same random numbers it is the same person without it.

    Args:
        subject: the person.
        rng: decides on other patterns, on marks, and whether there is a top; None: the person as it is.
        looks: how likely these are.
    """
    figure, model = dress(subject), load_model_body()
    points, on_body = figure.template, figure.group == SKIN
    bare = rng is not None and rng.uniform() < looks.no_top
    worn = replace(subject, top_hem=np.inf) if bare else subject
    colours = paint_places(worn, points, figure.group)
    if rng is not None:
        upper = regions.top(points, subject, EDGE) * on_body
        if bare:
            colours[on_body] = _bare_trunk(colours[on_body], points[on_body], subject, looks, rng)
        elif rng.uniform() < looks.other_pattern:
            colours += upper[:, None] * (_other_pattern(points, subject, rng) - colours)
        if rng.uniform() < looks.marked:
            colours = _marked(colours, points, upper, looks, rng)
    rest = model.template + model.shapedirs @ subject.betas
    outside = rest + OUTWARDS * vertex_normals(rest, model.faces)
    _, index = KDTree(figure.rest).query(outside)
    return np.asarray(colours[index])


def _other_pattern(points: Floats, subject: Subject, rng: np.random.Generator) -> Floats:
    """Returns the colours of a top with dots, stripes lengthwise, blots, another back, or a fade, `[N, 3]`."""
    first, second = subject.top_colours
    width = 1.5 * subject.pattern_scale
    along, across = points[:, 1], points[:, 0] + 0.5 * points[:, 2]
    match rng.integers(5):
        case 0:
            away = np.hypot((along % width) - 0.5 * width, (across % width) - 0.5 * width)
            share = (away < 0.25 * width).astype(np.float64)
        case 1:
            share = band(across % width, 0.0, 0.5 * width, 0.003)
        case 2:
            share = np.clip(0.5 + 2.0 * value_noise(points, 0.08, int(rng.integers(1000)), 2), 0.0, 1.0)
        case 3:
            share = (points[:, 2] < 0.0).astype(np.float64)
        case _:
            share = np.clip((along + 0.1) / 0.55, 0.0, 1.0)
    return np.asarray(first + share[:, None] * (second - first))


def _half(points: Floats, behind: bool = False) -> Floats:
    """Returns 1 on the front half of the body, or on the back half, 0 on the other one, `[N]`."""
    return step(-points[:, 2] if behind else points[:, 2], 0.02, 0.03)


def _one_side(points: Floats, behind: bool) -> Floats:
    """Returns 1 on the front of the trunk, or on its back, 0 on the other side and on the arms, `[N]`."""
    return _half(points, behind) * (1.0 - step(np.abs(points[:, 0]), regions.ARM_STARTS - 0.02, 0.02))


def _marked(colours: Floats, points: Floats, where: Floats, looks: Looks, rng: np.random.Generator) -> Floats:
    """Returns colours with marks on the front or the back: shapes, lines of writing, a picture, an open jacket.

    Args:
        colours: of the person, `[N, 3]`.
        points: places on the template, `[N, 3]`, metres.
        where: they are, `[N]`, 0..1.
        looks: how likely they are on the back.
        rng: source of all choices.
    """
    across, along = points[:, 0], points[:, 1]
    behind = bool(rng.uniform() < looks.marked_behind)
    side = where * _one_side(points, behind)
    kind = rng.integers(4)
    for _ in range(int(rng.integers(1, 6)) if kind == 0 else 1):
        ink = np.repeat(rng.uniform(0.02, 0.98, (1, 3)), len(points), axis=0)
        x, y = rng.uniform(-0.09, 0.09), rng.uniform(0.08, 0.42)
        angle, stretch = rng.uniform(0.0, np.pi), rng.uniform(0.4, 1.0)
        u = np.cos(angle) * (across - x) + np.sin(angle) * (along - y)
        v = (np.cos(angle) * (along - y) - np.sin(angle) * (across - x)) / stretch
        size = rng.uniform(0.02, 0.09)
        match kind:
            case 0:
                power = float(rng.choice([1.0, 2.0, 8.0]))  # a rhombus, an ellipse, a rectangle
                away = (np.abs(u) ** power + np.abs(v) ** power) ** (1.0 / power)
                inner = rng.uniform(0.3, 0.7) * size if rng.uniform() < 0.3 else -1.0
                share = band(away, inner, size, 0.004)
            case 1:
                height, letters = rng.uniform(0.02, 0.05), value_noise(points, 0.02, int(rng.integers(1000)))
                lines = band((along - y) % (1.7 * height), 0.0, height, 0.004)
                share = lines * (np.abs(along - y) < rng.integers(1, 4) * 1.7 * height)
                share = share * (np.abs(across) < rng.uniform(0.05, 0.14)) * (letters > -0.3)
            case 2:
                noise = [value_noise(points, 0.04, int(rng.integers(1000)), 2) for _ in range(3)]
                ink = np.clip(ink + 0.8 * np.stack(noise, axis=-1), 0.0, 1.0)
                half = rng.uniform(0.04, 0.13, 2)
                share = ((np.abs(across) < half[0]) & (np.abs(along - y) < half[1])).astype(np.float64)
            case _:  # what is worn below an open jacket
                share = 1.0 - step(np.abs(across), rng.uniform(0.02, 0.1) * (1.0 + 0.5 * along), 0.005)
        colours = colours + (side * share)[:, None] * (ink - colours)
    return colours


def _bare_trunk(
    colours: Floats, points: Floats, subject: Subject, looks: Looks, rng: np.random.Generator
) -> Floats:
    """Returns who wears no top: nipples, a navel, soft shades and, of most, hair in front; limbs are darker.

    Args:
        colours: of skin and of what is worn below the waist, `[N, 3]`.
        points: places on the template, `[N, 3]`, metres.
        subject: whose hair has the colour of that on the head, or darker.
        looks: how likely hair is.
        rng: source of all choices.
    """
    across, along, front = points[:, 0], points[:, 1], _half(points)
    soft = np.clip(0.5 + value_noise(points, 0.09, int(rng.integers(1000)), 2), 0.0, 1.0)
    nipples = np.hypot(np.abs(across) - rng.uniform(0.08, 0.11), along - rng.uniform(0.26, 0.32))
    navel = np.hypot(across, along - rng.uniform(0.06, 0.1))
    dots = 1.0 - step(np.minimum(nipples, navel), 0.015, 0.01)
    trunk = (along > regions.WAIST) * (along < CHIN)
    light = (1.0 - rng.uniform(0.0, 0.25) * front * soft * trunk) * (1.0 - 0.5 * front * dots * trunk)
    limbs = step(np.abs(across), regions.ARM_STARTS, 0.04) + (1.0 - step(along, regions.WAIST, 0.004))
    light *= 1.0 - rng.uniform(0.0, 0.35) * limbs * (0.7 + 0.3 * soft)
    colours = colours * light[:, None]
    if rng.uniform() < looks.hairy:
        chest, high, wide = rng.uniform(0.29, 0.4), rng.uniform(0.05, 0.13), rng.uniform(0.07, 0.25)
        patch = np.exp(-(((along - chest) / high) ** 4) - (across / wide) ** 4)
        line = np.exp(-((across / rng.uniform(0.015, 0.06)) ** 2)) * rng.uniform(0.0, 1.0) * (along < chest)
        curls = np.clip(0.8 + value_noise(points, 0.02, int(rng.integers(1000))), 0.0, 1.0)
        share = rng.uniform(0.2, 0.9) * curls * np.maximum(patch, line) * front * trunk
        colours = colours + share[:, None] * (rng.uniform(0.5, 1.0) * subject.hair - colours)
    return np.asarray(colours)
