"""Body files with SMPL's keys: reading (`.npz`, `.safetensors`, official `.pkl`), checking key by key, and writing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from occfusion.errors import DataError
from occfusion.files.arrays import load_npz
from occfusion.files.atomic import atomic_write
from occfusion.files.inert import SparseMatrix, Unresolved
from occfusion.files.unpickle import load_pickle

NUM_JOINTS = 24
_MIN_SHAPES, _MAX_SHAPES = 10, 300
_POSE_FEATURES = (NUM_JOINTS - 1) * 9
"""Entries of the 23 rotation matrices that drive the pose blend shapes."""

_WEIGHT_SLACK = 1e-3
"""Published skinning weights are rounded; rows that miss 1 by more than this are an error."""

_HEIGHT = (0.5, 3.0)
"""Plausible height of the template in metres; outside, the file is in other units."""

_OTHER_MODELS = {
    52: "SMPL-H: SMPL's mesh with jointed fingers, whose weights and blend shapes are not SMPL's",
    55: "SMPL-X: another mesh, with jointed fingers, jaw and eyes",
    16: "MANO: a hand alone",
    5: "FLAME: a head alone",
}
"""What the relatives of SMPL are, by their number of joints."""

_STAR_FEATURES = 93
"""Numbers that drive STAR's pose blend shapes: 23 quaternions and one shape component."""

_WHERE_TO_GET = (
    "SMPL's files come from https://smpl.is.tue.mpg.de after registration; "
    "`dataset=synthetic` needs none, its body is part of the package."
)


_KEYS = (
    *("v_template", "shapedirs", "posedirs", "J_regressor", "J_template", "J_dirs", "weights"),
    *("kintree_table", "parents", "f", "faces"),
)


@dataclass(frozen=True)
class BodyArrays:
    """A linear blend-skinned body with 24 joints, checked. Floats are float64, integers int64.

    Attributes:
        v_template: vertices at rest, `[V, 3]`, metres.
        shapedirs: displacement per shape component, `[V, 3, B]`, B from 10 to 300.
        posedirs: displacement per entry of `R - I` of joints 1 to 23, `[V, 3, 207]`, or None.
        J_regressor: joints from vertices, `[24, V]`; None where the file gives joints directly.
        J_template: joints of the template, `[24, 3]`, metres.
        J_dirs: displacement of the joints per shape component, `[24, 3, B]`: joints at rest are
            `J_template + J_dirs @ betas`, the same as regressing them from the shaped vertices.
        weights: skinning weights, `[V, 24]`, rows sum to 1.
        parents: parent of each joint, `[24]`; -1 for the pelvis, else smaller than the joint's own index.
        faces: triangles, `[F, 3]`.
    """

    v_template: NDArray[np.float64]
    shapedirs: NDArray[np.float64]
    posedirs: NDArray[np.float64] | None
    J_regressor: NDArray[np.float64] | None
    J_template: NDArray[np.float64]
    J_dirs: NDArray[np.float64]
    weights: NDArray[np.float64]
    parents: NDArray[np.int64]
    faces: NDArray[np.int64]


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
        raise DataError(f"{path}: body file not found. {_WHERE_TO_GET}")
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
        raise DataError(f"{path}: holds a {type(content).__name__}, not a table of arrays. {_WHERE_TO_GET}")
    return _BodyChecker(str(path), content).body()


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


