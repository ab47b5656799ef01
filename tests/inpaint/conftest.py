"""A small avatar in front of a camera, and frames of it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from made_up_person import made_up_camera
from occfusion.human import Avatar, Body
from occfusion.human.rendering import Renderer
from occfusion.types import Frame, Pose
from oracles.people import make_arrays

SIZE = 48


def standing() -> Pose:
    """In front of the made-up camera, upright."""
    return Pose(
        torch.zeros(10), torch.tensor([np.pi, 0.0, 0.0]), torch.zeros(69), torch.tensor([0.0, 0.0, 4.0])
    )


@pytest.fixture
def avatar() -> Avatar:
    generator = torch.Generator().manual_seed(3)
    made = Avatar(Body(make_arrays(), torch.float32), sh_degree=0, refine_pose=False, learn_skinning=False)
    with torch.no_grad():
        made.gaussians.sh0.copy_(torch.randn(made.gaussians.sh0.shape, generator=generator))
        made.gaussians.opacity_logits.fill_(1.0)
    return made.eval()


MakeFrame = Callable[..., Frame]


@pytest.fixture
def make_frame(avatar: Avatar) -> MakeFrame:
    """Makes a frame that shows the avatar itself, hidden where `hidden [H, W]` says so."""

    def make(index: int = 0, hidden: torch.Tensor | None = None) -> Frame:
        camera = made_up_camera(SIZE)
        pose = standing()
        with torch.no_grad():
            made = Renderer("torch").draw(avatar(pose, camera.centre), camera)
        person = made.alpha > 0.5
        visible = person if hidden is None else person & ~hidden
        rgb = made.rgb.float().clamp(0.0, 1.0)
        return Frame(
            index, 0, f"{index:06d}", rgb * visible[..., None], visible, None, person, None, camera, pose
        )

    return make
