"""A scene: who, in which clothes, moving how, seen by which cameras, behind what; and its pictures."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from occfusion.synth.actor import Actor
from occfusion.synth.disturb import disturb_mask, disturb_shape, disturb_take, move_edge, person_mask
from occfusion.synth.estimator import estimate_cameras, estimate_shape, estimate_take, hidden_joints
from occfusion.synth.filming import Filming
from occfusion.synth.fullbody import bone_transforms, load_model_body, skin
from occfusion.synth.light import AMBIENT, Lighting, light_vertices
from occfusion.synth.occluders import Occluder
from occfusion.synth.paint import paint
from occfusion.synth.rotations import Floats, axis_angle_from_quaternion, multiply, quaternion_from_axis_angle
from occfusion.synth.sensor import JPEG_QUALITY as FILMED_QUALITY
from occfusion.synth.shading import SUPERSAMPLING, Mesh, Window, draw, lay_over
from occfusion.synth.spec import FILMED, SceneSpec
from occfusion.synth.studio import FOCAL, NOMINAL, RADIUS, Y_UP_TO_Z_UP, make_background, make_cameras

TEXEL = 0.0017  # metres of skin a texel of the full atlas covers
FIT_SIZE = 128  # pixels at which the share hidden by an occluder is measured
FIT_FRAMES = 8
JPEG_QUALITY = 95

_QUARTER_TURN = np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])
"""`studio.Y_UP_TO_Z_UP` as a quaternion."""


@dataclass(frozen=True)
class Shot:
    """One picture as it is written.

    Attributes:
        image: `[S, S, 3]`, uint8, RGB.
        mask: the person as far as seen, bool `[S, S]`.
        image_complete: the picture without the occluder, or None where there is none.
        mask_complete: the whole person, or None where there is no occluder.
    """

    image: NDArray[np.uint8]
    mask: NDArray[np.bool_]
    image_complete: NDArray[np.uint8] | None = None
    mask_complete: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class Parameters:
    """Body parameters of a frame in EasyMocap's convention: x = R(Rh) SMPL(poses, shapes) + Th.

    Attributes:
        poses: `[72]`, the first three 0.
        Rh: axis-angle about the origin, `[3]`.
        Th: `[3]`, metres.
        shapes: `[10]`.
        vertices: the body of 6890 vertices with these parameters, `[6890, 3]`, world, metres.
    """

    poses: Floats
    Rh: Floats
    Th: Floats
    shapes: Floats
    vertices: Floats


class Scene:
    """All of a scene that does not depend on the frame; frames may be made in any order, or at once."""

    def __init__(self, spec: SceneSpec) -> None:
        self.spec = spec
        self.actor = Actor(spec)
        self.subject, self.take = self.actor.subject, self.actor.take
        self.cameras = make_cameras(spec.cameras, spec.image_size)
        self.disk_cameras = self.cameras
        self.is_hard = spec.level == "hard"
        self.disk_betas, self.disk_take = self.subject.betas, self.take
        if self.is_hard:
            self.disk_betas = disturb_shape(self.subject.betas, self._rng(2))
            self.disk_take = disturb_take(self.take, self._rng(3))
        self._lighting = Lighting(AMBIENT[spec.light], shadows=self.is_hard)
        sample = RADIUS / (FOCAL * spec.image_size / NOMINAL * SUPERSAMPLING)
        self._texture = paint(self.subject, sample / TEXEL)
        self._backgrounds = [make_background(c.place, spec.image_size) for c in self.cameras]
        self._occluder: Occluder | None = None
        if spec.occluders != "none":
            self._occluder = Occluder(spec.occluders, spec.seed, spec.subject, self.cameras[0])
            self._width = self._fitted(self._occluder)
        if spec.level == "wild":
            self._estimate()
        self._filming: Filming | None = None
        if spec.level in FILMED:
            occluder = None if self._occluder is None else (self._occluder, self._width)
            self._filming = Filming(
                self.actor, self.cameras, self._backgrounds, self._texture, occluder, _laid, self._rng
            )

    @property
    def jpeg_quality(self) -> int:
        """Returns how well pictures are kept, 1 to 100."""
        return JPEG_QUALITY if self._filming is None else FILMED_QUALITY

    def _estimate(self) -> None:
        """Puts an estimate in place of the true parameters and cameras on disk."""
        width = 0.0 if self._occluder is None else self._width
        hidden = hidden_joints(self.take, self.subject.betas, self._occluder, width)
        self.disk_betas = estimate_shape(self.subject.betas, self._rng(2))
        self.disk_take = estimate_take(self.take, hidden, self.cameras[0], self._rng(3))
        self.disk_cameras = estimate_cameras(self.cameras, self._rng(8))

    def _rng(self, *keys: int) -> np.random.Generator:
        return np.random.default_rng([self.spec.seed, self.spec.subject, *keys])

    def parameters(self, frame: int) -> Parameters:
        """Returns what is written to disk for a frame."""
        body = load_model_body()
        rest = body.template + body.shapedirs @ self.disk_betas
        joints = body.regressor @ rest
        pose, transl = self.disk_take.poses[frame], self.disk_take.transl[frame]
        quaternion = quaternion_from_axis_angle(pose[:3])
        root = bone_transforms(np.concatenate([pose[:3], np.zeros(69)]), joints, body.parents)[0]
        vertices = skin(rest, body.weights, bone_transforms(pose, joints, body.parents)) + transl
        return Parameters(
            poses=np.concatenate([np.zeros(3), pose[3:]]),
            Rh=axis_angle_from_quaternion(multiply(_QUARTER_TURN, quaternion)),
            Th=Y_UP_TO_Z_UP @ (root[:3, 3] + transl),
            shapes=self.disk_betas,
            vertices=vertices @ Y_UP_TO_Z_UP.T,
        )

    def mesh(self, frame: int) -> Mesh:
        """Returns the dressed and lit person at a frame, in the world."""
        figure = self.actor.figure
        points, shade = self.actor.vertices(frame)
        light = light_vertices(points, figure.faces, self._lighting) * shade
        return Mesh(points, light, figure.faces, figure.uv, figure.layer, self._texture)

    def shots(self, frame: int) -> Iterator[Shot]:
        """Yields the picture of each camera at a frame."""
        if self._filming is not None:
            yield from (Shot(*picture) for picture in self._filming.pictures(frame))
            return
        size = self.spec.image_size
        person = self.mesh(frame)
        thing = self._occluder.mesh(self._width, frame) if self._occluder else None
        for number, camera in enumerate(self.cameras):
            background = self._backgrounds[number]
            window = draw(person, camera.viewmat, camera.K, size)
            image, coverage = _compose(background, window, None)
            complete, shift = self._mask(coverage, window, self._rng(4, frame, number))
            if thing is None:
                yield Shot(image, complete)
                continue
            before = draw(thing, camera.viewmat, camera.K, size)
            occluded, seen = _compose(background, window, before)
            visible = person_mask(seen) & complete
            if shift is not None and window is not None:
                part = _part(window)
                visible[part] = move_edge(person_mask(seen[part]), shift) & complete[part]
            yield Shot(occluded, visible, image, complete)

    def _mask(
        self, coverage: NDArray[np.float32], window: Window | None, rng: np.random.Generator
    ) -> tuple[NDArray[np.bool_], NDArray[np.float32] | None]:
        """Returns the mask of a picture, and in hard scenes how far its edge was moved inside the window."""
        mask = person_mask(coverage)
        if not self.is_hard or window is None:
            return mask, None
        part = _part(window)
        mask[part], shift = disturb_mask(coverage[part], self.spec.image_size, rng)
        return mask, shift

    def _fitted(self, occluder: Occluder) -> float:
        """Returns the width with which the occluder hides the wanted share of the person, metres."""
        camera = make_cameras(1, FIT_SIZE)[0]
        windows = self._fit_windows(camera.viewmat, camera.K)

        def hidden_share(width: float) -> float:
            hidden = total = 0
            for frame, window in windows:
                before = draw(occluder.mesh(width, frame), camera.viewmat, camera.K, FIT_SIZE)
                there = np.isfinite(window.depth)
                total += int(there.sum())
                hidden += int((there & (_aligned(before, window)[0] < window.depth)).sum())
            return hidden / max(total, 1)

        return occluder.fit(hidden_share)

    def _fit_windows(self, viewmat: Floats, K: Floats) -> list[tuple[int, Window]]:
        frames = np.unique(np.linspace(0, self.spec.frames - 1, FIT_FRAMES).round().astype(int))
        drawn = [(int(f), draw(self.mesh(int(f)), viewmat, K, FIT_SIZE)) for f in frames]
        return [(f, w) for f, w in drawn if w is not None]


def _part(window: Window) -> tuple[slice, slice]:
    """Returns the rows and columns of a picture that a window covers."""
    rows, columns = window.depth.shape
    return (
        slice(window.y, window.y + rows // SUPERSAMPLING),
        slice(window.x, window.x + columns // SUPERSAMPLING),
    )


def _aligned(other: Window | None, window: Window) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Returns depth and colour of `other` on the samples of `window`; infinite where it does not reach."""
    depth = np.full(window.depth.shape, np.inf, np.float32)
    colour = np.zeros(window.colour.shape, np.float32)
    if other is None:
        return depth, colour
    x, y = SUPERSAMPLING * (other.x - window.x), SUPERSAMPLING * (other.y - window.y)
    h, w, oh, ow = *window.depth.shape, *other.depth.shape
    top, left, bottom, right = max(y, 0), max(x, 0), min(y + oh, h), min(x + ow, w)
    if top < bottom and left < right:
        source = slice(top - y, bottom - y), slice(left - x, right - x)
        depth[top:bottom, left:right] = other.depth[source]
        colour[top:bottom, left:right] = other.colour[source]
    return depth, colour


def _compose(
    background: NDArray[np.float32], window: Window | None, before: Window | None
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Returns the picture, and the share of each pixel that shows the person."""
    picture, coverage = _laid(background, window, before)
    return np.clip(picture + 0.5, 0.0, 255.0).astype(np.uint8), coverage


def _laid(
    background: NDArray[np.float32], window: Window | None, before: Window | None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Returns the picture without rounding, and the share of each pixel that shows the person."""
    picture = background.copy()
    coverage = np.zeros(background.shape[:2], np.float32)
    if before is not None:
        nothing = np.full(before.depth.shape, np.inf, np.float32)
        lay_over(picture, coverage, before.x, before.y, before.depth, before.colour, nothing, before.colour)
        coverage[:] = 0.0
    if window is not None:
        part = _part(window)
        picture[part] = background[part]
        lay_over(
            picture, coverage, window.x, window.y, window.depth, window.colour, *_aligned(before, window)
        )
    return picture, coverage
