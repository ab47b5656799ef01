"""The body at rest and in a frame's pose, and what joints at rest tell of a body."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from occfusion.data.scene import Array, BodyParameters
from occfusion.errors import DataError

USUAL_BETAS = 10
"""Shape components of SMPL, where a body does not say how many it has."""


class RestBody(Protocol):
    """The part of a body that data need: vertices and joints for given parameters."""

    def __call__(
        self, betas: Tensor, global_orient: Tensor, body_pose: Tensor, transl: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Returns vertices `[V, 3]` and joints `[24, 3]` in metres."""


class Poser:
    """Asks a body for vertices and joints, in NumPy; remembers shapes at rest.

    Attributes:
        body: the body.
        num_betas: how many shape components it takes.
        stands_in: it is not the one that the data were made with: what needs that one is done roughly.
    """

    def __init__(self, body: RestBody, *, stands_in: bool = False) -> None:
        self.body = body
        self._rest: dict[bytes, tuple[Array, Array]] = {}
        self.num_betas: int = getattr(body, "num_betas", USUAL_BETAS)
        self.stands_in = stands_in

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
        vertices, joints = self.body(*(torch.tensor(part, dtype=torch.float32) for part in parts))
        return vertices.double().cpu().numpy(), joints.double().cpu().numpy()

    def _at_rest(self, betas: Array) -> tuple[Array, Array]:
        key = betas.tobytes()
        if key not in self._rest:
            self._rest[key] = self.pose(BodyParameters(betas, np.zeros(3), np.zeros(69), np.zeros(3)))
        return self._rest[key]


ROUNDING = 1e-4
"""Largest distance, in metres, of a joint from the body's own that is rounding.

Joints of a person at rest lie within 2 m, where float32 has steps of 1.2e-7 m: this is 800 of them. The embedded
body meets its own joints within 2e-7 m, by the coefficients they were made with as by those that follow from them.
"""

ANOTHER_BODY = 2e-3
"""Distance, in metres, from which on a body is certainly another one and is refused.

Of the embedded body made 1 % wider, joints lie 8 mm off with the coefficients of the data, made 2 % larger 20 mm. With
coefficients that were fitted to the joints most of that is taken up: 1.9 and 1.5 mm are left, which is remarked only.
Between the two bounds a body may be the right one in another version, and is trained on.
"""

_STEP = 64.0
"""Betas by which the derivatives are taken: joints are linear in betas, and a long way loses fewer digits."""

_DETERMINED = 1e-5
"""Singular values below this share of the largest leave a direction of the shape open."""


def shape_from_joints(rest: Array, body: Poser) -> Array:
    """Returns the shape coefficients `[10]` whose joints at rest come nearest to `rest`, by least squares.

    With the embedded body (condition 195) and joints rounded to float32 they are right to 5e-6, vertices to 3e-8 m.
    Directions that move no joint stay 0. Whether it is the right body `joints_remark` says.

    Args:
        rest: joints at rest, `[24, 3]`, metres, anywhere.
        body: the body that they were made with.
    """
    count = min(USUAL_BETAS, body.num_betas)
    steps = np.eye(count) * _STEP
    columns = [_bones(body.joints(step)) - _bones(body.joints(-step)) for step in steps]
    directions = np.stack(columns, axis=1) / (2 * _STEP)
    wanted = _bones(rest) - _bones(body.joints(np.zeros(count)))
    return np.asarray(np.linalg.lstsq(directions, wanted, rcond=_DETERMINED)[0])


def joints_remark(given: Array, own: Array, where: str) -> str:
    """Returns a sentence where joints at rest that data hold are near the body's own but not the same, else nothing.

    Args:
        given: of the data, `[24, 3]`, metres, wherever the person stands.
        own: the body's, with the shape coefficients of the same person, `[24, 3]`, metres.
        where: what messages call the given joints.

    Raises:
        DataError: the largest distance is above `ANOTHER_BODY`; gives it in millimetres.
    """
    apart = np.linalg.norm((_bones(given) - _bones(own)).reshape(-1, 3), axis=1)
    if apart.max() <= ROUNDING:
        return ""
    text = (
        f"{where}: joint {int(apart.argmax()) + 1} is {apart.max() * 1000:.3g} mm from where the body has it "
        f"(mean of all joints {apart.mean() * 1000:.3g} mm)"
    )
    if apart.max() <= ANOTHER_BODY:
        return (
            f"{text}, more than the {ROUNDING * 1000:g} mm of rounding: another version or sex of the body?"
        )
    raise DataError(
        f"{text}, and more than {ANOTHER_BODY * 1000:g} mm are refused: these joints were made with another body file. "
        "Name that one (body.path in training, --body of check): the same sex, the same version. For ZJU-MoCap and "
        "OcMotion it is the neutral SMPL with 10 coefficients."
    )


def _bones(joints: Array) -> Array:
    """Returns joints 1 to 23 as seen from the pelvis, `[69]`."""
    return (joints[1:] - joints[:1]).reshape(-1)
