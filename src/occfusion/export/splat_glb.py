"""Gaussians as glTF points with `KHR_gaussian_splatting`: standard deviations and opacities as they are, +y up."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from occfusion.errors import DataError
from occfusion.files.glb import VERTICES, Glb
from occfusion.files.ply import SplatTable, check_table
from occfusion.splat.harmonics import COLOR_OFFSET, SH_C0

EXTENSION = "KHR_gaussian_splatting"


def write_splat_glb(path: Path | str, table: SplatTable) -> None:
    """Writes the Gaussians whole or not at all; programs without the extension show coloured points.

    Raises:
        DataError: a value is not finite, the arrays do not fit together, there are none, or the disk refuses.
    """
    count = check_table(path, table)
    if not len(table.means):
        raise DataError(f"{path}: no Gaussians, and glTF has no empty arrays")
    opacities = (1.0 / (1.0 + np.exp(-table.opacity_logits.astype(np.float64)))).astype(np.float32)
    quats = np.roll(table.raw_quats, -1, axis=1)  # w, x, y, z to x, y, z, w
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    shown = np.concatenate([table.sh0[:, 0] * SH_C0 + COLOR_OFFSET, opacities[:, None]], axis=1)
    glb = Glb()
    attributes: dict[str, Any] = {
        "POSITION": glb.add(table.means, target=VERTICES, bounds=True),
        "COLOR_0": glb.add(
            (255 * shown.clip(0, 1)).round().astype(np.uint8), target=VERTICES, normalized=True
        ),
        f"{EXTENSION}:ROTATION": glb.add(quats.astype(np.float32), target=VERTICES),
        f"{EXTENSION}:SCALE": glb.add(np.exp(table.log_scales), target=VERTICES),
        f"{EXTENSION}:OPACITY": glb.add(opacities, target=VERTICES),
    }
    coefficients = np.concatenate([table.sh0, table.sh_rest], axis=1)
    for degree in range(4):
        for k, index in enumerate(range(degree**2, min((degree + 1) ** 2, count))):
            semantic = f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k}"
            attributes[semantic] = glb.add(np.ascontiguousarray(coefficients[:, index]), target=VERTICES)
    kernel = {
        "kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }  # fmt: skip
    said = {"extras": {"about": table.about}} if table.about else {}
    points = {"mode": 0, "attributes": attributes, "extensions": {EXTENSION: kernel}}
    glb.document = {
        "extensionsUsed": [EXTENSION], "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "avatar", "mesh": 0, **said}], "meshes": [{"primitives": [points]}],
    }  # fmt: skip
    glb.write(path)
