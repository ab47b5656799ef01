"""OcMotion as released with CHOMP: several cameras, all sequences in one pickle, no person masks.

| file | content |
|---|---|
| `annot/train.pkl`, `annot/test.pkl` | list of sequences, of cameras, of frames: `{h_w, img_path, "<id>": person}` |
| person | `bbox` 2 x 2, `lsp_joints_2d` 14 x 3, `pose` 72, `betas` 10, `trans` 3, `intri` 3 x 3, `extri` 4 x 4 |
| `<img_path>` | pictures, below the folder or below `images/` |
| `mask/<img_path>.png` | made by the user; values may number the people by id |
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from occfusion.data import checks
from occfusion.data.annots import inside
from occfusion.data.fixed_camera import FixedCamera
from occfusion.data.humannerf_layout import need
from occfusion.data.lens import OPENCV_CENTRE
from occfusion.data.listing import MAX_DIGITS
from occfusion.data.scene import Array, BodyParameters, Calibration, PictureFiles, Scene
from occfusion.errors import ConfigError, DataError
from occfusion.files.thinned import Thin, load_thinned
from occfusion.files.unpickle import load_pickle

PATH = "img_path"


class ChompScene(Scene):
    """One sequence of the raw release: the frames that all cameras have and that show the wanted person."""

    def __init__(
        self,
        folder: Path,
        sequence: str,
        pelvis: Callable[[Array], Array],
        masks: str = "mask",
        person: int | None = None,
        *,
        numbered: bool = False,
    ) -> None:
        """Reads the annotations.

        Args:
            folder: the folder that holds `annot/`.
            sequence: its name: the folder above the cameras' in the pictures' paths, else as `train/3`.
            pelvis: gives the pelvis at rest, `[3]` in metres, for shape coefficients `[B]`.
            masks: mask folder.
            person: id of the person; the one in the most frames when None.
            numbered: masks hold the people's ids; else everything but 0 is the person.

        Raises:
            DataError: no such sequence or person, a key is missing, or what is there cannot be.
        """
        self.name, self.root, self._pelvis, self._mask_folder = sequence, folder, pelvis, masks
        self._file, cameras = _find(folder, sequence)
        self._person = _choose(cameras, person, self._file)
        key = str(self._person)
        count = min(len(camera) for camera in cameras)
        kept = [i for i in range(count) if all(isinstance(c[i].get(key), Mapping) for c in cameras)]
        if not kept:
            raise DataError(f"{self._file}, {sequence}: person {key} is in no frame of all cameras.")
        self._frames = [[camera[i] for i in kept] for camera in cameras]
        self._where = [f"{self._file}, {sequence}, frame {i}, person {key}" for i in kept]
        self._label = self._person if numbered else None
        self._base = folder / "images" if not (folder / self._path(0, 0)).exists() else folder
        self.num_frames = len(kept)
        self.cameras = tuple(self._path(0, c).parent.as_posix() for c in range(len(cameras)))
        others = _people(cameras).keys() - {self._person}
        if others and not numbered:
            self.remarks = (
                f"{self._file}, {sequence}: the people {', '.join(map(str, sorted(others)))} are annotated beside "
                f"person {key}; masks must show {key} alone. If their values are the people's ids, set "
                f"dataset.numbered_masks=true dataset.person={key} (in check: --numbered-masks --person {key}).",
            )
        self._rigs = [self._rig(camera) for camera in range(len(cameras))]

    def calibration(self, camera: int) -> Calibration:
        """Returns a camera."""
        return self._rigs[camera].calibration

    def parameters(self, frame: int) -> BodyParameters:
        """Returns the body of a frame, in the world of the first camera's annotation."""
        row, where = self._frames[0][frame][str(self._person)], self._where[frame]
        poses = checks.numbers(need(row, "pose", where), 72, f"{where}, pose")
        betas = checks.shape_numbers(need(row, "betas", where), f"{where}, betas")
        transl = checks.numbers(need(row, "trans", where), 3, f"{where}, trans")
        body = BodyParameters(betas, poses[:3], poses[3:], transl)
        return self._rigs[0].carry(frame, body, self._pelvis(betas))

    def files(self, frame: int, camera: int) -> PictureFiles:
        """Returns the paths of one picture and its mask."""
        path = self._path(frame, camera)
        mask = self.root / self._mask_folder / path.with_suffix(".png")
        name = path.with_suffix("").as_posix()
        return PictureFiles(name, self._base / path, (mask,), None, None, True, self._label)

    def evidence(self, frame: int) -> tuple[Path, ...]:
        """Returns the annotations."""
        return (self._file,)

    def _path(self, frame: int, camera: int) -> PurePosixPath:
        where = self._where[frame]
        return PurePosixPath(inside(need(self._frames[camera][frame], "img_path", where), where))

    def _rig(self, camera: int) -> FixedCamera:
        where = [f"{at}, camera {camera}" for at in self._where]
        people = [frame[str(self._person)] for frame in self._frames[camera]]
        return FixedCamera(
            self.cameras[camera],
            [need(row, "intri", at) for row, at in zip(people, where, strict=True)],
            [need(row, "extri", at) for row, at in zip(people, where, strict=True)],
            None,
            where,
            OPENCV_CENTRE,
        )


