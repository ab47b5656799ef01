"""The measurements: each gives rows of one table, whose empty fields were not measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from occfusion.bench.contestants import Contestant, backend, tiled
from occfusion.bench.cost import Timing, extra_memory_mb, interleaved
from occfusion.bench.parts import step_parts
from occfusion.bench.plan import KNOBS, NO_CUTS, TILE_KNOB, TILES
from occfusion.bench.reference import Reference, dense_reference
from occfusion.bench.scenes import BenchScene, SceneSize, make_scene
from occfusion.errors import ConfigError

FLIP = 1e-5
"""A larger error of a colour is a threshold that was crossed in one precision and not in the other."""


@dataclass(frozen=True)
class BenchRow:
    """One line of `bench.csv`.

    Attributes:
        part: which measurement.
        case: which point of it, for instance the knob and its setting.
        contestant: who.
        gaussians: scene: how many.
        size: scene: side of the picture, pixels.
        footprint: scene: factor on sizes.
        sh_degree: scene: harmonics degree.
        threads: torch's threads.
        forward_cpu_ms: least processor time of a forward pass.
        cpu_ms: least processor time of forward and backward (or of the part).
        cpu_median_ms: its median.
        wall_ms: least wall time of forward and backward.
        first_ms: wall time of the first call, compilation or its cache included.
        rounds: repetitions.
        extra_mb: peak memory above the level before, forward and backward.
        speed_up: processor time of the `torch` backend over this one's, both measured in turn.
        error_rgb: largest absolute error of a colour against the reference.
        error_alpha: of alpha.
        error_depth: of depth, metres.
        flips: share of pixels whose colour is off by more than 1e-5.
        error_gradient: largest relative error (2-norm) among the inputs' gradients.
    """

    part: str
    case: str
    contestant: str
    gaussians: int | None = None
    size: int | None = None
    footprint: float | None = None
    sh_degree: int | None = None
    threads: int | None = None
    forward_cpu_ms: float | None = None
    cpu_ms: float | None = None
    cpu_median_ms: float | None = None
    wall_ms: float | None = None
    first_ms: float | None = None
    rounds: int | None = None
    extra_mb: float | None = None
    speed_up: float | None = None
    error_rgb: float | None = None
    error_alpha: float | None = None
    error_depth: float | None = None
    flips: float | None = None
    error_gradient: float | None = None


@dataclass(frozen=True)
class Conditions:
    """What all measurements share: device, seed, and wall seconds and rounds for each timed call."""

    device: torch.device
    seed: int
    seconds: float
    least_rounds: int = 3


@dataclass(frozen=True)
class Errors:
    """Distances from the reference.

    Attributes:
        rgb: largest absolute error of a colour.
        alpha: largest absolute error of alpha.
        depth: largest absolute error of depth, metres; None where the contestant has no depth.
        flips: share of pixels with a colour error above `FLIP`.
        gradients: relative error in the 2-norm, by input.
    """

    rgb: float
    alpha: float
    depth: float | None
    flips: float
    gradients: dict[str, float]

    @property
    def worst_gradient(self) -> float:
        """The largest of the gradients' errors; not a number where one of them is not."""
        return float(np.max(list(self.gradients.values())))


def race(
    part: str, sizes: Sequence[SceneSize], contestants: Sequence[Contestant], conditions: Conditions
) -> Iterator[BenchRow]:
    """Yields time and memory of every contestant on every scene, measured in turn in one process."""
    for size in sizes:
        scene = make_scene(size, conditions.seed).to(conditions.device)
        calls: dict[str, Callable[[], object]] = {}
        for contestant in contestants:
            calls[f"{contestant.name} forward"] = partial(contestant.forward, scene)
            calls[f"{contestant.name} backward"] = partial(contestant.gradients, scene)
        timings = interleaved(calls, conditions.seconds, conditions.least_rounds)
        base = timings.get("torch backward")
        for contestant in contestants:
            forward, both = timings[f"{contestant.name} forward"], timings[f"{contestant.name} backward"]
            yield _row(
                part, _describe(size), contestant.name, size, both,
                forward_cpu_ms=forward.cpu_min, first_ms=forward.first,
                extra_mb=extra_memory_mb(partial(contestant.gradients, scene), conditions.device),
                speed_up=None if base is None else base.cpu_min / both.cpu_min,
            )  # fmt: skip


def accuracy(
    sizes: Sequence[SceneSize], contestants: Sequence[Contestant], conditions: Conditions
) -> Iterator[BenchRow]:
    """Yields the errors of every contestant against the dense float64 reference."""
    for size in sizes:
        scene = make_scene(size, conditions.seed)
        # who gives no depth is asked for the gradients of a scalar without it
        targets = {c.has_depth: scene if c.has_depth else scene.without_depth() for c in contestants}
        references = {has_depth: dense_reference(target) for has_depth, target in targets.items()}
        for contestant in contestants:
            target = targets[contestant.has_depth].to(conditions.device)
            errors = errors_of(contestant, target, references[contestant.has_depth])
            yield _row("accuracy", _describe(size), contestant.name, size, **_columns(errors))


