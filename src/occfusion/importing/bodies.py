"""Bodies that other tools found in a video: each tool's own file, as its program writes it.

| tool | file | written by |
|---|---|---|
| `gvhmr` | `hmr4d_results.pt` | zju3dv/GVHMR `tools/demo/demo.py`, `hmr4d/model/gvhmr/gvhmr_pl_demo.py` (2024-09) |
| `gem` | `smpl_params.pt` | NVlabs/GENMO `demo_smpl*.py` (2026-05) |
| `wham` | `wham_output.pkl`, joblib | yohanshin/WHAM `demo.py` (2024-04) |
| `tram` | `hps_track_0.npy`, pickled | yufu-wang/tram `lib/models/hmr_vimo.py` (2025-06) |
| `vibe` | `vibe_output.pkl`, joblib | mkocabas/VIBE `demo.py@1147b97e`, weak perspective: `lib/utils/renderer.py` |
| `4d-humans` | `results/demo_V.pkl`, joblib | brjathu/PHALP `phalp/trackers/PHALP.py` (2026-02) |
| `prompthmr` | `results.pkl`, joblib | yufu-wang/PromptHMR `pipeline/pipeline.py`, `pipeline/phmr_vid.py` (2025-10) |
| `nlf` | `V_smoothfits.pkl`, pickled | isarandi/nlf-pipeline `src/nlf_pipeline/run_smoothed_smplfitter.py` |
| `smpl` | `.smpl`, a zip of arrays | Meshcapade/smplcodec `smplcodec/codec.py` (2.3.0) |
| `easymocap` | `output/smpl/000000.json`, the folder | zju3dv/EasyMocap `easymocap/mytools/file_utils.py` |
| `motion` | what `dataset.poses` reads: AMASS, AIST++, InstantAvatar | see `data/video/pose_table.py` |
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.data.checking import checks
from occfusion.data.video.pose_table import read_motion
from occfusion.errors import ConfigError, DataError
from occfusion.files.arrays import load_npy
from occfusion.footage.camera import centred, pinhole
from occfusion.importing.body_files import load_file

_SMPLX = "its body is SMPL-X: pose and place are taken, and the shape's numbers mean something else to SMPL."
_NLF_FIELD = 55
"""Degrees that NLF's pipeline takes a camera to see across the longer side, unless told (`--fov`)."""
_LENS = 5000.0 / 224.0
"""Focal length against the longer side: what tools of weak perspective suppose of their 224 px inputs if they must."""
_LONG_LENS = "its camera supposes a very long lens, so that the person stands far away."

Floats = NDArray[np.float64]
Pelvis = Callable[[Floats], Floats]


@dataclass(frozen=True)
class Found:
    """One person's body in some frames of a video, in the camera (OpenCV axes, metres), in smplx's convention.

    Attributes:
        tool: that wrote it.
        frames: places in the video, `[N]`, rising.
        betas: one shape, `[10]`: the median where the tool gives one a frame.
        global_orient: `[N, 3]`, radians.
        body_pose: `[N, 69]`, radians; hands are straight where the tool's body is SMPL-X.
        transl: `[N, 3]`, metres.
        K: intrinsics for pictures as large as the video's, `[3, 3]`; None where the file does not say.
        notes: what a user should know, in sentences.
        in_world: whether the numbers are of a world whose place to the camera the file does not say.
    """

    tool: str
    frames: NDArray[np.int64]
    betas: Floats
    global_orient: Floats
    body_pose: Floats
    transl: Floats
    K: Floats | None
    notes: tuple[str, ...] = ()
    in_world: bool = False


