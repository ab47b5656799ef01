"""The corpus on disk: made once, memory-mapped, read by position."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from occfusion.files.atomic import write_json
from occfusion.priors.batches import Batch, Fields, make_batch
from occfusion.priors.corpus import SIZE, make_corpus
from occfusion.priors.keypoints import NUM_KEYPOINTS

VERSION = 1
"""Of the corpus: raised whenever its bytes change."""

_FIELDS: dict[str, tuple[str, tuple[int, ...]]] = {
    "person": ("uint8", (SIZE, SIZE)),
    "body": ("uint8", (SIZE, SIZE)),
    "depth": ("int8", (SIZE, SIZE)),
    "keypoints": ("float32", (NUM_KEYPOINTS, 2)),
    "shown": ("bool", (NUM_KEYPOINTS,)),
}


class Corpus:
    """Examples in one folder, memory-mapped; made when missing or unfinished.

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
        return np.memmap(path, dtype=dtype, mode=mode, shape=(self.count, *shape))  # type: ignore[call-overload]

    def batch(self, step: int, size: int, seed: int) -> Batch:
        """Returns the batch of a training step: a function of the step and the seed alone."""
        rng = np.random.default_rng([seed, 3, step])
        return make_batch([self._example(int(k)) for k in rng.integers(self.count, size=size)], rng)

    def _example(self, k: int) -> Fields:
        return {name: np.asarray(array[k]) for name, array in self._arrays.items()}
