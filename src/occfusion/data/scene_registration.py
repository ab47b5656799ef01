"""The registration of a scene: which of its cameras are corrected, and by how much."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from occfusion.data.outline_offsets import Correction, View
from occfusion.data.posing import Poser
from occfusion.data.prepare import Prepared
from occfusion.data.registration import MOST_FRAMES, Registration, agreement, register
from occfusion.data.sampling import spread
from occfusion.data.views import Views
from occfusion.types import Frame

HELD_OUT_VIEWS = 60
"""Held-out pictures that are asked whether they are off like the training pictures, evenly spread."""
AGREED = 0.5
"""Of the training camera's correction: what held-out cameras must ask for to be given it as well."""
CONFIRMED = 4.0
"""Standard errors of what they ask for, from which on they confirm what the training camera alone leaves uncertain."""


@dataclass(frozen=True)
class SceneRegistration:
    """What was measured, and what follows.

    Attributes:
        measured: of the training camera, in pixels of its frames; None where outlines tell too little.
        corrections: what is corrected, by camera, in pixels of stored pictures; empty where nothing is.
        held_out: how much of the correction held-out cameras ask for (1: all of it) and its standard error; None
            where they were not asked.
    """

    measured: Registration | None
    corrections: dict[int, Correction]
    held_out: tuple[float, float] | None = None

    def text(self) -> str:
        """Returns what was measured and what follows, in words."""
        if self.measured is None:
            return "the outlines of body and masks tell too little of a shift of the pictures"
        text, asked = self.measured.text(), ""
        if self.held_out is not None:
            asked = ": held-out cameras ask for {:.2f} ± {:.2f} of it".format(*self.held_out)
        if not self.corrections:
            return f"{text}; nothing is certainly off{asked}"
        is_certain = not self.measured.correction.is_none
        taken = self.measured.correction if is_certain else self.measured.suspected
        text += f"; corrected by ({taken.shift[0]:+.2f}, {taken.shift[1]:+.2f}) px and {1 + taken.scale:.4f}"
        if self.held_out is None:
            return text
        whose = "in all cameras" if len(self.corrections) > 1 else "in the training camera alone"
        return f"{text}, {whose}{asked}"


def register_scene(
    prepared: Prepared,
    views: Views,
    poser: Poser,
    faces: NDArray[np.int64],
    poses_may_explain: bool = False,
) -> SceneRegistration:
    """Returns what the outlines of bodies and masks say of the cameras.

    What is corrected in the training camera is measured on training pictures alone. Other cameras are given the same
    correction if they need it, for a convention is one for all. Their masks say that, and they confirm a shift that
    wrong poses might explain as well: these look another way from each side, so that what a body elsewhere in the world
    would explain is no confirmation. They say nothing else.

    Args:
        prepared: the scene.
        views: its frames; cameras not corrected yet.
        poser: of the body.
        faces: of the body, `[F, 3]`.
        poses_may_explain: a shift may be one of poses throughout the video: it takes held-out cameras to confirm it.
    """
    own = prepared.camera
    chosen = spread(len(prepared.train), MOST_FRAMES)
    shown = [_view(views.train_frame(k, truth=False), k, views, poser) for k in chosen]
    rest = poser.rest_vertices(views.parameters(prepared.train[0]).betas)
    measured = register(shown, faces, rest)
    if measured is None:
        return SceneRegistration(None, {})
    lens, is_certain = views.lens(own), not measured.correction.is_none and not poses_may_explain
    found = measured.correction if is_certain else measured.suspected
    if found.is_none:
        return SceneRegistration(measured, {})
    correction = found.resized(lens.source[0] / lens.size[0])
    corrections = {own: correction} if is_certain else {}
    others = [view for view in prepared.test_views if view[1] != own]
    asked = [others[k] for k in spread(len(others), HELD_OUT_VIEWS)]
    held_out = _agreement(asked, correction, views, poser, faces, rest, or_misplaced=not is_certain)
    if (
        held_out is not None
        and held_out[0] >= AGREED
        and (is_certain or held_out[0] >= CONFIRMED * held_out[1])
    ):
        corrections = {camera: correction for camera in (own, *prepared.cameras)}
    return SceneRegistration(measured, corrections, held_out)


def _view(frame: Frame, group: int, views: Views, poser: Poser) -> View:
    vertices = poser.pose(views.parameters(frame.index))[0]
    return View(group, vertices, frame.camera, frame.visible_mask.numpy())


def _agreement(
    asked: Sequence[tuple[int, int]],
    correction: Correction,
    views: Views,
    poser: Poser,
    faces: NDArray[np.int64],
    rest: NDArray[np.float64],
    *,
    or_misplaced: bool,
) -> tuple[float, float] | None:
    if not asked:
        return None
    shown = [_view(views.test_frame(frame, camera), camera, views, poser) for frame, camera in asked]
    lenses = [views.lens(camera) for _, camera in asked]
    corrections = [correction.resized(lens.size[0] / lens.source[0]) for lens in lenses]
    return agreement(shown, corrections, faces, rest, or_misplaced=or_misplaced)
