"""A body's mesh in a pose, in float64 and without gradients: videos are looked at by some thousands of them.

`Body` is the specification. Its forward pass takes three times as long: a vertex hangs on four joints of 24.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array

from occfusion.cpu.compilation import kernel
from occfusion.files.bodyfile import NUM_JOINTS
from occfusion.geometry.rotation_kernels import fill_rotations
from occfusion.geometry.skinning_kernels import fill_bones
from occfusion.geometry.winding import is_closed
from occfusion.human.body import Body
from occfusion.types import Pose

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class PosedMesh:
    """The mesh, and the motions of bones that it follows.

    Attributes:
        vertices: in the world, `[V, 3]`, metres.
        joints: `[24, 3]`, metres.
        turns: of the bones from rest, `[24, 3, 3]`.
        shifts: of the bones, behind the turns and before the place, `[24, 3]`, metres.
        rest: vertices of the shape, `[V, 3]`, without pose blend shapes.
        rest_joints: of the shape, `[24, 3]`.
    """

    vertices: Floats
    joints: Floats
    turns: Floats
    shifts: Floats
    rest: Floats
    rest_joints: Floats


class MeshPoser:
    """Poses a body's mesh; a body has one (`mesh_poser`), which keeps its numbers in float64.

    Attributes:
        body: the body.
        faces: triangles, int32 `[F, 3]`.
        closed: whether they enclose the mesh (`is_closed`).
        directions: of shape components, `[V, 3, B]`.
        joint_directions: of the joints, `[24, 3, B]`.
    """

    def __init__(self, body: Body) -> None:
        self.body = body
        weights, self._template, self._joints, self.directions, self.joint_directions = (
            part.double().cpu().numpy()
            for part in (body.weights, body.v_template, body.joint_template, body.shapedirs, body.joint_dirs)
        )
        self.faces = np.ascontiguousarray(body.faces.cpu().numpy(), np.int32)
        self.closed = is_closed(self._template, self.faces)
        sparse = csr_array(weights)
        self._sparse = sparse.indptr.astype(np.int64), sparse.indices.astype(np.int64), sparse.data
        self._parents = np.array(body.parents, np.int64)
        self._rest: tuple[bytes, Floats, Floats] | None = None

    def pose(self, pose: Pose, turns: Floats | None = None, shift: Floats | None = None) -> PosedMesh:
        """Returns the mesh in a pose.

        Args:
            pose: as given.
            turns: multiplied from the right, axis-angles `[24, 3]`, radians; None: none.
            shift: added to the place, `[3]`, metres; None: none.

        Raises:
            DataError: as `Body.check_betas`.
        """
        given = torch.cat([pose.global_orient.reshape(1, 3), pose.body_pose.reshape(-1, 3)])
        rotations = _rotations(given.double().cpu().numpy())
        if turns is not None:
            rotations = rotations @ _rotations(turns)
        rest, rest_joints = self._at_rest(self.body.check_betas(pose.betas).double().cpu().numpy())
        motion, joints = np.empty((NUM_JOINTS, 3, 3)), np.empty((NUM_JOINTS, 3))
        transforms = np.empty((NUM_JOINTS, 4, 4))
        fill_bones(rotations, rest_joints, self._parents, transforms, motion, joints)
        shifts = transforms[:, :3, 3].copy()
        place = pose.transl.double().cpu().numpy()
        if shift is not None:
            place = place + shift
        points = rest
        if self.body.posedirs is not None:
            offsets = self.body.pose_offsets(torch.from_numpy(rotations).to(self.body.v_template))
            points = rest + offsets.double().cpu().numpy()
        vertices = np.empty_like(points)
        _skin(points, *self._sparse, motion, shifts, place, vertices)
        return PosedMesh(vertices, joints + place, motion, shifts, rest, rest_joints)

    def derivatives(self, mesh: PosedMesh, chosen: NDArray[np.int64], along: Floats) -> tuple[Floats, Floats]:
        """Returns how far vertices move along directions with each turn `[N, 72]` and each shape component `[N, B]`.

        They are those of linear blend skinning, written out. Pose blend shapes are left out of them: they move an
        outline by less than it can be told.

        Args:
            mesh: of a pose; turns are multiplied from the right.
            chosen: vertices, `[N]`.
            along: the direction of each, `[N, 3]`.
        """
        by_turns = np.zeros((len(chosen), 3 * NUM_JOINTS))
        by_shape = np.zeros((len(chosen), self.directions.shape[2]))
        _fill_derivatives(
            np.asarray(chosen, np.int64), np.ascontiguousarray(along), *self._sparse, self._parents, mesh.turns,
            mesh.shifts, mesh.rest, mesh.rest_joints, self.directions, self.joint_directions, by_turns, by_shape,
        )  # fmt: skip
        return by_turns, by_shape

    def _at_rest(self, betas: Floats) -> tuple[Floats, Floats]:
        """Returns vertices and joints of a shape; that of the last call, which is that of the sequence, is kept."""
        key, kept = betas.tobytes(), self._rest
        if kept is None or kept[0] != key:
            vertices = self._template + self.directions[..., : len(betas)] @ betas
            joints = self._joints + self.joint_directions[..., : len(betas)] @ betas
            self._rest = kept = key, vertices, joints
        return kept[1:]  # of this call: several threads ask


@lru_cache(2)
def mesh_poser(body: Body) -> MeshPoser:
    """Returns what poses a body's mesh: asked for each frame of a sequence, several times."""
    with torch.no_grad():
        return MeshPoser(body)


