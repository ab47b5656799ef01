"""ZJU-MoCap as a LightningDataModule, in any of the forms in which people have it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from occfusion.data.humannerf_layout import HumanNerfScene
from occfusion.data.layouts import ZJU, find_layout
from occfusion.data.module import HumanDataModule
from occfusion.data.occlusion import OcclusionSettings
from occfusion.data.opening import noted
from occfusion.data.posing import RestBody
from occfusion.data.prepare import Selection
from occfusion.data.presets import find_preset, place_strip, select
from occfusion.data.scene import Scene
from occfusion.data.zju_layout import ZjuScene
from occfusion.errors import ConfigError


class ZjuDataModule(HumanDataModule):
    """Frames of one ZJU-MoCap sequence, or of an embedded scene written in one of its layouts."""

    def __init__(
        self,
        root: Path | str | None,
        scene: str | None,
        body: RestBody,
        image_size: int = 512,
        train_camera: int | None = None,
        test_cameras: Sequence[int] | None = None,
        train_frames: Sequence[int | None] | None = None,
        test_frames: Sequence[int | None] | None = None,
        occlusion: str | Mapping[str, Any] | OcclusionSettings | None = "strip",
        masks: str | None = None,
        layout: str = "auto",
        protocol: str = "paper",
        seed: int = 0,
        cache_megabytes: float = 200.0,
    ) -> None:
        """Keeps the settings; nothing is read before `setup` or `validate`.

        Args:
            root: the folder that holds the sequences.
            scene: the sequence's folder.
            body: the body the parameters belong to.
            image_size: longer side in pixels after scaling; pictures are never enlarged.
            train_camera: index of the one camera that is trained on; the protocol's when None.
            test_cameras: indices of the held-out cameras; all the others when None.
            train_frames: `[start, stop, step]`; the protocol's, cut to the sequence, when None.
            test_frames: the same for held-out views.
            occlusion: a kind or its settings; applied to the training camera alone.
            masks: `mask`, `mask_cihp`, or `mask+mask_cihp` for their union; the protocol's when None. In
                HumanNeRF's form the one folder of masks, `masks`.
            layout: `original`, `refined`, `humannerf`, or `auto` to look.
            protocol: `paper`, `gauhuman` or `occnerf`.
            seed: of the order of training frames.
            cache_megabytes: how much memory decoded training frames may take.

        Raises:
            ConfigError: a setting is out of its range.
        """
        if not root or not scene:
            raise ConfigError("dataset.root and dataset.scene must name a folder and a sequence in it.")
        if layout not in ("auto", *ZJU):
            raise ConfigError(f"dataset.layout={layout!r}: choose auto, {', '.join(ZJU)}.")
        preset, folder = find_preset(protocol), Path(root) / str(scene)
        self._layout = find_layout(folder, ZJU, layout) if folder.is_dir() else layout
        alone = self._layout == "humannerf"
        if train_camera is None:
            train_camera = 0 if alone else preset.train_camera
        asked = Selection(train_camera, test_cameras, train_frames, test_frames)
        hidden = place_strip(preset, folder.name, OcclusionSettings.parse(occlusion))
        super().__init__(body, select(preset, folder.name, asked), image_size, hidden, seed, cache_megabytes)
        self._folder = folder
        self._masks = masks or ("masks" if alone else preset.masks)

    def open_scene(self) -> Scene:
        """Returns the reader of the sequence."""
        layout = find_layout(self._folder, ZJU, self._layout)
        if layout == "humannerf":
            return noted(HumanNerfScene(self._folder, self.poser, self._masks), self._folder, layout)
        reader = ZjuScene(self._folder, self.poser.pelvis, self._masks, refined=layout == "refined")
        return noted(reader, self._folder, layout)
