"""ZJU-MoCap as a LightningDataModule, in any of the forms in which people have it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from occfusion.data.layouts import ZJU, find_layout, noted
from occfusion.data.module import HumanDataModule
from occfusion.data.occlusion import OcclusionSettings
from occfusion.data.posing import RestBody
from occfusion.data.prepare import Selection, find_protocol
from occfusion.data.scene import Scene
from occfusion.data.zju.humannerf_layout import HumanNerfScene
from occfusion.data.zju.stored_vertices import compare_with_stored
from occfusion.data.zju.zju_layout import AUTO_FIT, ZjuScene
from occfusion.data.zju.zju_protocols import PRESETS, place_strip, select
from occfusion.errors import ConfigError


class ZjuDataModule(HumanDataModule):
    """Frames of one ZJU-MoCap sequence, or of an embedded scene written in one of its layouts."""

    def __init__(
        self,
        root: Path | str | None,
        scene: str | None,
        body: RestBody,
        image_size: int | None = None,
        train_camera: int | None = None,
        test_cameras: Sequence[int] | None = None,
        train_frames: Sequence[int | None] | None = None,
        test_frames: Sequence[int | None] | None = None,
        max_train_frames: int | None = None,
        occlusion: str | Mapping[str, Any] | OcclusionSettings | None = "strip",
        masks: str | None = None,
        layout: str = "auto",
        protocol: str = "paper",
        fit: str = AUTO_FIT,
        seed: int = 0,
    ) -> None:
        """Keeps the settings; nothing is read before `setup` or `validate`.

        Args:
            root: the folder that holds the sequences.
            scene: the sequence's folder.
            body: the body the parameters belong to.
            image_size: longer side in pixels after scaling, the protocol's when None; pictures are never enlarged.
            train_camera: index of the one camera that is trained on; the protocol's when None.
            test_cameras: indices of the held-out cameras; the protocol's when None.
            train_frames: `[start, stop, step]`; the protocol's, cut to the sequence, when None.
            test_frames: the same for held-out views.
            max_train_frames: of more training frames so many are taken, evenly spread.
            occlusion: a kind or its settings; applied to the training camera alone.
            masks: `mask`, `mask_cihp`, `schp`, or `mask+mask_cihp` for the union; the protocol's when None. In
                HumanNeRF's form the one folder of masks, `masks`.
            layout: `original`, `refined`, `humannerf`, or `auto` to look.
            protocol: a name in `PRESETS`.
            fit: folder of the body parameters, `new_params`, `params` or `smpl_params`; `auto` takes the newest.
            seed: of the order of training frames.

        Raises:
            ConfigError: a setting is out of its range.
        """
        if not root or not scene:
            raise ConfigError("dataset.root and dataset.scene must name a folder and a sequence in it.")
        if layout not in ("auto", *ZJU):
            raise ConfigError(f"dataset.layout={layout!r}: choose auto, {', '.join(ZJU)}.")
        preset, folder = find_protocol(PRESETS, protocol, "ZJU-MoCap"), Path(root) / str(scene)
        self._layout = find_layout(folder, ZJU, layout) if folder.is_dir() else layout
        alone = self._layout == "humannerf"
        if train_camera is None:
            train_camera = 0 if alone else preset.train_camera
        asked = Selection(train_camera, test_cameras, train_frames, test_frames, max_train_frames)
        asked_occlusion = OcclusionSettings.parse(occlusion)
        hidden = place_strip(preset, folder.name, asked_occlusion, own_frames=train_frames is not None)
        size = preset.image_size if image_size is None else image_size
        super().__init__(body, select(preset, folder.name, asked), size, hidden, seed)
        self._fit = fit
        self._folder = folder
        self._masks = masks or ("masks" if alone else preset.masks)

    def open_scene(self) -> Scene:
        """Returns the reader of the sequence."""
        layout = find_layout(self._folder, ZJU, self._layout)
        if layout == "humannerf":
            return noted(HumanNerfScene(self._folder, self.poser, self._masks), self._folder, layout)
        refined = layout == "refined"
        reader = ZjuScene(self._folder, self.poser.pelvis, self._masks, refined=refined, fit=self._fit)
        return noted(compare_with_stored(reader, self.poser.body), self._folder, layout)
