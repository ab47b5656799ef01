"""The initialisation stage of a run: masks are completed, or taken over from another run."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import torch

from occfusion.cpu.processes import is_helper
from occfusion.data.module import HumanDataModule
from occfusion.files.atomic import write_json
from occfusion.files.run_folder import RunFolder
from occfusion.files.sharing import shared_folder, take_or_make
from occfusion.human import Avatar, Body
from occfusion.observation.frames import ObservedFrame
from occfusion.priors.build_prior import make_mask_prior
from occfusion.priors.masks import MaskPrior, TruthMasks
from occfusion.run.training import tell_damage, training_truths
from occfusion.settings.schema import Settings
from occfusion.stages.init import InitStage
from occfusion.types import Frame


@dataclass(frozen=True)
class MaskCompletion:
    """Writes the complete masks of a run and has the training frames carry them.

    Masks that another run on the same data with the same prior and settings made are taken from it; the time
    that they took there counts as this run's.

    Attributes:
        settings: of the run.
        folder: of the run.
        data: the training frames.
        data_hash: of all that is read.
        observed_frames: what masks and poses say of the training frames.
        device: where the prior runs.
        aligned: frames between knots of the alignment that the poses of `observed_frames` have; 0: none, as given.
    """

    settings: Settings
    folder: RunFolder
    data: HumanDataModule
    data_hash: str
    observed_frames: Sequence[ObservedFrame]
    device: torch.device
    aligned: int = 0

    def run(self, avatar: Avatar) -> Avatar:
        """Returns the avatar as it was given, once the masks are complete.

        Raises:
            Interrupted: a signal stopped it; what is written stays.
        """
        if not is_helper():  # masks are complete before the helpers are started
            self._complete(avatar.body)
        self.data.use_complete_masks(self.folder.masks.picture)
        return avatar

    def _complete(self, body: Body) -> None:
        settings, folder, data = self.settings, self.folder, self.data

        def read(position: int) -> Frame:
            return data.train_frame(position, truth=False)

        prior = make_prior(settings, data, self.device)
        identity = {"data": self.data_hash} | ({"aligned": self.aligned} if self.aligned else {})
        stage = InitStage(prior, body, self.observed_frames, read, settings.init, folder.masks, identity)
        progress, own = settings.trainer.enable_progress_bar, folder.stage(stage.name)
        record = own.record
        if settings.trainer.fast_dev_run:  # the one frame that the trial step of each process will see
            seen = {data.position_at(step) for step in range(settings.trainer.devices)}
            stage.complete([k for k in stage.wanted if k in seen], progress=progress)
            return
        wanted = stage.wanted
        if not wanted and record.is_file() and own.damage is None:
            return
        tell_damage(own)

        def make() -> None:
            started = time.monotonic()
            # all of them, whatever of a damaged result was taken
            stage.complete(sorted({*wanted, *stage.wanted}), progress=progress)
            done = stage.finish()
            steady, seconds = done["consistency"], time.monotonic() - started
            write_json(record, {"train_seconds": seconds, **done})
            print(
                f"init: {done['completed']} of {done['frames']} masks completed in {seconds:.1f} s"
                + ("" if steady is None else f", consistency {steady:.3f} (warped IoU)")
            )

        def is_whole() -> bool:
            stage.read_again()
            return not stage.wanted

        shared = shared_folder(folder, settings.shared_dir, stage.name, stage.identity)
        made = take_or_make(shared, folder.masks.path, record, is_whole=is_whole, make=make)
        if made is not None:
            write_json(record, {**made, "shared": str(shared)})
            print(
                f"init: {made['completed']} of {made['frames']} masks completed before, taken from {shared}"
            )


def make_prior(settings: Settings, data: HumanDataModule, device: torch.device) -> MaskPrior:
    """Returns what completes masks: a network, or the truth.

    Raises:
        ConfigError: the truth is asked for and not known.
    """
    if settings.init.source == "prior":
        return make_mask_prior(asdict(settings.prior), device)
    return TruthMasks({name: truth.mask.numpy() for name, truth in training_truths(data, "init")})
