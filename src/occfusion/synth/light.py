"""Brightness at the vertices: lamps all around plus a key light, which in hard scenes casts shadows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from occfusion.geometry.normals import vertex_normals
from occfusion.geometry.zbuffer import rasterize_mesh
from occfusion.synth.rotations import Floats

AMBIENT = {"soft": 0.78, "directional": 0.45}  # the key light gives the rest of 1
KEY_DIRECTION = np.array([0.45, -0.65, 0.75]) / np.linalg.norm([0.45, -0.65, 0.75])  # towards the lamp, z up
MAP_SIZE = 256  # texels a side of a depth map from a lamp
MAP_WIDTH = 2.8  # metres it covers
BIAS = 0.02  # metres by which a surface may lie behind the map's and still be lit
PENUMBRA = 3  # texels: shadow edges are this soft
SKY = 10  # directions from which ambient light is tested for being blocked
OCCLUSION_STRENGTH = 0.35  # share of ambient light that closed-in places lose


@dataclass(frozen=True)
class Lighting:
    """How a scene is lit.

    Attributes:
        ambient: light from all around, 0..1; the key light gives the rest.
        shadows: whether the key light is blocked, and hollows are darker.
    """

    ambient: float
    shadows: bool


def light_vertices(vertices: Floats, faces: NDArray[np.int64], lighting: Lighting) -> Floats:
    """Returns the brightness at each vertex, `[V]`, 0..1; world with z up, metres."""
    normals = vertex_normals(vertices, faces)
    key = np.maximum(0.0, normals @ KEY_DIRECTION)
    ambient = np.full(len(vertices), lighting.ambient)
    if lighting.shadows:
        key *= lit_share(vertices, faces, KEY_DIRECTION, PENUMBRA)
        ambient *= 1.0 - OCCLUSION_STRENGTH * (1.0 - openness(vertices, faces, normals))
    return np.asarray(ambient + (1.0 - lighting.ambient) * key)


def lit_share(vertices: Floats, faces: NDArray[np.int64], towards: Floats, reach: int) -> Floats:
    """Returns the share of light from a direction that arrives, `[V]`: a filtered shadow map."""
    side = np.cross(towards, [0.0, 0.0, 1.0] if abs(towards[2]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    axes = np.stack([side, np.cross(towards, side), -towards])
    local = (vertices - vertices.mean(0)) @ axes.T
    texels = (local[:, :2] / MAP_WIDTH + 0.5) * MAP_SIZE
    depth = local[:, 2] + 10.0  # any positive number; perspective plays no part at this distance
    blocked = rasterize_mesh(texels, depth, faces, MAP_SIZE, MAP_SIZE).depth
    lit = np.zeros(len(vertices))
    offsets = np.arange(-reach, reach + 1) * 0.5
    for dx in offsets:
        for dy in offsets:
            column = np.clip((texels[:, 0] + dx).astype(int), 0, MAP_SIZE - 1)
            row = np.clip((texels[:, 1] + dy).astype(int), 0, MAP_SIZE - 1)
            lit += depth - BIAS < blocked[row, column]
    return lit / len(offsets) ** 2


def openness(vertices: Floats, faces: NDArray[np.int64], normals: Floats) -> Floats:
    """Returns how much of the surroundings each vertex sees, `[V]`, 0..1."""
    k = np.arange(SKY) + 0.5
    z = 1.0 - 1.6 * k / SKY  # a golden spiral without the lowest directions, which the floor blocks
    angle = k * np.pi * (3.0 - np.sqrt(5.0))
    radius = np.sqrt(1.0 - z * z)
    total, arrived = np.zeros(len(vertices)), np.zeros(len(vertices))
    for direction in np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1):
        weight = np.maximum(0.0, normals @ direction)
        total += weight
        arrived += weight * lit_share(vertices, faces, direction, 1)
    return np.where(total > 1e-6, arrived / np.maximum(total, 1e-6), 1.0)
