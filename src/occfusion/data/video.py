"""One's own footage as a LightningDataModule (PeopleSnapshot's and NeuMan's form)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from occfusion.data.layouts import find_layout
from occfusion.data.module import HumanDataModule
from occfusion.data.occlusion import OcclusionSettings
from occfusion.data.posing import RestBody
from occfusion.data.prepare import Selection
from occfusion.data.scene import Scene
from occfusion.data.video_layout import VideoScene
from occfusion.errors import ConfigError


class VideoDataModule(HumanDataModule):
    """Frames of one video of one person; nothing is held out unless `test_frames` say so."""

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
        occlusion: str | Mapping[str, Any] | OcclusionSettings | None = "none",
        masks: str = "masks",
        person: int | None = None,
        occluded: bool = True,
        seed: int = 0,
        cache_megabytes: float = 200.0,
    ) -> None:
        """Keeps the settings; nothing is read before `setup` or `validate`.

        Args:
            root: the folder that holds the sequences.
            scene: the sequence's folder.
            body: the body the parameters belong to.
            image_size: longer side in pixels after scaling; pictures are never enlarged.
            train_camera: 0, the one there is.
            test_cameras: `[0]` to hold out `test_frames` of the one camera.
            train_frames: `[start, stop, step]`; all frames when None.
            test_frames: `[start, stop, step]`, with `test_cameras=[0]`.
            occlusion: hides more, on top of what is really hidden.
            masks: mask folder.
            person: the value of the wanted person in masks that number several.
            occluded: whether things may stand before the person; False where all of it is always seen.
            seed: of the order of training frames.
            cache_megabytes: how much memory decoded training frames may take.

        Raises:
            ConfigError: a setting is out of its range.
        """
        frames = (0, None, 1) if train_frames is None else train_frames
        selection = Selection(train_camera, test_cameras, frames, test_frames)
        super().__init__(body, selection, image_size, occlusion, seed, cache_megabytes)
        if not root or not scene:
            raise ConfigError("dataset.root and dataset.scene must name a folder and a sequence in it.")
        self._folder = Path(root) / str(scene)
        self._masks, self._person, self._is_occluded = masks, person, occluded

    def open_scene(self) -> Scene:
        """Returns the reader of the folder."""
        find_layout(self._folder, ("video",))
        return VideoScene(
            self._folder, self.poser.pelvis, self._masks, self._person, occluded=self._is_occluded
        )
