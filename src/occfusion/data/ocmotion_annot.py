"""The pickles of OcMotion as released: which sequences they have, and the rows of one of them.

Upstream reads lists of sequences, of cameras, of frames. Lists of frames without cameras around them, as its authors'
other data sets have, are taken for cameras; those of one sequence are put together.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

from occfusion.data.ocmotion_moments import PATH, last_number
from occfusion.errors import ConfigError, DataError
from occfusion.files.thinned import Thin, load_thinned
from occfusion.files.unpickle import load_pickle

_CAMERA = re.compile(r"(.+)_(\d{1,3})\Z")
_CLIP = re.compile(r"(.+?)_(\d{1,3})_\d{1,3}\Z")


class Found(NamedTuple):
    """A sequence in the annotations.

    Attributes:
        file: the annotations.
        number: its place in them.
        name: of the sequence.
        cameras: the rows of each camera that is read.
        is_flat: the file has lists of frames, without a level of cameras.
        unread: folders of the sequence's other cameras.
    """

    file: Path
    number: int
    name: str
    cameras: list[list[Mapping[Any, Any]]]
    is_flat: bool
    unread: tuple[str, ...] = ()


def sequence_name(path: object) -> str:
    """Returns the name of a picture's sequence: the folder above its camera's; empty where the path has none."""
    parts = _posix(path).parts
    return parts[-3] if len(parts) >= 3 else ""


def sequence_names(folder: Path) -> list[str]:
    """Returns the names of all sequences in the annotations of a folder, in order."""
    return [found.name for file in annotation_files(folder) for found in _all(file, set())]


def _posix(path: object) -> PurePosixPath:
    return PurePosixPath(str(path).replace("\\", "/"))


def annotation_files(folder: Path) -> list[Path]:
    """Returns the annotations that a folder has."""
    return [file for name in ("train.pkl", "test.pkl") if (file := folder / "annot" / name).is_file()]


def _all(file: Path, wanted: set[str]) -> list[Found]:
    """Returns all sequences of a file; frames of those not wanted have nothing but a path."""
    return _grouped(load_thinned(file, _dropping_all_but(wanted)), file)


def _dropping_all_but(wanted: set[str]) -> Thin:
    """Returns what drops the frames of all other sequences; where the path names none, the frame is kept."""
    stands: dict[PurePosixPath, dict[str, str]] = {}

    def thin(frame: dict[Any, Any]) -> object | None:
        path = frame.get(PATH)
        if not isinstance(path, str) or sequence_name(path) in ("", *wanted):
            return None
        return stands.setdefault(_posix(path).parent, {PATH: path})  # one for each folder of pictures

    return thin


def find_sequence(folder: Path, sequence: str) -> Found:
    """Returns a sequence, or one camera of it.

    Args:
        folder: the folder that holds `annot/`.
        sequence: its name; with `_02` behind it, its camera 02 alone.

    Raises:
        ConfigError: no such sequence or camera.
        DataError: no annotations, or they are damaged.
    """
    camera, clip = _CAMERA.match(sequence), _CLIP.match(sequence)
    wanted = {sequence, *(match[1] for match in (camera, clip) if match)}
    names: list[str] = []
    for file in annotation_files(folder):
        by_name = {found.name: found for found in _all(file, wanted)}
        if sequence in by_name:
            return _complete(by_name[sequence])
        if camera and camera[1] in by_name:
            return _one_camera(_complete(by_name[camera[1]]), int(camera[2]), sequence)
        if clip and clip[1] in by_name:
            raise ConfigError(
                f"dataset.scene={sequence!r}: {sequence} is a clip that Wild2Avatar cut from camera {clip[2]} of "
                f"{clip[1]}, and {file} does not say where it begins. Set dataset.scene={clip[1]}_{clip[2]} and "
                "dataset.train_frames=[start, stop, 2]."
            )
        names += by_name
    if not names:
        raise DataError(f"{folder / 'annot'}: holds neither train.pkl nor test.pkl.")
    raise ConfigError(
        f"dataset.scene={sequence!r}: the annotations in {folder / 'annot'} have {', '.join(names)[:400]}; one camera "
        f"alone is called as {names[0]}_02."
    )


def _complete(found: Found) -> Found:
    """Returns a sequence with all its frames."""
    if any(row.keys() == {PATH} for rows in found.cameras for row in rows):
        # pictures of one sequence lie in folders of several names: rare, and then everything is read
        everything = _grouped(load_pickle(found.file), found.file)
        return next(other for other in everything if other.number == found.number)
    return found


def _one_camera(found: Found, number: int, sequence: str) -> Found:
    """Returns a sequence with the camera of a number alone, by the name of its pictures' folder."""
    folders = [_posix(rows[0].get(PATH, "")).parent for rows in found.cameras]
    numbers = [last_number(folder.name) for folder in folders]
    if numbers.count(number) != 1:
        raise ConfigError(
            f"dataset.scene={sequence!r}: {found.file}, {found.name} has no camera {number}; its pictures lie in "
            f"{', '.join(map(str, folders))}."
        )
    chosen = numbers.index(number)
    unread = tuple(folder.name for k, folder in enumerate(folders) if k != chosen)
    return found._replace(cameras=[found.cameras[chosen]], unread=unread)


def _grouped(content: Any, file: Path) -> list[Found]:
    """Returns the sequences of a file, their nesting checked; empty lists are left out."""
    if not isinstance(content, (list, tuple)):
        raise DataError(f"{file}: holds a {type(content).__name__}, not a list of sequences.")
    found: dict[str, Found] = {}
    for number, entry in enumerate(content):
        if not isinstance(entry, (list, tuple)):
            raise DataError(f"{file}: sequence {number} is no list of cameras.")
        is_flat = bool(entry) and isinstance(entry[0], Mapping)
        cameras = [
            rows
            for c, rows in enumerate([entry] if is_flat else entry)
            if _checked_rows(rows, file, number, c)
        ]
        if not cameras:
            continue
        name = sequence_name(cameras[0][0].get(PATH, "")) or f"{file.stem}/{number}"
        if is_flat and name in found and found[name].is_flat:
            found[name] = found[name]._replace(cameras=[*found[name].cameras, *cameras])
        else:
            known = name if name not in found else f"{file.stem}/{number}"
            found[known] = Found(file, number, known, cameras, is_flat)
    return list(found.values())


def _checked_rows(rows: Any, file: Path, number: int, camera: int) -> bool:
    """Returns whether a camera has frames; raises DataError where it is no list of tables."""
    if not isinstance(rows, (list, tuple)):
        raise DataError(f"{file}: sequence {number}, camera {camera} is no list of frames.")
    for index, row in enumerate(rows):
        if not isinstance(row, Mapping):
            raise DataError(f"{file}: sequence {number}, camera {camera}, frame {index} is no table.")
    return bool(rows)
