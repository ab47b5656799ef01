"""One's own footage, in the form that PeopleSnapshot and NeuMan have come to: one camera, one folder."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from occfusion.data.cameras import FixedCamera
from occfusion.data.checking import checks
from occfusion.data.folder_contents import MASK_SUFFIXES, need, pictures_in
from occfusion.data.scene import Array, BodyParameters, Calibration, PictureFiles, Scene, Taken
from occfusion.data.video.pose_table import WIDTHS
from occfusion.data.video.pose_tracks import Track, Tracks, open_tracks
from occfusion.data.video.video_form import AUTO, CENTRES, Form, Pairs, find_form, instantavatar_marks, pair
from occfusion.data.video.video_shape import BetasSetting, choose_betas
from occfusion.errors import DataError
from occfusion.files.arrays import load_npz
from occfusion.files.images import MASK_ARRAY, image_size


def _remarks(cameras: Path, form: Form, tracks: Tracks) -> tuple[str, ...]:
    """Returns what is doubtful: poses fitted under one camera beside another program's."""
    fitted = [track.name for track in tracks.read if "anim_nerf" in track.name]
    if not (form.assumed_camera and fitted):
        return ()
    return (
        f"{cameras}: is the camera that ROMP assumes for every video, but {fitted[0]} was fitted under "
        "PeopleSnapshot's own; process-sequence.sh has written over it. Write it again with "
        "preprocess_PeopleSnapshot.py, or read poses.npz (dataset.poses).",
    )


def _said(track: Track) -> str:
    pictures, rows = track.pictures, len(track.motion)
    where = f"[{pictures.start}, {pictures.stop}, {pictures.step}]"
    return (
        f"{track.name} ({track.motion.form}), {rows} rows for the pictures {where}, known by {track.known_by}"
    )


CAMERAS = "cameras.npz"
_CAMERA_KEYS = ("intrinsic", "extrinsic", "height", "width", "distortion", CENTRES)