def sequence_name(path: object) -> str:
    """Returns the name of a picture's sequence: the folder above its camera's; empty where the path has none."""
    parts = PurePosixPath(str(path)).parts
    return parts[-3] if len(parts) >= 3 else ""


def sequence_names(folder: Path) -> list[str]:
    """Returns the names of all sequences in the annotations of a folder, in order."""
    return [name for _, _, name, _ in _all(folder, None)]


Sequence = list[list[Mapping[str, Any]]]
"""Cameras of frames."""


def _all(folder: Path, wanted: str | None) -> Iterator[tuple[Path, int, str, Sequence]]:
    """Yields file, place in it, name and frames of all sequences; frames not wanted have nothing but a path."""
    for file in (folder / "annot" / "train.pkl", folder / "annot" / "test.pkl"):
        if file.is_file():
            for number, cameras in enumerate(_sequences(load_thinned(file, _dropping_all_but(wanted)), file)):
                name = sequence_name(cameras[0][0].get(PATH, "")) or f"{file.stem}/{number}"
                yield file, number, name, cameras


def _dropping_all_but(wanted: str | None) -> Thin:
    """Returns what drops the frames of all other sequences; where the path names none, the frame is kept."""
    stands: dict[str, dict[str, str]] = {}

    def thin(frame: dict[Any, Any]) -> object | None:
        path = frame.get(PATH)
        if not isinstance(path, str) or sequence_name(path) in ("", wanted):
            return None
        return stands.setdefault(path.rpartition("/")[0], {PATH: path})  # one for each folder of pictures

    return thin


def _find(folder: Path, sequence: str) -> tuple[Path, Sequence]:
    names: list[str] = []
    for file, number, name, cameras in _all(folder, sequence):
        if sequence == name:
            if any(frame.keys() == {PATH} for frames in cameras for frame in frames):
                # pictures of one sequence lie in folders of several names: rare, and then everything is read
                cameras = _sequences(load_pickle(file), file)[number]
            return file, cameras
        names.append(name)
    if not names:
        raise DataError(f"{folder / 'annot'}: holds neither train.pkl nor test.pkl.")
    raise ConfigError(
        f"dataset.scene={sequence!r}: the annotations in {folder / 'annot'} have {', '.join(names)[:400]}."
    )


def _sequences(content: Any, file: Path) -> list[list[list[Mapping[str, Any]]]]:
    """Returns sequences, cameras, frames, their nesting checked."""
    if not isinstance(content, (list, tuple)):
        raise DataError(f"{file}: holds a {type(content).__name__}, not a list of sequences.")
    for number, cameras in enumerate(content):
        if not isinstance(cameras, (list, tuple)) or not cameras:
            raise DataError(f"{file}: sequence {number} is no list of cameras.")
        for camera, frames in enumerate(cameras):
            if not isinstance(frames, (list, tuple)) or not frames:
                raise DataError(f"{file}: sequence {number}, camera {camera} is no list of frames.")
            for index, frame in enumerate(frames):
                if not isinstance(frame, Mapping):
                    raise DataError(f"{file}: sequence {number}, camera {camera}, frame {index} is no table.")
    return list(content)


def _people(cameras: list[list[Mapping[str, Any]]]) -> Counter[int]:
    """Returns in how many frames each person is annotated, by id."""
    return Counter(
        int(key) for frames in cameras for frame in frames for key, value in frame.items()
        if str(key).isdecimal() and len(str(key)) <= MAX_DIGITS and isinstance(value, Mapping)
    )  # fmt: skip


def _choose(cameras: list[list[Mapping[str, Any]]], person: int | None, file: Path) -> int:
    people = _people(cameras)
    if not people:
        raise DataError(f"{file}: no person is annotated in this sequence.")
    if person is None:
        return people.most_common(1)[0][0]
    if person not in people:
        known = ", ".join(str(known) for known in sorted(people))
        raise ConfigError(f"dataset.person={person}: the sequence has the people {known}.")
    return person
