"""Metrics of renderings against truth, region by region; the recipe in prose is `docs/reference/metrics.md`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from occfusion.cpu.memory import large_blocks_apart, trim_memory
from occfusion.cpu.workers import threaded_map
from occfusion.errors import ConfigError
from occfusion.files.run_folder import FIGURES, REGIONS
from occfusion.files.table import write_table
from occfusion.geometry.coverage import CLASSES
from occfusion.perceptual import PerceptualMetric
from occfusion.quality.metrics import (
    OCCUPIED,
    PSNR_CAP,
    depth_error,
    holes,
    mask_iou,
    padded_box,
    psnr,
    spill,
    ssim,
    ssim_over_black,
)
from occfusion.types import Box, Frame, Rendering

Classes = Callable[[Frame], NDArray[np.int8] | None]
"""Gives the class (`geometry.coverage`) of the place that each pixel of a person shows; None where it is not known."""

HARDLY_SEEN = ("seen_one", "unseen")
MOST = 0.5
"""Share of a person's pixels above which a class of places is what a picture shows, and the perceptual metric has
something to look at. Where most is seen from many directions, the whole picture has a figure anyway."""
TRIMMED_EVERY = 16
"""Images: windows of ever other sizes leave holes in the heap, 200 MB of them over a few hundred images."""


@dataclass(frozen=True)
class ImageRow:
    """The metrics of one region of one picture; None where a figure cannot be computed.

    Attributes:
        frame: position of the moment in the sequence.
        camera: which camera took it.
        region: one of `REGIONS`.
        pixels: size of the region; 0 when the picture has no such region or its truth is not known.
        psnr: decibels, capped at 100.
        ssim: mean over the region.
        lpips: the perceptual metric that was given, whatever its name; of a class of places only where it makes most
            of the person.
        mask_iou: of alpha > 0.5 with the person's mask.
        depth_error_mm: mean absolute error of depth where alpha > 0.5 and the true surface is.
        spill: share of the squared error that lies outside the true mask; of whole frames alone.
        holes: share of the pixels well inside the true mask where alpha < 0.5; of whole frames alone.
    """

    frame: int
    camera: int
    region: str
    pixels: int = 0
    psnr: float | None = None
    ssim: float | None = None
    lpips: float | None = None
    mask_iou: float | None = None
    depth_error_mm: float | None = None
    spill: float | None = None
    holes: float | None = None


@torch.inference_mode()
def evaluate_frames(
    render: Callable[[Frame], Rendering],
    frames: Iterable[Frame],
    regions: Sequence[str],
    perceptual: PerceptualMetric | None,
    perceptual_every: int = 1,
    classes: Classes | None = None,
) -> list[ImageRow]:
    """Returns one row for each frame and region, frames in their order.

    On a CPU as many pictures are compared at a time as torch has threads.

    Args:
        render: gives the picture over black at the size of the frame.
        frames: what to compare with; taken one at a time.
        regions: some of `REGIONS`.
        perceptual: fills the `lpips` column; None leaves it empty.
        perceptual_every: fill it for every k-th frame alone, beginning with the first: on a CPU this metric
            costs several times all the rest.
        classes: which places of the body were seen in training, for the regions that go by it; None: not known.

    Raises:
        ConfigError: an unknown region.
    """
    rendered = ((render(frame), frame, number) for number, frame in enumerate(frames))
    first = next(rendered, None)
    if first is None:
        return []

    @torch.inference_mode()  # holds for the thread that sets it
    def rows_of(image: tuple[Rendering, Frame, int]) -> list[ImageRow]:
        rendering, frame, number = image
        return evaluate_image(
            rendering, frame, regions, perceptual if number % perceptual_every == 0 else None, classes
        )

    workers = torch.get_num_threads() if first[0].rgb.device.type == "cpu" else 1
    found: list[ImageRow] = []
    with large_blocks_apart():
        for number, rows in enumerate(threaded_map(rows_of, chain([first], rendered), workers)):
            found += rows
            if number % TRIMMED_EVERY == 0:
                trim_memory()
    return found


def evaluate_image(
    rendering: Rendering,
    frame: Frame,
    regions: Sequence[str],
    perceptual: PerceptualMetric | None,
    classes: Classes | None = None,
) -> list[ImageRow]:
    """Returns one row a region for one rendering over black; arguments as `evaluate_frames`."""
    unknown = set(regions) - set(REGIONS)
    if unknown:
        raise ConfigError(f"unknown regions {sorted(unknown)}; choose from {', '.join(REGIONS)}")
    rgb, alpha = rendering.rgb.clamp(0, 1), rendering.alpha
    shown = classes(frame) if classes is not None and set(regions) & set(CLASSES) else None
    scores = []
    for region in regions:
        by_class = region in CLASSES
        if by_class:
            comparison = _of_class(region, frame, shown, rgb.device)
        else:
            comparison = _comparison(region, frame, rgb.device)
        figures: dict[str, Any] = {}
        if comparison is not None:
            # of scattered pixels, a network that looks at their surroundings says nothing
            is_whole = not by_class or (region in HARDLY_SEEN and _is_most(comparison))
            figures = _figures(comparison, rgb, alpha > OCCUPIED, perceptual if is_whole else None)
            figures["depth_error_mm"] = _depth_error(comparison, frame, rendering)
            if region == "full":
                assert comparison.person is not None
                figures["spill"] = spill(rgb, comparison.truth, comparison.person)
                figures["holes"] = holes(alpha, comparison.person)
        scores.append(ImageRow(frame.index, frame.camera_index, region, **figures))
    return scores


@dataclass(frozen=True)
class _Comparison:
    """What a region is compared with.

    Attributes:
        truth: `[H, W, 3]`, black outside the person.
        person: the mask that alpha is compared with, bool `[H, W]`; None when there is nothing to compare
            with.
        domain: pixels where masks are compared, bool `[H, W]`; None for all.
        pixels: pixels whose colours count; everything else is blacked in both pictures; None for all.
        box: what SSIM and the perceptual metric look at; None for the whole frame.
    """

    truth: Tensor
    person: Tensor | None
    domain: Tensor | None
    pixels: Tensor | None
    box: Box | None


def _comparison(region: str, frame: Frame, device: torch.device) -> _Comparison | None:
    """Returns what to compare in a region; None when the frame has none or its truth is not known."""
    if region == "visible":
        return _visible(frame, device)
    if frame.truth is None:
        return None
    rgb, mask = frame.truth.rgb.to(device), frame.truth.mask.to(device)
    if region == "full":
        return _Comparison(rgb, mask, None, None, None)
    if region == "box":
        box = padded_box(mask)
        return None if box is None else _Comparison(rgb, mask, _inside(box, mask), None, box)
    # a noisy visible mask leaves out rims that no occluder covers; where the occluder is known, it decides
    hidden = (~frame.visible_mask if frame.occluded is None else frame.occluded).to(device)
    pixels = mask & hidden
    box = padded_box(pixels)
    return None if box is None else _Comparison(rgb, mask, hidden, pixels, box)


def _of_class(
    region: str, frame: Frame, shown: NDArray[np.int8] | None, device: torch.device
) -> _Comparison | None:
    """Returns what to compare where a person's pixels show places of one class; None where no pixel does."""
    if shown is None or frame.truth is None:
        return None
    mask = frame.truth.mask.to(device)
    pixels = mask & torch.from_numpy(shown == CLASSES[region]).to(device)
    box = padded_box(pixels)
    return None if box is None else _Comparison(frame.truth.rgb.to(device), mask, pixels, pixels, box)


