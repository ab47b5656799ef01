"""Who the person is: shape, skin, hair and clothes, all from the subject's number."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass
from functools import cache

import numpy as np

from occfusion.synth.fullbody import NUM_SHAPES, SKIN, load_full_body
from occfusion.synth.rotations import Floats

_SEED = 20_406  # fixed for ever: the numbered people must stay who they are

PATTERNS = ("striped", "plain", "logo", "plaid", "raglan")
SLEEVES = ("short", "long", "short", "none", "long", "short", "long")
BOTTOMS = ("trousers", "shorts", "trousers", "skirt", "trousers", "loose")
HAIR_STYLES = ("medium", "short", "short", "long", "short", "medium", "short")
NECKLINES = ("round", "v", "round", "wide")

MIN_HEIGHT, MAX_HEIGHT = 1.52, 1.92  # metres; the first shape component is chosen to meet the height drawn
SHAPE_SPREAD, SHAPE_LIMIT = 0.8, 1.6  # standard deviations of the other nine components

SKIN_TONES = (
    (0.93, 0.77, 0.67),
    (0.87, 0.68, 0.56),
    (0.78, 0.58, 0.44),
    (0.63, 0.45, 0.33),
    (0.47, 0.32, 0.23),
    (0.36, 0.24, 0.18),
)
HAIR_COLOURS = (
    (0.10, 0.08, 0.07),
    (0.22, 0.14, 0.09),
    (0.36, 0.22, 0.12),
    (0.62, 0.45, 0.24),
    (0.42, 0.17, 0.09),
    (0.48, 0.47, 0.46),
)
EYE_COLOURS = ((0.25, 0.15, 0.08), (0.20, 0.35, 0.50), (0.25, 0.38, 0.22), (0.16, 0.10, 0.06))


@dataclass(frozen=True)
class Subject:
    """A person. Colours are sRGB 0..1 `[3]`, lengths metres, places heights or |x| on the template.

    Attributes:
        number: the subject's number.
        betas: shape, `[10]`.
        skin: skin tone.
        hair: hair colour.
        hair_style: `short`, `medium` or `long`.
        hair_depth: how far hair stands off the scalp.
        eyes: colour of the irises.
        pattern: of the top: `plain`, `striped`, `plaid`, `logo` or `raglan`.
        top_colours: main and second colour, `[2, 3]`.
        pattern_scale: width of a stripe or square.
        sleeve_end: |x| where sleeves end.
        neckline: `round`, `v` or `wide`.
        top_hem: height where the top ends.
        bottom: `trousers`, `loose` trousers, `shorts` or `skirt`.
        bottom_colour: colour of trousers, shorts or skirt.
        bottom_hem: height where they end.
        has_belt: whether a belt shows.
        shoe_colour: colour of the shoes.
        looseness: distance of the top and of the trousers from the skin, `[2]`.
    """

    number: int
    betas: Floats
    skin: Floats
    hair: Floats
    hair_style: str
    hair_depth: float
    eyes: Floats
    pattern: str
    top_colours: Floats
    pattern_scale: float
    sleeve_end: float
    neckline: str
    top_hem: float
    bottom: str
    bottom_colour: Floats
    bottom_hem: float
    has_belt: bool
    shoe_colour: Floats
    looseness: Floats


@cache
def _height_of_shapes() -> tuple[float, Floats]:
    """Returns the height of the template and, per component, what it adds; exact near the template."""
    body = load_full_body()
    own = np.flatnonzero(body.vertex_group == SKIN)
    top = own[body.template[own, 1].argmax()]
    low = own[body.template[own, 1].argmin()]
    return (
        float(body.template[top, 1] - body.template[low, 1]),
        body.shapedirs[top, 1] - body.shapedirs[low, 1],
    )


def _shape(rng: np.random.Generator) -> Floats:
    height = rng.uniform(MIN_HEIGHT, MAX_HEIGHT)
    betas = np.clip(SHAPE_SPREAD * rng.standard_normal(NUM_SHAPES), -SHAPE_LIMIT, SHAPE_LIMIT)
    base, per_component = _height_of_shapes()
    betas[0] = (height - base - per_component[1:] @ betas[1:]) / per_component[0]
    return betas


def _colour(rng: np.random.Generator, saturation: tuple[float, float], value: tuple[float, float]) -> Floats:
    return np.array(colorsys.hsv_to_rgb(rng.uniform(), rng.uniform(*saturation), rng.uniform(*value)))


def _top_colours(rng: np.random.Generator) -> Floats:
    first = _colour(rng, (0.35, 0.85), (0.35, 0.85))
    second = _colour(rng, (0.0, 0.7), (0.2, 0.95))
    while np.abs(first - second).sum() < 0.6:  # a pattern in two like colours is no pattern
        second = _colour(rng, (0.0, 0.7), (0.2, 0.95))
    return np.stack([first, second])


def make_subject(number: int) -> Subject:
    """Returns the person of that number, always the same.

    Cuts go round in cycles, so that any dozen neighbours show all of them: numbers 3, 9, ... 105 wear a
    skirt, 5, 11, ... 101 loose trousers.

    Raises:
        ValueError: the number is negative.
    """
    if number < 0:
        raise ValueError(f"subject numbers start at 0; got {number}")
    rng = np.random.default_rng([_SEED, number])
    betas = _shape(rng)
    bottom = BOTTOMS[number % len(BOTTOMS)]
    sleeves = SLEEVES[number % len(SLEEVES)]
    dark = rng.uniform() < 0.6
    has_belt = bottom != "skirt" and bool(rng.uniform() < 0.5)
    loose = rng.uniform([0.0045, 0.0045], [0.0075, 0.007])
    if bottom == "loose":
        loose = rng.uniform([0.012, 0.012], [0.018, 0.016])
    return Subject(
        number=number,
        betas=betas,
        skin=np.array(SKIN_TONES[rng.integers(len(SKIN_TONES))]) * rng.uniform(0.95, 1.05),
        hair=np.array(HAIR_COLOURS[rng.integers(len(HAIR_COLOURS))]),
        hair_style="long" if bottom == "skirt" else HAIR_STYLES[number % len(HAIR_STYLES)],
        hair_depth=rng.uniform(0.012, 0.020),
        eyes=np.array(EYE_COLOURS[rng.integers(len(EYE_COLOURS))]),
        pattern=PATTERNS[number % len(PATTERNS)],
        top_colours=_top_colours(rng),
        pattern_scale=rng.uniform(0.035, 0.06),
        sleeve_end={"none": 0.185, "short": rng.uniform(0.30, 0.38), "long": 0.70}[sleeves],
        neckline=NECKLINES[rng.integers(len(NECKLINES))],
        top_hem=0.02 if has_belt or bottom == "skirt" else rng.uniform(-0.10, -0.03),
        bottom=bottom,
        bottom_colour=_colour(rng, (0.05, 0.5), (0.15, 0.38) if dark else (0.45, 0.75)),
        bottom_hem={"shorts": rng.uniform(-0.46, -0.36), "skirt": rng.uniform(-0.58, -0.42)}.get(
            bottom, -0.925
        ),
        has_belt=has_belt,
        shoe_colour=_colour(rng, (0.0, 0.5), (0.12, 0.9)),
        looseness=loose,
    )
