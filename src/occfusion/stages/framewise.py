"""Stages that treat frames one by one and write what they make of each; run until done or until a signal comes."""

from __future__ import annotations

import json
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import lightning as L
import torch
from torch.utils.data import DataLoader, IterableDataset

from occfusion.errors import CheckpointError
from occfusion.files.atomic import write_json
from occfusion.files.digest import changed, digests
from occfusion.files.run_folder import FrameFolder, read_json
from occfusion.observation.frames import ObservedFrames
from occfusion.stages.base import Stage
from occfusion.stages.interruption import Interrupted, SignalGuard
from occfusion.stages.progress import FrameProgress
from occfusion.types import Frame

WRITTEN_EACH = 100
"""Frames up to which the manifest is written after each; beyond, so seldom that a frame costs no more than then."""


class FramewiseStage(Stage):
    """A stage that writes a picture of each frame and keeps a manifest, so that a stopped run continues behind it.

    Args:
        folder: where the pictures and the manifest go.
        identity: all that the pictures depend on; records of another identity are not taken up.
        observed_frames: of all training frames, in order.

    Attributes:
        records: what was done with each frame, by its name.
    """

    def __init__(
        self, folder: FrameFolder, identity: dict[str, Any], observed_frames: ObservedFrames
    ) -> None:
        super().__init__()
        self.folder, self.identity, self.observed_frames = folder, identity, observed_frames
        self._positions = observed_frames.positions
        self.records = self._earlier()

    @property
    @abstractmethod
    def wanted(self) -> list[int]:
        """Positions of the frames that are not written yet."""

    def treat(self, read: Callable[[int], Frame], positions: Sequence[int], *, progress: bool) -> None:
        """Calls `predict_step` for the frames at some positions.

        Args:
            read: gives the training frame at a position.
            positions: of the frames.
            progress: whether a progress line is shown.

        Raises:
            Interrupted: a signal stopped it; what is written stays.
        """
        if not positions:
            return
        signal = predict_frames(self, read, positions, progress=progress)
        self.write_manifest()
        if signal is not None:
            raise Interrupted(signal, str(self.folder.path))

    def read_again(self) -> None:
        """Takes up what has been put into the folder since: pictures with the manifest of this very identity."""
        self.records = self._earlier()

    def _earlier(self) -> dict[str, dict[str, Any]]:
        """Returns the records of an earlier call that still hold."""
        path = self.folder.manifest
        if not path.is_file():
            return {}
        try:
            content = read_json(path)
            if content["identity"] != json.loads(json.dumps(self.identity)):
                return {}
            frames = {str(name): dict(record) for name, record in content["frames"].items() if int(name) >= 0}
            whole = {name: r for name, r in frames.items() if not self._is_changed(int(name), r)}
        except (CheckpointError, AttributeError, KeyError, TypeError, ValueError):
            print(f"{self.name}: {path} is damaged; its pictures are made again")
            return {}
        if len(whole) < len(frames):
            missed = sorted(frames.keys() - whole.keys())
            print(
                f"{self.name}: {len(missed)} pictures in {self.folder.path} are not as they were left, first that of "
                f"frame {missed[0]}; made again"
            )
        return whole

    def _is_changed(self, frame: int, record: dict[str, Any]) -> bool:
        """Returns whether pictures of a frame are not those of its record; older ones have no fingerprints."""
        return not self.folder.picture(frame).is_file() or bool(
            changed(self.folder.path, record.get("sha256", {}))
        )

    def transfer_batch_to_device(self, batch: Frame, device: torch.device, dataloader_idx: int) -> Frame:
        """Returns the frame where it is: geometry is done on the host, and a network's owner moves what it needs."""
        return batch

    def on_predict_batch_end(self, *_: Any) -> None:
        """Writes the manifest, which holds all frames, after each of them or after a few."""
        done = len(self.records)
        if done % (1 + done // WRITTEN_EACH) == 0:
            self.write_manifest()

    def write_manifest(self, **more: Any) -> None:
        """Writes what was done, with what, and the fingerprints of the pictures."""
        for name, record in self.records.items():
            if "sha256" not in record:  # or each frame would cost the reading of all before it
                pictures = (self.folder.picture(int(name)), self.folder.second_picture(int(name)))
                record["sha256"] = digests(self.folder.path, pictures)
        content = {"identity": self.identity, **more, "frames": dict(sorted(self.records.items()))}
        write_json(self.folder.manifest, content)


class _Frames(IterableDataset[Frame]):
    """Training frames at some positions, until a signal comes: Lightning's prediction loop does not look for one."""

    def __init__(self, read: Callable[[int], Frame], positions: Sequence[int], guard: SignalGuard) -> None:
        self._read, self._positions, self._guard = read, positions, guard

    def __iter__(self) -> Iterator[Frame]:
        for position in self._positions:
            if self._guard.received is not None:
                return
            yield self._read(position)


def predict_frames(
    stage: Stage, read: Callable[[int], Frame], positions: Sequence[int], *, progress: bool
) -> int | None:
    """Calls `stage.predict_step` for the frames at `positions`; returns the signal that stopped it, if any.

    Args:
        stage: writes what it makes of a frame.
        read: gives the training frame at a position.
        positions: of the frames.
        progress: whether a progress line is shown.
    """
    guard = SignalGuard()
    callbacks: list[L.Callback] = [guard]
    if progress:
        callbacks.append(FrameProgress(len(positions)))
    trainer = L.Trainer(
        accelerator="cpu", devices=1, logger=False, enable_checkpointing=False, enable_model_summary=False,
        enable_progress_bar=progress, callbacks=callbacks,
    )  # fmt: skip
    with guard:
        trainer.predict(
            stage, DataLoader(_Frames(read, positions, guard), batch_size=None), return_predictions=False
        )
    return guard.received
