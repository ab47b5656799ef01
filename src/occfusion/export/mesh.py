"""Meshes of an avatar: `.obj` with colours, and `.glb` with a skeleton that plays its motions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from occfusion.export.surface import Surface
from occfusion.files.atomic import write_bytes
from occfusion.files.glb import INDICES, VERTICES, Glb
from occfusion.geometry.normals import vertex_normals
from occfusion.geometry.rotation import matrix_to_quaternion
from occfusion.human import Avatar
from occfusion.motion import USUAL_FPS, Performance

BONES_PER_VERTEX = 4
"""What every program reads."""
JOINTS = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle",
    "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hand", "right_hand",
)  # fmt: skip
"""Names of SMPL's joints."""


def write_obj(path: Path, vertices: Tensor, surface: Surface) -> None:
    """Writes a mesh with a colour a vertex, whole or not at all.

    Raises:
        DataError: the disk refuses.
    """
    import trimesh

    colors = (255 * surface.colors).round().byte().numpy()
    mesh = trimesh.Trimesh(vertices.numpy(), surface.faces, vertex_colors=colors, process=False)
    text = trimesh.exchange.obj.export_obj(mesh, include_normals=True, include_texture=False)
    write_bytes(path, str(text).encode())


@torch.no_grad()
def write_skinned_glb(
    path: Path, avatar: Avatar, surface: Surface, performances: Sequence[Performance]
) -> None:
    """Writes a mesh with its skeleton and motions, whole or not at all; it stands as the first motion begins.

    Colours are lit by nothing (`KHR_materials_unlit`), in linear numbers, as glTF has them. Each vertex keeps its
    `BONES_PER_VERTEX` strongest bones.

    Raises:
        DataError: the disk refuses.
    """
    body, glb = avatar.body, Glb()
    joints = body.rest(performances[0].betas).joints
    strongest = surface.weights.topk(BONES_PER_VERTEX, dim=1)
    shares = strongest.values / strongest.values.sum(dim=1, keepdim=True)
    bones = strongest.indices.where(shares > 0.0, 0)
    normals = vertex_normals(surface.rest.double().numpy(), surface.faces)
    opaque = torch.cat([_linear(surface.colors), torch.ones(len(surface.colors), 1)], dim=1)
    back = torch.eye(4).repeat(len(joints), 1, 1)
    back[:, :3, 3] = -joints

    def add(values: Any, **how: Any) -> int:
        return glb.add(np.ascontiguousarray(values, np.float32), **how)

    attributes = {
        "POSITION": add(surface.rest, target=VERTICES, bounds=True),
        "NORMAL": add(normals, target=VERTICES),
        "COLOR_0": glb.add(
            (65535 * opaque.double()).round().numpy().astype(np.uint16), target=VERTICES, normalized=True
        ),
        "JOINTS_0": glb.add(bones.numpy().astype(np.uint8), target=VERTICES),
        "WEIGHTS_0": add(shares, target=VERTICES),
    }
    triangles = {
        "attributes": attributes,
        "indices": glb.add(surface.faces.reshape(-1).astype(np.uint32), target=INDICES),
        "material": 0,
    }
    steps = joints - torch.where(
        torch.tensor(body.parents)[:, None] >= 0, joints[list(body.parents)], torch.zeros(3)
    )
    tracks = [_tracks(avatar, each) for each in performances]
    turns, places = tracks[0]
    nodes: list[dict[str, Any]] = []
    for k, name in enumerate(JOINTS):
        node = {"name": name, "rotation": turns[0, k].tolist(), "translation": steps[k].tolist()}
        below = [child for child, parent in enumerate(body.parents) if parent == k]
        nodes.append(node | ({"children": below} if below else {}))
    nodes[0]["translation"] = places[0].tolist()
    nodes.append({"name": "avatar", "mesh": 0, "skin": 0})
    glb.document = {
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0, len(JOINTS)]}],
        "nodes": nodes,
        "meshes": [{"primitives": [triangles]}],
        "materials": [
            {"pbrMetallicRoughness": {"metallicFactor": 0.0}, "extensions": {"KHR_materials_unlit": {}}}
        ],
        "skins": [{"joints": list(range(len(JOINTS))), "skeleton": 0, "inverseBindMatrices": add(back)}],
        "animations": [
            _animation(glb, each, *track) for each, track in zip(performances, tracks, strict=True)
        ],
    }
    glb.write(path)


def _animation(
    glb: Glb, performance: Performance, turns: NDArray[Any], places: NDArray[Any]
) -> dict[str, Any]:
    rate = performance.clip.fps or USUAL_FPS
    times = glb.add((np.arange(len(performance)) / rate).astype(np.float32), bounds=True)
    outputs = [("rotation", k, np.ascontiguousarray(turns[:, k])) for k in range(len(JOINTS))]
    outputs.append(("translation", 0, places))
    return {
        "name": performance.clip.name,
        "samplers": [{"input": times, "output": glb.add(values)} for _, _, values in outputs],
        "channels": [
            {"sampler": k, "target": {"node": node, "path": what}}
            for k, (what, node, _) in enumerate(outputs)
        ],
    }


def _tracks(avatar: Avatar, performance: Performance) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Returns rotations x, y, z, w of the nodes `[T, 24, 4]` and places of the root `[T, 3]`, upright frame."""
    upright = performance.upright
    root = avatar.body.rest(performance.betas).joints[0]
    turns, places = [], []
    for row in range(len(performance)):
        rotations, transl = avatar._corrected(performance.pose(row))
        turns.append(torch.cat([upright[None, :3, :3] @ rotations[:1], rotations[1:]]))
        places.append(upright[:3, :3] @ (root + transl) + upright[:3, 3])
    quats = matrix_to_quaternion(torch.stack(turns).double()).roll(-1, dims=-1)
    # a program goes the short way between two keys where they are on one side
    flips = torch.where((quats[1:] * quats[:-1]).sum(dim=-1, keepdim=True) < 0, -1.0, 1.0).cumprod(dim=0)
    quats[1:] *= flips
    return quats.float().numpy(), torch.stack(places).float().numpy()


def _linear(colors: Tensor) -> Tensor:
    """Returns the light that sRGB's numbers stand for."""
    return torch.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
