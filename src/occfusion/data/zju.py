"""ZJU-MoCap as a LightningDataModule."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from occfusion.data.module import HumanDataModule
from occfusion.data.occlusion import OcclusionSettings
from occfusion.data.posing import RestBody
from occfusion.data.prepare import Selection
from occfusion.data.scene import Scene
from occfusion.data.zju_layout import ZjuScene
from occfusion.errors import ConfigError


class ZjuDataModule(HumanDataModule):
    """Frames of one ZJU-MoCap sequence in its original layout, or of an embedded scene written in it."""

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
        occlusion: str | Mapping[str, Any] | OcclusionSettings | None = "strip",
        masks: str = "mask",
        seed: int = 0,
        cache_megabytes: float = 200.0,
    ) -> None:
        """Keeps the settings; nothing is read before `setup` or `validate`.

        Args:
            root: the folder that holds the sequences.
            scene: the sequence's folder.
            body: the body the parameters belong to.
            image_size: longer side in pixels after scaling; pictures are never enlarged.
            train_camera: index of the one camera that is trained on.
            test_cameras: indices of the held-out cameras; all the others when None.
            train_frames: `[start, stop, step]`; the paper's, cut to the sequence, when None.
            test_frames: the same for held-out views.
            occlusion: a kind or its settings; applied to the training camera alone.
            masks: `mask`, `mask_cihp`, or `mask+mask_cihp` for their union.
            seed: of the order of training frames.
            cache_megabytes: how much memory decoded training frames may take.

        Raises:
            ConfigError: a setting is out of its range.
        """
        selection = Selection(train_camera, test_cameras, train_frames, test_frames)
        super().__init__(body, selection, image_size, occlusion, seed, cache_megabytes)
        if not root or not scene:
            raise ConfigError("dataset.root and dataset.scene must name a folder and a sequence in it.")
        self._root = Path(root)
        self._scene_folder = str(scene)
        self._masks = masks

    def open_scene(self) -> Scene:
        """Returns the reader of the sequence."""
        return ZjuScene(self._root, self._scene_folder, self.poser.pelvis, self._masks)
