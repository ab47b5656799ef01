"""Perceptual distance of two pictures: ST-LPIPS or LPIPS, each under its own name."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from occfusion.errors import ConfigError
from occfusion.geometry.boxes import mask_bounds
from occfusion.perceptual.network import VggFeatures
from occfusion.perceptual.surround import BlackSurround, mean_distance
from occfusion.perceptual.weights import MetricWeights, load_lpips, load_stlpips

NORM_EPS = 1e-10
"""Added to the squared length of a feature vector inside the root: finite gradients at zero features."""
SMALLEST = 64
"""Pixels of a side under which a mostly black picture is computed as a whole."""
WORTH_IT = 0.6
"""Share of the lit pixels' box above which nothing is taken as known."""
Features = list[Tensor]
"""Unit-length features of a picture, `[h, w, C]` for each of the five blocks."""
PRECISIONS = ("float32", "bfloat16", "auto")
NATIVE = ("avx512_bf16", "amx_bf16")
"""Names in `torch.cpu.get_capabilities` of instructions that multiply bfloat16; without them it is slower."""


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
        self._surround = BlackSurround(self.network)
        for number, head in enumerate(weights.heads):
            self.register_buffer(f"head{number}", head)

    def with_unit_inputs(self) -> PerceptualMetric:
        """Returns this metric fed with 0..1 instead of -1..1, under a name that says so; weights are shared."""
        if not self.centred:
            return self
        other = copy.copy(self)
        other.centred, other.name = False, unit_name(self.name)
        return other

    def with_dtype(self, dtype: torch.dtype) -> PerceptualMetric:
        """Returns this metric computed in another type, for a training term: a figure is named for float32 alone."""
        return self if dtype == self.network.dtype else copy.deepcopy(self).to(dtype)

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
    def over_black(self, a: Tensor, b: Tensor) -> Tensor:
        """Returns `self(a, b)` of two pictures that are mostly black, computing only where they are not.

        Positions that see nothing but black in both pictures have a distance of 0; they are counted, not
        computed. All others are computed from the whole of what they see, so the result is the same up to
        rounding: 1e-5 of it and 1e-8.

        Args:
            a: `[H, W, 3]` in 0..1.
            b: the same shape.
        """
        compiled = a.device.type == "cpu" and self.network.dtype == torch.float32
        if a.shape != b.shape or not compiled or min(a.shape[:2]) < SMALLEST:
            return self(a, b)  # refuses pictures of two shapes
        lit = ((a.clamp(0, 1) != 0) | (b.clamp(0, 1) != 0)).any(dim=2)  # what is not a number is lit
        if bool(lit.all()):
            return self(a, b)  # nothing is black
        if (bounds := mask_bounds(lit)) is None:
            return a.new_zeros(())
        left, top, right, bottom = bounds
        if (right - left) * (bottom - top) > WORTH_IT * lit.numel():
            lit = torch.ones_like(lit)
        pictures = torch.stack([a, b]).float().clamp(0, 1).permute(0, 3, 1, 2)
        pictures = pictures * 2 - 1 if self.centred else pictures
        total = 0.0
        for number, part in enumerate(self._surround.parts(pictures, lit, -1.0 if self.centred else 0.0)):
            head: Tensor = getattr(self, f"head{number}")
            total += mean_distance(part, head, NORM_EPS)
        return a.new_tensor(total)

    def drop_filters(self) -> None:
        """Drops what `over_black` keeps of the network in another form, 235 MB; the next call makes it anew."""
        self._surround.drop_filters()

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
    title = title if centred else unit_name(title)
    return PerceptualMetric(title, weights, antialiased=antialiased, centred=centred).eval()


def unit_name(name: str) -> str:
    """Returns what a metric is called when it is fed with 0..1."""
    return name.replace("(VGG)", "(VGG, inputs 0..1)")


def training_dtype(precision: str, device: torch.device) -> torch.dtype:
    """Returns the type of the term's network: for `auto` bfloat16 where the device multiplies it natively.

    Raises:
        ConfigError: an unknown name.
    """
    if precision not in PRECISIONS:
        raise ConfigError(f"perceptual.precision={precision}: choose one of {', '.join(PRECISIONS)}")
    if precision == "float32" or (precision == "auto" and not _is_native(device)):
        return torch.float32
    return torch.bfloat16


def _is_native(device: torch.device) -> bool:
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    known: dict[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()
    return device.type == "cpu" and any(known.get(name, False) for name in NATIVE)