class VideoScene(Scene):
    """A folder with `cameras.npz` and a pose file.

    Attributes:
        pictures: the picture of each frame, by its place in the folder, from 0.
    """

    pictures: tuple[int, ...]

    def __init__(
        self,
        folder: Path,
        pelvis: Callable[[Array], Array],
        masks: str = "masks",
        person: int | None = None,
        *,
        occluded: bool = True,
        poses: str | None = None,
        track_frames: Sequence[object] | None = None,
        betas: BetasSetting = None,
        pixel_centres: object = AUTO,
    ) -> None:
        """Reads cameras and poses and lists the pictures.

        Args:
            folder: the sequence's folder.
            pelvis: gives the pelvis at rest, `[3]` in metres, for shape coefficients `[B]`.
            masks: mask folder.
            person: the value of the wanted person in masks that number several.
            occluded: whether things may stand before the person.
            poses: pose file, relative to the folder; None for what InstantAvatar's program would read.
            track_frames: `[start, stop, step]` of the pictures that the pose file covers; None to find out.
            betas: shape coefficients: None, a count, `zeros`, numbers, or a file.
            pixel_centres: `auto`, 0 or 0.5.

        Raises:
            ConfigError: a setting is out of its range or does not fit the folder.
            DataError: a file, key or frame is missing, or what they hold cannot be.
        """
        self.name, self.root, self.cameras = folder.name, folder, ("camera",)
        self._pelvis, self._person, self._occluded = pelvis, person, occluded
        images = pictures_in(folder / "images")
        mask_files = pictures_in(folder / masks, MASK_SUFFIXES, prefer=MASK_ARRAY)
        marks = instantavatar_marks(folder, mask_files)
        pairs = pair(list(images), mask_files, folder / masks, complete=not marks)
        tracks = open_tracks(folder, len(pairs.names), poses, track_frames)
        shapes = {track.name: choose_betas(betas, track.motion, folder, pelvis) for track in tracks.read}
        self._betas = {name: found for name, (found, _) in shapes.items()}
        rows = tracks.rows()
        self.pictures = tuple(k for k in rows if pairs.names[k] in pairs.masks)
        if not self.pictures:
            raise DataError(f"{folder}: no picture has both a pose and a mask.")
        self._rows: list[tuple[Track, int]] = [rows[k] for k in self.pictures]
        self._names = [pairs.names[k] for k in self.pictures]
        self._pictures = [images[name] for name in self._names]
        self._masks = [pairs.masks[name] for name in self._names]
        self.num_frames = len(self._names)
        content = load_npz(folder / CAMERAS, _CAMERA_KEYS)
        form = find_form(marks, tracks, content, pixel_centres, folder / CAMERAS)
        self._camera = self._read_camera(content, len(pairs.names), form.shift)
        self.remarks = _remarks(folder / CAMERAS, form, tracks)
        moving = any(
            np.ndim(content[key]) == 3 and len(content[key]) > 1 for key in ("intrinsic", "extrinsic")
        )
        said = (text for _, text in shapes.values())
        self.taken = self._account(pairs, tracks, form, masks, shapes=said, moving=moving)

    def calibration(self, camera: int) -> Calibration:
        """Returns the one camera there is."""
        return self._camera.calibration

    def parameters(self, frame: int) -> BodyParameters:
        """Returns the body of a frame."""
        track, row = self._rows[frame]
        where = f"{self.root / track.name}, row {row}"
        values = {
            key: checks.numbers(getattr(track.motion, key)[row], width, f"{where}, {key}")
            for key, width in WIDTHS.items()
        }
        betas = self._betas[track.name]
        betas = checks.shape_numbers(betas[row if len(betas) > 1 else 0], f"{where}, betas")
        body = BodyParameters(betas, values["global_orient"], values["body_pose"], values["transl"])
        return self._camera.carry(frame, body, self._pelvis(betas))

    def files(self, frame: int, camera: int) -> PictureFiles:
        """Returns the paths of one picture and its mask."""
        mask = self._masks[frame]
        return PictureFiles(
            self._names[frame], self._pictures[frame], (mask,), None, None, self._occluded, self._person
        )

    def evidence(self, frame: int) -> tuple[Path, ...]:
        """Returns the camera's file and that of the frame's pose."""
        return self.root / CAMERAS, self.root / self._rows[frame][0].name

    def _account(
        self, pairs: Pairs, tracks: Tracks, form: Form, masks: str, *, shapes: Iterable[str], moving: bool
    ) -> Taken:
        without_pose = len(pairs.masks) - self.num_frames
        lost = [f"{pairs.unmasked} dropped for want of a mask"] if pairs.unmasked else []
        lost += [f"{without_pose} dropped because no pose track covers them"] if without_pose else []
        left_out = sorted({track.motion.left_out for track in tracks.read if track.motion.left_out})
        suffix = next(iter(pairs.masks.values())).suffix
        values = "every value but 0" if self._person is None else f"value {self._person} (dataset.person)"
        folders = [
            path.name for path in sorted(self.root.glob("masks*")) if path.is_dir() and path.name != masks
        ]
        others = [*tracks.others, *(f"{name}/ (dataset.masks={name} reads it)" for name in folders)]
        others += [f"{pairs.lone_masks} masks that belong to no picture"] if pairs.lone_masks else []
        return Taken(
            layout="video" + (", as InstantAvatar's scripts write it" if form.marks else ""),
            pictures=f"images/, {self.num_frames} of {pairs.pictures}"
            + "".join(f"; {text}" for text in lost),
            body="; ".join(map(_said, tracks.read)) + "".join(f"; left out: {text}" for text in left_out),
            shape="; ".join(dict.fromkeys(shapes)),
            masks=f"{masks}/, {suffix} files; the person is {values}",
            cameras="cameras.npz, "
            + ("given for each picture" if moving else "one that stands still")
            + (", the one that ROMP assumes for every video" if form.assumed_camera else ""),
            centres=form.centres,
            others="; ".join(others),
        )

    def _read_camera(self, content: dict[str, np.ndarray], pictures: int, shift: float) -> FixedCamera:
        file = self.root / CAMERAS
        where = [f"{file}, {name}" for name in self._names]
        given = {key: np.asarray(need(content, key, str(file))) for key in ("intrinsic", "extrinsic")}
        rows = {}
        for key, value in given.items():
            if value.ndim == 2:
                rows[key] = [value] * self.num_frames
            elif value.ndim == 3 and len(value) in (1, pictures):
                rows[key] = [value[k if len(value) > 1 else 0] for k in self.pictures]
            else:
                raise DataError(
                    f"{file}, {key} has shape {value.shape}; give one matrix, or one for each of the "
                    f"{pictures} pictures."
                )
        self._check_size(content, file)
        bent = content.get("distortion")
        distortions = None if bent is None else [bent] * self.num_frames
        return FixedCamera("camera", rows["intrinsic"], rows["extrinsic"], distortions, where, shift)

    def _check_size(self, content: dict[str, np.ndarray], file: Path) -> None:
        """Raises DataError when the camera was calibrated for pictures of another size."""
        if "width" not in content or "height" not in content:
            return
        declared = [int(checks.numbers(content[key], 1, f"{file}, {key}")[0]) for key in ("width", "height")]
        actual = list(image_size(self._pictures[0]))
        if declared != actual:
            raise DataError(
                f"{file}: calibrated for {declared[0]} x {declared[1]} pixels, but {self._pictures[0].name} has "
                f"{actual[0]} x {actual[1]}; scale intrinsic with the pictures, and correct width and height."
            )
