"""What an inpainter is given of a partly hidden person, and the interface of those who inpaint (paper §4.3)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.errors import NumericsError
from occfusion.human.avatar import Avatar
from occfusion.human.rendering import Renderer
from occfusion.inpaint.accumulation import Accumulated
from occfusion.observation.frames import Observation
from occfusion.types import Frame

Picture = NDArray[np.float32]
Mask = NDArray[np.bool_]

SOLID = 0.65
"""Coarse occupancy from which a pixel that is not seen counts as the hidden person (the authors' code)."""

KNOWN = 0.5
"""Share of a pixel's Gaussians that other frames show, from which on it needs no reference."""


@dataclass(frozen=True)
class Partial:
    """A frame, and the coarse avatar in its place.

    Attributes:
        observation: what is seen, the camera and the body.
        complete: the person's mask: M-hat where a stage made it, else M; bool `[H, W]`.
        coarse: the coarse rendering over black, `[H, W, 3]`, 0..1.
        alpha: its occupancy, `[H, W]`, 0..1.
        draw_gathered: draws the avatar in the colours that the whole video shows of it.
        seen: how well each place of the avatar is known from the video, times its occupancy, `[H, W]`, 0..1.
    """

    observation: Observation
    complete: Mask
    coarse: Picture
    alpha: Picture
    draw_gathered: Callable[[], Picture]
    seen: Picture

    @property
    def gathered(self) -> Picture:
        """The avatar in the colours that the whole video shows of it, over black, `[H, W, 3]`, 0..1; drawn for it."""
        return self.draw_gathered()

    @property
    def region(self) -> Mask:
        """The paper's R = (1 - M) A: pixels of the person that are not seen, bool `[H, W]`."""
        return ~self.observation.visible & (self.alpha > SOLID)

    @property
    def unseen(self) -> Mask:
        """Where R shows what no frame of the video does: what was seen makes up less than half, bool `[H, W]`."""
        return self.region & (self.seen < KNOWN * self.alpha)


class Inpainter(ABC):
    """An interface: paints what is hidden of a person."""

    name: str

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """Returns all that decides its pictures, for the manifest: plain numbers and text."""

    @abstractmethod
    def inpaint(self, partial: Partial) -> Picture:
        """Returns the whole person over black, `[H, W, 3]`, 0..1; only `partial.region` of it is used."""


@torch.no_grad()
def take_partial(
    avatar: Avatar, accumulated: Accumulated, frame: Frame, observation: Observation, renderer: Renderer
) -> Partial:
    """Returns a frame with the avatar rendered in its pose: in its own colours and in those of the video."""
    device = avatar.gaussians.means.device
    camera = frame.camera.to(device)
    cloud = avatar(frame.pose.to(device), camera.centre)

    def render(colors: torch.Tensor) -> tuple[Picture, Picture]:
        made = renderer.draw(replace(cloud, colors=colors), camera)
        return made.rgb.clamp(0.0, 1.0).cpu().numpy(), made.alpha.cpu().numpy()

    coarse, alpha = render(cloud.colors)

    @torch.no_grad()
    def gathered() -> Picture:
        return render(accumulated.colors.to(cloud.colors))[0]

    seen, _ = render(accumulated.seen.to(cloud.colors)[:, None].expand(-1, 3).contiguous())
    mask = frame.visible_mask if frame.complete_mask is None else frame.complete_mask
    return Partial(observation, mask.cpu().numpy(), coarse, alpha, gathered, seen[..., 0])


def checked_picture(inpainter: Inpainter, partial: Partial) -> Picture:
    """Returns the frame as the complete person: what is seen as it is, the region painted, black elsewhere.

    Raises:
        NumericsError: the inpainter returned a value that is not finite, or a picture of another size.
    """
    made, name = inpainter.inpaint(partial), partial.observation.name
    if made.shape != partial.coarse.shape:
        raise NumericsError(
            f"inpainter {inpainter.name}, frame {name}: a picture of shape {list(made.shape)} for one of "
            f"{list(partial.coarse.shape)}"
        )
    if not np.isfinite(made).all():
        raise NumericsError(
            f"inpainter {inpainter.name}, frame {name}: {int((~np.isfinite(made)).sum())} values are not finite; "
            f"the pictures finished before stay. With prior=sd15 try prior.dtype=float32"
        )
    observation = partial.observation
    whole = np.where(observation.visible[..., None], observation.rgb, 0.0)
    return np.where(partial.region[..., None], np.clip(made, 0.0, 1.0), whole).astype(np.float32)


class CoarsePictures(Inpainter):
    """Leaves the hidden part as the coarse avatar shows it: what refinement gains without inpainting."""

    name = "coarse"

    def describe(self) -> dict[str, Any]:
        """Returns the name."""
        return {"inpainter": self.name}

    def inpaint(self, partial: Partial) -> Picture:
        """Returns the coarse rendering."""
        return partial.coarse


class TruthPictures(Inpainter):
    """Shows what the occluder hides: an upper bound.

    Args:
        pictures: the unoccluded person of each frame by the frame's name, `[H, W, 3]`, 0..1.
    """

    name = "truth"

    def __init__(self, pictures: Mapping[str, NDArray[np.float32]]) -> None:
        self._pictures = pictures

    def describe(self) -> dict[str, Any]:
        """Returns the name."""
        return {"inpainter": self.name}

    def inpaint(self, partial: Partial) -> Picture:
        """Returns the true picture."""
        return self._pictures[partial.observation.name]
