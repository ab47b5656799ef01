"""Running a stage that treats frames one by one, until it is done or a signal comes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import lightning as L
from torch.utils.data import DataLoader, IterableDataset

from occfusion.stages.base import Stage
from occfusion.stages.interruption import SignalGuard
from occfusion.stages.progress import FrameProgress
from occfusion.types import Frame


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
