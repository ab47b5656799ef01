"""What the silhouette prior learns from: dressed people in wide poses, and what an estimator would say of their body.

Only subjects below `HELD_OUT_FROM` and the training movements are used.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.geometry.camera import project_vertices
from occfusion.geometry.normals import vertex_normals
from occfusion.human.body import Body, embedded_body
from occfusion.observation.bodyview import view_body
from occfusion.observation.crop import Square
from occfusion.observation.keypoints import face_vertices, keypoints_3d, see_keypoints
from occfusion.priors.embedded.silhouette_net import SIZE
from occfusion.synth.dress import Figure, dress
from occfusion.synth.fullbody import (
    ModelBody,
    bone_transforms,
    load_full_body,
    load_model_body,
    skin,
)
from occfusion.synth.motion import make_take
from occfusion.synth.rotations import Floats, matrix_from_axis_angle
from occfusion.synth.spec import HELD_OUT_FROM
from occfusion.synth.studio import Y_UP_TO_Z_UP
from occfusion.synth.subject import Subject, make_subject
from occfusion.types import Camera

TAKE_FRAMES = 80
PICTURE, FOCAL = 1024, 2000.0  # pixels, of the pictures before cropping

LIMB_JOINTS = (
    (13, 16, 18, 20, 22), (14, 17, 19, 21, 23), (1, 4, 7, 10), (2, 5, 8, 11), (3, 6, 9), (12, 15),
)  # fmt: skip
"""Joints whose angles are exchanged together between frames."""

LIMITS = {  # radians about x, y, z of random poses, after the sign conventions of the body
    1: ((-1.7, 0.5), (-0.4, 0.4), (-0.2, 0.7)), 2: ((-1.7, 0.5), (-0.4, 0.4), (-0.7, 0.2)),
    4: ((0.0, 1.9), (0.0, 0.0), (0.0, 0.0)), 5: ((0.0, 1.9), (0.0, 0.0), (0.0, 0.0)),
    7: ((-0.4, 0.4), (-0.2, 0.2), (-0.2, 0.2)), 8: ((-0.4, 0.4), (-0.2, 0.2), (-0.2, 0.2)),
    3: ((-0.1, 0.5), (-0.3, 0.3), (-0.2, 0.2)), 6: ((-0.1, 0.3), (-0.2, 0.2), (-0.15, 0.15)),
    9: ((-0.1, 0.2), (-0.2, 0.2), (-0.1, 0.1)), 12: ((-0.3, 0.4), (-0.5, 0.5), (-0.25, 0.25)),
    15: ((-0.3, 0.4), (-0.4, 0.4), (-0.2, 0.2)), 13: ((0.0, 0.0), (-0.2, 0.2), (-0.2, 0.2)),
    14: ((0.0, 0.0), (-0.2, 0.2), (-0.2, 0.2)), 16: ((-0.8, 0.8), (-1.6, 0.5), (-1.3, 0.9)),
    17: ((-0.8, 0.8), (-0.5, 1.6), (-0.9, 1.3)), 18: ((-0.3, 0.3), (-2.2, 0.0), (0.0, 0.0)),
    19: ((-0.3, 0.3), (0.0, 2.2), (0.0, 0.0)), 20: ((-0.4, 0.4), (-0.3, 0.3), (-0.5, 0.5)),
    21: ((-0.4, 0.4), (-0.3, 0.3), (-0.5, 0.5)),
}  # fmt: skip


@dataclass(frozen=True)
class Example:
    """A person in the crop.

    Attributes:
        person: share of each pixel that shows the person, uint8 `[S, S]`, 0..255.
        body: share that the estimated body covers, uint8 `[S, S]`.
        depth: its relative depth, int8 `[S, S]`, -127..127.
        keypoints: of the estimated body, in crop widths, float32 `[18, 2]`.
        shown: those that pass the z-buffer test, bool `[18]`.
    """

    person: NDArray[np.uint8]
    body: NDArray[np.uint8]
    depth: NDArray[np.int8]
    keypoints: NDArray[np.float32]
    shown: NDArray[np.bool_]


@dataclass(frozen=True)
class Estimate:
    """How the body that the prior is shown differs from the true one.

    Attributes:
        pose_noise: standard deviation of each angle of each joint, radians.
        shape_noise: of each shape component; infinite: the mean shape.
        place_noise: of each coordinate of the translation, metres.
        inflation: how far the skin is moved outwards, metres.
        exact: joints whose angles are right all the same.
    """

    pose_noise: float = 0.0
    shape_noise: float = 0.0
    place_noise: float = 0.0
    inflation: float = 0.0
    exact: tuple[int, ...] = ()


@cache
def _body() -> tuple[Body, ModelBody, tuple[int, ...]]:
    body = embedded_body()
    return body, load_model_body(), face_vertices(body)


def draw_estimate(rng: np.random.Generator) -> Estimate:
    """Returns an estimate's errors: a third of the bodies are true, the others off by up to a poor estimator's."""
    kind = rng.uniform()
    inflation = float(rng.uniform(0.0, 0.015)) if rng.uniform() < 0.25 else 0.0
    if kind < 0.33:
        return Estimate(inflation=inflation)
    shape = rng.choice([0.0, 0.4, np.inf], p=[0.4, 0.35, 0.25])
    return Estimate(float(rng.uniform(0.0, 0.12)), float(shape), float(rng.uniform(0.0, 0.015)), inflation)


def draw_poses(count: int, betas: Floats, rng: np.random.Generator, held_out: bool = False) -> Floats:
    """Returns poses of one person, `[count, 72]`: of takes, of takes with limbs exchanged, and within limits."""
    take = make_take(max(TAKE_FRAMES, count), betas, held_out, rng).poses
    chosen = take[rng.integers(len(take), size=count)].copy()
    if held_out:
        return chosen
    for k, kind in enumerate(rng.uniform(size=count)):
        pose = chosen[k].reshape(24, 3)
        if kind < 0.35:  # as recorded
            continue
        if kind < 0.75:
            for joints in LIMB_JOINTS:
                if rng.uniform() < 0.6:
                    other = take[rng.integers(len(take))].reshape(24, 3)
                    pose[list(joints)] = other[list(joints)]
            pose[1:] += rng.normal(0.0, 0.12, (23, 3))
        else:
            for joint, ranges in LIMITS.items():
                low, high = np.array(ranges).T
                # most joints near the middle of their range, some at its ends
                pose[joint] = low + (high - low) * rng.beta(1.4, 1.4, 3)
    return chosen


def draw_camera(middle: Floats, rng: np.random.Generator) -> Camera:
    """Returns a camera somewhere around a point, upright but for a few degrees, looking about there."""
    distance, turn = rng.uniform(2.2, 5.5), rng.uniform(0.0, 2.0 * np.pi)
    rise = np.deg2rad(rng.triangular(-12.0, 4.0, 38.0))
    away = np.array([np.sin(turn) * np.cos(rise), -np.cos(turn) * np.cos(rise), np.sin(rise)])
    forward = -away
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    R = matrix_from_axis_angle(np.array([0.0, 0.0, rng.normal(0.0, 0.04)])) @ R
    viewmat = np.eye(4)
    viewmat[:3, :3] = R
    viewmat[:3, 3] = -R @ (middle + distance * away)
    K = np.array([[FOCAL, 0.0, 0.5 * PICTURE], [0.0, FOCAL, 0.5 * PICTURE], [0.0, 0.0, 1.0]])
    return Camera(torch.tensor(viewmat), torch.tensor(K), PICTURE, PICTURE)


def make_example(
    subject: Subject,
    figure: Figure,
    pose: Floats,
    estimate: Estimate,
    rng: np.random.Generator,
    camera: Camera | None = None,
) -> Example:
    """Returns a person of a pose, seen from somewhere, and the body as estimated.

    Args:
        subject: who.
        figure: the same, dressed.
        pose: axis-angles, `[72]`.
        estimate: how the body is off.
        rng: source of camera, errors and crop.
        camera: looks at the origin's surroundings; drawn when None.
    """
    _, model, face = _body()
    transforms = bone_transforms(pose, figure.joints, load_full_body().parents)
    person = skin(figure.rest, figure.weights, transforms)
    sway = rng.normal(0.0, 0.03, 3) * np.array([1.0, 0.3, 1.0])
    person = (person + figure.hanging[:, None] * sway) @ Y_UP_TO_Z_UP.T
    vertices, joints = _estimated(subject, pose, estimate, rng)
    if camera is None:
        camera = draw_camera(0.5 * (person.min(0) + person.max(0)), rng)
    viewmat, K = camera.viewmat.numpy(), camera.K.numpy()
    pixels, _ = project_vertices(vertices, viewmat, K)
    square = Square.around(pixels, rng.uniform(0.06, 0.16))
    shift = rng.uniform(-0.02, 0.02, 2) * square.side
    window = Square(square.x + shift[0], square.y + shift[1], square.side).camera(camera, SIZE)
    K = window.K.numpy()
    shot = view_body(*project_vertices(person, viewmat, K), figure.faces, SIZE, SIZE)
    view = view_body(*project_vertices(vertices, viewmat, K), model.faces, SIZE, SIZE)
    points = keypoints_3d(torch.from_numpy(vertices), torch.from_numpy(joints), face)
    seen = see_keypoints(points, window, view.depth)
    return Example(
        person=np.round(255.0 * shot.coverage).astype(np.uint8),
        body=np.round(255.0 * view.coverage).astype(np.uint8),
        depth=np.round(127.0 * view.relative_depth).astype(np.int8),
        keypoints=(seen.pixels / SIZE).astype(np.float32),
        shown=seen.shown,
    )


def _estimated(
    subject: Subject, pose: Floats, estimate: Estimate, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Returns vertices and joints of the body as estimated, in the world."""
    model = _body()[1]
    betas = subject.betas * 0.0 if np.isinf(estimate.shape_noise) else subject.betas
    if np.isfinite(estimate.shape_noise):
        betas = betas + estimate.shape_noise * rng.standard_normal(len(betas))
    noise = estimate.pose_noise * rng.standard_normal((24, 3))
    noise[list(estimate.exact)] = 0.0
    pose = pose + noise.ravel()
    rest = model.template + model.shapedirs @ betas
    if estimate.inflation:
        rest = rest + estimate.inflation * vertex_normals(rest, model.faces)
    joints = model.regressor @ (model.template + model.shapedirs @ betas)
    transforms = bone_transforms(pose, joints, model.parents)
    transl = estimate.place_noise * rng.standard_normal(3)
    vertices = skin(rest, model.weights, transforms) + transl
    placed = np.einsum("jab,jb->ja", transforms[:, :3, :3], joints) + transforms[:, :3, 3] + transl
    return vertices @ Y_UP_TO_Z_UP.T, placed @ Y_UP_TO_Z_UP.T


def make_corpus(count: int, seed: int) -> Iterator[Example]:
    """Yields `count` examples of the training subjects, the same for the same seed.

    The numbers are visited in an order of their own, so that the first part of a corpus holds all kinds of people.
    """
    each = -(-count // HELD_OUT_FROM)
    made = 0
    for number in np.random.default_rng([seed, 1]).permutation(HELD_OUT_FROM):
        rng = np.random.default_rng([seed, 2, int(number)])
        subject = make_subject(int(number))
        figure = dress(subject)
        for pose in draw_poses(each, subject.betas, rng):
            if made == count:
                return
            yield make_example(subject, figure, pose, draw_estimate(rng), rng)
            made += 1