def _rotations(vectors: Floats) -> Floats:
    out = np.empty((len(vectors), 3, 3))
    fill_rotations(vectors, out)
    return out


@kernel
def _skin(
    points: Floats,
    firsts: NDArray[np.int64],
    bones: NDArray[np.int64],
    weights: Floats,
    turns: Floats,
    shifts: Floats,
    place: Floats,
    vertices: Floats,
) -> None:
    for v in range(len(points)):
        x, y, z = points[v, 0], points[v, 1], points[v, 2]
        for i in range(3):
            total = place[i]
            for at in range(firsts[v], firsts[v + 1]):
                k = bones[at]
                total += weights[at] * (
                    turns[k, i, 0] * x + turns[k, i, 1] * y + turns[k, i, 2] * z + shifts[k, i]
                )
            vertices[v, i] = total


@kernel
def _fill_derivatives(
    chosen: NDArray[np.int64],
    along: Floats,
    firsts: NDArray[np.int64],
    bones: NDArray[np.int64],
    weights: Floats,
    parents: NDArray[np.int64],
    turns: Floats,
    shifts: Floats,
    rest: Floats,
    rest_joints: Floats,
    directions: Floats,
    joint_directions: Floats,
    by_turns: Floats,
    by_shape: Floats,
) -> None:
    count, components = len(parents), directions.shape[2]
    joints = np.empty((count, 3))
    # how bones shift with the shape: places of joints are linear in joints at rest, and the root stays where it is
    moved = np.empty((count, 3, components))
    for m in range(count):
        above = parents[m]
        for i in range(3):
            joints[m, i] = shifts[m, i]
            for k in range(3):
                joints[m, i] += turns[m, i, k] * rest_joints[m, k]
            for b in range(components):
                moved[m, i, b] = joint_directions[m, i, b]
                if above >= 0:
                    moved[m, i, b] = moved[above, i, b]
                    for k in range(3):
                        moved[m, i, b] += turns[above, i, k] * joint_directions[m, k, b]
        for i in range(3):
            for b in range(components):
                for k in range(3):
                    moved[m, i, b] -= turns[m, i, k] * joint_directions[m, k, b]
    arms, share = np.empty((count, 3)), np.empty(count)
    for n in range(len(chosen)):
        v, u = chosen[n], along[n]
        arms[:], share[:] = 0.0, 0.0
        for at in range(firsts[v], firsts[v + 1]):
            bone, weight = bones[at], weights[at]
            # where this bone alone would have the vertex, summed over what it hangs on
            for i in range(3):
                place = shifts[bone, i]
                for k in range(3):
                    place += turns[bone, i, k] * rest[v, k]
                joint = bone
                while joint >= 0:
                    arms[joint, i] += weight * place
                    joint = parents[joint]
            joint = bone
            while joint >= 0:
                share[joint] += weight
                joint = parents[joint]
            for j in range(3):
                back = weight * (
                    turns[bone, 0, j] * u[0] + turns[bone, 1, j] * u[1] + turns[bone, 2, j] * u[2]
                )
                for b in range(components):
                    by_shape[n, b] += back * directions[v, j, b] + weight * u[j] * moved[bone, j, b]
        for joint in range(count):
            if share[joint] == 0.0:
                continue
            x, y, z = (
                arms[joint, 0] - share[joint] * joints[joint, 0],
                arms[joint, 1] - share[joint] * joints[joint, 1],
                arms[joint, 2] - share[joint] * joints[joint, 2],
            )
            # a turn multiplied from the right turns about an axis of the joint as it stands, and
            # direction . (axis x arm) = axis . (arm x direction)
            p, q, r = y * u[2] - z * u[1], z * u[0] - x * u[2], x * u[1] - y * u[0]
            for i in range(3):
                by_turns[n, 3 * joint + i] = (
                    turns[joint, 0, i] * p + turns[joint, 1, i] * q + turns[joint, 2, i] * r
                )