def read_bodies(
    path: Path, tool: str | None, size: tuple[int, int], pelvis: Pelvis, person: int | None = None
) -> Found:
    """Returns the person that a tool found.

    Args:
        path: its file.
        tool: its name; None to tell from the content.
        size: width and height of the video, pixels.
        pelvis: gives the pelvis at rest, `[3]`, for shape coefficients.
        person: the tool's number of the wanted person; None for the one in most frames.

    Raises:
        ConfigError: no such tool.
        DataError: the file is missing, damaged or of no known tool, or has no such person.
    """
    if tool is not None and tool not in TOOLS:
        raise ConfigError(f"--from {tool}: known are {', '.join(TOOLS)}.")
    content = load_file(path, tool)
    name = tool or _recognised(content, path)
    try:
        found = TOOLS[name](content, path, size, pelvis, person)
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise DataError(
            f"{path}: is not what {name} writes ({type(error).__name__}: {error}); say which tool wrote it with "
            f"--from TOOL FILE: {', '.join(TOOLS)}."
        ) from error
    for key in ("betas", "global_orient", "body_pose", "transl"):
        rows = getattr(found, key)
        if not np.isfinite(rows).all():
            raise DataError(f"{path}, {key}: holds NaN or infinite values.")
    if not len(found.frames):
        raise DataError(f"{path}: holds nobody.")
    return found


_OF_FILE = (
    ({"easymocap"}, "easymocap"), ({"smpl_params_incam"}, "gvhmr"), ({"body_params_incam"}, "gem"),
    ({"pred_rotmat"}, "tram"), ({"smpl_poses"}, "motion"), ({"bodyPose"}, "smpl"), ({"codecVersion"}, "smpl"),
    ({"people", "camera"}, "prompthmr"),
)  # fmt: skip
"""Keys by which a tool's dict is known."""
_OF_FIRST = (
    ({"pose", "trans", "betas"}, "wham"), ({"pose", "orig_cam", "betas"}, "vibe"),
    ({"smpl", "camera"}, "4d-humans"),
)  # fmt: skip
"""The same of the first value in it, a person or a frame."""
_OF_ROW = (({"pose_rotvecs"}, "nlf"),)
"""The same of the first entry of a list."""


def _recognised(content: Any, path: Path) -> str:
    if content is None:
        return "motion"
    parts: list[tuple[Any, Any]] = []
    if isinstance(content, Mapping):
        parts = [(content, _OF_FILE), (next(iter(content.values()), None), _OF_FIRST)]
    elif isinstance(content, list) and content:
        parts = [(content[0], _OF_ROW)]
    for part, marks in parts:
        for keys, tool in marks:
            if isinstance(part, Mapping) and keys <= set(part):
                return tool
    raise DataError(f"{path}: is not of a known tool; say which with --from TOOL FILE: {', '.join(TOOLS)}.")


def _numbers(table: Mapping[Any, Any], key: str, width: int, where: str) -> Floats:
    if key not in table:
        raise DataError(f"{where}: has no {key}; it has {', '.join(map(str, list(table)[:8]))}.")
    value = table[key]
    array = np.asarray(value.numpy() if isinstance(value, torch.Tensor) else value)
    if array.dtype.kind not in "fiu" or array.size % width or not array.size:
        raise DataError(f"{where}, {key}: has shape {array.shape}, expected rows of {width} numbers.")
    with np.errstate(invalid="ignore"):  # what is not finite is refused with its name later
        return array.astype(np.float64).reshape(-1, width)


def _diagonal(size: tuple[int, int]) -> Floats:
    """The camera that GVHMR and WHAM suppose: a focal length of the picture's diagonal."""
    return centred(math.hypot(*size), size)


def _shape(rows: Floats) -> Floats:
    return np.asarray(np.median(rows, axis=0))


def _whole_pose(body_pose: Floats) -> Floats:
    """Returns 23 joints of 21, hands straight."""
    return np.concatenate([body_pose[:, :63], np.zeros((len(body_pose), 6))], axis=1)


