"""Perceptual distance of two pictures: ST-LPIPS or LPIPS, each under its own name."""

from __future__ import annotations

from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from occfusion.errors import ConfigError
from occfusion.perceptual.network import VggFeatures
from occfusion.perceptual.weights import MetricWeights, load_lpips, load_stlpips
from occfusion.types import Box

NORM_EPS = 1e-10
"""Added to the squared length of a feature vector inside the root: finite gradients at zero features."""
Features = list[Tensor]
"""Unit-length features of a picture, `[h, w, C]` for each of the five blocks."""


class PerceptualMetric(nn.Module):
    """Weighted squared distance between the unit-length VGG16 features of two pictures (Zhang et al., 2018).

    Per block: the mean over positions of sum_c w_c (a_c/|a| - b_c/|b|)². Frozen; `train()` changes nothing.
    Pictures are clamped to 0..1 (no gradient outside) and a side too short for the network is filled up with
    black on the right or below, the same for both pictures.

    Args:
        name: what tables call the figure.
        weights: convolutions and heads.
        antialiased: the pooling that the weights were trained with.
        centred: map 0..1 to -1..1 as the metrics were defined; False feeds 0..1, a widespread slip in
            published tables that gives other, lower figures.
    """

    def __init__(self, name: str, weights: MetricWeights, *, antialiased: bool, centred: bool = True) -> None:
        super().__init__()
        self.name = name
        self.centred = centred
        self.network = VggFeatures(weights.convolutions, antialiased=antialiased)
        for number, head in enumerate(weights.heads):
            self.register_buffer(f"head{number}", head)

    def forward(self, a: Tensor, b: Tensor) -> Tensor:
        """Returns the distance of two pictures, a scalar that is differentiable in the first of them.

        Args:
            a: `[H, W, 3]` in 0..1.
            b: the same shape; taken as fixed.
        """
        if a.shape != b.shape:
            raise ValueError(f"the two pictures differ in shape: {list(a.shape)} and {list(b.shape)}")
        return self.distance(a, self.features(b))

    @torch.no_grad()
    def features(self, picture: Tensor) -> Features:
        """Returns the features of a picture `[H, W, 3]`, to be kept and given to `distance` again and again.

        A kept target saves a third of the time of a training step's term; 2.1 M numbers at 128 px square.
        """
        return [_unit(layer)[0] for layer in self._layers(picture)]

    def distance(self, picture: Tensor, target: Features) -> Tensor:
        """Returns the distance of a picture `[H, W, 3]` from a target given by its features, a scalar."""
        total = picture.new_zeros(())
        for number, (layer, wanted) in enumerate(zip(self._layers(picture), target, strict=True)):
            if layer.shape != wanted.shape:
                raise ValueError("the target's features are those of a picture of another size")
            head: Tensor = getattr(self, f"head{number}")
            total = total + _LayerDistance.apply(layer, wanted, head)
        return total

    def _layers(self, picture: Tensor) -> list[Tensor]:
        if picture.dim() != 3 or picture.shape[2] != 3 or picture.numel() == 0:
            raise ValueError(f"{self.name} needs pictures [H, W, 3], got {list(picture.shape)}")
        height, width = picture.shape[:2]
        x = picture.to(self.network.dtype).clamp(0, 1).permute(2, 0, 1)[None]
        least = self.network.minimum_size
        x = F.pad(x, (0, max(least - width, 0), 0, max(least - height, 0)))
        layers = self.network(x * 2 - 1 if self.centred else x)
        return [layer[0].permute(1, 2, 0) for layer in layers]


class _LayerDistance(torch.autograd.Function):
    """The distance of one block, differentiable in the first features; the target is fixed."""

    @staticmethod
    def forward(ctx, layer: Tensor, wanted: Tensor, head: Tensor) -> Tensor:  # type: ignore[no-untyped-def]
        unit, inverse = _unit(layer)
        difference = unit - wanted
        ctx.save_for_backward(unit, inverse, difference, head)
        return (difference.square() @ head).mean()

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None, None]:  # type: ignore[no-untyped-def]
        unit, inverse, difference, head = ctx.saved_tensors
        by_unit = difference * (head * (grad * (2.0 / inverse.numel())))
        # the derivative of f/|f|: what lies along f is taken out
        along = (by_unit * unit).sum(dim=-1, keepdim=True)
        return torch.addcmul(by_unit, unit, along, value=-1).mul_(inverse), None, None


def _unit(layer: Tensor) -> tuple[Tensor, Tensor]:
    """Returns features `[h, w, C]` divided by their length, and one over that length, `[h, w, 1]`."""
    inverse = (layer.square().sum(dim=-1, keepdim=True) + NORM_EPS).rsqrt()
    return layer * inverse, inverse


def load_perceptual(
    name: str, vgg_path: Path | str | None = None, *, centred: bool = True
) -> PerceptualMetric:
    """Returns a perceptual metric with its published weights, frozen.

    Args:
        name: `stlpips` (weights from the installed package stlpips_pytorch) or `lpips` (needs `vgg_path`).
        vgg_path: torchvision's `vgg16-397923af.pth`, for `lpips`.
        centred: False for the un-normalised call, reported under a name of its own.

    Raises:
        ConfigError: an unknown name, or weights that are missing or not the published ones.
    """
    if name not in ("stlpips", "lpips"):
        raise ConfigError(f"perceptual.name={name}: choose stlpips or lpips")
    antialiased = name == "stlpips"
    weights = load_stlpips() if antialiased else load_lpips(vgg_path)
    title = "ST-LPIPS (VGG)" if antialiased else "LPIPS (VGG)"
    if not centred:
        title = title.replace("(VGG)", "(VGG, inputs 0..1)")
    return PerceptualMetric(title, weights, antialiased=antialiased, centred=centred).eval()


def random_crop_box(mask: Tensor, size: int, generator: torch.Generator) -> Box:
    """Returns a window of `size` px around a random pixel of `mask`, cut to the picture.

    The window is moved into the mask's bounding box where it is larger than the window, so that no training
    step is spent on background, and into the picture in any case. An empty mask gives the middle of the
    picture.

    Args:
        mask: the person, bool `[H, W]`.
        size: side in pixels; smaller where the picture is.
        generator: source of the choice (on the CPU).
    """
    height, width = mask.shape
    pixels = mask.nonzero()
    if len(pixels) == 0:
        row, column = height // 2, width // 2
        first, last = [0, 0], [height - 1, width - 1]
    else:
        row, column = pixels[int(torch.randint(len(pixels), (1,), generator=generator))].tolist()
        first, last = pixels.amin(dim=0).tolist(), pixels.amax(dim=0).tolist()
    y, h = _place(row, size, first[0], last[0] + 1, height)
    x, w = _place(column, size, first[1], last[1] + 1, width)
    return x, y, w, h


def _place(centre: int, size: int, start: int, stop: int, length: int) -> tuple[int, int]:
    """Returns start and length of a window on one axis: around `centre`, in [start, stop), in [0, length)."""
    size = min(size, length)
    first = centre - size // 2
    if stop - start >= size:
        first = min(max(first, start), stop - size)
    return min(max(first, 0), length - size), size
