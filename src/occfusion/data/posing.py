"""The body at rest and in a frame's pose, for readers and checks."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from occfusion.data.scene import Array, BodyParameters

USUAL_BETAS = 10
"""Shape components of SMPL, where a body does not say how many it has."""


class RestBody(Protocol):
    """The part of a body that data need: vertices and joints for given parameters."""

    def __call__(
        self, betas: Tensor, global_orient: Tensor, body_pose: Tensor, transl: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Returns vertices `[V, 3]` and joints `[24, 3]` in metres."""


class AtRest(Protocol):
    """The part of a body that readers need.

    Attributes:
        num_betas: how many shape components it takes.
        stands_in: it is not the body that the data were made with, and its owner knows that.
    """

    num_betas: int
    stands_in: bool

    def pelvis(self, betas: Array) -> Array:
        """Returns the pelvis at rest for shape coefficients `[B]`, `[3]`, metres."""

    def joints(self, betas: Array) -> Array:
        """Returns the joints at rest for shape coefficients `[B]`, `[24, 3]`, metres."""


class Poser:
    """Asks a body for vertices and joints, in NumPy; remembers shapes at rest.

    Args:
        body: the body.
        stands_in: it is not the one that the data were made with: what needs that one is done roughly.
    """

    def __init__(self, body: RestBody, *, stands_in: bool = False) -> None:
        self._body = body
        self._rest: dict[bytes, tuple[Array, Array]] = {}
        self.num_betas: int = getattr(body, "num_betas", USUAL_BETAS)
        self.stands_in = stands_in

    @property
    def body(self) -> RestBody:
        """The body itself."""
        return self._body

    def pelvis(self, betas: Array) -> Array:
        """Returns the pelvis at rest for shape coefficients `[B]`, `[3]`, metres."""
        return self._at_rest(betas)[1][0]

    def joints(self, betas: Array) -> Array:
        """Returns the joints at rest for shape coefficients `[B]`, `[24, 3]`, metres."""
        return self._at_rest(betas)[1]

    def rest_vertices(self, betas: Array) -> Array:
        """Returns the vertices at rest, `[V, 3]`, metres."""
        return self._at_rest(betas)[0]

    @torch.no_grad()
    def pose(self, parameters: BodyParameters) -> tuple[Array, Array]:
        """Returns vertices `[V, 3]` and joints `[24, 3]` in the world, metres."""
        parts = (parameters.betas, parameters.global_orient, parameters.body_pose, parameters.transl)
        vertices, joints = self._body(*(torch.tensor(part, dtype=torch.float32) for part in parts))
        return vertices.double().cpu().numpy(), joints.double().cpu().numpy()

    def _at_rest(self, betas: Array) -> tuple[Array, Array]:
        key = betas.tobytes()
        if key not in self._rest:
            self._rest[key] = self.pose(BodyParameters(betas, np.zeros(3), np.zeros(69), np.zeros(3)))
        return self._rest[key]
