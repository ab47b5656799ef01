"""Key points that other tools found, as one person's 33 landmarks.

| points | file | written by |
|---|---|---|
| 25, 18 | a folder of `*_keypoints.json` | OpenPose `--write_json` (its `doc/02_output.md`) |
| 17, 26, 133, 136 | a list of `image_id`, `keypoints` | COCO's results; AlphaPose `alphapose/utils/pPose_nms.py` |
| 33 | a list of results, one a frame, or a folder of them | MediaPipe: `landmarks` (web), `pose_landmarks` (Python) |
| 70 | `.npz` or `.npy` of one person a file | SAM 3D Body, see `mhr.py` |
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from occfusion.errors import ConfigError, DataError
from occfusion.files.jsonfile import load_json
from occfusion.files.naming import natural
from occfusion.footage.camera import Intrinsics
from occfusion.footage.clip import Clip, Shot
from occfusion.footage.landmarks import COUNT, INDEX, KeyPoints
from occfusion.importing import mhr
from occfusion.importing.matching import coco_entries, places_of

Floats = NDArray[np.float64]

_FACE = ("nose", "left_eye", "right_eye", "left_ear", "right_ear")
_LIMBS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
COCO = (*_FACE, *(f"{side}_{limb}" for limb in _LIMBS for side in ("left", "right")))
"""The 17 points of COCO, in order."""
_RIGHT_ARM, _LEFT_ARM = (tuple(f"{s}_{limb}" for limb in _LIMBS[:3]) for s in ("right", "left"))
_RIGHT_LEG, _LEFT_LEG = (tuple(f"{s}_{limb}" for limb in _LIMBS[3:]) for s in ("right", "left"))
_OPENPOSE_FACE = ("right_eye", "left_eye", "right_ear", "left_ear")
_FEET = ("left_foot_index", "", "left_heel", "right_foot_index", "", "right_heel")
ORDERS: dict[int, tuple[str, ...]] = {
    17: COCO,
    18: ("nose", "", *_RIGHT_ARM, *_LEFT_ARM, *_RIGHT_LEG, *_LEFT_LEG, *_OPENPOSE_FACE),
    25: ("nose", "", *_RIGHT_ARM, *_LEFT_ARM, "", *_RIGHT_LEG, *_LEFT_LEG, *_OPENPOSE_FACE, *_FEET),
    26: (*COCO, "", "", "", "left_foot_index", "right_foot_index", "", "", "left_heel", "right_heel"),
    133: (*COCO, *_FEET),
}
ORDERS[136] = ORDERS[26]
"""By how many points a person has, the name of each as ours; empty where we have none."""

FAR = 1.0
"""Of the person's size: who is farther away in the next frame is somebody else."""


@dataclass(frozen=True)
class Person:
    """One person in one frame.

    Attributes:
        pixels: `[33, 2]`, of the file's pictures, the middle of the first pixel is 0.5.
        confidence: `[33]`, 0..1; 0 for points that the tool does not have.
        world: `[33, 3]`, metres, as `KeyPoints` has it; None without depth.
        track: the tool's number of the person; None without.
    """

    pixels: Floats
    confidence: Floats
    world: Floats | None = None
    track: int | None = None

    @property
    def middle(self) -> Floats:
        """Of the sure points, `[2]`, pixels."""
        return np.asarray(self.pixels[self.confidence > 0].mean(axis=0))

    @property
    def size(self) -> float:
        """The larger extent of the sure points, pixels."""
        return float(np.ptp(self.pixels[self.confidence > 0], axis=0).max())


