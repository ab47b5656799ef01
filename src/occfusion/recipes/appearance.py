"""The recipe of the embedded inpainter: coarse avatars of training subjects, as the optimisation stage leaves them."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.errors import ConfigError
from occfusion.files.atomic import write_json
from occfusion.human import Avatar
from occfusion.inpaint.batches import Batch, make_batch, whole_batch
from occfusion.inpaint.corpus import Example, make_examples
from occfusion.inpaint.network import AppearanceNet, from_signal
from occfusion.inpaint.planes import COARSE, SIZE
from occfusion.inpaint.weights import APPEARANCE
from occfusion.priors.diffusion import posterior_mean
from occfusion.priors.moments import Moment
from occfusion.recipes.recipe import Recipe
from occfusion.stages.settings import PriorTrainingSettings
from occfusion.synth.spec import HELD_OUT_FROM
from occfusion.types import Frame

VERSION = 1
"""Of the corpus: raised whenever its bytes change."""
FIRST_SUBJECT = 5
VALIDATION_SUBJECTS = 2
"""The first ones; they are measured on and not trained on."""
OCCLUSIONS = (
    ("strip", 0.5), ("strip", 0.6), ("moving", 0.5), ("strip", 0.4), ("box", 0.5), ("strip", 0.5), ("polygons", 0.5),
    ("strip", 0.55),
)  # fmt: skip
VALIDATION_EXAMPLES = 8


@dataclass(frozen=True)
class CoarseScene:
    """A scene whose coarse avatar the inpainter learns from.

    Attributes:
        scene: its name.
        seed: of its training.
        occlusion: kind.
        share: of the person.
    """

    scene: str
    seed: int
    occlusion: str
    share: float


@dataclass(frozen=True)
class Coarse:
    """A trained scene.

    Attributes:
        avatar: of the end of the optimisation stage.
        frames: all training frames, with truth and complete masks.
        moments: of the same frames.
        backend: rasteriser backend that it was trained with.
    """

    avatar: Avatar
    frames: Sequence[Frame]
    moments: Sequence[Moment]
    backend: str


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
        kind, share = OCCLUSIONS[(subject // 2) % len(OCCLUSIONS)]
        level = "hard" if subject % 2 else "clean"
        found.append(CoarseScene(f"{subject:03d}-{level}", subject, kind, share))
    return found


class AppearanceRecipe(Recipe[AppearanceNet]):
    """Hidden parts of people beside their coarse avatars; measured on subjects that it is not trained on.

    Args:
        settings: size of network and corpus.
        folder: of the corpus.
        seed: of batches.
        train: trains a scene.
    """

    kind, size = APPEARANCE, SIZE
    data = f"coarse avatars of embedded subjects from {FIRST_SUBJECT} on, made by this package"
    columns = ("coarse_psnr", "inpainted_psnr")

    def __init__(self, settings: PriorTrainingSettings, folder: Path, seed: int, train: TrainCoarse) -> None:
        self.settings = settings
        self.folder = folder
        self.seed = seed
        self._train = train
        self._shards: list[tuple[NDArray[np.uint8], ...]] = []

    def prepare(self) -> None:
        """Trains the scenes whose examples are not there, a few minutes each."""
        scenes = coarse_scenes(self.settings.subjects)
        for number, scene in enumerate(scenes):
            shard = self.folder / scene.scene
            identity = {"version": VERSION, "size": SIZE, **asdict(scene)}
            marker = shard / "shard.json"
            if not (marker.is_file() and json.loads(marker.read_text()) == identity):
                coarse = self._train(scene, self.folder / "runs" / scene.scene)
                examples = list(make_examples(coarse.avatar, coarse.frames, coarse.moments, coarse.backend))
                shard.mkdir(parents=True, exist_ok=True)
                for name in ("planes", "truth", "mask"):
                    np.save(shard / f"{name}.npy", np.stack([getattr(example, name) for example in examples]))
                write_json(marker, identity)
            print(f"corpus: {number + 1} of {len(scenes)} coarse avatars", flush=True)
            self._shards.append(
                tuple(np.load(shard / f"{n}.npy", mmap_mode="r") for n in ("planes", "truth", "mask"))
            )

    def make_net(self) -> AppearanceNet:
        """Returns the network, untrained."""
        return AppearanceNet(tuple(self.settings.widths), self.settings.depth)

    def batch(self, step: int) -> Batch:
        """Returns the batch of a training step: windows of random frames of random subjects."""
        rng = np.random.default_rng([self.seed, 3, step])
        shards = self._shards[VALIDATION_SUBJECTS:] or self._shards
        chosen = [shards[k] for k in rng.integers(len(shards), size=self.settings.batch)]
        return make_batch([_example(shard, int(rng.integers(len(shard[0])))) for shard in chosen], rng)

    @torch.no_grad()
    def measure(self, net: AppearanceNet, device: torch.device) -> dict[str, float]:
        """Returns the PSNR in what is hidden, of the coarse avatars and of the inpainted frames."""
        scores = {name: [] for name in self.columns}  # type: ignore[var-annotated]
        for shard in self._shards[:VALIDATION_SUBJECTS]:
            places = np.linspace(0, len(shard[0]) - 1, min(VALIDATION_EXAMPLES, len(shard[0]))).astype(int)
            for k in places:
                batch = whole_batch([_example(shard, int(k))]).to(device)
                planes = batch.conditions
                noise = torch.randn(batch.clean.shape, generator=torch.Generator().manual_seed(0)).to(device)
                found = posterior_mean(lambda x, t, planes=planes: net(x, t, planes), noise)  # type: ignore[misc]
                coarse = planes[:, COARSE]
                truth = torch.from_numpy(shard[1][k].astype(np.float32))[None].to(device) / 255.0
                for name, picture in zip(self.columns, (coarse, coarse + from_signal(found)), strict=True):
                    error = (picture.clamp(0.0, 1.0) - truth).square()[(batch.weight == 1.0).expand_as(truth)]
                    scores[name].append(float(-10.0 * error.mean().log10()))
        return {name: float(np.mean(values)) for name, values in scores.items()}


def _example(shard: tuple[NDArray[np.uint8], ...], k: int) -> Example:
    return Example(*(np.asarray(part[k]) for part in shard))