def _in_camera(block: str) -> Callable[..., Found]:
    def read(content: Any, path: Path, size: tuple[int, int], pelvis: Pelvis, person: int | None) -> Found:
        where = f"{path}, {block}"
        if not isinstance(content, Mapping) or not isinstance(content.get(block), Mapping):
            raise DataError(f"{path}: has no {block}.")
        part = content[block]
        orient = _numbers(part, "global_orient", 3, where)
        K = _diagonal(size)
        if "K_fullimg" in content:
            K = _numbers(content, "K_fullimg", 9, str(path))[0].reshape(3, 3)
        return Found(
            "gvhmr" if block.startswith("smpl") else "gem", np.arange(len(orient)),
            _shape(_numbers(part, "betas", 10, where)), orient,
            _whole_pose(_numbers(part, "body_pose", 63, where)), _numbers(part, "transl", 3, where), K,
            (_SMPLX,),
        )  # fmt: skip

    return read


def _tracked(tool: str) -> Callable[..., Found]:
    """Returns the reader of WHAM's or VIBE's people, which differ in the camera alone."""

    def read(content: Any, path: Path, size: tuple[int, int], pelvis: Pelvis, person: int | None) -> Found:
        rows = _person(
            {k: v for k, v in content.items() if isinstance(v, Mapping)}, "frame_ids", path, person
        )
        where = str(path)
        poses = _numbers(rows, "pose", 72, where)
        if tool == "vibe":
            K, transl = _weakly(_numbers(rows, "orig_cam", 4, where), size, where)
        else:
            K, transl = _diagonal(size), _numbers(rows, "trans", 3, where)
        return Found(
            tool, _numbers(rows, "frame_ids", 1, where)[:, 0].astype(np.int64),
            _shape(_numbers(rows, "betas", 10, where)), poses[:, :3], poses[:, 3:], transl, K,
            (_LONG_LENS,) if tool == "vibe" else (),
        )  # fmt: skip

    return read


def _weakly(cameras: Floats, size: tuple[int, int], where: str) -> tuple[Floats, Floats]:
    """Returns intrinsics `[3, 3]` and places of the body `[N, 3]`, metres, that draw it as weak perspective does.

    Many tools say where a person is by a scale and a shift, and no distance: a point of the body is drawn at
    `s (x + t)`, in shares of half the picture from its middle; how deep it lies does not matter. No camera that we
    render with does that, but one far away with a long lens nearly does: it is off by the depth over the distance,
    under one percent of the way from the middle.

    Args:
        cameras: `[N, 4]`: scales along x and y, in halves of the picture a metre, then shifts, metres.
        size: width and height of the picture, pixels.
        where: the file, for messages.

    Raises:
        DataError: a scale is none, or the two are of another picture's shape.
    """
    scales, shifts = cameras[:, :2], cameras[:, 2:]
    metre = scales * np.array(size) / 2  # pixels
    with np.errstate(invalid="ignore"):
        wrong = ~(metre > 1e-3).all(axis=1) | ~(np.abs(metre[:, 0] / metre[:, 1] - 1) < 0.02)
    if wrong.any():
        row = int(np.flatnonzero(wrong)[0])
        x, y = metre[row]
        raise DataError(
            f"{where}, row {row}: a metre of {x:g} x {y:g} px is none in pictures of {size[0]} x {size[1]}: is "
            "the file of this clip?"
        )
    K = centred(_LENS * max(size), size)
    return K, np.column_stack([shifts, K[0, 0] / metre[:, 0]])


def _tram(content: Any, path: Path, size: tuple[int, int], pelvis: Pelvis, person: int | None) -> Found:
    where = str(path)
    poses = _vectors(_numbers(content, "pred_rotmat", 24 * 9, where).reshape(-1, 24, 3, 3))
    K, camera = None, path.parent.parent / "camera.npy"
    if camera.is_file():
        table = load_npy(camera)
        focal = float(checks.numbers(table["img_focal"], 1, f"{camera}, img_focal")[0])
        middle = checks.numbers(table["img_center"], 2, f"{camera}, img_center")
        K = pinhole(focal, focal, *middle)
    return Found(
        "tram", _numbers(content, "frame", 1, where)[:, 0].astype(np.int64),
        _shape(_numbers(content, "pred_shape", 10, where)), poses[:, 0], poses[:, 1:].reshape(-1, 69),
        _numbers(content, "pred_trans", 3, where), K,
    )  # fmt: skip


