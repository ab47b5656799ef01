"""A brightness for each camera: one factor a colour channel that takes the avatar's colours to the camera's."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import torch
from torch import Tensor

from occfusion.quality.metrics import OCCUPIED
from occfusion.types import Frame, Rendering


@torch.inference_mode()
def camera_gains(
    render: Callable[[Frame], Rendering], frames: Iterable[Frame]
) -> dict[int, tuple[float, float, float] | None]:
    """Returns the gains of each camera, by its index: least squares over the person in all of its pictures.

    A pixel counts where the true mask and the rendering both show the person. None where no such pixel has any colour
    in some channel, so that nothing says what its gain is.

    Args:
        render: gives the picture over black at the size of the frame.
        frames: with their truth; those without do not count.
    """
    sums: dict[int, Tensor] = {}
    for frame in frames:
        found = sums.setdefault(frame.camera_index, torch.zeros(2, 3, dtype=torch.float64))
        if frame.truth is None:
            continue
        rendering = render(frame)
        person = frame.truth.mask.to(rendering.alpha.device) & (rendering.alpha > OCCUPIED)
        ours = rendering.rgb.clamp(0, 1)[person].double()
        truth = frame.truth.rgb.to(ours.device)[person].double()
        found += torch.stack([(ours * truth).sum(dim=0), ours.square().sum(dim=0)]).cpu()
    gains: dict[int, tuple[float, float, float] | None] = {}
    for camera, (product, square) in sums.items():
        red, green, blue = (product / square).tolist()
        gains[camera] = (red, green, blue) if bool((square > 0).all()) else None
    return gains


def with_gains(
    render: Callable[[Frame], Rendering], gains: dict[int, tuple[float, float, float] | None]
) -> Callable[[Frame], Rendering]:
    """Returns a renderer whose colours have the gain of the frame's camera; unchanged where that has none."""

    def rendered(frame: Frame) -> Rendering:
        rendering, gain = render(frame), gains.get(frame.camera_index)
        if gain is None:
            return rendering
        return replace(rendering, rgb=rendering.rgb * rendering.rgb.new_tensor(gain))

    return rendered
