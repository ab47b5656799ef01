"""Where skin, hair and each garment lie, as soft 0..1 masks over places on the template.

The same functions shape the surface (at vertices) and paint it (at texels), so colour and cloth end
together. Landmarks, in metres on the template: eyes (0.03, 0.687), lips y 0.617, ears x 0.085, chin y
0.575, shoulders (0.18, 0.44), elbows x 0.47, wrists x 0.72, hips y -0.05, knees y -0.49, ankles y -0.94.
"""

from __future__ import annotations

import numpy as np

from occfusion.synth.noise import value_noise
from occfusion.synth.rotations import Floats
from occfusion.synth.subject import Subject

ARM_STARTS = 0.19  # |x| beyond which a place above the hips belongs to an arm
WAIST = 0.055  # upper edge of trousers and skirt
BELT_WIDTH = 0.032
SHOE_TOP, SOCK_TOP = -0.935, -0.885
NECK = np.array([0.0, 0.545, -0.005])
NECK_RADII = {"round": 0.083, "v": 0.083, "wide": 0.105}
V_DEPTH = 0.43  # height of the point of a V neckline
HAIRLINE = 0.752
NAPES = {"short": 0.615, "medium": 0.60, "long": 0.50}  # long hair lies on the neck, which it colours


def step(value: Floats, edge: Floats | float, width: float) -> Floats:
    """Returns 0 below `edge`, 1 above, smooth over `width`."""
    t = np.clip((value - edge) / width + 0.5, 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))


def band(value: Floats, low: Floats | float, high: Floats | float, width: float) -> Floats:
    """Returns 1 between the two edges, 0 outside, smooth over `width`."""
    return step(value, low, width) * (1.0 - step(value, high, width))


def top(points: Floats, subject: Subject, width: float) -> Floats:
    """Returns the mask of shirt or pullover, `[N]`."""
    side, y, z = np.abs(points[:, 0]), points[:, 1], points[:, 2]
    mask = step(y, subject.top_hem, width) * (1.0 - step(side, subject.sleeve_end, width))
    away = np.linalg.norm((points - NECK) * [1.0, 1.15, 1.0], axis=1)
    mask *= step(away, NECK_RADII[subject.neckline], width) * (1.0 - step(y, NECK[1] + 0.01, width))
    if subject.neckline == "v":
        inside = step(0.42 * (y - V_DEPTH) - side, 0.0, width) * step(z, 0.0, 0.02)
        mask *= 1.0 - inside
    return mask


def bottom(points: Floats, subject: Subject, width: float) -> Floats:
    """Returns the mask of trousers or shorts, or of what is worn under a skirt, `[N]`."""
    side, y = np.abs(points[:, 0]), points[:, 1]
    hem = -0.22 if subject.bottom == "skirt" else subject.bottom_hem
    return band(y, hem, WAIST, width) * (1.0 - step(side, 0.30, 0.02))


def belt(points: Floats, subject: Subject, width: float) -> Floats:
    """Returns the mask of the belt, `[N]`; all zero without one."""
    if not subject.has_belt:
        return np.zeros(len(points))
    inside = band(points[:, 1], WAIST - BELT_WIDTH, WAIST + 0.002, width)
    return inside * (1.0 - step(np.abs(points[:, 0]), 0.30, 0.02))


def shoes(points: Floats, width: float) -> Floats:
    """Returns the mask of the shoes, `[N]`."""
    # the collar of a shoe is higher at the heel
    return 1.0 - step(points[:, 1], SHOE_TOP - 0.25 * np.maximum(points[:, 2] - 0.02, 0.0), width)


def socks(points: Floats, width: float) -> Floats:
    """Returns the mask of the socks, shoes included, `[N]`."""
    return 1.0 - step(points[:, 1], SOCK_TOP, width)


def hair(points: Floats, subject: Subject, width: float) -> Floats:
    """Returns the mask of the scalp that bears hair, `[N]`."""
    side, y, z = np.abs(points[:, 0]), points[:, 1], points[:, 2]
    ragged = 0.006 * value_noise(points, 0.012, subject.number + 7)
    # the edge falls from the forehead over the temples, round the ears, to the nape
    front = HAIRLINE - 0.35 * np.maximum(side - 0.035, 0.0)
    share = step(z, 0.035, 0.07)
    nape = NAPES[subject.hair_style]
    behind = np.where(z < -0.03, nape, max(nape, NAPES["medium"]))
    edge = share * front + (1.0 - share) * behind
    sideburn = band(z, 0.012, 0.05, 0.01) * 0.02
    ear = 1.0 - step(side, 0.079, 0.003) * (1.0 - step(y, 0.705, 0.01)) * step(z, -0.045, 0.01)
    return step(y, edge - sideburn + ragged, width) * ear
