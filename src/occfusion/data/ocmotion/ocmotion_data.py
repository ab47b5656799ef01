"""OcMotion as a LightningDataModule: really occluded people, of whom the hidden parts are not known.

What is measured: PSNR and SSIM on the visible pixels of the training frames; the perceptual distance after
both pictures have been laid on black outside the visible mask, cropped to the person's padded box
(region `visible` of `docs/reference/metrics.md`). There is no held-out truth: other cameras, where the raw release is
used, are occluded too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from occfusion.data.layouts import OCMOTION, find_layout, noted
from occfusion.data.module import HumanDataModule
from occfusion.data.occlusion import OcclusionSettings
from occfusion.data.ocmotion.chomp_layout import MASKS, ChompScene
from occfusion.data.ocmotion.ocmotion_protocols import PROTOCOLS
from occfusion.data.ocmotion.w2a_layout import W2aScene
from occfusion.data.posing import RestBody
from occfusion.data.prepare import Selection, find_protocol
from occfusion.data.scene import Scene
from occfusion.errors import ConfigError, DataError
from occfusion.files.images import image_size as stored_size

PAPER_SEQUENCES = PROTOCOLS["paper"].sequences
"""The six sequences of the paper, in Wild2Avatar's cut: 100 frames each."""


class OcMotionDataModule(HumanDataModule):
    """Frames of one OcMotion sequence, in Wild2Avatar's cut or as released."""

    def __init__(
        self,
        root: Path | str | None,
        scene: str | None,
        body: RestBody,
        image_size: int | None = None,
        train_camera: int = 0,
        test_cameras: Sequence[int] | None = (),
        train_frames: Sequence[int | None] | None = None,
        test_frames: Sequence[int | None] | None = None,
        max_train_frames: int | None = None,
        occlusion: str | Mapping[str, Any] | OcclusionSettings | None = "none",
        masks: str | None = None,
        person: int | None = None,
        numbered_masks: bool = False,
        layout: str = "auto",
        protocol: str = "paper",
        seed: int = 0,
    ) -> None:
        """Keeps the settings; nothing is read before `setup` or `validate`.

        Args:
            root: the folder that holds the sequences, or that holds `annot/`.
            scene: the sequence, `0013_02`; its folder may end in `_w2a`. In the raw release that is camera 02 of
                sequence 0013, and `0013` is the sequence with all its cameras.
            body: the body the parameters belong to.
            image_size: longer side in pixels after scaling; pictures are never enlarged. The protocol's, half of
                the stored one in the paper, when None.
            train_camera: index of the one camera that is trained on.
            test_cameras: indices of held-out cameras; all the others when None.
            train_frames: `[start, stop, step]`; the protocol's, the paper's being `[0, 100, 2]`, cut to the
                sequence, when None.
            test_frames: the same for held-out views.
            max_train_frames: of more training frames so many are taken, evenly spread.
            occlusion: hides more, on top of what is really hidden.
            masks: mask folder; `masks` in the cut, `mask` in the raw release when None.
            person: id of the person among several; the one in the most frames when None.
            numbered_masks: masks hold the people's ids, and only the person's own is the person.
            layout: `w2a`, `chomp`, or `auto` to look.
            protocol: `paper`, `wild2avatar` or `occnerf`: frames and size.
            seed: of the order of training frames.

        Raises:
            ConfigError: a setting is out of its range.
        """
        self._protocol, self._protocol_name = find_protocol(PROTOCOLS, protocol, "OcMotion"), protocol
        self._frames_given = train_frames is not None
        frames = self._protocol.frames if train_frames is None else train_frames
        held_out = self._protocol.frames if test_frames is None else test_frames
        selection = Selection(train_camera, test_cameras, frames, held_out, max_train_frames)
        super().__init__(body, selection, image_size, occlusion, seed)
        if not root or not scene:
            raise ConfigError("dataset.root and dataset.scene must name a folder and a sequence in it.")
        if layout not in ("auto", *OCMOTION):
            raise ConfigError(f"dataset.layout={layout!r}: choose auto, {', '.join(OCMOTION)}.")
        if numbered_masks and person is None:
            raise ConfigError("dataset.numbered_masks needs dataset.person, the id of the wanted person.")
        self._root, self._scene, self._layout = Path(root), str(scene), layout
        self._masks, self._person, self._numbered = masks, person, numbered_masks

    def open_scene(self) -> Scene:
        """Returns the reader of the sequence."""
        scene = self._open_layout()
        scene.taken = replace(scene.taken, pictures=f"{scene.taken.pictures}{self._protocol_in_words()}")
        return scene

    def own_image_size(self, scene: Scene) -> int:
        """Returns the longer side of the frames by the protocol: a share of the stored one."""
        return max(stored_size(scene.files(0, 0).rgb)) // self._protocol.divisor

    def summary(self) -> dict[str, Any]:
        """Returns what was selected and found, and what the protocol's authors do otherwise than they say."""
        protocol = {"name": self._protocol_name, "differs": list(self._protocol.differs)}
        return {**super().summary(), "protocol": protocol}

    def _protocol_in_words(self) -> str:
        frames = [] if self._frames_given else [f"frames {list(self._protocol.frames)}"]
        size = [] if self.image_size is not None else [self._protocol.size_in_words]
        words = " and ".join(frames + size)
        return f"; {words} (dataset.protocol={self._protocol_name})" if words else ""

    def _open_layout(self) -> Scene:
        layout, folder = self._layout, self._root / self._scene
        if layout == "auto" and not folder.is_dir() and (self._root / "annot").is_dir():
            layout = "chomp"
        if layout == "chomp":
            masks = self._masks or MASKS
            raw = ChompScene(
                self._root, self._scene, self.poser.pelvis, masks, self._person, numbered=self._numbered
            )
            raw.require_masks()
            return raw
        cut = folder.with_name(f"{folder.name}_w2a")
        folder = cut if not folder.is_dir() and cut.is_dir() else folder
        if not folder.is_dir():
            raise DataError(
                f"{folder}: no such folder, nor {cut.name}, nor annot/ of the raw release. The paper's sequences are "
                f"{', '.join(PAPER_SEQUENCES)}, each in a folder of its own or with _w2a at its end."
            )
        find_layout(folder, ("w2a",), layout)
        label = self._person if self._numbered else None
        return noted(W2aScene(folder, self.poser.pelvis, self._masks or "masks", label), folder, "w2a")
