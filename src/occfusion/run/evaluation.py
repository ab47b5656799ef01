"""Evaluates a trained avatar on a data set and writes the run folder's figures and pictures."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import islice
from typing import Any

from occfusion.cpu.memory import peak_memory_mb
from occfusion.evaluation.evaluate import (
    ImageRow,
    evaluate_frames,
    summarise,
    write_grouped_csv,
    write_per_image_csv,
)
from occfusion.evaluation.gain import camera_gains, with_gains
from occfusion.evaluation.pictures import write_comparison
from occfusion.files.atomic import write_json, write_png
from occfusion.geometry.coverage import CLASSES
from occfusion.human import Avatar
from occfusion.human.coverage import BodyCoverage, class_of_pixels
from occfusion.human.coverage_picture import draw_coverage
from occfusion.perceptual import PerceptualMetric
from occfusion.run.training import AvatarTraining
from occfusion.settings.schema import EvaluationSettings
from occfusion.types import Frame, Rendering

HELD_OUT_REGIONS = ("full", "box", *CLASSES)
TRAINING_REGIONS = ("visible", "hidden")
PICTURE_FRAMES = 4
FAST_DEV_IMAGES = 1


def evaluate_run(
    training: AvatarTraining, avatar: Avatar, left_out: list[str], coverage: BodyCoverage | None
) -> dict[str, Any]:
    """Writes the tables, the figures and the pictures of a run; returns the figures.

    Args:
        training: of the run, its stages done.
        avatar: trained.
        left_out: parts of the method that the scene did not need.
        coverage: how well the training views show the body; None where that is not known.
    """
    settings, folder, data = training.settings, training.folder, training.data
    perceptual, body, evaluation = training.evaluation_metric, avatar.body, settings.evaluation
    render: Callable[[Frame], Rendering] = partial(training.renderer.frame, avatar)
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
        positions = range(0, len(data.train_indices), evaluation.training_stride)
        views = islice((data.train_frame(k) for k in positions), limit)
        rows += evaluate_frames(render, views, TRAINING_REGIONS, perceptual)
    if perceptual is not None:  # pictures and films follow, which want room of their own
        perceptual.drop_filters()
    write_per_image_csv(folder.per_image, rows)
    write_grouped_csv(folder.per_camera, rows, "camera")
    write_grouped_csv(folder.per_frame, rows, "frame")
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
        "train_seconds": folder.train_seconds(),
        "gaussians": avatar.gaussians.num_gaussians,
        "peak_memory_mb": round(peak_memory_mb(), 1),
        "left_out": left_out,
    }
    write_json(folder.metrics, metrics)
    if evaluation.pictures:
        write_comparison(folder.held_out_picture, data.spread_test_frames(PICTURE_FRAMES), render)
        write_comparison(folder.training_picture, data.spread_train_frames(PICTURE_FRAMES), render)
        if coverage is not None:
            write_png(folder.directions_picture, draw_coverage(body, coverage))
    return metrics


def evaluation_metric(
    evaluation: EvaluationSettings, perceptual: PerceptualMetric | None
) -> PerceptualMetric | None:
    """Returns the perceptual metric that the evaluation asks for, None for none."""
    if perceptual is None or not evaluation.perceptual:
        return None
    return perceptual.with_unit_inputs() if evaluation.perceptual_inputs == "unit" else perceptual
