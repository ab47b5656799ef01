"""The task of the embedded inpainter: coarse avatars of training subjects, as the optimisation stage leaves them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from occfusion.cpu.memory import return_memory
from occfusion.errors import ConfigError
from occfusion.files.atomic import write_json
from occfusion.files.jsonfile import parse_json
from occfusion.human import Avatar
from occfusion.human.rendering import Renderer
from occfusion.inpaint.accumulation import Accumulated
from occfusion.inpaint.appearance_net import (
    APPEARANCE,
    COARSE,
    NETWORK_VERSION,
    SIZE,
    AppearanceNet,
    from_signal,
)
from occfusion.observation.frames import ObservedFrame
from occfusion.prior_training.appearance_batches import (
    make_batch,
    make_examples,
    region_of,
    unseen_of,
    whole_batch,
)
from occfusion.prior_training.example_shard import ExampleShard
from occfusion.prior_training.task import Batch, PriorTask
from occfusion.priors.embedded.diffusion import posterior_mean
from occfusion.settings.stages import PriorTrainingSettings
from occfusion.synth.spec import HELD_OUT_FROM
from occfusion.types import Frame

VERSION = 2
"""Of the corpus: raised whenever its bytes change."""
FIRST_SUBJECT = 5
VALIDATION_SUBJECTS = 2
"""The first ones; they are measured on and not trained on."""
OCCLUSIONS = (
    ("strip", 0.5, 100, 0.8), ("moving", 0.5, 100, 0.8), ("strip", 0.6, 40, 1.0), ("strip", 0.4, 30, 1.0),
    ("box", 0.5, 60, 1.0), ("strip", 0.5, 100, 0.8), ("polygons", 0.5, 40, 1.0), ("strip", 0.7, 100, 0.8),
)  # fmt: skip
"""Kind, share of the person, training frames, and the share of them that is occluded: short videos without a whole
frame leave much of a person that no frame shows, which is where the references count."""
VALIDATION_EXAMPLES = 8


@dataclass(frozen=True)
class CoarseScene:
    """A scene whose coarse avatar the inpainter learns from.

    Attributes:
        scene: its name.
        seed: of its training.
        occlusion: kind.
        share: of the person.
        frames: that are trained on, from the first on.
        fraction: of them that are occluded.
    """

    scene: str
    seed: int
    occlusion: str
    share: float
    frames: int
    fraction: float


@dataclass(frozen=True)
class Coarse:
    """A trained scene.

    Attributes:
        avatar: of the end of the optimisation stage, what no frame shows painted.
        frames: all training frames, with truth and complete masks.
        observed_frames: of the same frames.
        renderer: that it was trained with.
        accumulated: what the frames show of the avatar.
    """

    avatar: Avatar
    frames: Sequence[Frame]
    observed_frames: Sequence[ObservedFrame]
    renderer: Renderer
    accumulated: Accumulated


TrainCoarse = Callable[[CoarseScene, Path], Coarse]
"""Trains a scene in a folder."""


def coarse_scenes(count: int) -> list[CoarseScene]:
    """Returns the scenes: one subject each, both levels in turn, hidden in different ways.

    Raises:
        ConfigError: more subjects than may be trained on.
    """
    if not 1 <= count <= HELD_OUT_FROM - FIRST_SUBJECT:
        raise ConfigError(
            f"setting prior_training.subjects: {count} is not from 1 to {HELD_OUT_FROM - FIRST_SUBJECT}"
        )
    found = []
    for subject in range(FIRST_SUBJECT, FIRST_SUBJECT + count):
        level = "hard" if subject % 2 else "clean"
        how = OCCLUSIONS[(subject // 2) % len(OCCLUSIONS)]
        found.append(CoarseScene(f"{subject:03d}-{level}", subject, *how))
    return found


class AppearanceTask(PriorTask[AppearanceNet]):
    """Hidden parts of people beside their coarse avatars; measured on subjects that it is not trained on.

    Args:
        settings: size of network and corpus.
        folder: of the corpus.
        seed: of batches.
        made_by: hash of the settings that scenes are trained with; examples of others are made again.
        train: trains a scene.
    """

    kind, size, version = APPEARANCE, SIZE, NETWORK_VERSION
    data = f"coarse avatars of embedded subjects from {FIRST_SUBJECT} on, made by this package"
    columns = ("coarse_psnr", "inpainted_psnr", "coarse_unseen_psnr", "inpainted_unseen_psnr")

    def __init__(
        self, settings: PriorTrainingSettings, folder: Path, seed: int, made_by: str, train: TrainCoarse
    ) -> None:
        self.settings = settings
        self.folder = folder
        self.seed = seed
        self.made_by = made_by
        self._train = train
        self._shards: list[ExampleShard] = []

    def prepare(self) -> None:
        """Trains the scenes whose examples are not there, a few minutes each."""
        scenes = coarse_scenes(self.settings.subjects)
        for number, scene in enumerate(scenes):
            shard = ExampleShard(self.folder / scene.scene)
            identity = {"version": VERSION, "size": SIZE, "made_by": self.made_by, **asdict(scene)}
            marker = shard.folder / "shard.json"
            if not (marker.is_file() and parse_json(marker.read_text()) == identity):
                self._make(scene, shard)
                write_json(marker, identity)
            print(f"corpus: {number + 1} of {len(scenes)} coarse avatars", flush=True)
            self._shards.append(shard)

    def _make(self, scene: CoarseScene, shard: ExampleShard) -> None:
        coarse = self._train(scene, self.folder / "runs" / scene.scene)
        examples = make_examples(
            coarse.avatar, coarse.frames, coarse.observed_frames, coarse.renderer, coarse.accumulated
        )
        shard.write(examples, sum(frame.evidence.occluded for frame in coarse.observed_frames))
        del coarse, examples
        return_memory()

    def make_net(self) -> AppearanceNet:
        """Returns the network, untrained."""
        return AppearanceNet(tuple(self.settings.widths), self.settings.depth)

    def batch(self, step: int) -> Batch:
        """Returns the batch of a training step: windows of random frames of random subjects."""
        rng = np.random.default_rng([self.seed, 3, step])
        shards = self._shards[VALIDATION_SUBJECTS:] or self._shards
        chosen = [shards[k] for k in rng.integers(len(shards), size=self.settings.batch)]
        return make_batch([shard.read(int(rng.integers(len(shard)))) for shard in chosen], rng)

    @torch.no_grad()
    def measure(self, net: AppearanceNet, device: torch.device) -> dict[str, float]:
        """Returns the PSNR of the coarse avatars and of the inpainted frames, over all measured frames.

        The first two are of the paper's R, the others, where there is such, of what of it no frame shows.
        """
        errors, counts = np.zeros(4), np.zeros(4)
        for shard in self._shards[:VALIDATION_SUBJECTS]:
            places = np.linspace(0, len(shard) - 1, min(VALIDATION_EXAMPLES, len(shard))).astype(int)
            for k in places:
                example = shard.read(int(k))
                planes = whole_batch([example]).conditions.to(device)
                noise = torch.randn(planes[:, :3].shape, generator=torch.Generator().manual_seed(0))
                found = posterior_mean(partial(net, planes=planes), noise.to(device))
                coarse = planes[:, COARSE]
                truth = torch.from_numpy(example.truth.astype(np.float32))[None].to(device) / 255.0
                pictures = (coarse, coarse + from_signal(found))
                wrong = [(picture.clamp(0.0, 1.0) - truth).square().mean(dim=1) for picture in pictures]
                for number, pixels in enumerate((region_of(planes), unseen_of(planes))):
                    for which in range(2):
                        errors[2 * number + which] += float(wrong[which][pixels].sum())
                        counts[2 * number + which] += int(pixels.sum())
        known = zip(self.columns, errors, counts, strict=True)
        return {name: float(-10.0 * np.log10(error / count)) for name, error, count in known if count}
