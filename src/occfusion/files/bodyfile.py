"""Body files with SMPL's keys: reading (`.npz`, `.safetensors`, official `.pkl`) and writing."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from occfusion.errors import DataError
from occfusion.files.arrays import load_npz
from occfusion.files.atomic import atomic_write
from occfusion.files.bodycheck import NUM_JOINTS, WHERE_TO_GET, BodyArrays, BodyChecker
from occfusion.files.unpickle import load_pickle

__all__ = ["NUM_JOINTS", "BodyArrays", "load_body_arrays", "save_body_arrays"]

_KEYS = (
    *("v_template", "shapedirs", "posedirs", "J_regressor", "J_template", "J_dirs", "weights"),
    *("kintree_table", "parents", "f", "faces"),
)


def load_body_arrays(path: Path | str) -> BodyArrays:
    """Returns the body of a `.npz`, `.safetensors` or official `.pkl` file, checked.

    Keys are SMPL's: `v_template`, `shapedirs`, `posedirs` (optional), `J_regressor`, `weights`,
    `kintree_table` (or `parents`), `f` (or `faces`). `J_template` and `J_dirs` may take the place of
    `J_regressor`. Nothing in the file is executed; chumpy and scipy need not be installed.

    Raises:
        DataError: the file is missing, unsafe or damaged, a key is missing, has another shape or is
            not finite, or the body has another number of joints.
    """
    path = Path(path)
    if not path.is_file():
        raise DataError(f"{path}: body file not found. {WHERE_TO_GET}")
    match path.suffix.lower():
        case ".npz":
            content: Mapping[str, Any] = load_npz(path, _KEYS)
        case ".safetensors":
            content = _load_safetensors(path)
        case ".pkl":
            content = load_pickle(path)
        case other:
            raise DataError(f"{path}: unknown body format {other!r}; use .npz, .safetensors or .pkl.")
    if not isinstance(content, Mapping):
        raise DataError(f"{path}: holds a {type(content).__name__}, not a table of arrays. {WHERE_TO_GET}")
    return BodyChecker(str(path), content).body()


def save_body_arrays(path: Path | str, arrays: BodyArrays) -> None:
    """Writes the body with SMPL's keys as `.npz` or `.safetensors`, float32, whole or not at all.

    Raises:
        DataError: the suffix is another one.
    """
    path = Path(path)
    content: dict[str, NDArray[Any]] = {
        "kintree_table": np.stack([arrays.parents, np.arange(NUM_JOINTS)]).astype(np.int64),
        "f": arrays.faces.astype(np.int32),
    }
    for key in ("v_template", "shapedirs", "posedirs", "J_regressor", "J_template", "J_dirs", "weights"):
        value = getattr(arrays, key)
        if value is not None:
            content[key] = np.ascontiguousarray(value, dtype=np.float32)
    if path.suffix.lower() == ".npz":
        with atomic_write(path) as stream:
            np.savez_compressed(stream, allow_pickle=False, **content)
    elif path.suffix.lower() == ".safetensors":
        from safetensors.numpy import save

        with atomic_write(path) as stream:
            stream.write(save(content))
    else:
        raise DataError(f"{path}: bodies are written as .npz or .safetensors.")


def _load_safetensors(path: Path) -> dict[str, NDArray[Any]]:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), framework="numpy") as file:
            return {key: file.get_tensor(key) for key in file.keys() if key in _KEYS}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise DataError(f"{path}: not a safetensors file, or damaged ({error}).") from error
