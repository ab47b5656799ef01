"""The free body at full resolution, from which ground truth is rendered; and its skinning, in numpy.

y up, z forward, metres, T-pose, pelvis at the origin. Skin, eyes, and two helper meshes that wear hair
and skirt. Places on the body are named by where they lie on the *template* (`FullBody.template`),
which is the same for all people: a sleeve ends at |x| = 0.33 whatever the wearer's size.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from io import BytesIO

import numpy as np
from numpy.typing import NDArray

from occfusion.errors import DataError
from occfusion.synth.rotations import Floats, matrix_from_axis_angle

NUM_JOINTS = 24
NUM_SHAPES = 10
GROUPS = ("body", "helper-l-eye", "helper-r-eye", "helper-skirt", "helper-hair")
SKIN, LEFT_EYE, RIGHT_EYE, SKIRT, HAIR = range(len(GROUPS))

Ints = NDArray[np.int64]


@dataclass(frozen=True)
class FullBody:
    """The full body, cut down to the vertices that are drawn.

    Attributes:
        template: `[V, 3]`.
        shapedirs: `[V, 3, 10]`.
        weights: `[V, 24]`.
        J_template: joints of the template, `[24, 3]`.
        J_dirs: `[24, 3, 10]`; joints are exactly `J_template + J_dirs @ betas`.
        parents: `[24]`, -1 for the pelvis.
        faces: `[F, 3]`, all groups.
        face_group: group of each face, `[F]`.
        vertex_group: group of each vertex, `[V]`.
        uv: texture coordinates, `[U, 2]`, 0..1.
        face_uv: `[F, 3]` into `uv`.
    """

    template: Floats
    shapedirs: Floats
    weights: Floats
    J_template: Floats
    J_dirs: Floats
    parents: Ints
    faces: Ints
    face_group: Ints
    vertex_group: Ints
    uv: Floats
    face_uv: Ints


@dataclass(frozen=True)
class ModelBody:
    """The body of 6890 vertices that avatars are built on.

    Attributes:
        template: `[6890, 3]`.
        shapedirs: `[6890, 3, 10]`.
        regressor: `[24, 6890]`.
        weights: `[6890, 24]`.
        parents: `[24]`, -1 for the pelvis.
        faces: `[13776, 3]`.
    """

    template: Floats
    shapedirs: Floats
    regressor: Floats
    weights: Floats
    parents: Ints
    faces: Ints


def asset_bytes(name: str) -> bytes:
    """Returns a file of the package's data.

    Raises:
        DataError: it is not there.
    """
    try:
        return (files("occfusion") / "assets" / name).read_bytes()
    except FileNotFoundError:
        raise DataError(f"occfusion/assets/{name} is missing from the installation; install again.") from None


def asset_arrays(name: str) -> dict[str, NDArray[np.generic]]:
    """Returns the arrays of an `.npz` file of the package."""
    with np.load(BytesIO(asset_bytes(name)), allow_pickle=False) as content:
        return {key: content[key] for key in content.files}


@cache
def load_full_body() -> FullBody:
    """Returns the full body; read once a process."""
    data = asset_arrays("free_body_full.npz")
    faces = np.concatenate([data[f"f_{g}"] for g in GROUPS]).astype(np.int64)
    face_uv = np.concatenate([data[f"ft_{g}"] for g in GROUPS]).astype(np.int64)
    face_group = np.concatenate([np.full(len(data[f"f_{g}"]), k) for k, g in enumerate(GROUPS)])
    used, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3)
    vertex_group = np.zeros(len(used), np.int64)
    vertex_group[faces.ravel()] = np.repeat(face_group, 3)
    weights = np.zeros((len(used), NUM_JOINTS))
    np.add.at(
        weights,
        (np.arange(len(used))[:, None], data["w_idx"][used].astype(np.int64)),
        data["w_val"][used].astype(np.float64),
    )
    return FullBody(
        template=data["v_template"][used].astype(np.float64),
        shapedirs=data["shapedirs"][used].astype(np.float64),
        weights=weights / weights.sum(1, keepdims=True),
        J_template=data["J_template"].astype(np.float64),
        J_dirs=data["J_dirs"].astype(np.float64),
        parents=data["parents"].astype(np.int64),
        faces=faces,
        face_group=face_group,
        vertex_group=vertex_group,
        uv=data["uv"].astype(np.float64),
        face_uv=face_uv,
    )


@cache
def load_model_body() -> ModelBody:
    """Returns the body of 6890 vertices; read once a process."""
    data = asset_arrays("free_body.npz")
    parents = data["kintree_table"][0].astype(np.int64)
    parents[0] = -1
    return ModelBody(
        template=data["v_template"].astype(np.float64),
        shapedirs=data["shapedirs"].astype(np.float64),
        regressor=data["J_regressor"].astype(np.float64),
        weights=data["weights"].astype(np.float64),
        parents=parents,
        faces=data["f"].astype(np.int64),
    )


def bone_transforms(poses: Floats, joints: Floats, parents: Ints) -> Floats:
    """Returns what carries points from rest to pose, `[24, 4, 4]`.

    Args:
        poses: axis-angles of the 24 joints, `[72]`; the first turns about the pelvis.
        joints: joints at rest, `[24, 3]`.
        parents: `[24]`, each before its child.
    """
    rotations = matrix_from_axis_angle(poses.reshape(-1, 3))
    out = np.zeros((len(joints), 4, 4))
    out[:, 3, 3] = 1.0
    out[0, :3, :3] = rotations[0]
    out[0, :3, 3] = joints[0] - rotations[0] @ joints[0]
    for j in range(1, len(joints)):
        local = np.eye(4)
        local[:3, :3] = rotations[j]
        local[:3, 3] = joints[j] - rotations[j] @ joints[j]
        out[j] = out[parents[j]] @ local
    return out


def skin(points: Floats, weights: Floats, transforms: Floats) -> Floats:
    """Returns the points under linear blend skinning, `[V, 3]`."""
    blended = weights @ transforms[:, :3].reshape(len(transforms), 12)
    blended = blended.reshape(-1, 3, 4)
    return np.einsum("vij,vj->vi", blended[:, :, :3], points) + blended[:, :, 3]
