"""The body: SMPL's form, smplx's conventions (paper §3.1)."""

from __future__ import annotations

import hashlib
import math
from copy import copy
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from occfusion.errors import DataError
from occfusion.files.bodyfile import NUM_JOINTS, BodyArrays, load_body_arrays
from occfusion.geometry.rotation import axis_angle_to_matrix
from occfusion.geometry.skinning import blend, bone_transforms, posed_joints, skin_points
from occfusion.types import Pose

EMBEDDED_BODY = "free_body.npz"

DA_POSE = ((1, math.radians(45)), (2, math.radians(-45)), (7, math.radians(-30)), (8, math.radians(30)))
"""GauHuman's canonical pose, legs apart: `(joint, turn about z in radians)`.

All its turns are about z and stay within 45 degrees along every chain, so the linear part of any convex blend
of its bone transforms is `c, s` in the x-y plane with `c >= cos 45`: its determinant is at least 1/2, and its
inverse always exists.
"""


Betas = TypeVar("Betas", Tensor, NDArray[Any])


class Rest(NamedTuple):
    """A body before posing: `vertices [V, 3]` and `joints [24, 3]`, metres."""

    vertices: Tensor
    joints: Tensor


class Body(nn.Module):
    """A skinned body with 24 joints and shape components, and pose blend shapes if the file has them.

    All arrays are buffers left out of state dicts: an avatar's checkpoint does not carry a copy of a body
    whose licence may forbid it.

    Args:
        arrays: the checked content of a body file.
        dtype: floating point type of the buffers.
        cut_betas: leave out shape components that are given and that the body does not have; else an error.
    """

    v_template: Tensor
    shapedirs: Tensor
    posedirs: Tensor | None
    joint_template: Tensor
    joint_dirs: Tensor
    weights: Tensor
    faces: Tensor

    def __init__(
        self, arrays: BodyArrays, dtype: torch.dtype = torch.float32, cut_betas: bool = False
    ) -> None:
        super().__init__()
        self.cut_betas = cut_betas
        self.parents: tuple[int, ...] = tuple(int(parent) for parent in arrays.parents)
        floats = {
            "v_template": arrays.v_template,
            "shapedirs": arrays.shapedirs,
            "posedirs": arrays.posedirs,
            "joint_template": arrays.J_template,
            "joint_dirs": arrays.J_dirs,
            "weights": arrays.weights,
        }
        for name, array in floats.items():
            # a copy: arrays may be read-only
            tensor = None if array is None else torch.tensor(array, dtype=dtype)
            self.register_buffer(name, tensor, persistent=False)
        self.register_buffer("faces", torch.tensor(arrays.faces), persistent=False)

    @property
    def num_vertices(self) -> int:
        """Vertices of the template."""
        return len(self.v_template)

    @property
    def num_betas(self) -> int:
        """Shape components the body has."""
        return self.shapedirs.shape[2]

    def forward(
        self, betas: Tensor, global_orient: Tensor, body_pose: Tensor, transl: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Returns posed vertices `[V, 3]` and joints `[24, 3]` in metres, in the conventions of smplx.

        Args:
            betas: shape components, `[B]`; fewer than the body has are completed with zeros, more are left out
                where they are zero.
            global_orient: rotation about the pelvis joint as axis-angle, `[3]`, radians.
            body_pose: axis-angles of joints 1 to 23 relative to their parents, `[69]` or `[23, 3]`, radians.
            transl: added last, `[3]`, metres.

        Raises:
            DataError: betas that are not zero beyond those the body has, or inputs of another shape.
        """
        rotations = self.rotations(global_orient, body_pose)
        rest = self.rest(betas)
        transforms = bone_transforms(rotations, rest.joints, self.parents)
        points = rest.vertices + self.pose_offsets(rotations)
        vertices = skin_points(points, blend(self.weights, transforms))
        return vertices + transl, posed_joints(transforms, rest.joints) + transl

    def rest(self, betas: Tensor) -> Rest:
        """Returns the shaped body in its rest pose, without pose blend shapes.

        Raises:
            DataError: as `check_betas`.
        """
        betas = self.check_betas(betas)
        return Rest(
            self.v_template + self.shapedirs[:, :, : len(betas)] @ betas,
            self.joint_template + self.joint_dirs[:, :, : len(betas)] @ betas,
        )

    def check_betas(self, betas: Tensor) -> Tensor:
        """Returns the shape components that the body has, as a vector in its dtype.

        Raises:
            DataError: it is no vector, or is not zero beyond the body's components, unless they are to be left out.
        """
        if betas.dim() != 1:
            raise DataError(
                f"betas of shape {list(betas.shape)}: a body takes one vector of shape components"
            )
        return leading_betas(betas, self.num_betas, "betas", cut=self.cut_betas).to(self.v_template)

    def rotations(self, global_orient: Tensor, body_pose: Tensor) -> Tensor:
        """Returns the rotation of each joint relative to its parent, `[24, 3, 3]`, where the angles are.

        Raises:
            DataError: not 3 and 69 numbers.
        """
        if global_orient.numel() != 3 or body_pose.numel() != 3 * (NUM_JOINTS - 1):
            raise DataError(
                f"pose of {global_orient.numel()} + {body_pose.numel()} numbers; expected 3 for the root and "
                f"{3 * (NUM_JOINTS - 1)} for the other {NUM_JOINTS - 1} joints"
            )
        axis_angles = torch.cat([global_orient.reshape(1, 3), body_pose.reshape(-1, 3)])
        return axis_angle_to_matrix(axis_angles.to(self.v_template.dtype), compiled=True)

    def pose_offsets(self, rotations: Tensor) -> Tensor:
        """Returns the pose blend shapes at `rotations [24, 3, 3]`: `[V, 3]`, metres; zero without any."""
        if self.posedirs is None:
            return torch.zeros_like(self.v_template)
        identity = torch.eye(3, dtype=rotations.dtype, device=rotations.device)
        return self.posedirs @ (rotations[1:] - identity).flatten()

    def da_rotations(self) -> Tensor:
        """Returns the joint rotations of the canonical Da pose, `[24, 3, 3]`."""
        pose = self.da_pose()
        return self.rotations(pose.global_orient, pose.body_pose)

    def da_transforms(self) -> Tensor:
        """Returns the bone transforms from rest to the Da pose of the mean shape, `[24, 4, 4]`."""
        return bone_transforms(self.da_rotations(), self.joint_template, self.parents)

    def da_vertices(self) -> Tensor:
        """Returns the mean-shape body in the Da pose, `[V, 3]`, metres: where Gaussians start."""
        points = self.v_template + self.pose_offsets(self.da_rotations())
        return skin_points(points, blend(self.weights, self.da_transforms()))

    def da_pose(self) -> Pose:
        """Returns the Da pose as body parameters of the mean shape."""
        axis_angles = torch.zeros_like(self.joint_template)
        for joint, turn in DA_POSE:
            axis_angles[joint, 2] = turn
        zeros = torch.zeros_like(axis_angles[0])
        return Pose(zeros.new_zeros(0), zeros, axis_angles[1:].flatten(), zeros)

    def digest(self) -> str:
        """Returns a hash of all arrays at float32: what an avatar file names its body by."""
        content = hashlib.sha256()
        for name, tensor in self.named_buffers(recurse=False):
            plain = tensor.detach().cpu()
            plain = plain.float() if plain.is_floating_point() else plain.int()
            content.update(f"{name}{list(plain.shape)}".encode())
            content.update(plain.contiguous().numpy().tobytes())
        content.update(str(self.parents).encode())
        return content.hexdigest()[:32]


def leading_betas(betas: Betas, count: int, where: str, *, cut: bool = False) -> Betas:
    """Returns the shape components that a body has; exact where the others are zero.

    Motion of AMASS has 16 numbers, SMPL 1.0 has 10 components and SMPL 1.1 has 300.

    Args:
        betas: `[B]`, or `[N, B]` for several moments.
        count: components the body has; fewer numbers come back as they are.
        where: what errors call the numbers, such as file and key.
        cut: leave out what is not zero too.

    Raises:
        DataError: a number beyond `count` is not zero (or not finite), and `cut` is not set.
    """
    given = betas.shape[-1]
    if given <= count:
        return betas
    if not cut and bool((betas[..., count:] != 0).any()):
        raise DataError(
            f"{where}: {given} shape components, and the body has {count}; the last {given - count} are not all zero. "
            f"Use a body file with {given} or more (SMPL 1.1 has 300), or leave the last ones out with "
            "body.cut_betas=true (in Python: cut_betas=True): the figure then differs slightly from the one that "
            "was measured."
        )
    return betas[..., :count]


def without_pose_blend_shapes(body: Body) -> Body:
    """Returns a body that shares all arrays but the pose blend shapes, for parameters that were fitted without them."""
    plain = copy(body)
    plain._buffers = {**body._buffers, "posedirs": None}
    return plain


def load_body(path: Path | str, dtype: torch.dtype = torch.float32, *, cut_betas: bool = False) -> Body:
    """Returns the body of a `.npz`, `.safetensors` or official `.pkl` file with SMPL's keys.

    Args:
        path: the file.
        dtype: floating point type of the body.
        cut_betas: leave out shape components that are given and that the body does not have; else an error.

    Raises:
        DataError: the file is missing, unsafe, damaged, or no body with 24 joints.
    """
    return Body(load_body_arrays(path), dtype, cut_betas)


def embedded_body(dtype: torch.dtype = torch.float32) -> Body:
    """Returns the free body that comes with the package (CC0, see `assets/NOTICE.md`)."""
    with resources.as_file(resources.files("occfusion") / "assets" / EMBEDDED_BODY) as path:
        return load_body(path, dtype)
