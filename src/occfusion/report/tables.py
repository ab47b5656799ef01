"""Tables on the terminal: one run's figures, or several runs beside each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from occfusion.files.run_folder import FIGURES, METRICS

DECIMALS = {"psnr": 2, "ssim": 4, "lpips": 1, "mask_iou": 3, "depth_error_mm": 1, "spill": 3, "holes": 4}
PERCEPTUAL_SCALE = 1000
"""Perceptual scores are printed times 1000, as in the paper."""

OF_FRAMES = ("spill", "holes")
"""Figures that whole frames alone have; as columns they would leave a terminal no room for names."""


def figure(metric: str, value: float | None) -> str:
    """Returns a metric as tables print it; a dash where it could not be computed."""
    if value is None:
        return "-"
    scaled = value * PERCEPTUAL_SCALE if metric == "lpips" else value
    return f"{scaled:.{DECIMALS[metric]}f}"


def heading(metric: str, perceptual_metric: str | None) -> str:
    """Returns a column's heading; the perceptual column bears the name of the metric that it holds."""
    if metric == "lpips":
        return f"{perceptual_metric or 'perceptual'} x{PERCEPTUAL_SCALE}"
    words = {"psnr": "PSNR", "ssim": "SSIM", "mask_iou": "mask IoU", "depth_error_mm": "depth error mm"}
    return words.get(metric, metric)


def figures_known(metrics: Mapping[str, Any]) -> list[str]:
    """Returns the figures that tables of a run show: of those beyond `METRICS`, what some region has."""
    regions = metrics["regions"].values()
    return [
        figure
        for figure in FIGURES
        if figure in METRICS or any(values.get(figure) is not None for values in regions)
    ]


def run_title(metrics: Mapping[str, Any]) -> str:
    """Returns what a run is of: data set, scene, variant, and the recipe where it is not the default."""
    recipe = metrics.get("recipe", "ours")
    title = f"{metrics['dataset']} {metrics['scene']}, variant {metrics['variant']}"
    return title if recipe == "ours" else f"{title}, recipe {recipe}"


def print_summary(folder: Path, metrics: Mapping[str, Any]) -> None:
    """Prints one row a region, the run folder, and what to do with it."""
    name = metrics["perceptual_metric"]
    table = Table(title=escape(run_title(metrics)))
    table.add_column("region", no_wrap=True)
    shown = [metric for metric in figures_known(metrics) if metric not in OF_FRAMES]
    for metric in shown:
        table.add_column(heading(metric, name), justify="right")
    for region, values in metrics["regions"].items():
        table.add_row(region, *(figure(metric, values.get(metric)) for metric in shown))
    Console().print(table)
    full = metrics["regions"].get("full", {})
    told = [
        f"{metric} {figure(metric, full[metric])}" for metric in OF_FRAMES if full.get(metric) is not None
    ]
    if told:
        print(f"of whole frames: {', '.join(told)}")
    print(
        f"trained in {metrics['train_seconds']['total']:.1f} s, {metrics['gaussians']} Gaussians, "
        f"{metrics['images']} held-out images, peak memory {metrics['peak_memory_mb']:.0f} MB"
    )
    print(f"run folder: {folder}")
    # what a person wants to type after a run
    print(f"  python -m occfusion render {folder} --motion walk --output walk.mp4")
    print(f"  python -m occfusion view {folder}")
    print(f"  python -m occfusion export {folder} --output avatar.html")


def print_comparison(runs: Sequence[Mapping[str, Any]]) -> None:
    """Prints one row a run: held-out figures of the whole frame, and training time."""
    names = sorted({run["perceptual_metric"] or "perceptual" for run in runs})
    table = Table(title="held-out cameras, full frame")
    for column in ("scene", "variant"):
        table.add_column(column)
    for metric in METRICS:
        table.add_column(heading(metric, " / ".join(names)), justify="right")
    table.add_column("seconds", justify="right")
    for run in runs:
        full = run["regions"]["full"]
        cells = (figure(metric, full[metric]) for metric in METRICS)
        seconds = f"{run['train_seconds']['total']:.1f}"
        table.add_row(escape(str(run["scene"])), run["variant"], *cells, seconds)
    Console().print(table)
