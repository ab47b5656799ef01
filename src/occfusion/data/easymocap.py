"""A body as EasyMocap writes it (`poses`, `Rh`, `Th`, `shapes`), read into the convention of smplx."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from occfusion.data import checks
from occfusion.data.convention import easymocap_to_smplx
from occfusion.data.scene import Array, BodyParameters
from occfusion.errors import DataError

_KEYS = {"Rh": 3, "Th": 3}

_POSES = (72, 69)
"""With the root's rotation, and without: EasyMocap's own results leave out its three zeros, and the script that makes
ZJU-MoCap's layout of them hands them on."""


def read_body(content: Any, pelvis: Callable[[Array], Array], where: str) -> BodyParameters:
    """Returns the body of one frame, checked.

    Args:
        content: what the file holds.
        pelvis: gives the pelvis at rest, `[3]` in metres, for shape coefficients `[B]`.
        where: what messages call it.

    Raises:
        DataError: no dict, a key is missing, or its numbers cannot be.
    """
    if not isinstance(content, Mapping):
        raise DataError(f"{where}: holds a {type(content).__name__}, not a dict.")
    for key in ("poses", *_KEYS, "shapes"):
        if key not in content:
            known = ", ".join(map(str, content))[:200]
            raise DataError(f"{where}: key {key!r} is missing; it has {known}.")
    values = {key: checks.numbers(content[key], size, f"{where}, {key}") for key, size in _KEYS.items()}
    betas = checks.shape_numbers(content["shapes"], f"{where}, shapes")
    count = checks.count_of(content["poses"])
    poses = checks.numbers(content["poses"], count if count in _POSES else max(_POSES), f"{where}, poses")
    poses = np.concatenate([np.zeros(max(_POSES) - len(poses)), poses])
    orient, transl = easymocap_to_smplx(values["Rh"], values["Th"], poses[:3], pelvis(betas))
    return BodyParameters(betas, orient, poses[3:], transl)
