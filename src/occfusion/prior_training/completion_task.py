"""The task of the completion of colours: front and back of dressed people, of which a short video shows a part."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from occfusion.files.atomic import write_json
from occfusion.files.jsonfile import parse_json
from occfusion.human.body import embedded_body
from occfusion.human.unfolded import UnfoldedBody
from occfusion.inpaint.completion_net import (
    BODY,
    COMPLETION,
    FILLED,
    NETWORK_VERSION,
    SEEN,
    SIDES,
    SIZE,
    CompletionNet,
    brightness_gain,
    completion_loss,
    completion_planes,
)
from occfusion.prior_training.completion_examples import Example, make_example
from occfusion.prior_training.task import Batch, PriorTask
from occfusion.settings.stages import PriorTrainingSettings

VERSION = 5
"""Of the corpus: raised whenever its bytes change."""
KNOWN_WEIGHT = 0.1
"""In the loss, of what the video shows well; what it does not show counts 1."""
UNSEEN = 0.2
"""Share known up to which a place counts as not seen, in figures."""
SHUFFLED, FLIPPED = 0.4, 0.5
"""Shares of the examples whose channels of colour change places, and who are mirrored."""
TINTS = 0.1
"""By how much of itself each channel of an example is changed, at most."""
ARRAYS = ("truth", "filled", "seen")


class CompletionTask(PriorTask[CompletionNet]):
    """Colours of front and back; measured on subjects that it is not trained on.

    Args:
        settings: size of network and corpus.
        folder: of the corpus.
        seed: of corpus and batches.
    """

    kind, size, version, term = COMPLETION, SIZE, NETWORK_VERSION, "distance"
    data = "colours of people put together from embedded subjects 0 to 89, made by this package"
    columns = ("filled_psnr", "completed_psnr")

    def __init__(self, settings: PriorTrainingSettings, folder: Path, seed: int) -> None:
        self.settings = settings
        self.folder = folder
        self.seed = seed
        self.body = UnfoldedBody(embedded_body(), SIZE)
        self._corpus: tuple[NDArray[np.uint8], ...] = ()
        self._validation: list[Batch] = []

    def prepare(self) -> None:
        """Makes the corpus, unless it is there: 0.7 seconds an example."""
        count, identity = self.settings.examples, {"version": VERSION, "seed": self.seed}
        self.folder.mkdir(parents=True, exist_ok=True)
        marker = self.folder / "corpus.json"
        made = parse_json(marker.read_text()) if marker.is_file() else {}
        start = made.get("examples", 0) if {key: made.get(key) for key in identity} == identity else 0
        if start < count:
            examples: list[Example] = []
            for number in range(start, count):
                examples.append(make_example(number, self.seed))
                if (number + 1) % max(1, count // 10) == 0 or number + 1 == count:
                    self._write(examples, number + 1 - len(examples))
                    write_json(marker, {**identity, "examples": number + 1})
                    examples = []
                    print(f"corpus: {number + 1} of {count} people", flush=True)
        self._corpus = tuple(np.load(self.folder / f"{name}.npy", mmap_mode="r") for name in ARRAYS)

    def _write(self, examples: Sequence[Example], before: int) -> None:
        for name in ARRAYS:
            path = self.folder / f"{name}.npy"
            new = np.stack([getattr(example, name) for example in examples])
            np.save(path, np.concatenate([np.load(path)[:before], new]) if before else new)

    def make_net(self) -> CompletionNet:
        """Returns the network, untrained."""
        return CompletionNet(tuple(self.settings.widths), self.settings.depth)

    def batch(self, step: int) -> Batch:
        """Returns the batch of a training step: random people, some mirrored, some in other colours."""
        rng = np.random.default_rng([self.seed, 5, step])
        chosen = rng.integers(min(len(self._corpus[0]), self.settings.examples), size=self.settings.batch)
        return self.make_batch(
            [Example(*(np.asarray(part[k]) for part in self._corpus)) for k in chosen], rng
        )

    def make_batch(self, examples: Sequence[Example], rng: np.random.Generator | None = None) -> Batch:
        """Returns examples as the network sees them.

        Args:
            examples: people.
            rng: mirrors some and changes colours; None: as they are.
        """
        planes, truths = [], []
        for example in examples:
            truth, filled, seen = (
                torch.from_numpy(getattr(example, name).astype(np.float32)) / 255.0 for name in ARRAYS
            )
            if rng is not None:
                order = rng.permutation(3).tolist() if rng.uniform() < SHUFFLED else [0, 1, 2]
                tint = torch.from_numpy(rng.uniform(1.0 - TINTS, 1.0 + TINTS, 3)).float()
                truth, filled = (part[:, order] * tint for part in (truth, filled))
            gain = brightness_gain(filled, seen)
            truth, filled = gain * truth, gain * filled
            drawn = completion_planes(self.body, filled, seen)
            target = self.body.unfold(truth).flatten(0, 1)
            if rng is not None and rng.uniform() < FLIPPED:
                drawn, target = drawn.flip(-1), target.flip(-1)
                drawn[-2] *= -1.0  # left to right
            planes.append(drawn)
            truths.append(target)
        conditions, truth = torch.stack(planes), torch.stack(truths)
        weight = (1.0 - (1.0 - KNOWN_WEIGHT) * conditions[:, SEEN]) * conditions[:, BODY] + 1e-4
        return Batch(truth, conditions, weight)

    def loss(self, net: CompletionNet, batch: Batch) -> Tensor:
        """Returns the loss of a batch."""
        return completion_loss(net, batch.clean, batch.conditions, batch.weight)

    @torch.no_grad()
    def measure(self, net: CompletionNet, device: torch.device) -> dict[str, float]:
        """Returns the PSNR of what is not seen: of colours by what is seen nearby, and of completed ones."""
        if not self._validation:
            count = self.settings.validation
            self._validation = [
                self.make_batch([make_example(k, self.seed, validation=True)]) for k in range(count)
            ]
        errors, total = np.zeros(2), 0
        for batch in self._validation:
            planes, truth = batch.conditions.to(device), batch.clean.to(device).unflatten(1, (SIDES, 3))
            filled = planes[:, FILLED].unflatten(1, (SIDES, 3))
            unseen = ((planes[:, SEEN] < UNSEEN) & (planes[:, BODY] > 0))[:, :, None].expand_as(truth)
            for which, found in enumerate((filled, net(planes)[0].clamp(0.0, 1.0))):
                errors[which] += float((found - truth)[unseen].square().sum())
            total += int(unseen.sum())
        return dict(zip(self.columns, (-10.0 * np.log10(errors / max(total, 1))).tolist(), strict=True))