def _phalp(content: Any, path: Path, size: tuple[int, int], pelvis: Pelvis, person: int | None) -> Found:
    rows: dict[int, list[tuple[int, Any, Any]]] = {}
    for number, name in enumerate(sorted(content)):
        frame = content[name]
        for k, tid in enumerate(frame.get("tid", [])):
            rows.setdefault(int(tid), []).append((number, frame["smpl"][k], frame["camera"][k]))
    kept = _person({tid: {"frames": seen} for tid, seen in rows.items()}, "frames", path, person)["frames"]
    # PHALP lays the picture into a square of its longer side and supposes 5000 px of focal length at 256 px
    K = centred(5000.0 / 256.0 * max(size), size)
    parts = [(np.reshape(s["global_orient"], 9), np.reshape(s["body_pose"], 23 * 9)) for _, s, _ in kept]
    poses = _vectors(
        np.stack([np.concatenate(part) for part in parts]).astype(np.float64).reshape(-1, 24, 3, 3)
    )
    return Found(
        "4d-humans", np.array([k for k, _, _ in kept]),
        _shape(np.stack([np.reshape(s["betas"], 10) for _, s, _ in kept]).astype(np.float64)),
        poses[:, 0], poses[:, 1:].reshape(-1, 69),
        np.stack([np.reshape(c, 3) for _, _, c in kept]).astype(np.float64), K,
        (_LONG_LENS,),
    )  # fmt: skip


def _prompthmr(content: Any, path: Path, size: tuple[int, int], pelvis: Pelvis, person: int | None) -> Found:
    rows = _person(content["people"], "frames", path, person)
    where = f"{path}, smplx_cam"
    if not isinstance(rows.get("smplx_cam"), Mapping):
        raise DataError(f"{path}: the person has no smplx_cam; did the pipeline end before its bodies?")
    part = rows["smplx_cam"]
    poses = _numbers(part, "pose", 75, where)
    focal = float(_numbers(content["camera"], "img_focal", 1, f"{path}, camera")[0, 0])
    middle = _numbers(content["camera"], "img_center", 2, f"{path}, camera")[0]
    shrunk = size[0] / (2 * middle[0])  # the pipeline makes pictures at most 896 high
    return Found(
        "prompthmr", _numbers(rows, "frames", 1, str(path))[:, 0].astype(np.int64),
        _shape(_numbers(part, "shape", 10, where)), poses[:, :3], _whole_pose(poses[:, 3:]),
        _numbers(part, "trans", 3, where), centred(focal * shrunk, size), (_SMPLX,),
    )  # fmt: skip


def _nlf(content: Any, path: Path, size: tuple[int, int], pelvis: Pelvis, person: int | None) -> Found:
    """Frames list the people that were fitted, without a number: one is followed by place."""
    kept: list[tuple[int, Floats, Floats, Floats]] = []
    for number, frame in enumerate(content):
        where = f"{path}, frame {number}"
        if not np.size(frame.get("trans", ())):
            continue
        places = _numbers(frame, "trans", 3, where)
        if kept:
            k = int(np.linalg.norm(places - kept[-1][3], axis=1).argmin())
        elif (person or 0) >= len(places):
            raise DataError(f"{where}: has no person {person}; it has 0 to {len(places) - 1}.")
        else:
            k = person or 0
        shapes = _numbers(frame, "shape_betas", 10, where)
        kept.append((number, _numbers(frame, "pose_rotvecs", 72, where)[k], shapes[k], places[k]))
    if not kept:
        raise DataError(f"{path}: holds nobody.")
    poses = np.stack([row[1] for row in kept])
    focal = 0.5 * max(size) / math.tan(math.radians(_NLF_FIELD) / 2)
    return Found(
        "nlf", np.array([row[0] for row in kept]), _shape(np.stack([row[2] for row in kept])), poses[:, :3],
        poses[:, 3:], np.stack([row[3] for row in kept]), centred(focal, size),
        (f"its camera is taken to see {_NLF_FIELD} degrees and to stand still, the pipeline's own start.",),
    )  # fmt: skip


