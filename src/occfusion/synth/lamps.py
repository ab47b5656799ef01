"""Light of filmed scenes: several coloured lamps, a sky and a floor; rough cloth, and highlights.

Another shading model than that of `light`: what a surface sends back depends on where it is seen from. Cloth and skin
scatter as Oren and Nayar have it ("Generalization of Lambert's reflectance model", SIGGRAPH 1994, the first two
terms), and shine as Blinn has it ("Models of light reflection for computer synthesized pictures", SIGGRAPH 1977),
more at a glancing angle (Schlick 1994). All in linear light.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from occfusion.geometry.normals import vertex_normals
from occfusion.synth.dress import Figure
from occfusion.synth.fullbody import HAIR
from occfusion.synth.light import OCCLUSION_STRENGTH, PENUMBRA, lit_share, openness
from occfusion.synth.rotations import Floats

LAMPS = 3
STRENGTHS = ((0.9, 1.3), (0.35, 0.6), (0.3, 0.7))
"""Of the key light, the fill and the light from behind, beside a sky of 1: least and most."""
AZIMUTHS = ((-60.0, -20.0), (30.0, 80.0), (140.0, 220.0))
"""Degrees about the vertical from the first camera's side."""
HEIGHTS = (15.0, 60.0)  # degrees above the floor
TINTS = ((1.12, 1.0, 0.82), (0.85, 0.98, 1.15), (1.05, 0.95, 1.0))
"""Of the lamps: warm, cool, a little of magenta; each goes to another lamp by lot."""
SKY_TINT = (0.92, 1.0, 1.10)
FLOOR_TINT, FLOOR_SHARE = (1.05, 1.0, 0.92), 0.35
ROUGHNESS = 0.35  # radians: spread of the slopes of the surface's facets
FACING_SHINE = 0.04  # share that shines off a surface seen from the front: a refractive index of 1.5
GLOSS = {"cloth": (8.0, 0.35), "skin": (22.0, 0.9), "hair": (45.0, 1.2)}
"""Blinn's exponent, and how much of the highlight there is."""


@dataclass(frozen=True)
class Lamps:
    """What lights a scene.

    Attributes:
        towards: unit vectors to the lamps, `[L, 3]`, world.
        colours: their strength beside the sky, `[L, 3]`, linear.
        sky: light from above, `[3]`.
        floor: light that the floor sends back, `[3]`.
    """

    towards: Floats
    colours: Floats
    sky: Floats
    floor: Floats


@dataclass(frozen=True)
class LitSurface:
    """A surface with what reaches it; what of that a camera sees is `seen_from`'s.

    Attributes:
        points: `[V, 3]`, metres, world.
        normals: `[V, 3]`.
        even: light from sky and floor, `[V, 3]`.
        direct: share of each lamp's light that arrives, shadows counted, `[V, L]`.
        gloss: exponent and strength of highlights, `[V, 2]`.
        shade: further factor, of creases, `[V]`.
    """

    points: Floats
    normals: Floats
    even: Floats
    direct: Floats
    gloss: Floats
    shade: Floats


def make_lamps(rng: np.random.Generator) -> Lamps:
    """Returns the lamps of a scene by lot; the first camera stands at -y."""
    tints = np.array(TINTS)[rng.permutation(LAMPS)]
    azimuth = np.radians([rng.uniform(*limits) for limits in AZIMUTHS])
    height = np.radians(rng.uniform(*HEIGHTS, LAMPS))
    towards = np.stack(
        [np.sin(azimuth) * np.cos(height), -np.cos(azimuth) * np.cos(height), np.sin(height)], axis=1
    )
    strength = np.array([rng.uniform(*limits) for limits in STRENGTHS])
    return Lamps(towards, strength[:, None] * tints, np.array(SKY_TINT), FLOOR_SHARE * np.array(FLOOR_TINT))


def gloss_of(figure: Figure) -> Floats:
    """Returns exponent and strength of the highlights at each vertex of a dressed person, `[V, 2]`."""
    out = np.tile(np.array(GLOSS["skin"]), (len(figure.rest), 1))
    out[(figure.cloth > 0.0) | (figure.hanging > 0.0)] = GLOSS["cloth"]
    out[figure.group == HAIR] = GLOSS["hair"]
    return out


def light_surface(
    points: Floats, faces: NDArray[np.int64], shade: Floats, gloss: Floats, lamps: Lamps
) -> LitSurface:
    """Returns a surface with the light that reaches it; world with z up, metres."""
    normals = vertex_normals(points, faces)
    open_share = 1.0 - OCCLUSION_STRENGTH * (1.0 - openness(points, faces, normals))
    up = 0.5 + 0.5 * normals[:, 2:]
    even = open_share[:, None] * (up * lamps.sky + (1.0 - up) * lamps.floor)
    direct = np.stack([lit_share(points, faces, towards, PENUMBRA) for towards in lamps.towards], axis=1)
    return LitSurface(points, normals, even, direct, gloss, shade)


def seen_from(surface: LitSurface, lamps: Lamps, centre: Floats) -> tuple[Floats, Floats]:
    """Returns what a camera at `centre [3]` sees: the factor on the colour, and the highlights, `[V, 3]` each.

    A white surface under the sky alone, facing up, has a factor of 1.
    """
    towards = centre - surface.points
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-9)
    normals = surface.normals
    seen = np.clip((normals * towards).sum(axis=1), 1e-3, 1.0)  # what faces away is not seen
    diffuse, shine = surface.even.copy(), np.zeros_like(surface.even)
    exponent, strength = surface.gloss.T
    for k, lamp in enumerate(lamps.towards):
        lit = np.maximum(normals @ lamp, 0.0)
        arrived = (lit * surface.direct[:, k])[:, None] * lamps.colours[k]
        diffuse += arrived * oren_nayar(lit, seen, (towards @ lamp), ROUGHNESS)[:, None]
        half = towards + lamp
        half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-9)
        facing = np.clip((half * towards).sum(axis=1), 0.0, 1.0)
        glancing = FACING_SHINE + (1.0 - FACING_SHINE) * (1.0 - facing) ** 5
        lobe = (exponent + 8.0) / 8.0 * np.maximum((normals * half).sum(axis=1), 0.0) ** exponent
        shine += arrived * (strength * glancing * lobe)[:, None]
    return diffuse * surface.shade[:, None], shine * surface.shade[:, None]


def oren_nayar(lit: Floats, seen: Floats, between: Floats, roughness: float) -> Floats:
    """Returns what a rough surface sends back beside a Lambertian one, `[V]`.

    Args:
        lit: cosine of the light's angle to the normal, `[V]`, 0..1.
        seen: cosine of the camera's, `[V]`, above 0.
        between: cosine of the angle between the two, `[V]`.
        roughness: radians.
    """
    squared = roughness * roughness
    a, b = 1.0 - 0.5 * squared / (squared + 0.33), 0.45 * squared / (squared + 0.09)
    # cos(difference of azimuths) sin(light) sin(camera), without dividing by sines that may be 0
    around = between - lit * seen
    return np.asarray(a + b * np.where(around > 0.0, around / np.maximum(np.maximum(lit, seen), 1e-3), 0.0))
