"""Pictures of the levels `camera` and `wild`: linear light through a lens and a shutter onto a sensor, and masks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from occfusion.synth.actor import Actor
from occfusion.synth.disturb import move_edge, person_mask
from occfusion.synth.lamps import LitSurface, gloss_of, light_surface, make_lamps, seen_from
from occfusion.synth.occluders import Occluder
from occfusion.synth.rotations import Floats
from occfusion.synth.segmenter import ENDS, Segmenter
from occfusion.synth.sensor import Picture, expose, exposure, metered, to_linear, white_gain
from occfusion.synth.shading import LinearMesh, Mesh, Window, draw_linear
from occfusion.synth.studio import StudioCamera

SHUTTER = 0.2  # of the time between two frames: a fiftieth of a second
MOMENTS = (-1.0 / 3.0, 0.0, 1.0 / 3.0)
"""Of the time that the shutter is open: what a picture is the mean of."""

Compose = Callable[[Picture, Window | None, Window | None], tuple[Picture, Picture]]


class Moment(NamedTuple):
    """The person at a moment.

    Attributes:
        surface: lit.
        velocity: of its points, `[V, 3]`, metres a frame.
    """

    surface: LitSurface
    velocity: Floats


class Filming:
    """A crew: lamps, cameras with their exposure, a segmenter. Frames may be asked for in any order.

    Args:
        actor: who is filmed.
        cameras: the true ones.
        backgrounds: what each sees without anybody, `[S, S, 3]`, 0..255, sRGB.
        texture: of the person, `[L, S, S, 3]`, sRGB.
        occluder: in front of the first camera, and its width; None: nothing.
        compose: lays a person and things in front over a background, without a limit of brightness.
        rng: makes a source of random numbers of keys.
    """

    def __init__(
        self,
        actor: Actor,
        cameras: Sequence[StudioCamera],
        backgrounds: Sequence[Picture],
        texture: Picture,
        occluder: tuple[Occluder, float] | None,
        compose: Compose,
        rng: Callable[..., np.random.Generator],
    ) -> None:
        self._actor, self._cameras, self._occluder = actor, cameras, occluder
        self._compose, self._rng = compose, rng
        self._size = backgrounds[0].shape[0]
        self._frames = len(actor.take.poses)
        self._backgrounds = [to_linear(picture / 255.0) for picture in backgrounds]
        self._texture = to_linear(texture)
        self._lamps = make_lamps(rng(5))
        self._gloss = gloss_of(actor.figure)
        self._ends = {
            j: int(np.linalg.norm(actor.figure.rest - actor.figure.joints[j], axis=1).argmin()) for j in ENDS
        }
        self._segmenters = [
            Segmenter(self._size, self._frames, rng(7, number)) for number in range(len(cameras))
        ]
        self._moment = lru_cache(maxsize=8)(self._make_moment)
        first, seen = self._light(0, 0, None)
        self._first_light = metered(self._light(0, 0, occluder)[0])
        self._first_gain = white_gain(first, person_mask(seen))

    def gain(self, frame: int) -> float:
        """Returns the exposure of a frame: all cameras are set by what the first one meters."""
        return exposure(
            metered(self._light(frame, 0, self._occluder)[0]), self._first_light, self._first_gain
        )

    def pictures(
        self, frame: int
    ) -> Iterator[
        tuple[NDArray[np.uint8], NDArray[np.bool_], NDArray[np.uint8] | None, NDArray[np.bool_] | None]
    ]:
        """Yields picture and mask of each camera, and both without the occluder where there is one."""
        gain = self.gain(frame)
        for number, camera in enumerate(self._cameras):
            light, coverage = self._light(frame, number, None)
            shift = self._shift(frame, number, camera, coverage)
            complete = self._segmented(coverage, shift)
            # a picture with and without the occluder is one exposure, of the same noise
            whole = expose(light, gain, self._rng(6, frame, number))
            if self._occluder is None:
                yield whole, complete, None, None
                continue
            light, seen = self._light(frame, number, self._occluder)
            visible = self._segmented(seen, shift) & complete
            yield expose(light, gain, self._rng(6, frame, number)), visible, whole, complete

    def _light(
        self, frame: int, number: int, occluder: tuple[Occluder, float] | None
    ) -> tuple[Picture, Picture]:
        """Returns the linear picture, and the share of each pixel that shows the person, while the shutter is open."""
        camera, moment = self._cameras[number], self._moment(frame)
        light, shine = seen_from(moment.surface, self._lamps, camera.centre)
        figure, found = self._actor.figure, []
        for when in MOMENTS:
            points = moment.surface.points + SHUTTER * when * moment.velocity
            person = LinearMesh(points, light, shine, figure.faces, figure.uv, figure.layer, self._texture)
            window = draw_linear(person, camera.viewmat, camera.K, self._size)
            before = None
            if occluder is not None:
                thing = _lit(occluder[0].mesh(occluder[1], frame + SHUTTER * when), self._lamps.sky)
                before = draw_linear(thing, camera.viewmat, camera.K, self._size)
            found.append(self._compose(self._backgrounds[number], window, before))
        pictures, coverages = zip(*found, strict=True)
        return np.mean(pictures, axis=0, dtype=np.float32), np.mean(coverages, axis=0, dtype=np.float32)

    def _make_moment(self, frame: int) -> Moment:
        points, shade = self._actor.vertices(frame)
        before, after = max(frame - 1, 0), min(frame + 1, self._frames - 1)
        velocity = np.zeros_like(points)
        if after > before:
            velocity = (self._actor.vertices(after)[0] - self._actor.vertices(before)[0]) / (after - before)
        surface = light_surface(points, self._actor.figure.faces, shade, self._gloss, self._lamps)
        return Moment(surface, velocity)

    def _shift(self, frame: int, number: int, camera: StudioCamera, coverage: Picture) -> Picture:
        points = self._moment(frame).surface.points

        def place(joint: int) -> Floats:
            pixel = camera.K @ (camera.R @ points[self._ends[joint]] + camera.T)
            return np.asarray(pixel[:2] / pixel[2])

        whole = slice(0, coverage.shape[0]), slice(0, coverage.shape[1])
        return self._segmenters[number].shift(frame, whole, place)

    def _segmented(self, coverage: Picture, shift: Picture) -> NDArray[np.bool_]:
        return move_edge(person_mask(coverage), shift)


def _lit(mesh: Mesh, tint: Floats) -> LinearMesh:
    """Returns a thing in the light of the sky; it has no highlights."""
    light = mesh.light[:, None] * tint
    return LinearMesh(
        mesh.vertices, light, np.zeros_like(light), mesh.faces, mesh.uv, mesh.layer, to_linear(mesh.texture)
    )
