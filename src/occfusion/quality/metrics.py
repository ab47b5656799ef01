"""The image metrics that are reported; definitions and region recipes are in `docs/reference/metrics.md`."""

from __future__ import annotations

import math

from torch import Tensor

from occfusion.quality.losses import within
from occfusion.quality.ssim import WINDOW, ssim_map
from occfusion.types import Box

PSNR_CAP = 100.0
"""Decibels given to pictures that agree so well that the mean over images would be ruined by infinity."""
OCCUPIED = 0.5
"""Alpha above which a pixel counts as the person."""
EDGE = 0.01
"""Of the person's longer side: how far from the true outline a missing pixel is a hole and not an edge."""


def psnr(a: Tensor, b: Tensor, mask: Tensor | None = None) -> float | None:
    """Returns the peak signal-to-noise ratio in decibels, at most `PSNR_CAP`; None for no pixels.

    Args:
        a: `[H, W, C]`, 0..1.
        b: the same shape.
        mask: bool `[H, W]`, the pixels that count; all when None.
    """
    difference = (a - b).double()
    if mask is not None:
        difference = difference[mask]
    if difference.numel() == 0:
        return None
    error = float(difference.square().mean())
    return PSNR_CAP if error <= 10 ** (-PSNR_CAP / 10) else -10.0 * math.log10(error)


def ssim(a: Tensor, b: Tensor, mask: Tensor | None = None) -> float | None:
    """Returns the mean structural similarity; None for no pixels.

    The mean of `ssim_map` over all channels and the pixels of `mask`; without a mask, torchmetrics' figure.

    Args:
        a: `[H, W, C]`, 0..1.
        b: the same shape.
        mask: bool `[H, W]` or None.
    """
    if a.numel() == 0 or (mask is not None and not mask.any()):
        return None
    values = ssim_map(a, b)
    return float((values if mask is None else values[mask]).double().mean())


def ssim_over_black(a: Tensor, b: Tensor) -> float | None:
    """Returns `ssim(a, b)` of two pictures that are mostly black, looking only at the part that is not.

    A window that sees nothing but black in both pictures scores exactly 1, so those pixels are counted, not
    computed. The map is computed on a box around all other pixels, padded by one window: pixels whose window
    leaves the box see only black as well, inside the box and mirrored at its rim.
    """
    box = padded_box((a != 0).any(dim=2) | (b != 0).any(dim=2), WINDOW)
    if box is None or min(a.shape[:2]) < WINDOW:
        return ssim(a, b)
    x, y, w, h = box
    missing = 1.0 - ssim_map(a[y : y + h, x : x + w], b[y : y + h, x : x + w]).double()
    return 1.0 - float(missing.sum()) / a.numel()


def mask_iou(a: Tensor, b: Tensor, within: Tensor | None = None) -> float | None:
    """Returns intersection over union of two bool masks `[H, W]`; None when both are empty.

    Args:
        a: a mask.
        b: the other.
        within: bool `[H, W]`: only these pixels count; all when None.
    """
    intersection, union = a & b, a | b
    if within is not None:
        intersection, union = intersection & within, union & within
    size = int(union.sum())
    return None if size == 0 else int(intersection.sum()) / size


def depth_error(depth: Tensor, truth: Tensor, where: Tensor) -> float | None:
    """Returns the mean absolute error of depth in millimetres; None for no pixels.

    Args:
        depth: metres, `[H, W]`.
        truth: metres, `[H, W]`; pixels where it is not finite do not count.
        where: bool `[H, W]`, the pixels that count.
    """
    where = where & truth.isfinite()
    if not where.any():
        return None
    return 1000.0 * float((depth[where].double() - truth[where].double()).abs().mean())


def spill(a: Tensor, b: Tensor, mask: Tensor) -> float | None:
    """Returns the share of the squared difference that lies outside a mask; None where pictures agree.

    Args:
        a: `[H, W, C]`, 0..1.
        b: the same shape.
        mask: the true person, bool `[H, W]`.
    """
    error = (a - b).double().square().sum(dim=2)
    total = float(error.sum())
    return None if total == 0 else float(error[~mask].sum()) / total


def holes(alpha: Tensor, mask: Tensor) -> float | None:
    """Returns the share of the pixels well inside a mask that are not occupied; None where none lies so deep.

    Well inside are pixels whose neighbourhood of `EDGE` of the mask's longer side in each direction, at least one
    pixel, lies in the mask: the very edge is a matter of half a pixel.

    Args:
        alpha: `[H, W]`, 0..1.
        mask: the true person, bool `[H, W]`.
    """
    box = padded_box(mask, 0)
    if box is None:
        return None
    reach = max(1, round(EDGE * max(box[2:])))
    inside = within(mask, reach)
    return None if not inside.any() else float((alpha[inside] < OCCUPIED).double().mean())


def padded_box(mask: Tensor, padding: int | None = None) -> Box | None:
    """Returns the padded bounding box of a mask, cut to the picture; None for an empty mask.

    Args:
        mask: the region, bool `[H, W]`.
        padding: pixels on each side; when None a tenth of the box's own width or height, and on each axis at
            least so much that the SSIM window fits (where the picture is large enough).
    """
    height, width = mask.shape
    rows, columns = mask.any(dim=1).nonzero(), mask.any(dim=0).nonzero()
    if len(rows) == 0:
        return None
    x, w = _padded_span(int(columns[0]), int(columns[-1]) + 1, width, padding)
    y, h = _padded_span(int(rows[0]), int(rows[-1]) + 1, height, padding)
    return x, y, w, h


def _padded_span(start: int, stop: int, length: int, padding: int | None) -> tuple[int, int]:
    if padding is None:
        padding = max(math.ceil(0.1 * (stop - start)), math.ceil((WINDOW - (stop - start)) / 2))
        start, stop = start - padding, stop + padding
        # near the picture's edge the other side gives the pixels that the window needs
        start = min(start, max(length - WINDOW, 0))
        stop = max(stop, min(WINDOW, length))
    else:
        start, stop = start - padding, stop + padding
    start, stop = max(start, 0), min(stop, length)
    return start, stop - start