def _is_most(comparison: _Comparison) -> bool:
    """Returns whether a region's pixels are most of the person's."""
    assert comparison.pixels is not None and comparison.person is not None
    return int(comparison.pixels.sum()) > MOST * int(comparison.person.sum())


def _inside(box: Box, like: Tensor) -> Tensor:
    x, y, w, h = box
    inside = torch.zeros_like(like)
    inside[y : y + h, x : x + w] = True
    return inside


def _visible(frame: Frame, device: torch.device) -> _Comparison | None:
    pixels = frame.visible_mask.to(device)
    box = padded_box(pixels)
    if box is None:
        return None
    person = pixels if frame.truth is None else frame.truth.mask.to(device)
    if frame.occluded is None:
        # what lies behind an unknown occluder cannot be told from background: alpha has no truth there
        return _Comparison(frame.rgb.to(device), None, None, pixels, box)
    return _Comparison(frame.rgb.to(device), person, ~frame.occluded.to(device), pixels, box)


def _figures(
    comparison: _Comparison, rgb: Tensor, occupied: Tensor, perceptual: PerceptualMetric | None
) -> dict[str, Any]:
    truth, pixels, domain, person = comparison.truth, comparison.pixels, comparison.domain, comparison.person
    if pixels is not None:
        rgb, truth = rgb * pixels[..., None], truth * pixels[..., None]
    overlap = None if person is None else mask_iou(occupied, person, domain)
    if comparison.box is not None:
        x, y, w, h = comparison.box
        window = (slice(y, y + h), slice(x, x + w))
        rgb, truth = rgb[window], truth[window]
        pixels = None if pixels is None else pixels[window]
    return {
        "pixels": truth.shape[0] * truth.shape[1] if pixels is None else int(pixels.sum()),
        "psnr": psnr(rgb, truth, pixels),
        "ssim": ssim_over_black(rgb, truth) if pixels is None else ssim(rgb, truth, pixels),
        "lpips": None if perceptual is None else float(perceptual.over_black(rgb, truth)),
        "mask_iou": overlap,
    }


def _depth_error(comparison: _Comparison, frame: Frame, rendering: Rendering) -> float | None:
    if frame.truth is None or frame.truth.depth is None:
        return None
    where = rendering.alpha > OCCUPIED
    pixels = comparison.domain if comparison.pixels is None else comparison.pixels
    if pixels is not None:
        where = where & pixels
    return depth_error(rendering.depth, frame.truth.depth.to(where.device), where)


def summarise(rows: Iterable[ImageRow]) -> dict[str, dict[str, float | int | None]]:
    """Returns the mean over images of every metric in every region, None where no image has it.

    Beside the metrics: `images`, how many had the region, `lpips_images` and `depth_images`, how many of these have
    a perceptual figure and one of depth, and `psnr_capped`, how many reached the PSNR cap.
    """
    rows = [row for row in rows if row.pixels > 0]
    return {region: _mean([row for row in rows if row.region == region]) for region in REGIONS}


def _mean(rows: list[ImageRow]) -> dict[str, float | int | None]:
    result: dict[str, float | int | None] = {}
    for metric in FIGURES:
        values = [value for row in rows if (value := getattr(row, metric)) is not None]
        result[metric] = sum(values) / len(values) if values else None
    result["images"] = len(rows)
    result["lpips_images"] = sum(row.lpips is not None for row in rows)
    result["depth_images"] = sum(row.depth_error_mm is not None for row in rows)
    result["psnr_capped"] = sum(row.psnr is not None and row.psnr >= PSNR_CAP for row in rows)
    return result


def write_per_image_csv(path: Path | str, rows: Iterable[ImageRow]) -> None:
    """Writes one line for each row; an empty field is a figure that cannot be computed."""
    write_table(path, [field.name for field in fields(ImageRow)], (asdict(row) for row in rows))


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
