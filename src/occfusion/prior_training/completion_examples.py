"""What the completion of colours is learned from: people whose colours are known, and what a short video shows of them.

The videos are takes of the training movements, seen by one camera, most of people who hardly turn.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from occfusion.geometry.camera import project_vertices
from occfusion.geometry.normals import vertex_normals
from occfusion.geometry.zbuffer import NO_FACE, rasterize_mesh
from occfusion.human import Avatar, Gaussians
from occfusion.human.body import embedded_body
from occfusion.human.rendering import Renderer
from occfusion.inpaint.accumulation import Accumulated, gather, with_neighbours
from occfusion.prior_training.completion_people import VALIDATION, mixed_subject, vertex_colours
from occfusion.synth.disturb import disturb_shape, disturb_take
from occfusion.synth.fullbody import bone_transforms, load_model_body, skin
from occfusion.synth.motion import Take, make_take
from occfusion.synth.rotations import Floats
from occfusion.synth.subject import make_subject
from occfusion.types import Camera, Frame, Pose

FRAMES = 30
"""Of a video, spread over it."""
PICTURE, FOCAL, DISTANCE = 192, 206.0, 2.65  # pixels, pixels, metres
INTRINSICS = np.array([[FOCAL, 0.0, 0.5 * PICTURE], [0.0, FOCAL, 0.5 * PICTURE], [0.0, 0.0, 1.0]])
LONGER = (1.0, 5.0, 25.0)
"""How many times more pixels a person may have been seen in: videos are longer, and pictures larger."""
THICKNESS = 0.002
"""Metres, of Gaussians on the body, as a training begins."""
OPACITIES = (0.3, 0.95)
"""Of all Gaussians, at least and at most: those of a trained avatar are not quite opaque."""
SCATTER = 0.006
"""Metres of standard deviation, at most, by which Gaussians lie off the body, as training moves them."""
PIXEL_NOISE = 0.02
"""Standard deviation of a pixel's colour, 0..1."""
MOST_ERRORS = 3
"""How often poses and shape are put off as those of level `hard` are, at most; each as likely, none among them."""
LAMP = 0.2
"""By how much of its brightness a place may be brighter or darker, since the lamp was not quite found, at most."""


@dataclass(frozen=True)
class Example:
    """A person's colours at the body's vertices.

    Attributes:
        truth: `[V, 3]`, 0..255.
        filled: as a video shows them, and where it does not, by what is seen nearby, `[V, 3]`, 0..255.
        seen: how well each is known, `[V]`, 0..255.
    """

    truth: NDArray[np.uint8]
    filled: NDArray[np.uint8]
    seen: NDArray[np.uint8]


@cache
def _avatar() -> Avatar:
    """Returns an avatar that is nothing but the body: a Gaussian on each vertex, as a training begins."""
    body = embedded_body()
    gaussians = Gaussians.on_body(body, 0, thickness=THICKNESS)
    return Avatar(body, sh_degree=0, refine_pose=False, learn_skinning=False, gaussians=gaussians).eval()


def make_example(number: int, seed: int, *, validation: bool = False) -> Example:
    """Returns an example, always the same for the same numbers.

    Args:
        number: of the example.
        seed: of the corpus.
        validation: a subject of `VALIDATION` as it is, seen from before or behind.
    """
    rng = np.random.default_rng([seed, number, int(validation)])
    subject = make_subject(int(VALIDATION[number % len(VALIDATION)])) if validation else mixed_subject(rng)
    truth = vertex_colours(subject, None if validation else rng)
    facing = float(rng.choice([0.0, 0.0, 180.0])) if validation else None
    shown = watched(truth, subject.betas, rng, facing)
    return Example(_bytes(truth), _bytes(shown.colors.numpy()), _bytes(shown.seen.numpy()))


