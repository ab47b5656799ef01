"""The corpus of silhouettes on disk, and batches of it: occluders and dropped conditions drawn anew each time."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.files.atomic import write_json
from occfusion.files.jsonfile import parse_json
from occfusion.observation.keypoints import MIRRORED, NUM_KEYPOINTS
from occfusion.prior_training.random_occluders import centre_strip, draw_hidden, observed, random_half
from occfusion.prior_training.silhouette_examples import make_corpus
from occfusion.prior_training.task import Batch
from occfusion.priors.embedded.conditions import make_conditions
from occfusion.priors.embedded.silhouette_net import SIZE

DROP_BODY, DROP_POSE, DROP_BACKGROUND, DROP_ALL = 0.12, 0.15, 0.4, 0.06
DROP_JOINT = 0.08
KEYPOINT_NOISE = 0.008  # crop widths
SURE_WEIGHT = 0.25
"""In the loss, of a pixel that the conditions tell."""

Fields = dict[str, NDArray[Any]]
"""The fields of a `silhouette_examples.Example` by name."""
MEASURED = 16
"""Silhouettes of a batch that is not trained on."""


def validation_batches(count: int, seed: int) -> dict[str, list[Batch]]:
    """Returns silhouettes of the training subjects in other poses, half hidden, every condition given.

    Keys: `centre`, an upright strip that hides half of the person; `half`, a half plane through the person's middle.

    Args:
        count: silhouettes.
        seed: other than the corpus's.
    """
    rng = np.random.default_rng([seed, 4])
    found: dict[str, list[Batch]] = {"centre": [], "half": []}
    examples: list[Fields] = [dict(vars(example)) for example in make_corpus(count, seed)]
    for first in range(0, count, MEASURED):
        rows = examples[first : first + MEASURED]
        people = [row["person"] > 127 for row in rows]
        found["centre"].append(hidden_batch(rows, [centre_strip(person, 0.5) for person in people]))
        found["half"].append(hidden_batch(rows, [random_half(person, rng) for person in people]))
    return found


def fusion_batches(count: int, seed: int) -> Iterator[Batch]:
    """Yields silhouettes of the training subjects behind random occluders, every condition given.

    Args:
        count: silhouettes.
        seed: other than the corpus's.
    """
    rng = np.random.default_rng([seed, 5])
    rows: list[Fields] = []
    for made, example in enumerate(make_corpus(count, seed), 1):
        rows.append(dict(vars(example)))
        if len(rows) == MEASURED or made == count:
            people = [observed(row["person"].astype(np.float32) / 255.0, rng) for row in rows]
            yield hidden_batch(rows, [draw_hidden(person, rng) for person in people], people)
            rows = []


def hidden_batch(
    examples: list[Fields], hidden: list[NDArray[np.bool_]], segmented: list[NDArray[np.bool_]] | None = None
) -> Batch:
    """Returns examples behind given occluders, with every condition as it is.

    Args:
        examples: fields of `silhouette_examples.Example`.
        hidden: what each occluder covers, bool `[S, S]`.
        segmented: each person as segmented, with errors, bool `[S, S]`; None: without.
    """
    rows: list[Fields] = []
    for k, (example, mask) in enumerate(zip(examples, hidden, strict=True)):
        parts = _as_floats(example)
        seen = parts["person"] > 0.5 if segmented is None else segmented[k]
        rows.append(
            {
                "clean": 2.0 * parts["person"] - 1.0,
                "visible": (seen & ~mask).astype(np.float32),
                "background": (~seen & ~mask).astype(np.float32),
                "weight": np.ones_like(parts["person"]),
                **{name: parts[name] for name in ("body", "depth", "keypoints", "shown")},
            }
        )
    return _stacked(rows)


def make_batch(examples: list[Fields], rng: np.random.Generator) -> Batch:
    """Returns a batch: examples mirrored or not, behind random occluders, with conditions dropped at random.

    Args:
        examples: fields of `silhouette_examples.Example`.
        rng: source of all choices.
    """
    return _stacked([_augmented(example, rng) for example in examples])


def _stacked(rows: list[Fields]) -> Batch:
    stacked = {name: torch.from_numpy(np.stack([row[name] for row in rows])) for name in rows[0]}
    conditions = make_conditions(
        stacked["visible"], stacked["background"], stacked["body"], stacked["depth"], stacked["keypoints"],
        stacked["shown"],
    )  # fmt: skip
    return Batch(stacked["clean"][:, None], conditions, stacked["weight"][:, None])


def _as_floats(example: Fields) -> Fields:
    return {
        "person": example["person"].astype(np.float32) / 255.0,
        "body": example["body"].astype(np.float32) / 255.0,
        "depth": example["depth"].astype(np.float32) / 127.0,
        "keypoints": example["keypoints"].astype(np.float32),
        "shown": example["shown"].astype(bool),
    }


def _augmented(example: Fields, rng: np.random.Generator) -> Fields:
    person, body, depth, keypoints, shown = _as_floats(example).values()
    if rng.uniform() < 0.5:
        person, body, depth = (np.ascontiguousarray(a[:, ::-1]) for a in (person, body, depth))
        keypoints = (
            np.array([1.0, 0.0], np.float32) + np.array([-1.0, 1.0], np.float32) * keypoints[list(MIRRORED)]
        )
        shown = shown[list(MIRRORED)]
    seen = observed(person, rng)
    hidden = draw_hidden(seen, rng)
    visible = (seen & ~hidden).astype(np.float32)
    background = (~seen & ~hidden).astype(np.float32)
    keypoints = keypoints + rng.normal(0.0, KEYPOINT_NOISE, keypoints.shape).astype(np.float32)
    shown = shown & (rng.uniform(size=len(shown)) > DROP_JOINT)
    drop = rng.uniform(size=4) < (DROP_BODY, DROP_POSE, DROP_BACKGROUND, DROP_ALL)
    # a person of a rim of error round what is seen still counts; what is sure counts little
    weight = np.where(hidden | (drop[2] & ~seen), 1.0, SURE_WEIGHT).astype(np.float32)
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

    def prepare(self) -> Iterator[int]:
        """Makes the corpus if it is not there, yielding how many examples are made."""
        identity = {"version": VERSION, "count": self.count, "seed": self.seed, "size": SIZE}
        marker = self.folder / "corpus.json"
        if not (marker.is_file() and parse_json(marker.read_text()) == identity):
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
