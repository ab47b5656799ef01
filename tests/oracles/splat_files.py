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


def read_raw_ply(path: Path) -> dict[str, np.ndarray]:
    """Raw values of a 3DGS `.ply`, by the names of `SplatTable`."""
    header, numbers = path.read_bytes().split(b"end_header\n", 1)
    names = [line.split()[-1] for line in header.decode("ascii").splitlines() if line.startswith("property")]
    values = np.frombuffer(numbers, "<f4").reshape(-1, len(names))
    column = dict(zip(names, values.T, strict=True))

    def take(*wanted: str) -> np.ndarray:
        return np.stack([column[name] for name in wanted], axis=1)

    rest = sum(name.startswith("f_rest_") for name in names) // 3
    higher = [[column[f"f_rest_{colour * rest + k}"] for colour in range(3)] for k in range(rest)]
    return {
        "means": take("x", "y", "z"),
        "raw_quats": take(*(f"rot_{k}" for k in range(4))),
        "log_scales": take(*(f"scale_{k}" for k in range(3))),
        "opacity_logits": column["opacity"],
        "sh0": take("f_dc_0", "f_dc_1", "f_dc_2")[:, None],
        "sh_rest": np.array(higher, np.float32).reshape(rest, 3, len(values)).transpose(2, 0, 1),
    }


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
