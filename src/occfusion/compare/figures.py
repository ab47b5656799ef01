"""Statistics over runs: seeds and scenes kept apart, and the time to reach variant A's final error."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from occfusion.compare.methods import methods
from occfusion.compare.reading import CurvePoint, RunRecord, variant_rank
from occfusion.files.run_folder import FIGURES, REGIONS

COUNTED_BY = {"lpips": "lpips_images", "depth_error_mm": "depth_images"}
"""Figures that fewer images have than the region, and what says how many."""
TARGET_VARIANT = "A"


@dataclass(frozen=True)
class Statistic:
    """Mean of some figures.

    Attributes:
        mean: their mean.
        deviation: sample standard deviation; None for a single figure.
        count: how many.
    """

    mean: float
    deviation: float | None
    count: int


@dataclass(frozen=True)
class Summary:
    """Figures of one method on one scene (over seeds), or on all scenes of a data set.

    Attributes:
        level: `seeds`: mean and deviation over the seeds of one scene; `scenes`: mean and deviation over the
            scenes' means, every scene counting the same; `images`: mean over all images of all scenes.
        dataset: name of the data set.
        scene: the scene; empty for the other levels.
        method: the variant, with the settings in which it differs from other runs of that variant.
        perceptual_metric: name of what `lpips` holds.
        seeds: number of different seeds.
        scenes: number of scenes.
        values: a statistic for each quantity of `quantities`; absent where no run has it.
        seed_deviation: for level `scenes`: the deviation over seeds within a scene, root mean square over scenes.
        paper: the paper's figures.
    """

    level: str
    dataset: str
    scene: str
    method: str
    perceptual_metric: str | None
    seeds: int
    scenes: int
    values: dict[str, Statistic]
    seed_deviation: dict[str, float]
    paper: dict[str, float]


def quantities(run: RunRecord, target: float | None) -> dict[str, float | None]:
    """Returns a run's figures by name: `REGION.METRIC`, `seconds`, `memory_mb`, `gaussians`, `seconds_to_target`.

    Args:
        run: the run.
        target: PSNR in dB on the curve's images that `seconds_to_target` asks for; None for unknown.
    """
    result: dict[str, float | None] = {}
    for region in REGIONS:
        values = run.metrics["regions"].get(region) or {}
        result |= {f"{region}.{metric}": values.get(metric) for metric in FIGURES}
    result["seconds"] = run.metrics["train_seconds"].get("total")
    result["memory_mb"] = run.metrics.get("peak_memory_mb")
    result["gaussians"] = run.metrics.get("gaussians")
    result["seconds_to_target"] = None if target is None else seconds_to_reach(run.curve, target)
    return result


def seconds_to_reach(curve: Sequence[CurvePoint], target: float) -> float | None:
    """Returns the training seconds at which the curve's PSNR first reaches `target` dB; None if it never does.

    Between two measurements the PSNR is taken to change linearly with time.
    """
    before: tuple[float, float] | None = None
    for point in curve:
        value = point.values["psnr"]
        if value is None:
            continue
        if value >= target:
            if before is None or value == before[1]:
                return point.seconds
            share = (target - before[1]) / (value - before[1])
            return before[0] + share * (point.seconds - before[0])
        before = point.seconds, value
    return None


def targets(runs: Iterable[RunRecord]) -> dict[tuple[str, str, str], float]:
    """Returns variant A's final PSNR on the curve's images by (data set, scene, recipe), mean over its runs there."""
    finals: dict[tuple[str, str, str], list[float]] = {}
    for run in runs:
        measured = [p.values["psnr"] for p in run.curve if p.values["psnr"] is not None]
        if run.variant == TARGET_VARIANT and measured:
            finals.setdefault((run.dataset, run.scene, run.recipe), []).append(float(measured[-1] or 0.0))
    return {key: sum(values) / len(values) for key, values in finals.items()}


def summarise_seeds(runs: Sequence[RunRecord]) -> list[Summary]:
    """Returns one summary for each scene and method, over its seeds."""
    goal = targets(runs)
    groups: dict[tuple[str, str, str, str | None], list[RunRecord]] = {}
    for run, method in zip(runs, methods(runs), strict=True):
        key = (run.dataset, run.scene, method, run.metrics["perceptual_metric"])
        groups.setdefault(key, []).append(run)
    return [
        Summary("seeds", dataset, scene, method, name, len({run.seed for run in members}), 1,
                _statistics([quantities(run, goal.get((dataset, scene, run.recipe))) for run in members]), {},
                members[0].paper)
        for (dataset, scene, method, name), members in groups.items()
    ]  # fmt: skip


def summarise_scenes(runs: Sequence[RunRecord]) -> list[Summary]:
    """Returns for each method one summary over scenes, and one over all images of all scenes."""
    by_seed = summarise_seeds(runs)
    names = methods(runs)
    result = []
    for dataset, method, name in dict.fromkeys((s.dataset, s.method, s.perceptual_metric) for s in by_seed):
        members = [
            s for s in by_seed if (s.dataset, s.method, s.perceptual_metric) == (dataset, method, name)
        ]
        own = [r for r, n in zip(runs, names, strict=True) if (r.dataset, n) == (dataset, method)]
        means = [{key: value.mean for key, value in s.values.items()} for s in members]
        over_images = _over_images([r for r in own if r.metrics["perceptual_metric"] == name])
        for level, values, within in (
            ("scenes", _statistics(means), _pooled([s.values for s in members])),
            ("images", over_images, {}),
        ):
            result.append(
                Summary(level, dataset, "", method, name, len({r.seed for r in own}), len(members), values, within,
                        members[0].paper)
            )  # fmt: skip
    return sorted(result, key=lambda s: (s.level != "scenes", s.dataset, variant_rank(s.method)))


def _statistics(rows: Sequence[Mapping[str, float | None]]) -> dict[str, Statistic]:
    result = {}
    for name in dict.fromkeys(key for row in rows for key in row):
        values = [float(value) for row in rows if (value := row.get(name)) is not None]
        if values:
            mean = sum(values) / len(values)
            squares = sum((value - mean) ** 2 for value in values)
            deviation = math.sqrt(squares / (len(values) - 1)) if len(values) > 1 else None
            result[name] = Statistic(mean, deviation, len(values))
    return result


def _pooled(groups: Sequence[Mapping[str, Statistic]]) -> dict[str, float]:
    result = {}
    for name in dict.fromkeys(key for group in groups for key in group):
        squares = [
            s.deviation**2 for g in groups if (s := g.get(name)) is not None and s.deviation is not None
        ]
        if squares:
            result[name] = math.sqrt(sum(squares) / len(squares))
    return result


def _over_images(runs: Sequence[RunRecord]) -> dict[str, Statistic]:
    """Returns the mean over all images of all runs, from each run's means and numbers of images."""
    result = {}
    for region in REGIONS:
        for metric in FIGURES:
            total, count = 0.0, 0
            for run in runs:
                values = run.metrics["regions"].get(region) or {}
                images = values.get(COUNTED_BY.get(metric, "images")) or 0
                if values.get(metric) is not None and images:
                    total, count = total + values[metric] * images, count + images
            if count:
                result[f"{region}.{metric}"] = Statistic(total / count, None, count)
    return result
