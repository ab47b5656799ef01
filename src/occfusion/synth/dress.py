"""The dressed figure at rest: cloth, hair and shoes stand off the skin; hidden parts are left out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from occfusion.geometry.normals import vertex_normals
from occfusion.synth import regions
from occfusion.synth.atlas import load_unwrapping
from occfusion.synth.fullbody import HAIR, LEFT_EYE, RIGHT_EYE, SKIN, SKIRT, load_full_body
from occfusion.synth.noise import value_noise
from occfusion.synth.rotations import Floats
from occfusion.synth.subject import Subject

EDGE = 0.012  # metres over which cloth comes away from the skin; a vertex is about 17 mm from the next
SMOOTHING = 12  # rounds of averaging under cloth: cloth spans hollows
SHOE_DEPTH, SOLE = 0.006, 0.005
SOCK_DEPTH = 0.003
BELT_DEPTH = 0.003
FOLD_DEPTH = 0.30  # folds at rest, as a share of the looseness
SKIRT_GAP = 0.018
HAIR_GAP = 0.012
HAIR_LENGTHS = {"short": None, "medium": None, "long": 0.40}  # height where long hair ends
COVERED = 0.05  # metres above the hem from which legs under a skirt are left out


@dataclass(frozen=True)
class Figure:
    """A dressed person at rest; only what is drawn.

    Attributes:
        rest: `[V, 3]`, metres.
        joints: `[24, 3]`.
        weights: `[V, 24]`.
        faces: `[F, 3]`.
        uv: texture coordinates of the corners, `[F, 3, 2]`.
        layer: texture layer of each face, `[F]`.
        template: place of each vertex on the template, `[V, 3]`.
        group: what each vertex belongs to (`fullbody.GROUPS`), `[V]`.
        cloth: how far cloth stands off, `[V]`, metres; 0 on skin and hair.
        hanging: 0..1 share by which a vertex swings freely (skirt, long hair), `[V]`.
    """

    rest: Floats
    joints: Floats
    weights: Floats
    faces: NDArray[np.int64]
    uv: Floats
    layer: NDArray[np.int64]
    template: Floats
    group: NDArray[np.int64]
    cloth: Floats
    hanging: Floats


def dress(subject: Subject) -> Figure:
    """Returns the dressed figure of a person."""
    body, unwrapping = load_full_body(), load_unwrapping()
    rest = body.template + body.shapedirs @ subject.betas
    joints = body.J_template + body.J_dirs @ subject.betas
    skin_faces = body.faces[body.face_group == SKIN]
    offset, cloth, smooth = _offsets(subject)
    rest = _smoothed(rest, skin_faces, smooth)
    normals = vertex_normals(rest, body.faces)
    rest = rest + offset[:, None] * normals
    hanging = np.zeros(len(rest))
    weights = body.weights.copy()
    own = body.vertex_group == SKIRT
    low = np.clip((regions.WAIST - body.template[own, 1]) / 0.55, 0.0, 1.0)
    rest[own] += normals[own] * (SKIRT_GAP + 0.05 * low**2)[:, None]
    # the mesh reaches the ankles: what lies below the hem is drawn up to it
    rest[own, 1] += np.maximum(0.0, subject.bottom_hem - body.template[own, 1])
    around = np.arctan2(body.template[own, 0], body.template[own, 2])
    rest[own] += normals[own] * (0.012 * low * np.sin(9.0 * around))[:, None]
    hanging[own] = low
    cloth[own] = 0.012
    own = body.vertex_group == HAIR
    fall = np.clip((0.66 - body.template[own, 1]) / 0.15, 0.0, 1.0)
    rest[own] += (HAIR_GAP * (1.0 + fall))[:, None] * normals[own]
    hanging[own] = np.clip((0.62 - body.template[own, 1]) / 0.25, 0.0, 1.0)
    shown = _shown(subject)
    used, faces = np.unique(body.faces[shown], return_inverse=True)
    return Figure(
        rest=rest[used],
        joints=joints,
        weights=weights[used],
        faces=faces.reshape(-1, 3),
        uv=unwrapping.uv[shown],
        layer=unwrapping.layer[shown],
        template=body.template[used],
        group=body.vertex_group[used],
        cloth=cloth[used],
        hanging=hanging[used],
    )


def _offsets(subject: Subject) -> tuple[Floats, Floats, Floats]:
    """Returns per vertex how far the surface stands off, how far cloth does, and what is smoothed."""
    body = load_full_body()
    points = body.template
    on_skin = (body.vertex_group == SKIN).astype(np.float64)
    upper, lower = regions.top(points, subject, EDGE), regions.bottom(points, subject, EDGE)
    shoe, sock = regions.shoes(points, EDGE), regions.socks(points, EDGE)
    folds = 1.0 + FOLD_DEPTH * value_noise(points, np.array([0.07, 0.12, 0.07]), subject.number + 3, 2)
    loose_top, loose_bottom = subject.looseness[0] * folds, subject.looseness[1] * folds
    # a top over trousers lies outside them; tucked in, under the belt, it does not reach down
    cloth = np.maximum(lower * loose_bottom, upper * (loose_top + 0.003 * lower))
    cloth += BELT_DEPTH * regions.belt(points, subject, EDGE)
    cloth *= on_skin
    soles = SOLE * (1.0 - regions.step(points[:, 1], -1.0, 0.02))
    feet = np.maximum(SOCK_DEPTH * sock, shoe * (SHOE_DEPTH + soles)) * on_skin
    grows = regions.hair(points, subject, 0.02) * on_skin
    tufts = 1.0 + 0.25 * value_noise(points, 0.03, subject.number + 5, 2)
    depth = subject.hair_depth * (1.4 if subject.hair_style != "short" else 1.0)
    crown = 0.55 + 0.45 * regions.step(points[:, 1], 0.72, 0.08)
    hair = grows * depth * crown * tufts
    return (
        np.maximum.reduce([cloth, feet, hair]),
        cloth,
        np.clip(upper + lower + 1.2 * shoe, 0.0, 1.0) * on_skin,
    )


def _smoothed(points: Floats, faces: NDArray[np.int64], share: Floats) -> Floats:
    """Returns the points with those of share 1 moved towards the mean of their neighbours again and again."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    count = np.maximum(np.bincount(edges[:, 0], minlength=len(points)), 1)
    out = points
    for round_ in range(2 * SMOOTHING):
        mean = np.stack(
            [np.bincount(edges[:, 0], out[edges[:, 1], k], minlength=len(points)) / count for k in range(3)],
            axis=1,
        )
        # Taubin's pair of steps, in and out, keeps the volume
        pace = 0.5 if round_ % 2 == 0 else -0.52
        out = out + pace * share[:, None] * (mean - out) * (count > 1)[:, None]
    return out


def _shown(subject: Subject) -> NDArray[np.int64]:
    """Returns the faces that are drawn."""
    body = load_full_body()
    middle = body.template[body.faces].mean(axis=1)
    group = body.face_group
    highest = body.template[body.faces, 1].max(axis=1)
    shown = (group == SKIN) | (group == LEFT_EYE) | (group == RIGHT_EYE)
    if subject.bottom == "skirt":
        shown |= (group == SKIRT) & (highest > subject.bottom_hem) & (middle[:, 1] < regions.WAIST + 0.02)
        legs = (
            (middle[:, 1] < -0.02)
            & (middle[:, 1] > subject.bottom_hem + COVERED)
            & (np.abs(middle[:, 0]) < 0.3)
        )
        shown &= ~((group == SKIN) & legs)
    length = HAIR_LENGTHS[subject.hair_style]
    if length is not None:
        behind = middle[:, 2] < 0.0  # strips of the helper mesh before the ears would veil the face
        shown |= (group == HAIR) & behind & (middle[:, 1] > length)
    return np.flatnonzero(shown)