def read_keypoints(path: Path, clip: Clip, shot: Shot, person: int | None = None) -> KeyPoints:
    """Returns the key points of one person in each picture of a shot; confidence 0 where the tool found nobody.

    Args:
        path: file or folder that a tool wrote.
        clip: that it was run on.
        shot: the chosen pictures.
        person: which of several, from 1, from the left in the frame with most people; None for the only or largest.

    Raises:
        ConfigError: there is no such person.
        DataError: missing, damaged, of no known form, or of another clip.
    """
    width, height = (length / shot.scale for length in shot.size)
    rows = _rows(path, (width, height))
    names = sorted(rows, key=natural)
    frames = [
        [] if place is None else rows[names[place]] for place in places_of(names, clip, shot, str(path))
    ]
    chosen = _followed(frames, person, path)
    far = [p for p in chosen if p is not None and (p.middle > 1.2 * np.array([width, height])).any()]
    if far:
        raise DataError(
            f"{path}: key points lie outside of the clip's {width:.0f} x {height:.0f} pixels, near "
            f"{far[0].middle.round()}: were they found in larger pictures?"
        )
    nobody = Person(np.zeros((COUNT, 2)), np.zeros(COUNT))
    people = [p or nobody for p in chosen]
    world = None
    if all(p is None or p.world is not None for p in chosen):
        world = np.stack([np.zeros((COUNT, 3)) if p.world is None else p.world for p in people])
    return KeyPoints(
        np.stack([p.pixels for p in people]) * shot.scale, np.stack([p.confidence for p in people]), world,
        np.array([float(p is not None) for p in chosen]),
    )  # fmt: skip


def camera_in(path: Path, shot: Shot) -> Intrinsics | None:
    """Returns the camera that a tool's key points imply, for the pictures of a shot; None where they imply none."""
    seen = [person for file in mhr.files_of(path) for person in mhr.people_of(file)]
    if not seen:
        return None
    flat, _, at = (np.concatenate(part) for part in zip(*seen, strict=True))
    K = mhr.camera_of(flat, at)
    return Intrinsics(np.diag([shot.scale, shot.scale, 1.0]) @ K, True, f"key points of {path.name}")


def _rows(path: Path, size: tuple[float, float]) -> dict[str, list[Person]]:
    """Returns the people of each frame by the frame's name."""
    if not path.exists():
        raise DataError(f"{path}: no such file or folder.")
    if dumps := mhr.files_of(path):
        return {
            f.stem: [Person(*mhr.as_ours(flat, deep)) for flat, deep, _ in mhr.people_of(f)] for f in dumps
        }
    if path.is_dir():
        files = sorted(path.glob("*.json"), key=lambda file: natural(file.stem))
        if not files:
            raise DataError(f"{path}: holds no .json files.")
        return {f.stem.removesuffix("_keypoints"): _frame(load_json(f), str(f), size) for f in files}
    content = load_json(path)
    if (entries := coco_entries(content, "keypoints", path)) is not None:
        out: dict[str, list[Person]] = {}
        for k, (name, row) in enumerate(entries):
            found = _person(row["keypoints"], f"{path}, entry {k}", row.get("idx", row.get("track_id")))
            out.setdefault(name, []).extend([] if found is None else [found])
        return out
    if isinstance(content, Mapping) and isinstance(content.get("instance_info"), list):  # MMPose's inferencer
        content = content["instance_info"]
    if isinstance(content, list) and content:
        return {str(k): _frame(row, f"{path}, entry {k}", size) for k, row in enumerate(content)}
    raise DataError(
        f"{path}: no key points of a known form: a list of image_id and keypoints (COCO, AlphaPose), of MediaPipe's "
        "results, or a folder of OpenPose's files."
    )


def _frame(content: Any, where: str, size: tuple[float, float]) -> list[Person]:
    """Returns the people of one frame: OpenPose's, MMPose's or MediaPipe's."""
    if content is None:
        return []
    if isinstance(content, Mapping) and isinstance(content.get("people"), list):
        people = content["people"]
        points = [_person(p.get("pose_keypoints_2d"), f"{where}, person {k}") for k, p in enumerate(people)]
        return [p for p in points if p is not None]
    if isinstance(content, Mapping) and isinstance(content.get("instances"), list):
        try:
            flat = [
                np.column_stack([one["keypoints"], one["keypoint_scores"]]).ravel()
                for one in content["instances"]
            ]
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(
                f"{where}: an instance needs `keypoints`, [K, 2], and `keypoint_scores`, [K] ({error!r})."
            ) from error
        return [p for p in (_person(f, where) for f in flat) if p is not None]
    if isinstance(content, list) and content and isinstance(content[0], Mapping) and "x" in content[0]:
        content = {"landmarks": [content]}
    if not isinstance(content, Mapping):
        raise DataError(f"{where}: holds no people.")
    flat_lists = _people_of(content, ("landmarks", "pose_landmarks", "poseLandmarks", "landmark"))
    deep = _people_of(content, ("worldLandmarks", "pose_world_landmarks", "poseWorldLandmarks"))
    if flat_lists is None:
        raise DataError(
            f"{where}: has none of people, landmarks, pose_landmarks; it has {', '.join(content)}."
        )
    out = []
    for k, marks in enumerate(flat_lists):
        if len(marks) != COUNT:
            raise DataError(f"{where}: {len(marks)} landmarks, expected MediaPipe's {COUNT}.")
        pixels = _numbers(marks, ("x", "y"), where) * np.array(size)
        sure = np.array([m.get("visibility", 1.0) * m.get("presence", 1.0) for m in marks], dtype=float)
        inside = ((pixels >= 0) & (pixels < np.array(size))).all(axis=1)
        world = None if deep is None or k >= len(deep) else _numbers(deep[k], ("x", "y", "z"), where)
        out.append(Person(pixels, np.where(inside, sure.clip(0, 1), 0.0), world))
    return out


