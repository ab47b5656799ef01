"""Evaluates a trained avatar on a data set and writes the run folder's figures and pictures."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

from occfusion.cpu.memory import peak_memory_mb
from occfusion.data.module import HumanDataModule
from occfusion.evaluation.evaluate import ImageRow, evaluate_frames, summarise, write_per_image_csv
from occfusion.evaluation.gain import camera_gains, with_gains
from occfusion.evaluation.pictures import write_comparison
from occfusion.evaluation.tables import write_grouped_csv
from occfusion.files.atomic import write_json, write_png
from occfusion.geometry.coverage import CLASSES
from occfusion.human import Body
from occfusion.human.coverage import BodyCoverage, class_of_pixels
from occfusion.human.coverage_picture import draw_coverage
from occfusion.perceptual import PerceptualMetric
from occfusion.settings.schema import STAGES, EvaluationSettings, Settings
from occfusion.types import Frame, Rendering

HELD_OUT_REGIONS = ("full", "box", *CLASSES)
TRAINING_REGIONS = ("visible", "hidden")
PICTURE_FRAMES = 4
FAST_DEV_IMAGES = 1


def evaluate_run(
    folder: Path,
    data: HumanDataModule,
    render: Callable[[Frame], Rendering],
    settings: Settings,
    perceptual: PerceptualMetric | None,
    gaussians: int,
    body: Body,
    coverage: BodyCoverage | None,
) -> dict[str, Any]:
    """Writes the tables, `metrics.json` and the pictures; returns the content of `metrics.json`.

    The tables are `per_image.csv`, `per_camera.csv` and `per_frame.csv`.

    Args:
        folder: the run folder.
        data: the frames.
        render: draws the avatar as a frame's camera sees it.
        settings: of the run.
        perceptual: the metric of the `lpips` column, None for none.
        gaussians: how many the avatar has.
        body: of the data.
        coverage: how well the training views show it; None where that is not known.
    """
    evaluation = settings.evaluation
    perceptual = evaluation_metric(evaluation, perceptual)
    limit = FAST_DEV_IMAGES if settings.trainer.fast_dev_run else None
    rows: list[ImageRow] = []
    images = 0
    gains: dict[int, tuple[float, float, float] | None] | None = None
    if evaluation.held_out:
        held_out = islice(data.test_dataloader(), limit)
        drawn = render
        if evaluation.camera_gain == "camera":
            gains = camera_gains(render, islice(data.test_dataloader(), limit))
            drawn = with_gains(render, gains)
        classes = None if coverage is None else partial(class_of_pixels, body=body, coverage=coverage)
        rows += evaluate_frames(
            drawn, held_out, HELD_OUT_REGIONS, perceptual, evaluation.perceptual_every, classes
        )
        images = len({(row.camera, row.frame) for row in rows})
    if evaluation.training_views:
        views = islice(_training_views(data, evaluation.training_stride), limit)
        rows += evaluate_frames(render, views, TRAINING_REGIONS, perceptual)
    write_per_image_csv(folder / "per_image.csv", rows)
    write_grouped_csv(folder / "per_camera.csv", rows, "camera")
    write_grouped_csv(folder / "per_frame.csv", rows, "frame")
    metrics = {
        "dataset": settings.dataset.name,
        "scene": data.scene_name,
        "variant": settings.variant.name,
        "recipe": settings.recipe.name,
        "images": images,
        "regions": summarise(rows),
        "camera_gain": evaluation.camera_gain,
        "camera_gains": None if gains is None else {str(camera): gain for camera, gain in gains.items()},
        "perceptual_metric": None if perceptual is None else perceptual.name,
        "train_seconds": _train_seconds(folder),
        "gaussians": gaussians,
        "peak_memory_mb": round(peak_memory_mb(), 1),
        "left_out": _left_out(folder),
    }
    write_json(folder / "metrics.json", metrics)
    if evaluation.pictures:
        (folder / "pictures").mkdir(exist_ok=True)
        write_comparison(
            folder / "pictures" / "held_out.png", data.spread_test_frames(PICTURE_FRAMES), render
        )
        write_comparison(
            folder / "pictures" / "training.png", data.spread_train_frames(PICTURE_FRAMES), render
        )
        if coverage is not None:
            write_png(folder / "pictures" / "directions.png", draw_coverage(body, coverage))
    return metrics


def evaluation_metric(
    evaluation: EvaluationSettings, perceptual: PerceptualMetric | None
) -> PerceptualMetric | None:
    """Returns the perceptual metric that the evaluation asks for, None for none."""
    if perceptual is None or not evaluation.perceptual:
        return None
    return perceptual.with_unit_inputs() if evaluation.perceptual_inputs == "unit" else perceptual


def _training_views(data: HumanDataModule, stride: int) -> Iterator[Frame]:
    for position in range(0, len(data.train_indices), stride):
        yield data.train_frame(position)


def _train_seconds(folder: Path) -> dict[str, float | None]:
    seconds: dict[str, float | None] = {}
    for stage in STAGES:
        record = folder / stage / "stage.json"
        seconds[stage] = None
        if record.is_file():
            seconds[stage] = round(json.loads(record.read_text(encoding="utf-8"))["train_seconds"], 3)
    seconds["total"] = round(sum(value for value in seconds.values() if value is not None), 3)
    return seconds


def _left_out(folder: Path) -> list[str]:
    plan = json.loads((folder / "plan.json").read_text(encoding="utf-8"))
    return [decision["part"] for decision in plan["decisions"] if not decision["used"]]
