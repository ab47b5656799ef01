"""One's own footage as a LightningDataModule (PeopleSnapshot's and NeuMan's form)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from occfusion.data.layouts import find_layout, noted
from occfusion.data.module import HumanDataModule
from occfusion.data.occlusion import OcclusionSettings
from occfusion.data.posing import RestBody
from occfusion.data.prepare import Selection
from occfusion.data.scene import Scene
from occfusion.data.video.video_form import AUTO
from occfusion.data.video.video_layout import CAMERAS, VideoScene
from occfusion.data.video.video_protocols import find_ranges
from occfusion.data.video.video_shape import BetasSetting
from occfusion.errors import ConfigError


class VideoDataModule(HumanDataModule):
    """Frames of one video of one person; nothing is held out unless `test_frames` or a protocol say so."""

    def __init__(
        self,
        root: Path | str | None,
        scene: str | None,
        body: RestBody,
        image_size: int = 512,
        train_camera: int = 0,
        test_cameras: Sequence[int] | None = None,
        train_frames: Sequence[int | None] | None = None,
        test_frames: Sequence[int | None] | None = None,
        max_train_frames: int | None = None,
        occlusion: str | Mapping[str, Any] | OcclusionSettings | None = "none",
        masks: str = "masks",
        person: int | None = None,
        occluded: bool = True,
        protocol: str | None = None,
        poses: str | None = None,
        track_frames: Sequence[Any] | None = None,
        betas: BetasSetting = None,
        pixel_centres: str | float = AUTO,
        layout: str = AUTO,
        seed: int = 0,
    ) -> None:
        """Keeps the settings; nothing is read before `setup` or `validate`.

        Args:
            root: the folder that holds the sequences.
            scene: the sequence's folder.
            body: the body the parameters belong to.
            image_size: longer side in pixels after scaling; pictures are never enlarged.
            train_camera: 0, the one there is.
            test_cameras: `[0]` to hold out `test_frames` of the one camera; a protocol holds out its own.
            train_frames: `[start, stop, step]` of the frames, which are the pictures that have a pose and a mask;
                the protocol's, or all, when None.
            test_frames: `[start, stop, step]`, with `test_cameras=[0]`; the protocol's when None.
            max_train_frames: of more training frames so many are taken, evenly spread.
            occlusion: hides more, on top of what is really hidden.
            masks: mask folder.
            person: the value of the wanted person in masks that number several.
            occluded: whether things may stand before the person; False where all of it is always seen.
            protocol: `instantavatar` for the pictures that it trains on and holds out, by the scene's name.
            poses: pose file in the folder; None for the one that InstantAvatar's program reads.
            track_frames: `[start, stop, step]` of the pictures that the pose file covers, or one such list for each
                pose file; found out when None.
            betas: shape coefficients: None for the pose file's, how many of them, `zeros`, numbers, or a file.
            pixel_centres: where the middle of the first pixel is for the stored principal points: 0, 0.5 or `auto`.
            layout: `video`, for a folder that has another layout too, or `auto` to look.
            seed: of the order of training frames.

        Raises:
            ConfigError: a setting is out of its range.
        """
        if not root or not scene:
            raise ConfigError("dataset.root and dataset.scene must name a folder and a sequence in it.")
        self._folder = Path(root) / str(scene)
        self._ranges = find_ranges(protocol, self._folder.name)
        if self._ranges is not None and test_cameras is None:
            test_cameras = [0]
        frames = (0, None, 1) if train_frames is None and self._ranges is None else train_frames
        selection = Selection(train_camera, test_cameras, frames, test_frames, max_train_frames)
        super().__init__(body, selection, image_size, occlusion, seed)
        self._masks, self._person, self._is_occluded = masks, person, occluded
        self._poses, self._track_frames, self._betas = poses, track_frames, betas
        self._pixel_centres, self._layout = pixel_centres, layout

    def open_scene(self) -> Scene:
        """Returns the reader of the folder; a protocol's pictures become frames of the scene."""
        if self._poses is None or not (self._folder / CAMERAS).is_file():
            find_layout(self._folder, ("video",), self._layout)
        scene = VideoScene(
            self._folder,
            self.poser.pelvis,
            self._masks,
            self._person,
            occluded=self._is_occluded,
            poses=self._poses,
            track_frames=self._track_frames,
            betas=self._betas,
            pixel_centres=self._pixel_centres,
        )
        if self._ranges is not None:
            asked = self._selection
            self._selection = replace(
                asked,
                train_frames=asked.train_frames or _frames(scene, self._ranges.train, "train_frames"),
                test_frames=asked.test_frames or _frames(scene, self._ranges.test, "test_frames"),
            )
        noted(scene, self._folder, "video")
        return scene


def _frames(scene: VideoScene, pictures: range, key: str) -> tuple[int, int, int]:
    """Returns `[start, stop, step]` of the frames that are certain pictures.

    Raises:
        ConfigError: none of them is a frame of the scene, or their frames are not evenly spaced.
    """
    found = [frame for frame, picture in enumerate(scene.pictures) if picture in pictures]
    if not found:
        raise ConfigError(
            f"dataset.protocol: its pictures {pictures.start} to {pictures[-1]} are not among the {scene.num_frames} "
            f"of {scene.root} that have a pose and a mask. Read a pose file that covers them (dataset.poses), or give "
            f"dataset.{key}."
        )
    step = found[1] - found[0] if len(found) > 1 else 1
    frames = range(found[0], found[-1] + 1, step)
    if list(frames) != found:
        raise ConfigError(
            f"dataset.protocol: its pictures {pictures.start} to {pictures[-1]} are not evenly spaced among the frames "
            f"of {scene.root}, some of which were dropped; give dataset.{key}."
        )
    return frames.start, frames.stop, frames.step
