"""A body in many poses at once: joints, and the points that a fit needs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from occfusion.geometry.rotation import axis_angle_to_matrix
from occfusion.human import Body


class BodyBatch:
    """Joints and chosen vertices of one person in many frames, differentiable; pose blend shapes are left out.

    Args:
        body: with 24 joints.
        vertices: which vertices are wanted, `[M]`.
    """

    def __init__(self, body: Body, vertices: NDArray[np.integer]) -> None:
        chosen = torch.as_tensor(vertices, dtype=torch.long)
        self.parents = body.parents
        self._template = body.v_template[chosen].float()
        self._shapedirs = body.shapedirs[chosen].float()
        self._weights = body.weights[chosen].float()
        self._joints = body.joint_template.float()
        self._joint_dirs = body.joint_dirs.float()

    def joints_at_rest(self, betas: Tensor) -> Tensor:
        """Returns the joints at rest, `[24, 3]`, metres."""
        return self._joints + self._joint_dirs[:, :, : len(betas)] @ betas

    def transforms(self, betas: Tensor, rotations: Tensor, transl: Tensor) -> tuple[Tensor, Tensor]:
        """Returns each joint's rotation `[N, 24, 3, 3]` and place `[N, 24, 3]`, in the world.

        Args:
            betas: `[B]`.
            rotations: of each joint relative to its parent, `[N, 24, 3, 3]`; the first about the pelvis.
            transl: added last, `[N, 3]`, metres.
        """
        return chain(rotations, self.joints_at_rest(betas), transl, self.parents)

    def points(self, betas: Tensor, turns: Tensor, places: Tensor) -> Tensor:
        """Returns the chosen vertices, `[N, M, 3]`, metres, for what `transforms` returned."""
        rest = self._template + self._shapedirs[:, :, : len(betas)] @ betas
        at_rest = self.joints_at_rest(betas)
        shift = places - (turns @ at_rest[..., None])[..., 0]
        count = len(turns)
        linear = self._weights @ turns.reshape(count, 24, 9)
        moved = (linear.reshape(count, -1, 3, 3) @ rest[..., None])[..., 0]
        return moved + self._weights @ shift


def chain(
    rotations: Tensor, at_rest: Tensor, transl: Tensor, parents: Sequence[int]
) -> tuple[Tensor, Tensor]:
    """Returns rotations `[N, J, 3, 3]` and places `[N, J, 3]` of a chain of joints in the world."""
    turns = [rotations[:, 0]]
    places = [at_rest[0] + transl]
    for joint in range(1, len(at_rest)):
        parent = parents[joint]
        turns.append(turns[parent] @ rotations[:, joint])
        places.append(places[parent] + turns[parent] @ (at_rest[joint] - at_rest[parent]))
    return torch.stack(turns, dim=1), torch.stack(places, dim=1)


def rotations_of(global_orient: Tensor, body_pose: Tensor) -> Tensor:
    """Returns `[N, 24, 3, 3]` of axis-angles `[N, 3]` and `[N, 69]`."""
    return axis_angle_to_matrix(torch.cat([global_orient[:, None], body_pose.reshape(-1, 23, 3)], dim=1))


def height_at_rest(body: Body, betas: Tensor) -> Tensor:
    """Returns the height of a body of that shape at rest, from the soles to the crown, `[]`, metres.

    Args:
        body: upright along y at rest.
        betas: `[B]`.
    """
    upright = body.v_template[:, 1] + body.shapedirs[:, 1, : len(betas)].to(betas) @ betas
    return upright.amax() - upright.amin()


def spread_vertices(body: Body, count: int) -> NDArray[np.int64]:
    """Returns vertices that lie far from each other (farthest-point sampling of the template), `[count]`."""
    points = body.v_template.double().numpy()
    chosen = [int(points[:, 1].argmax())]
    away = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(sorted(chosen))
