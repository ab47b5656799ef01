"""What all human data sets share: selection, occlusion, frames, loaders, checks."""

from __future__ import annotations

import logging
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader

from occfusion.data.checking import survey, validation
from occfusion.data.occluders import write_occlusion
from occfusion.data.occlusion import OcclusionSettings
from occfusion.data.posing import Poser, RestBody
from occfusion.data.prepare import MAX_SIZE, MIN_SIZE, Prepared, Selection, prepare
from occfusion.data.sampling import StepSampler, StepStream, prefetched, spread
from occfusion.data.scene import Scene, Taken
from occfusion.data.scene_registration import SceneRegistration, register_scene
from occfusion.data.views import Views, frame_to
from occfusion.errors import ConfigError
from occfusion.types import Camera, Frame, Pose

__all__ = ["HumanDataModule", "RestBody"]

_log = logging.getLogger(__name__)

CACHE_BYTES = 200_000_000
"""Memory that decoded training frames may take."""

CLEAR = 0.85
"""Estimated visible share from which a person counts as not occluded.

Embedded people in full view (subjects 1, 2, 3, 5) have 0.89 to 1 at 96 px and more, down to 0.79 at 64 px."""


class HumanDataModule(L.LightningDataModule):
    """One sequence of one person: a training camera with occlusion, and held-out views without.

    A reader for a new layout gives `open_scene`; everything else is here. Nothing is read before `setup`,
    and then only the files of the selected frames and cameras.

    Attributes:
        most_seen: frames that training steps see at most; of more so many are taken, evenly spread. Set before
            `setup`; None: all are.
    """

    def __init__(
        self,
        body: RestBody,
        selection: Selection,
        image_size: int | None,
        occlusion: str | Mapping[str, Any] | OcclusionSettings | None,
        seed: int,
    ) -> None:
        super().__init__()
        whole = isinstance(image_size, int) and not isinstance(image_size, bool)
        if image_size is not None and not (whole and MIN_SIZE <= image_size <= MAX_SIZE):
            raise ConfigError(f"dataset.image_size={image_size!r}: must be from {MIN_SIZE} to {MAX_SIZE}.")
        self.image_size = image_size
        self.occlusion = OcclusionSettings.parse(occlusion)
        self.seed = seed
        self.most_seen: int | None = None
        self.poser = Poser(body)
        self.findings: list[str] = []
        self._selection = selection
        self._opened: tuple[Prepared, Views, StepSampler] | None = None
        self._shares: list[float] | None = None
        self.registration: SceneRegistration | None = None

    @abstractmethod
    def open_scene(self) -> Scene:
        """Returns the reader of the sequence."""

    def own_image_size(self, scene: Scene) -> int:
        """Returns the longer side of the frames in pixels where none is given; asked once the files are open."""
        raise ConfigError(f"dataset.image_size=null: must be from {MIN_SIZE} to {MAX_SIZE}.")

    # --- preparation ---------------------------------------------------------------------------------

    def setup(self, stage: str | None = None) -> None:
        """Opens the scene, selects frames and cameras, reads the training masks and plans the occlusion.

        Raises:
            ConfigError: a frame range or camera that the scene has not.
            DataError: a file is missing or cannot be what it should.
        """
        self._open()

    def validate(self) -> None:
        """Checks everything that training and evaluation will read, as far as that is cheap.

        What is doubtful but possible is logged and kept in `findings`.

        Raises:
            DataError: a file, size, camera, parameter or projection is wrong; says which and what to do.
        """
        prepared, views, _ = self._open()
        for finding in validation.validate(prepared, views, self.poser):
            if finding not in self.findings:
                self.findings.append(finding)
                _log.warning(finding)

    def register(self, faces: NDArray[np.int64], *, poses_may_explain: bool = False) -> SceneRegistration:
        """Measures whether pictures lie where the cameras say, and corrects cameras where it is certain that not.

        Args:
            faces: of the body, `[F, 3]`.
            poses_may_explain: poses are known to be off by so much that they explain a shift as well: then only what
                held-out cameras confirm is corrected.
        """
        if self.registration is None:
            prepared, views, _ = self._open()
            self.registration = register_scene(prepared, views, self.poser, faces, poses_may_explain)
            views.corrections = self.registration.corrections
        return self.registration

    def even_exposure(self, gains: NDArray[np.floating]) -> None:
        """Has the colours of training frames divided by gains, from now on.

        Args:
            gains: a row a training frame, a column a channel, `[N, 3]`.
        """
        self._open()[1].gains = np.asarray(gains, np.float32)

    def _open(self) -> tuple[Prepared, Views, StepSampler]:
        if self._opened is None:
            scene = self.open_scene()
            prepared = prepare(scene, self._selection, self.occlusion, self.most_seen)
            if self.image_size is None:
                self.image_size = min(max(self.own_image_size(scene), MIN_SIZE), MAX_SIZE)
            views = Views(prepared, self.image_size, CACHE_BYTES)
            self._opened = prepared, views, StepSampler(len(prepared.train), self.seed)
        return self._opened

    # --- what was selected ---------------------------------------------------------------------------

    @property
    def scene_name(self) -> str:
        """Name of the sequence."""
        return self._open()[0].scene.name

    @property
    def taken(self) -> Taken:
        """What the reader took of the folder, and how many of its frames are trained on where not all are."""
        prepared = self._open()[0]
        taken, count = prepared.scene.taken, len(prepared.train) + len(prepared.left_out)
        if count == prepared.offered:
            return taken
        why = "steps see no more" if count < len(prepared.sequence) else "dataset.max_train_frames"
        thinned = f"{count} of {prepared.offered} training frames, evenly spread ({why})"
        return replace(taken, pictures=f"{taken.pictures}; {thinned}")

    @property
    def train_indices(self) -> tuple[int, ...]:
        """Training frames, without those that show no person."""
        return self._open()[0].train

    @property
    def sequence(self) -> tuple[int, ...]:
        """The frames that were asked for, with those that no step sees."""
        return self._open()[0].sequence

    @property
    def test_indices(self) -> tuple[int, ...]:
        """Held-out frames."""
        return self._open()[0].test

    @property
    def train_cameras(self) -> tuple[int, ...]:
        """Indices of the cameras trained on: one."""
        return (self._open()[0].camera,)

    @property
    def test_cameras(self) -> tuple[int, ...]:
        """Indices of the held-out cameras."""
        return self._open()[0].cameras

    @property
    def test_views(self) -> tuple[tuple[int, int], ...]:
        """The held-out `(frame, camera)`, camera by camera."""
        return self._open()[0].test_views

    def camera(self, index: int) -> Camera:
        """Returns a camera at frame size."""
        prepared, views, _ = self._open()
        return views.camera_at(prepared.train[0] if index == prepared.camera else prepared.test[0], index)

    def camera_at(self, frame: int, index: int) -> Camera:
        """Returns a camera at frame size, as it was at a frame of the sequence."""
        return self._open()[1].camera_at(frame, index)

    def pose(self, frame: int) -> Pose:
        """Returns the body parameters of a frame of the sequence."""
        return self._open()[1].pose(frame)

    def use_complete_masks(self, path_of: Callable[[int], Path | None]) -> None:
        """Gives training frames complete masks, the paper's M-hat: read when a frame is, not before.

        Args:
            path_of: where the complete mask of a frame of the sequence lies, at the size of the frames; None: it has
                none.
        """
        self._open()[1].complete_masks = path_of

    @property
    def views(self) -> Views:
        """Makes the frames."""
        return self._open()[1]

    # --- frames --------------------------------------------------------------------------------------

    def train_frame(self, position: int, *, truth: bool = True, complete: bool = False) -> Frame:
        """Returns a training frame by its position in `train_indices`.

        Args:
            position: 0 to the number of training frames less one.
            truth: also give the unoccluded person and the occluder's place; training never asks for it.
            complete: also give the complete mask, if a stage has made one.
        """
        return self._open()[1].train_frame(position, truth=truth, complete=complete)

    def frame_at(self, step: int) -> Frame:
        """Returns the frame that training step `step` is given: a function of seed and step alone."""
        _, views, sampler = self._open()
        return views.train_frame(sampler.position_at(step), truth=False, complete=True)

    def position_at(self, step: int) -> int:
        """Returns the position of the frame that training step `step` is given."""
        return self._open()[2].position_at(step)

    def positions_until(self, steps: int) -> frozenset[int]:
        """Returns the positions of the frames that the first `steps` training steps are given."""
        return frozenset(self.position_at(step) for step in range(min(steps, len(self.train_indices))))

    def train_frames(self) -> Iterator[Frame]:
        """Yields all training frames in order, with the truth where it is known."""
        return prefetched(self.train_frame, range(len(self.train_indices)))

    def test_frame(self, frame: int, camera: int) -> Frame:
        """Returns a held-out view: unoccluded, its truth being what it shows."""
        return self._open()[1].test_frame(frame, camera)

    def train_dataloader(self) -> DataLoader[Frame]:
        """Returns an endless loader that begins at the trainer's step and gives one frame at a time.

        Of several processes each is given another frame of a step.
        """
        _, views, sampler = self._open()

        def read(position: int) -> Frame:
            return views.train_frame(position, truth=False, complete=True)

        def first_step() -> int:
            return 0 if self.trainer is None else self.trainer.global_step

        def share() -> tuple[int, int]:
            return (0, 1) if self.trainer is None else (self.trainer.global_rank, self.trainer.world_size)

        return DataLoader(StepStream(read, sampler, first_step, share, views.is_kept), batch_size=None)

    def test_dataloader(self) -> Iterator[Frame]:
        """Returns the held-out views that show a person, one at a time."""
        frames = prefetched(lambda view: self.test_frame(*view), self.test_views)
        return (frame for frame in frames if bool(frame.visible_mask.any()))

    def spread_test_frames(self, wanted: int) -> list[Frame]:
        """Returns evenly spread held-out views; they go round the cameras and through time."""
        views = self.test_views
        return [self.test_frame(*views[k]) for k in spread(len(views), wanted)]

    def spread_train_frames(self, wanted: int) -> list[Frame]:
        """Returns evenly spread training views with their truth."""
        return [self.train_frame(k) for k in spread(len(self.train_indices), wanted)]

    def transfer_batch_to_device(self, batch: Frame, device: torch.device, dataloader_idx: int) -> Frame:
        """Returns the frame on `device` (Lightning does not enter frozen records by itself)."""
        return frame_to(batch, device)

    def _visible_shares(self) -> list[float]:
        prepared, views, _ = self._open()
        if self._shares is None:
            shares = prepared.visible_shares()
            if any(prepared.unknown):
                estimated = validation.estimated_shares(prepared, views, self.poser)
                shares = [
                    s * e if u else s for s, e, u in zip(shares, estimated, prepared.unknown, strict=True)
                ]
            self._shares = shares
        return self._shares

    def store_occlusion(self, folder: Path) -> None:
        """Writes what the simulated occlusion hides of each training frame, for `kind=files` of another run.

        Args:
            folder: made when missing; untouched where nothing is hidden.
        """
        prepared = self._open()[0]
        whole = prepared.people[0].whole
        about = {"scene": prepared.scene.name, "camera": prepared.scene.cameras[prepared.camera]}
        hidden = dict(zip(prepared.train, prepared.hidden, strict=True))
        write_occlusion(folder, hidden, (whole.width, whole.height), about)

    # --- account -------------------------------------------------------------------------------------

    def summary(self) -> dict[str, Any]:
        """Returns what was selected and found, for the run folder: plain numbers and text."""
        prepared, views, _ = self._open()
        shares, lens = self._visible_shares(), views.lens(prepared.camera)
        settings = repr((self.occlusion, self.image_size, prepared.train))
        settings += survey.hidden_digest(prepared.hidden)
        if views.gains is not None:
            settings += views.gains.tobytes().hex()
        held_out = repr(prepared.test_views)
        for camera, correction in sorted(views.corrections.items()):
            if camera == prepared.camera:
                settings += repr(correction)
            else:
                held_out += repr((camera, correction))
        return {
            "scene": prepared.scene.name,
            "taken": asdict(self.taken),
            "frames": len(prepared.train),
            "frames_left_out": list(prepared.left_out),
            "frames_unseen": len(prepared.sequence) - len(prepared.train) - len(prepared.left_out),
            "cameras": len(prepared.scene.cameras),
            "train_camera": prepared.scene.cameras[prepared.camera],
            "test_images": len(prepared.test_views),
            "stored_size": list(lens.source),
            "size": list(lens.size),
            "occlusion": self.occlusion.kind,
            "occluded_frames": sum(
                share < (CLEAR if unknown else 1.0)
                for share, unknown in zip(shares, prepared.unknown, strict=True)
            ),
            "visible_share_is": "estimated" if any(prepared.unknown) else "known",
            "hidden_boxes": survey.hidden_boxes(prepared.hidden),
            "visible_share": {
                str(frame): round(share, 4) for frame, share in zip(prepared.train, shares, strict=True)
            },
            "hash": survey.data_hash(prepared.scene, prepared.train_views, settings),
            "held_out_hash": survey.data_hash(prepared.scene, prepared.test_views, held_out),
            "findings": list(self.findings),
        }
