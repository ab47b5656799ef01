"""Means of an evaluation camera by camera and frame by frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from occfusion.evaluation.evaluate import ImageRow, summarise
from occfusion.files.run_folder import FIGURES
from occfusion.files.table import write_table


def write_grouped_csv(path: Path | str, rows: Sequence[ImageRow], by: str) -> None:
    """Writes one line for each region and camera, or each region and frame, with the mean over its images.

    Columns: `by`, `region`, `images`, `lpips_images` and `depth_images` (how many have a perceptual figure, and one
    of depth) and the metrics; an empty field is a figure that no image has. The mean over a column is the mean over
    cameras or frames, which differs from the mean over images where these have different numbers of images.

    Args:
        path: the file.
        rows: of an evaluation.
        by: `camera` or `frame`.
    """
    lines: list[dict[str, Any]] = []
    for value in sorted({getattr(row, by) for row in rows}):
        means = summarise(row for row in rows if getattr(row, by) == value)
        lines += [{by: value, "region": region, **mean} for region, mean in means.items() if mean["images"]]
    for line in lines:
        del line["psnr_capped"]
    write_table(path, [by, "region", "images", "lpips_images", "depth_images", *FIGURES], lines)
