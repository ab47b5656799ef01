"""OcMotion as released with CHOMP: several cameras, all sequences in one pickle, no person masks.

| file | content |
|---|---|
| `annot/train.pkl`, `annot/test.pkl` | lists of sequences, of cameras, of frames: `{h_w, img_path, "0": person}` |
| person | `bbox` 2 x 2, `lsp_joints_2d` 14 x 3, `pose` 72, `betas` 10, `trans` 3, `intri` 3 x 3, `extri` 4 x 4 |
| `<img_path>` | pictures, as `images/0013/Camera02/000000.jpg`, below the folder or below `images/` |
| `mask/<img_path>.png` | made by the user; values may number the people |

`0013` is a sequence with all its cameras, `0013_02` its camera 02 alone, as Wild2Avatar calls it. Keys of people are
numbers, written as numbers or as text; frames without people are normal. Lists of frames without cameras around them
are cameras too, and those of one sequence belong together. `x = SMPL(pose, betas) + trans`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath

from occfusion.data.cameras import FixedCamera
from occfusion.data.checking import checks
from occfusion.data.folder_contents import need
from occfusion.data.ocmotion.ocmotion_annotations import (
    SAME_PLACE,
    Found,
    FrameSets,
    Person,
    Shot,
    annotation_files,
    count_people,
    distance,
    find_sequence,
    frame_sets_in_words,
    pair,
    person_number,
    read_shots,
    sequence_names,
    successor,
)
from occfusion.data.ocmotion.ocmotion_joints import COMPARED_FRAMES, Posing, limb_distances, limb_warnings
from occfusion.data.sampling import evenly
from occfusion.data.scene import Array, BodyParameters, Calibration, PictureFiles, Scene, Taken
from occfusion.errors import ConfigError, DataError
from occfusion.files.images import image_size

__all__ = ["ChompScene", "sequence_names"]

MASKS = "mask"

_READ = ("pose", "betas", "trans", "intri", "extri", "lsp_joints_2d", "bbox")


class ChompScene(Scene):
    """One sequence of the raw release: the moments at which each of its cameras shows the wanted person."""

    def __init__(
        self,
        folder: Path,
        sequence: str,
        pelvis: Callable[[Array], Array],
        masks: str = MASKS,
        person: int | None = None,
        *,
        numbered: bool = False,
    ) -> None:
        """Reads the annotations.

        Args:
            folder: the folder that holds `annot/`.
            sequence: its name: the folder above the cameras' in the pictures' paths, else as `train/3`; with `_02`
                behind it, its camera 02 alone.
            pelvis: gives the pelvis at rest, `[3]` in metres, for shape coefficients `[B]`.
            masks: mask folder.
            person: number of the person; the one in the most pictures when None.
            numbered: masks hold the people's numbers; else everything but 0 is the person.

        Raises:
            ConfigError: no such sequence, camera or person.
            DataError: a key is missing, or what is there cannot be.
        """
        self.name, self.root, self._pelvis = sequence, folder, pelvis
        found = find_sequence(folder, sequence)
        self._file = found.file
        shots = [
            read_shots(rows, f"{self._file}, {sequence}, camera {c}") for c, rows in enumerate(found.cameras)
        ]
        self._person = _choose(shots, person, self._file)
        frame_sets = pair(shots)
        self._shots = [
            frame_set
            for frame_set in frame_sets.shots
            if all(self._person in shot.people for shot in frame_set)
        ]
        if not self._shots:
            raise DataError(f"{self._file}, {sequence}: person {self._person} is in no frame of all cameras.")
        self._where = [
            f"{self._file}, {sequence}, frame {frame_set[0].place}, person {self._person}"
            for frame_set in self._shots
        ]
        self._label = self._person if numbered else None
        self.num_frames = len(self._shots)
        self.cameras = tuple(shot.path.parent.as_posix() for shot in self._shots[0])
        first = self._shots[0][0].path
        self._base = folder if (folder / first).exists() else folder / "images"
        self._mask_folder, self._mask_parts = _mask_place(folder, masks, first)
        self._check_sizes()
        self._rigs = [self._rig(camera) for camera in range(len(self.cameras))]
        self.remarks = tuple(self._remarks(shots, frame_sets, numbered))
        self.taken = self._say(found, shots, frame_sets)

    def calibration(self, camera: int) -> Calibration:
        """Returns a camera."""
        return self._rigs[camera].calibration

    def parameters(self, frame: int) -> BodyParameters:
        """Returns the body of a frame, in the world of the first camera's annotation."""
        row, where = self._row(frame, 0), self._where[frame]
        poses = checks.numbers(need(row, "pose", where), 72, f"{where}, pose")
        betas = checks.shape_numbers(need(row, "betas", where), f"{where}, betas")
        transl = checks.numbers(need(row, "trans", where), 3, f"{where}, trans")
        body = BodyParameters(betas, poses[:3], poses[3:], transl)
        return self._rigs[0].carry(frame, body, self._pelvis(betas))

    def files(self, frame: int, camera: int) -> PictureFiles:
        """Returns the paths of one picture and its mask."""
        path = self._shots[frame][camera].path
        mask = self._mask_folder.joinpath(*path.parts[self._mask_parts :]).with_suffix(".png")
        name = path.with_suffix("").as_posix()
        return PictureFiles(name, self._base / path, (mask,), None, None, True, self._label)

    def evidence(self, frame: int) -> tuple[Path, ...]:
        """Returns the annotations."""
        return (self._file,)

    def body_warnings(self, pose: Posing) -> list[str]:
        """Returns a sentence where the body's limbs are far from the annotated key points of the first camera."""
        found = []
        for frame in evenly(range(self.num_frames), COMPARED_FRAMES):
            row, where = self._row(frame, 0), f"{self._where[frame]}, lsp_joints_2d"
            if "lsp_joints_2d" in row:
                joints = pose(self.parameters(frame))[1]
                found.append(limb_distances(row["lsp_joints_2d"], joints, self.calibration(0), where))
        return limb_warnings(found, f"{self._file}, {self.name}, person {self._person}")

    def require_masks(self) -> None:
        """Raises DataError where there is not one mask: the data set comes without."""
        if self._mask_folder.is_dir():
            return
        example = self.files(0, 0)
        raise DataError(
            f"{self._mask_folder}: no such folder. OcMotion comes without person masks: make one for each picture "
            f"with a segmenter, 0 and 255 (255 the visible person alone), at {example.masks[0]} for {example.rgb}; or "
            "use Wild2Avatar's cut, which has masks. dataset.masks names another folder."
        )

    def _row(self, frame: int, camera: int) -> Person:
        return self._shots[frame][camera].people[self._person]

    def _rig(self, camera: int) -> FixedCamera:
        where = [f"{at}, camera {camera}" for at in self._where]
        people = [self._row(frame, camera) for frame in range(self.num_frames)]
        return FixedCamera.of_rows(self.cameras[camera], people, where, ("intri", "extri"))

    def _check_sizes(self) -> None:
        """Raises DataError where a camera's first picture is not of the declared size."""
        for camera, shot in enumerate(self._shots[0]):
            path, at = self._base / shot.path, f"{self._where[0]}, camera {camera}"
            if shot.size is None or not path.is_file():
                continue
            height, width = checks.numbers(shot.size, 2, f"{at}, h_w").tolist()
            if (real := image_size(path)) != (width, height):
                raise DataError(
                    f"{path}: has {real[0]} x {real[1]} pixels, but {at} was annotated in {width:.0f} x {height:.0f} "
                    "(h_w is height, width). Use the pictures as they were released; dataset.image_size scales them."
                )

    def _remarks(self, shots: list[list[Shot]], frame_sets: FrameSets, numbered: bool) -> Iterator[str]:
        where, person = f"{self._file}, {self.name}", self._person
        others = sorted(count_people(shots).keys() - {person})
        if others and not numbered:
            yield (
                f"{where}: the people {', '.join(map(str, others))} are annotated beside "
                f"person {person}; masks must show {person} alone. If their values are the people's ids, set "
                f"dataset.numbered_masks=true dataset.person={person} (in check: --numbered-masks --person {person})."
            )
        if (other := successor([frame_set[0] for frame_set in frame_sets.shots], person)) is not None:
            number, shot, gap = other
            yield (
                f"{where}: person {number} begins in frame {shot.place}, {100 * gap:.0f} cm from where person {person} "
                f"ends: one person under two numbers? dataset.person={number} trains on the other part; to have both, "
                "give them one number in the annotations."
            )
        if (camera := self._strange_camera()) is not None:
            yield (
                f"{where}: person {person} of camera {self.cameras[camera]} is more than {SAME_PLACE:g} m from person "
                f"{person} of camera {self.cameras[0]} at the same moment: another person under this number, or "
                f"another world. Train on one camera, as dataset.scene={_alone(self.name, self.cameras[0])}."
            )

    def _strange_camera(self) -> int | None:
        """Returns the first camera whose annotation places the person elsewhere than the first camera's."""
        for camera in range(1, len(self.cameras)):
            for frame in evenly(range(self.num_frames), COMPARED_FRAMES):
                gap = distance(self._row(frame, 0), self._row(frame, camera))
                if gap is not None and gap > SAME_PLACE:
                    return camera
        return None

    def _say(self, found: Found, shots: list[list[Shot]], frame_sets: FrameSets) -> Taken:
        person, place = self._person, f"annot/{self._file.name}"
        key = next(key for row in found.cameras[0] for key in row if person_number(key) == person)
        shapes = len({repr(self._row(frame, 0).get("betas")) for frame in range(self.num_frames)})
        moves = self._rigs[0].moves
        there = self._mask_folder.is_dir()
        values = "every value but 0" if self._label is None else f"value {self._label}"
        return Taken(
            layout="OcMotion as released with CHOMP (chomp), "
            + ("lists of frames, grouped by sequence" if found.is_flat else "sequences, cameras, frames"),
            pictures=frame_sets_in_words(frame_sets, person, self.num_frames, place),
            body=f"{place}: SMPL(pose, betas) + trans of person {person} (key {key!r})"
            + (f", from the rows of {self.cameras[0]}" if len(self.cameras) > 1 else ""),
            shape=f"betas of {place}, "
            + ("the same in all frames" if shapes == 1 else f"{shapes} shapes, each frame its own"),
            masks=f"{self._mask_folder.name}/ with the picture's path, {values}"
            if there
            else f"none: {self._mask_folder.name}/ is not there, and OcMotion comes without",
            cameras=f"{place}: intri and extri of {', '.join(self.cameras)}; "
            + ("the first moves, which is carried over to the person" if moves else "the first stands still"),
            centres="0 (OpenCV)",
            others="; ".join(
                _others(found, self._file, self._row(0, 0), count_people(shots).keys() - {person})
            ),
        )


