"""What the cameras of a run saw, beside what its avatar looks like from there."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from occfusion.errors import DataError
from occfusion.evaluation.pictures import ERROR_GAIN, error_map, to_uint8
from occfusion.human.rendering import Renderer
from occfusion.run.bodies import make_body, make_data
from occfusion.run.loaded import LoadedRun
from occfusion.show.paths import still
from occfusion.show.views import HELD_OUT, TRAIN, View
from occfusion.viewer.figure import Figure

if TYPE_CHECKING:
    from occfusion.data.module import HumanDataModule

KINDS = ("input", "avatar", "truth", "error")
TRAINING = "training"
_MOST_KEPT = 64
"""Pictures of the data that are kept in memory."""


@dataclass(frozen=True)
class Shown:
    """A picture of a camera.

    Attributes:
        picture: uint8 `[H, W, 3]`.
        text: what it is, in a few words.
    """

    picture: NDArray[np.uint8]
    text: str


@dataclass(frozen=True)
class _Pictures:
    """What is known of a view: all `[H, W, 3]` in 0..1 or `[H, W]`, as in `types.Frame`."""

    rgb: Tensor
    visible_mask: Tensor
    truth: Tensor | None


class Seen:
    """The cameras of a run and their pictures; the data set is opened when the first of them is asked for.

    Args:
        run: of whom.
    """

    def __init__(self, run: LoadedRun) -> None:
        self._run = run
        self._views: dict[str, list[View]] = {TRAINING: run.views(TRAIN)}
        try:
            held_out = run.views(HELD_OUT)
        except DataError:  # a video has one camera: its list of others is empty
            held_out = []
        for view in held_out:
            self._views.setdefault(f"held out, camera {view.camera_index}", []).append(view)
        self._data: HumanDataModule | None = None
        self._kept: dict[tuple[str, int | None], _Pictures] = {}
        self._renderer = Renderer("auto")

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(self._views)

    def nearest(self, camera: str, number: float) -> View:
        """Returns the view of a camera whose frame is nearest to a number of the sequence."""
        return min(self._views[camera], key=lambda view: abs((view.frame or 0) - number))

    def picture(self, camera: str, view: View, kind: str, figure: Figure) -> Shown:
        """Returns a picture of a view.

        Args:
            camera: its name.
            view: of that camera.
            kind: one of `KINDS`. An error is that against the truth, where the data have it; else against the input,
                where it shows the person.
            figure: whose avatar is drawn.

        Raises:
            OccfusionError: the data are not where they were.
        """
        if kind == "avatar":
            return Shown(to_uint8(self._draw(view, figure)), f"the avatar at frame {view.frame}")
        known = self._look_up(camera, view)
        if kind == "input":
            return Shown(to_uint8(known.rgb), f"what the data have of frame {view.frame}")
        if kind == "truth":
            if known.truth is None:
                black = np.zeros((*known.visible_mask.shape, 3), np.uint8)
                return Shown(black, "these data have no truth: nobody saw what is hidden")
            text = f"the truth of frame {view.frame}, without what hides the person"
            return Shown(to_uint8(known.truth), text)
        drawn = self._draw(view, figure)
        if known.truth is not None:
            squared = float((drawn.clamp(0, 1) - known.truth).square().mean())
            decibels = f"{-10 * math.log10(squared):.1f} dB" if squared > 0 else "none"
            text = f"error x{ERROR_GAIN:g} against the truth of frame {view.frame}; whole frame {decibels}"
            return Shown(to_uint8(error_map(drawn, known.truth)), text)
        seen = error_map(drawn, known.rgb) * known.visible_mask[..., None]
        where = f"the input of frame {view.frame}, where it shows the person: no truth is known"
        return Shown(to_uint8(seen), f"error x{ERROR_GAIN:g} against {where}")

    @torch.inference_mode()
    def _draw(self, view: View, figure: Figure) -> Tensor:
        own = figure.own
        assert own.clip.numbers is not None
        row = int(np.abs(own.clip.numbers - (view.frame or 0)).argmin())
        (shot,) = still(own, [row], [view], torch.eye(4), None)
        return self._renderer.draw(figure.at_home(own.pose(row), shot.camera.centre), shot.camera).rgb

    def _look_up(self, camera: str, view: View) -> _Pictures:
        key = (camera, view.frame)
        if key not in self._kept:
            if self._data is None:
                settings = self._run.settings
                data = make_data(settings, make_body(settings.body))
                data.setup()
                self._data = data
            assert view.frame is not None and view.camera_index is not None
            if camera == TRAINING:
                frame = self._data.train_frame(self._data.train_indices.index(view.frame))
            else:
                frame = self._data.test_frame(view.frame, view.camera_index)
            truth = None if frame.truth is None else frame.truth.rgb
            self._kept[key] = _Pictures(frame.rgb, frame.visible_mask, truth)
            if len(self._kept) > _MOST_KEPT:
                del self._kept[next(iter(self._kept))]  # the oldest
        return self._kept[key]