def _bytes(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.clip(values * 255.0 + 0.5, 0.0, 255.0).astype(np.uint8)


def watched(
    truth: Floats, betas: Floats, rng: np.random.Generator, facing: float | None = None
) -> Accumulated:
    """Returns what a short video shows at each vertex of a body whose poses and shape may be off.

    The pictures are of the true body, under a lamp that was not quite found. They are read as a run reads them, through
    the Gaussians of an avatar that is posed as estimated: a hand may leave its colour on the hip that it hangs before,
    and what is not quite opaque lets the front's colours through to the back, which then counts as seen.

    Args:
        truth: colours of the person, `[V, 3]`, 0..1.
        betas: the person's shape.
        rng: source of all choices.
        facing: degrees that a person who hardly turns is turned away from the camera; None: any, and any turn.
    """
    turn = 30.0
    if facing is None:
        facing, turn = (
            float(rng.uniform(0.0, 360.0)),
            float(rng.choice([0.0, 30.0, 30.0, 60.0, 120.0, 180.0])),
        )
    take = make_take(60, betas, False, rng, turn=turn, facing=facing)
    taken_for, shape = take, betas
    for _ in range(rng.integers(MOST_ERRORS + 1)):
        taken_for, shape = disturb_take(taken_for, rng), disturb_shape(shape, rng)
    height = rng.uniform(0.7, 1.5)
    viewmat = np.array([[1.0, 0, 0, 0], [0, -1.0, 0, height], [0, 0, -1.0, DISTANCE], [0, 0, 0, 1.0]])
    camera = Camera(_tensor(viewmat), _tensor(INTRINSICS), PICTURE, PICTURE)
    centre = PICTURE * rng.uniform(0.3, 0.7)
    half = 0.0 if rng.uniform() < 0.3 else PICTURE * rng.uniform(0.03, 0.14)
    hidden_frames = rng.choice([0.8, 1.0])
    beside = np.abs(np.arange(PICTURE) + 0.5 - centre) > half
    lamp = rng.normal(size=3)
    lamp *= rng.uniform(0.0, LAMP) / np.linalg.norm(lamp)
    tint = 1.0 + rng.normal(0.0, 0.02, 3)
    faces = load_model_body().faces

    def frames() -> Iterator[Frame]:
        for k, moment in enumerate(np.linspace(0, len(take.poses) - 1, FRAMES).round().astype(int)):
            points = _posed(take, betas, moment)
            pixels, depths = project_vertices(points, viewmat, INTRINSICS)
            drawn = rasterize_mesh(pixels, depths, faces, PICTURE, PICTURE)
            shaded = truth * tint * (1.0 + vertex_normals(points, faces) @ lamp)[:, None]
            picture = (drawn.barycentrics[..., None] * shaded[faces[drawn.face]]).sum(axis=2)
            noisy = picture + rng.normal(0.0, PIXEL_NOISE, picture.shape)
            shown = drawn.face != NO_FACE
            if k < hidden_frames * FRAMES:
                shown &= beside
            pose = taken_for.poses[moment]
            yield Frame(
                index=int(moment), camera_index=0, name=f"{moment:06d}", rgb=_tensor(noisy.clip(0.0, 1.0)),
                visible_mask=torch.from_numpy(shown), occluded=None, complete_mask=None, truth=None, camera=camera,
                pose=Pose(
                    _tensor(shape), _tensor(pose[:3]), _tensor(pose[3:]), _tensor(taken_for.transl[moment])
                ),
            )  # fmt: skip

    avatar, opacity = deepcopy(_avatar()), float(rng.uniform(*OPACITIES))
    scatter = rng.uniform(0.0, SCATTER) * rng.normal(size=(len(truth), 3))
    with torch.no_grad():
        avatar.gaussians.means.add_(_tensor(scatter))
    colors, pixels = gather(avatar, frames(), Renderer("auto"), opacity, through=False)
    weights = pixels * float(rng.choice(LONGER))
    return Accumulated(with_neighbours(colors, weights, avatar.gaussians.means.detach()), weights)


def _tensor(values: Floats) -> Tensor:
    return torch.from_numpy(np.asarray(values, np.float32))


def _posed(take: Take, betas: Floats, frame: int) -> Floats:
    """Returns the vertices of a body in a frame, y up, `[V, 3]`, metres."""
    model = load_model_body()
    rest = model.template + model.shapedirs @ betas
    transforms = bone_transforms(take.poses[frame], model.regressor @ rest, model.parents)
    return np.asarray(skin(rest, model.weights, transforms) + take.transl[frame])