def _choose(cameras: list[list[Shot]], person: int | None, file: Path) -> int:
    people = count_people(cameras)
    if not people:
        raise DataError(f"{file}: no person is annotated in this sequence.")
    if person is None:
        return min(people, key=lambda number: (-people[number], number))
    if person not in people:
        known = ", ".join(str(known) for known in sorted(people))
        raise ConfigError(f"dataset.person={person}: the sequence has the people {known}.")
    return person


def _mask_place(folder: Path, masks: str, first: PurePosixPath) -> tuple[Path, int]:
    """Returns the folder of masks, and how many parts of a picture's path it leaves out: 0, or `images`."""
    root = folder / masks
    short = root.joinpath(*first.parts[1:]).with_suffix(".png")
    is_short = (
        first.parts[0] == "images" and not (root / first).with_suffix(".png").exists() and short.exists()
    )
    return root, int(is_short)


def _alone(name: str, camera: str) -> str:
    number = PurePosixPath(camera).name[-2:]
    return f"{name}_{number}" if number.isdecimal() else f"{name}_<camera>"


def _others(found: Found, file: Path, row: Person, people: set[int]) -> Iterator[str]:
    """Yields what else the annotations have and how to ask for it."""
    if found.unread:
        yield f"cameras {', '.join(found.unread)} (dataset.scene={found.name} takes all)"
    if people:
        yield f"people {', '.join(map(str, sorted(people)))} (dataset.person)"
    if unread := [str(key) for key in row if key not in _READ]:
        yield f"of the person: {', '.join(unread[:12])}"
    if spare := [f"annot/{other.name}" for other in annotation_files(file.parents[1]) if other != file]:
        yield f"{spare[0]}, whose sequences are named in the same way"