class _BodyChecker:
    """Takes the keys of one file, one check a line."""

    def __init__(self, source: str, content: Mapping[str, Any]) -> None:
        self._source = source
        self._content = content

    def body(self) -> BodyArrays:
        """Returns the body, or raises DataError naming file and key."""
        self._refuse_relatives()
        template = self._array("v_template", ("V", 3))
        vertices = template.shape[0]
        if not _HEIGHT[0] <= float(np.ptp(template, axis=0).max(initial=0.0)) <= _HEIGHT[1]:
            raise DataError(
                f"{self._source}: v_template is {np.ptp(template, axis=0).max(initial=0.0):.3g} long in its "
                f"largest direction; a person in metres has {_HEIGHT[0]} to {_HEIGHT[1]}."
            )
        shapedirs = self._array("shapedirs", (vertices, 3, "B"))
        if not _MIN_SHAPES <= shapedirs.shape[2] <= _MAX_SHAPES:
            raise DataError(
                f"{self._source}: shapedirs has {shapedirs.shape[2]} components; "
                f"{_MIN_SHAPES} to {_MAX_SHAPES} are supported."
            )
        posedirs = self._posedirs(vertices)
        regressor, joints, directions = self._joints(template, shapedirs)
        parents = self._parents()
        return BodyArrays(
            template, shapedirs, posedirs, regressor, joints, directions,
            self._weights(vertices), parents, self._faces(vertices),
        )  # fmt: skip

    def _refuse_relatives(self) -> None:
        """Names a file of another model before its shapes are found to differ."""
        table, posedirs = (_shape(self._content.get(key)) for key in ("kintree_table", "posedirs"))
        joints = table[1] if len(table) == 2 else NUM_JOINTS
        if joints != NUM_JOINTS:
            what = f" This is {_OTHER_MODELS[joints]}." if joints in _OTHER_MODELS else ""
            raise DataError(
                f"{self._source}: the body has {joints} joints, expected {NUM_JOINTS} (SMPL).{what} Use SMPL's own "
                f"file, such as SMPL_NEUTRAL.pkl or basicmodel_neutral_lbs_10_207_0_v1.1.0.pkl. {_WHERE_TO_GET}"
            )
        if posedirs[-1:] == (_STAR_FEATURES,):
            raise DataError(
                f"{self._source}: the pose blend shapes take {_STAR_FEATURES} numbers, SMPL's {_POSE_FEATURES}. This "
                f"is STAR, whose shapes and blend shapes are not SMPL's. Use SMPL's own file. {_WHERE_TO_GET}"
            )

    def _has(self, key: str) -> bool:
        return self._content.get(key) is not None

    def _array(self, key: str, shape: tuple[int | str, ...]) -> NDArray[np.float64]:
        value = self._content.get(key)
        if value is None:
            known = ", ".join(sorted(str(k) for k in self._content)[:20])
            raise DataError(f"{self._source}: key {key!r} is missing; the file has: {known}. {_WHERE_TO_GET}")
        if isinstance(value, Unresolved):
            raise DataError(
                f"{self._source}: key {key!r} is a {value.name} that cannot be read safely: {value.reason}. "
                "Convert the file to .npz where chumpy is installed and the file is trusted."
            )
        if isinstance(value, SparseMatrix):
            if max(value.shape) > 10**6 or value.shape[0] * value.shape[1] > 10**8:
                raise DataError(f"{self._source}: key {key!r} declares the shape {value.shape}.")
            value = value.dense()
        array = np.asarray(value)
        if array.dtype.kind not in "fiu":
            raise DataError(f"{self._source}: key {key!r} holds {array.dtype}, not numbers.")
        fits = array.ndim == len(shape) and all(
            isinstance(want, str) or have == want for have, want in zip(array.shape, shape, strict=True)
        )
        if not fits:
            raise DataError(f"{self._source}: key {key!r} has shape {array.shape}, expected {_show(shape)}.")
        array = np.ascontiguousarray(array, dtype=np.float64)
        if not np.isfinite(array).all():
            raise DataError(f"{self._source}: key {key!r} holds NaN or infinite values.")
        return array

    def _integers(self, key: str, shape: tuple[int | str, ...]) -> NDArray[np.int64]:
        array = self._array(key, shape)
        if not (array == np.rint(array)).all():
            raise DataError(f"{self._source}: key {key!r} must hold whole numbers.")
        return array.astype(np.int64)

    def _posedirs(self, vertices: int) -> NDArray[np.float64] | None:
        if not self._has("posedirs"):
            return None
        if np.ndim(self._content["posedirs"]) == 2:  # smplx stores them as [207, V * 3]
            flat = self._array("posedirs", (_POSE_FEATURES, vertices * 3))
            return np.ascontiguousarray(flat.T.reshape(vertices, 3, _POSE_FEATURES))
        return self._array("posedirs", (vertices, 3, _POSE_FEATURES))

    def _joints(
        self, template: NDArray[np.float64], shapedirs: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64] | None, NDArray[np.float64], NDArray[np.float64]]:
        if self._has("J_template") and self._has("J_dirs"):
            joints = self._array("J_template", (NUM_JOINTS, 3))
            directions = self._array("J_dirs", (NUM_JOINTS, 3, shapedirs.shape[2]))
            regressor = (
                self._array("J_regressor", (NUM_JOINTS, len(template))) if self._has("J_regressor") else None
            )
            return regressor, joints, directions
        regressor = self._array("J_regressor", ("joints", "V"))
        if regressor.shape == (len(template), NUM_JOINTS):  # some conversions store the transpose
            regressor = np.ascontiguousarray(regressor.T)
        if regressor.shape != (NUM_JOINTS, len(template)):
            raise DataError(
                f"{self._source}: J_regressor has shape {regressor.shape}, expected "
                f"({NUM_JOINTS}, {len(template)}): this body has another number of joints or vertices."
            )
        return regressor, regressor @ template, np.einsum("jv,vcb->jcb", regressor, shapedirs)

    def _weights(self, vertices: int) -> NDArray[np.float64]:
        weights = self._array("weights", (vertices, NUM_JOINTS))
        sums = weights.sum(axis=1)
        if weights.min() < -_WEIGHT_SLACK or np.abs(sums - 1.0).max() > _WEIGHT_SLACK:
            worst = int(np.abs(sums - 1.0).argmax())
            raise DataError(
                f"{self._source}: skinning weights must be at least 0 and sum to 1; vertex {worst} has "
                f"the sum {sums[worst]:.4g}, the smallest weight is {weights.min():.3g}."
            )
        weights = np.clip(weights, 0.0, None)
        return weights / weights.sum(axis=1, keepdims=True)

    def _parents(self) -> NDArray[np.int64]:
        if self._has("kintree_table"):
            parents = self._integers("kintree_table", (2, "joints"))[0]
        else:
            parents = self._integers("parents", ("joints",))
        if len(parents) != NUM_JOINTS:
            raise DataError(
                f"{self._source}: the body has {len(parents)} joints, expected {NUM_JOINTS} (SMPL)."
            )
        parents = parents.copy()
        parents[0] = -1  # written as 2^32 - 1 in SMPL's files
        if (parents[1:] < 0).any() or (parents[1:] >= np.arange(1, NUM_JOINTS)).any():
            raise DataError(
                f"{self._source}: each joint's parent must come before it; got {parents.tolist()}."
            )
        return parents

    def _faces(self, vertices: int) -> NDArray[np.int64]:
        faces = self._integers("f" if self._has("f") else "faces", ("F", 3))
        if faces.size == 0 or faces.min() < 0 or faces.max() >= vertices:
            raise DataError(
                f"{self._source}: faces name vertices outside 0..{vertices - 1}, or there are none."
            )
        return faces


def _shape(value: Any) -> tuple[int, ...]:
    return value.shape if isinstance(value, (np.ndarray, SparseMatrix)) else ()


def _show(shape: tuple[int | str, ...]) -> str:
    return "(" + ", ".join(str(n) for n in shape) + ")"
