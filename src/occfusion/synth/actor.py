"""The dressed person in motion: geometry alone, without texture, light, cameras and occluders."""

from __future__ import annotations

import numpy as np

from occfusion.geometry.normals import vertex_normals
from occfusion.synth.cloth import swing, wrinkles
from occfusion.synth.dress import dress
from occfusion.synth.fullbody import bone_transforms, load_full_body, skin
from occfusion.synth.motion import Take, make_take
from occfusion.synth.rotations import Floats
from occfusion.synth.spec import MAX_SHORT, SceneSpec
from occfusion.synth.studio import Y_UP_TO_Z_UP
from occfusion.synth.subject import make_subject


class Actor:
    """Who moves how in a scene; frames may be asked for in any order, or at once.

    Attributes:
        subject: the person.
        figure: the person dressed, at rest.
        take: the motion, as it truly was.
    """

    def __init__(self, spec: SceneSpec) -> None:
        self._seed = spec.seed
        self.subject = make_subject(spec.subject)
        self.figure = dress(self.subject)
        # moments of all levels agree, so that `hard` differs from `clean` in what makes it hard alone
        rng = np.random.default_rng([spec.seed, spec.subject, 1])
        self.take = make_take(
            max(spec.frames, MAX_SHORT) if spec.short else spec.frames,
            self.subject.betas,
            spec.is_held_out,
            rng,
            turn=spec.turn,
            facing=spec.facing,
            seated=spec.motion == "sitting",
        )
        if spec.short:  # the beginning of a long take, at its pace
            self.take = Take(self.take.poses[: spec.frames], self.take.transl[: spec.frames])
        self._is_hard = spec.level == "hard"
        if self._is_hard:
            self._swinging, self._swing = swing(self.figure, self.take)

    def vertices(self, frame: int) -> tuple[Floats, Floats]:
        """Returns the surface that cameras see at a frame, and the shade of its wrinkles.

        Vertices of `figure.faces` in the world, `[V, 3]`, metres; factors on their brightness, `[V]`.
        """
        figure = self.figure
        rest, shade = figure.rest, np.ones(len(figure.rest))
        if self._is_hard:
            lift, shade = wrinkles(figure, self.take, frame, self._seed)
            rest = rest + lift[:, None] * vertex_normals(rest, figure.faces)
        transforms = bone_transforms(self.take.poses[frame], figure.joints, load_full_body().parents)
        points = skin(rest, figure.weights, transforms) + self.take.transl[frame]
        if self._is_hard:
            points[self._swinging] += self._swing[frame]
        return points @ Y_UP_TO_Z_UP.T, shade
