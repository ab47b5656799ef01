"""Random bodies and poses, small enough for slow oracles."""

from __future__ import annotations

import numpy as np
import torch

from occfusion.files.bodyfile import BodyArrays
from occfusion.types import Pose

PARENTS = np.array([-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21])


def make_arrays(vertices: int = 40, *, pose_shapes: bool = True, seed: int = 0) -> BodyArrays:
    """A random body: a cloud of vertices hung on a random tree, 10 shape components."""
    rng = np.random.default_rng(seed)
    weights = rng.random((vertices, 24)) ** 6
    regressor = rng.random((24, vertices))
    regressor /= regressor.sum(axis=1, keepdims=True)
    template = rng.normal(size=(vertices, 3)) * [0.3, 0.5, 0.15]
    shapes = rng.normal(size=(vertices, 3, 10)) * 0.02
    return BodyArrays(
        v_template=template,
        shapedirs=shapes,
        posedirs=rng.normal(size=(vertices, 3, 207)) * 0.005 if pose_shapes else None,
        J_regressor=regressor,
        J_template=regressor @ template + rng.normal(size=(24, 3)) * 0.2,
        J_dirs=np.einsum("jv,vcb->jcb", regressor, shapes),
        weights=weights / weights.sum(axis=1, keepdims=True),
        parents=PARENTS,
        faces=rng.integers(0, vertices, (30, 3)),
    )


def make_pose(
    seed: int = 0, *, angle: float = 0.4, betas: int = 10, dtype: torch.dtype = torch.float64
) -> Pose:
    generator = torch.Generator().manual_seed(seed)

    def draw(n: int) -> torch.Tensor:
        return torch.randn(n, generator=generator, dtype=torch.float64).to(dtype)

    return Pose(draw(betas), draw(3), draw(69) * angle, draw(3))