def _accepts(contestant: Contestant, scene: BenchScene) -> bool:
    """Returns whether a contestant works with its settings; not all backends take all cut-offs."""
    try:
        contestant.forward(scene)
    except ConfigError:
        return False
    return True


def precision(size: SceneSize, names: Sequence[str], conditions: Conditions) -> Iterator[BenchRow]:
    """Yields time and error of every backend for every setting of the cut-offs, dtypes and tiles that it takes.

    The truth blends every splat, however faint.
    """
    scene = make_scene(size, conditions.seed).without_depth()
    truth = dense_reference(scene, NO_CUTS)
    scene = scene.to(conditions.device)
    for knob in (*KNOBS, TILE_KNOB):
        entrants = {
            (case, dtype, name): contestant
            for name in names
            for dtype in ((torch.float32, torch.float64) if name == "torch" else (torch.float32,))
            for case, contestant in _settings(knob, name, dtype)
        }
        entrants = {key: entrant for key, entrant in entrants.items() if _accepts(entrant, scene)}
        calls: dict[str, Callable[[], object]] = {
            "/".join(map(str, key)): partial(c.gradients, scene) for key, c in entrants.items()
        }
        timings = interleaved(calls, conditions.seconds / 4, conditions.least_rounds)
        for key, contestant in entrants.items():
            known = _columns(errors_of(contestant, scene, truth)) | {"error_depth": None, "flips": None}
            yield _row("precision", key[0], contestant.name, size, timings["/".join(map(str, key))], **known)


def _settings(knob: str, name: str, dtype: torch.dtype) -> list[tuple[str, Contestant]]:
    """Returns a backend at every setting of a knob, by case."""
    if knob == TILE_KNOB:  # tiles of the compiled kernels are fixed when these are compiled
        return [(f"{knob} {tile} px", tiled(tile, dtype)) for tile in TILES] if name == "torch" else []
    return [(f"{knob} {setting}", backend(name, dtype, limits)) for setting, limits in KNOBS[knob]]


def step(name: str, gaussians: int, size: int, conditions: Conditions) -> Iterator[BenchRow]:
    """Yields the time of every part of a training step; on the CPU."""
    calls = step_parts(name, gaussians, size, conditions.seed)
    for case, timing in interleaved(calls, conditions.seconds, conditions.least_rounds).items():
        yield _row("step", case, name, None, timing, gaussians=gaussians, size=size)


def _describe(size: SceneSize) -> str:
    extra = "" if size.footprint == 1 else f", footprint x{size.footprint:g}"
    return f"{size.gaussians} Gaussians, {size.size} px, SH {size.sh_degree}{extra}"


def _row(
    part: str, case: str, contestant: str, scene: SceneSize | None, both: Timing | None = None, **known: Any
) -> BenchRow:
    if scene is not None:
        known |= asdict(scene)
    if both is not None:
        known |= {
            "cpu_ms": both.cpu_min, "cpu_median_ms": both.cpu_median, "wall_ms": both.wall_min, "rounds": both.rounds
        }  # fmt: skip
    return BenchRow(part, case, contestant, threads=torch.get_num_threads(), **known)


def _columns(errors: Errors) -> dict[str, Any]:
    return {
        "error_rgb": errors.rgb, "error_alpha": errors.alpha, "error_depth": errors.depth, "flips": errors.flips,
        "error_gradient": errors.worst_gradient,
    }  # fmt: skip


def errors_of(contestant: Contestant, scene: BenchScene, reference: Reference) -> Errors:
    """Returns the errors of a contestant; not a number where it gives one."""
    (rgb, alpha, depth), gradients = contestant.gradients(scene)
    colour = _distance(rgb, reference.rgb)
    relative = {}
    for name, wanted in reference.gradients.items():
        difference = gradients[name].detach().cpu().double() - wanted
        relative[name] = float(difference.norm() / wanted.norm().clamp(min=torch.finfo(torch.float64).tiny))
    return Errors(
        rgb=float(colour.max()),
        alpha=float(_distance(alpha, reference.alpha).max()),
        depth=None if depth is None else float(_distance(depth, reference.depth).max()),
        flips=float((colour.amax(dim=2) > FLIP).double().mean()),
        gradients=relative,
    )


def _distance(ours: Tensor, wanted: Tensor) -> Tensor:
    return (ours.detach().cpu().double() - wanted).abs()