def _smplcodec(content: Any, path: Path, size: tuple[int, int], pelvis: Pelvis, person: int | None) -> Found:
    where, kind = str(path), int(np.asarray(content.get("smplVersion", 2)).reshape(-1)[0])
    if kind not in (0, 1, 2) or "bodyPose" not in content:
        raise DataError(f"{where}: has no motion of SMPL, SMPL-H or SMPL-X (smplVersion {kind}).")
    joints = 24 if kind == 0 else 22
    poses = _numbers(content, "bodyPose", 3 * joints, where)
    count = len(poses)
    return Found(
        "smpl", np.arange(count),
        _numbers(content, "shapeParameters", 1, where)[:10, 0] if kind == 0 else np.zeros(10),
        poses[:, :3], poses[:, 3:] if kind == 0 else _whole_pose(poses[:, 3:]),
        _numbers(content, "bodyTranslation", 3, where) if "bodyTranslation" in content else np.zeros((count, 3)),
        None, () if kind == 0 else (_SMPLX,), in_world=True,
    )  # fmt: skip


def _easymocap(content: Any, path: Path, size: tuple[int, int], pelvis: Pelvis, person: int | None) -> Found:
    people: dict[int, list[tuple[int, Mapping[str, Any]]]] = {}
    for number, rows in content["easymocap"]:
        for row in rows:
            people.setdefault(int(row["id"]), []).append((number, row))
    kept = _person({k: {"frames": v} for k, v in people.items()}, "frames", path, person)["frames"]
    where = str(path)
    betas = _shape(np.concatenate([_numbers(row, "shapes", 10, where) for _, row in kept]))
    root, joint = np.concatenate([_numbers(row, "Rh", 3, where) for _, row in kept]), pelvis(betas)
    # Rh turns about the origin, smplx about the pelvis
    turned = np.stack([cv2.Rodrigues(vector)[0] @ joint for vector in root])
    return Found(
        "easymocap", np.array([k for k, _ in kept]), betas, root,
        np.concatenate([_numbers(row, "poses", 72, where) for _, row in kept])[:, 3:],
        np.concatenate([_numbers(row, "Th", 3, where) for _, row in kept]) + turned - joint, None,
        in_world=True,
    )  # fmt: skip


def _motion(content: Any, path: Path, size: tuple[int, int], pelvis: Pelvis, person: int | None) -> Found:
    motion = read_motion(path)
    betas = np.zeros(10) if motion.betas is None else _shape(motion.betas)[:10]
    return Found(
        "motion", np.arange(len(motion)), betas, motion.global_orient, motion.body_pose, motion.transl, None,
        (f"{motion.form}.",), in_world=True,
    )  # fmt: skip


def _person(people: Mapping[Any, Any], key: str, path: Path, person: int | None) -> Any:
    if not people:
        raise DataError(f"{path}: holds nobody.")
    if person is None:
        return max(people.values(), key=lambda rows: len(rows[key]))
    if person not in people:
        raise DataError(f"{path}: has no person {person}; it has {', '.join(map(str, people))}.")
    return people[person]


def _vectors(rotations: Floats) -> Floats:
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_rotvec()
    return np.asarray(turns.reshape(*rotations.shape[:-2], 3))


TOOLS: dict[str, Callable[[Any, Path, tuple[int, int], Pelvis, int | None], Found]] = {
    "gvhmr": _in_camera("smpl_params_incam"),
    "gem": _in_camera("body_params_incam"),
    "wham": _tracked("wham"),
    "vibe": _tracked("vibe"),
    "tram": _tram,
    "4d-humans": _phalp,
    "prompthmr": _prompthmr,
    "nlf": _nlf,
    "smpl": _smplcodec,
    "easymocap": _easymocap,
    "motion": _motion,
}
"""Readers by the name that `--from` takes."""