def _people_of(content: Mapping[str, Any], keys: Sequence[str]) -> list[list[Mapping[str, Any]]] | None:
    for key in keys:
        value = content.get(key)
        if isinstance(value, Mapping):  # a protobuf's list, as a dict
            value = value.get("landmark", value.get("landmarks"))
        if isinstance(value, list):
            return [value] if value and isinstance(value[0], Mapping) else value
    return None


def _numbers(marks: Sequence[Mapping[str, Any]], axes: Sequence[str], where: str) -> Floats:
    try:
        values = np.array([[float(mark[axis]) for axis in axes] for mark in marks])
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{where}: a landmark has no number for {', '.join(axes)} ({error}).") from error
    if not np.isfinite(values).all():
        raise DataError(f"{where}: a landmark is NaN or infinite.")
    return values


def _person(flat: Any, where: str, track: Any = None) -> Person | None:
    """Returns a person of a list `x, y, confidence, ...`; None where no point is sure."""
    try:
        values = np.asarray(flat, dtype=np.float64).reshape(-1, 3)
    except (TypeError, ValueError) as error:
        raise DataError(f"{where}: key points are no list of x, y, confidence.") from error
    order = ORDERS.get(len(values))
    if order is None:
        raise DataError(f"{where}: {len(values)} key points; known are {', '.join(map(str, ORDERS))}.")
    if not np.isfinite(values).all():
        raise DataError(f"{where}: a key point is NaN or infinite.")
    pixels, confidence = np.zeros((COUNT, 2)), np.zeros(COUNT)
    for row, name in zip(values, order, strict=False):
        if name:
            # these tools count the middle of the first pixel as 0; COCO's truth has 1 hidden and 2 visible
            pixels[INDEX[name]], confidence[INDEX[name]] = row[:2] + 0.5, min(max(row[2], 0.0), 1.0)
    if not (confidence > 0).any():
        return None
    number = track[0] if isinstance(track, list) and track else track
    return Person(pixels, confidence, None, int(number) if isinstance(number, int | float) else None)


def _followed(frames: Sequence[Sequence[Person]], person: int | None, path: Path) -> list[Person | None]:
    """Returns one person in each frame: by the tool's own number, else by place from frame to frame."""
    if not any(frames):
        raise DataError(f"{path}: has nobody in the chosen frames.")
    most = max(len(people) for people in frames)
    if person is None:
        start, first = max(
            ((k, p) for k, people in enumerate(frames) for p in people),
            key=lambda pair: pair[1].size * pair[1].confidence.sum(),
        )
    else:
        start = next(k for k, people in enumerate(frames) if len(people) == most)
        ordered = sorted(frames[start], key=lambda p: p.middle[0])
        if not 1 <= person <= most:
            raise ConfigError(f"--person {person}: {path} has {most} in a frame; choose 1 to {most}.")
        first = ordered[person - 1]
    chosen: list[Person | None] = [None] * len(frames)
    for order in (range(start, len(frames)), range(start, -1, -1)):
        last = first
        for k in order:
            same = [p for p in frames[k] if first.track is not None and p.track == first.track]
            if first.track is None or not any(p.track is not None for p in frames[k]):
                near = sorted(frames[k], key=lambda p: float(np.linalg.norm(p.middle - last.middle)))
                same = [p for p in near if np.linalg.norm(p.middle - last.middle) < FAR * last.size]
            if same:
                chosen[k] = last = first if k == start else same[0]
    return chosen
