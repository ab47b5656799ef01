"""Batches for training the silhouette prior: a corpus kept on disk, occluders and dropped conditions drawn anew."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from occfusion.files.atomic import write_json
from occfusion.priors.corpus import SIZE, make_corpus
from occfusion.priors.hiding import draw_hidden, observed
from occfusion.priors.keypoints import MIRRORED, NUM_KEYPOINTS
from occfusion.priors.silhouette import Conditions, make_conditions

VERSION = 1
"""Of the corpus: raised whenever its bytes change."""

DROP_BODY, DROP_POSE, DROP_BACKGROUND, DROP_ALL = 0.12, 0.15, 0.4, 0.06
DROP_JOINT = 0.08
KEYPOINT_NOISE = 0.008  # crop widths

_FIELDS: dict[str, tuple[str, tuple[int, ...]]] = {
    "person": ("uint8", (SIZE, SIZE)),
    "body": ("uint8", (SIZE, SIZE)),
    "depth": ("int8", (SIZE, SIZE)),
    "keypoints": ("float32", (NUM_KEYPOINTS, 2)),
    "shown": ("bool", (NUM_KEYPOINTS,)),
}


@dataclass(frozen=True)
class Batch:
    """What the network is trained on.

    Attributes:
        clean: whole silhouettes, -1..1, `[B, 1, S, S]`.
        conditions: what is shown of them.
        weight: of each pixel in the loss, `[B, 1, S, S]`.
    """

    clean: Tensor
    conditions: Conditions
    weight: Tensor


class Corpus:
    """Examples in one folder, memory-mapped; made when missing, continued when its making was interrupted.

    Args:
        folder: where it lies or is to lie.
        count: how many examples.
        seed: of the examples.
    """

    def __init__(self, folder: Path, count: int, seed: int) -> None:
        self.folder, self.count, self.seed = folder, count, seed
        self._arrays: dict[str, NDArray[np.generic]] = {}

    def __len__(self) -> int:
        """Returns the number of examples."""
        return self.count

    def prepare(self) -> Iterator[int]:
        """Makes the corpus if it is not there, yielding how many examples are made."""
        identity = {"version": VERSION, "count": self.count, "seed": self.seed, "size": SIZE}
        marker = self.folder / "corpus.json"
        if not (marker.is_file() and json.loads(marker.read_text()) == identity):
            self.folder.mkdir(parents=True, exist_ok=True)
            marker.unlink(missing_ok=True)
            arrays = {name: self._open(name, "w+") for name in _FIELDS}
            for k, example in enumerate(make_corpus(self.count, self.seed)):
                for name, array in arrays.items():
                    array[k] = getattr(example, name)
                yield k + 1
            for array in arrays.values():
                array.flush()
            write_json(marker, identity)
        self._arrays = {name: self._open(name, "r") for name in _FIELDS}

    def _open(self, name: str, mode: str) -> np.memmap[tuple[int, ...], np.dtype[np.generic]]:
        dtype, shape = _FIELDS[name]
        path = self.folder / f"{name}.bin"
        return np.memmap(path, dtype=dtype, mode=mode, shape=(self.count, *shape))  # type: ignore[call-overload,no-any-return]

    def batch(self, step: int, size: int, seed: int) -> Batch:
        """Returns the batch of a training step: a function of the step and the seed alone."""
        rng = np.random.default_rng([seed, 3, step])
        return make_batch([self._example(int(k)) for k in rng.integers(self.count, size=size)], rng)

    def _example(self, k: int) -> dict[str, NDArray[np.generic]]:
        return {name: np.asarray(array[k]) for name, array in self._arrays.items()}


def make_batch(examples: list[dict[str, NDArray[np.generic]]], rng: np.random.Generator) -> Batch:
    """Returns a batch: examples mirrored or not, behind random occluders, with conditions dropped at random.

    Args:
        examples: fields of `corpus.Example`.
        rng: source of all choices.
    """
    rows = [_augmented(example, rng) for example in examples]
    stacked = {name: torch.from_numpy(np.stack([row[name] for row in rows])) for name in rows[0]}
    conditions = make_conditions(
        stacked["visible"], stacked["background"], stacked["body"], stacked["depth"], stacked["keypoints"],
        stacked["shown"],
    )  # fmt: skip
    return Batch(stacked["clean"][:, None], conditions, stacked["weight"][:, None])


def _augmented(example: dict[str, NDArray[np.generic]], rng: np.random.Generator) -> dict[str, NDArray[np.generic]]:
    person = example["person"].astype(np.float32) / 255.0
    body = example["body"].astype(np.float32) / 255.0
    depth = example["depth"].astype(np.float32) / 127.0
    keypoints, shown = example["keypoints"].astype(np.float32), example["shown"].astype(bool)
    if rng.uniform() < 0.5:
        person, body, depth = (np.ascontiguousarray(a[:, ::-1]) for a in (person, body, depth))
        keypoints = keypoints[list(MIRRORED)] * np.float32([-1.0, 1.0]) + np.float32([1.0, 0.0])
        shown = shown[list(MIRRORED)]
    seen = observed(person, rng)
    hidden = draw_hidden(seen, rng)
    visible = (seen & ~hidden).astype(np.float32)
    background = (~seen & ~hidden).astype(np.float32)
    keypoints = keypoints + rng.normal(0.0, KEYPOINT_NOISE, keypoints.shape).astype(np.float32)
    shown = shown & (rng.uniform(size=len(shown)) > DROP_JOINT)
    drop = rng.uniform(size=4) < (DROP_BODY, DROP_POSE, DROP_BACKGROUND, DROP_ALL)
    # a person of a rim of error round what is seen still counts; what is sure counts little
    weight = np.where(hidden | (drop[2] & ~seen), 1.0, 0.25).astype(np.float32)
    if drop[0] or drop[3]:
        body, depth = np.zeros_like(body), np.zeros_like(depth)
    if drop[1] or drop[3]:
        shown = np.zeros_like(shown)
    if drop[2] or drop[3]:
        background = np.zeros_like(background)
    if drop[3]:
        visible, weight = np.zeros_like(visible), np.ones_like(weight)
    return {
        "clean": 2.0 * person - 1.0, "visible": visible, "background": background, "body": body, "depth": depth,
        "keypoints": keypoints, "shown": shown, "weight": weight,
    }  # fmt: skip
