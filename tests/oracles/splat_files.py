"""Files of Gaussians read by programs that are not ours: activated values, rotations w, x, y, z."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh


def read_by_gsply(path: Path) -> dict[str, np.ndarray]:
    gsply = pytest.importorskip("gsply", reason="gsply reads files of Gaussians independently of us")
    data = gsply.read_spz(path) if path.suffix == ".spz" else gsply.plyread(str(path))
    higher = np.zeros((len(data.means), 0, 3), np.float32) if data.shN is None else data.shN
    sh = np.concatenate([data.sh0.reshape(-1, 1, 3), higher], axis=1)
    opacities = 1 / (1 + np.exp(-data.opacities.reshape(-1).astype(np.float64)))
    return {"means": data.means, "quats": data.quats, "scales": np.exp(data.scales), "sh": sh, "o": opacities}


def read_by_trimesh(path: Path) -> dict[str, np.ndarray]:
    """What trimesh decodes, named as KhronosGroup/glTF, extensions/2.0/Khronos/KHR_gaussian_splatting has it.

    Scales are linear since KhronosGroup/glTF#2563, and rotations x, y, z, w.
    """
    extensions = pytest.importorskip(
        "trimesh.exchange.gltf.extensions", reason="trimesh 5 hands out accessors"
    )
    found: dict[str, np.ndarray] = {}

    def keep(context: dict[str, Any]) -> None:
        named = context["primitive"]["attributes"].items()
        found.update({name.split(":")[-1]: np.asarray(context["accessors"][k]) for name, k in named})

    extensions.register_handler("KHR_gaussian_splatting", "primitive_preprocess")(keep)
    points = trimesh.load(path)
    assert len(points.geometry) == 1
    sh = np.stack([found[name] for name in sorted(found) if name.startswith("SH_DEGREE")], axis=1)
    quats = np.roll(found["ROTATION"], 1, axis=1)
    opacities = found["OPACITY"].reshape(-1)
    return {"means": found["POSITION"], "quats": quats, "scales": found["SCALE"], "sh": sh, "o": opacities}
