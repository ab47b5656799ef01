"""The convolutional trunk of VGG16 with plain or anti-aliased pooling, frozen."""

from __future__ import annotations

from collections.abc import Mapping

import torch
import torch.nn.functional as F
from torch import Tensor, nn

BLOCKS = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
"""Output channels of the 3x3 convolutions between two poolings (Simonyan and Zisserman, configuration D)."""
_MEAN = (-0.030, -0.088, -0.188)
_SPREAD = (0.458, 0.448, 0.450)
"""ImageNet's mean and deviation for inputs in -1..1: 2 mean - 1 and 2 deviation, rounded as in LPIPS."""
_BINOMIAL = (0.25, 0.5, 0.25)
_BLUR_PADDING = 2
"""Mirrored pixels on each side before the blur; the net was trained with twice what would keep the size."""


def layer_names() -> list[str]:
    """Returns the names of the 13 convolutions, `conv1_1` to `conv5_3`, in order."""
    return [f"conv{i}_{j}" for i, block in enumerate(BLOCKS, 1) for j, _ in enumerate(block, 1)]


def layer_shapes() -> dict[str, tuple[int, int, int, int]]:
    """Returns the weight shape `[out, in, 3, 3]` of each convolution by name."""
    shapes, incoming = {}, 3
    for name, outgoing in zip(layer_names(), (c for block in BLOCKS for c in block), strict=True):
        shapes[name] = (outgoing, incoming, 3, 3)
        incoming = outgoing
    return shapes


class VggFeatures(nn.Module):
    """VGG16 up to its last convolution; gives the activations before each pooling and at the end.

    The plain network (LPIPS) pools by the maximum of 2x2 pixels at stride 2. The shift-tolerant one (Ghildyal
    and Liu, ECCV 2022, after Zhang 2019) takes that maximum at every pixel, then blurs with a 3x3 binomial
    filter and keeps every second: an H px side becomes H // 2 + 1.

    Args:
        weights: weight `[out, in, 3, 3]` and bias `[out]` of each convolution by `layer_names`.
        antialiased: pool as the shift-tolerant network.
    """

    mean: Tensor
    spread: Tensor
    binomial: Tensor

    def __init__(self, weights: Mapping[str, tuple[Tensor, Tensor]], *, antialiased: bool) -> None:
        super().__init__()
        self.antialiased = antialiased
        for name, shape in layer_shapes().items():
            weight, bias = weights[name]
            assert weight.shape == shape and bias.shape == shape[:1], name
            # buffers: frozen, and of no interest to an optimiser
            self.register_buffer(f"{name}_weight", weight.contiguous(memory_format=torch.channels_last))
            self.register_buffer(f"{name}_bias", bias.clone())
        self.register_buffer("mean", torch.tensor(_MEAN).view(1, 3, 1, 1))
        self.register_buffer("spread", torch.tensor(_SPREAD).view(1, 3, 1, 1))
        binomial = torch.tensor(_BINOMIAL)
        self.register_buffer("binomial", torch.outer(binomial, binomial)[None, None])

    @property
    def dtype(self) -> torch.dtype:
        """The type that pictures are converted to."""
        return self.mean.dtype

    @property
    def minimum_size(self) -> int:
        """The shortest side in pixels that the network takes: what its four poolings leave something of."""
        return 18 if self.antialiased else 16

    def forward(self, x: Tensor) -> list[Tensor]:
        """Returns the five activations, `[1, C, h, w]` each.

        Args:
            x: a picture in -1..1, `[1, 3, H, W]`, neither side under `minimum_size`.
        """
        x = self.whiten(x)
        features = []
        for number, block in enumerate(BLOCKS, 1):
            if number > 1:
                x = self.pool(x)
            for part, _ in enumerate(block, 1):
                x = self.convolve(x, f"conv{number}_{part}")
            features.append(x)
        return features

    def whiten(self, x: Tensor) -> Tensor:
        """Returns pictures `[B, 3, H, W]` in -1..1 as the first convolution takes them."""
        return ((x - self.mean) / self.spread).contiguous(memory_format=torch.channels_last)

    def convolve(self, x: Tensor, name: str, padding: int = 1) -> Tensor:
        """Returns the rectified result of one of the 13 convolutions."""
        weight, bias = self.layer(name)
        return F.relu_(F.conv2d(x, weight, bias, padding=padding))

    def layer(self, name: str) -> tuple[Tensor, Tensor]:
        """Returns weight and bias of one of the 13 convolutions."""
        return getattr(self, f"{name}_weight"), getattr(self, f"{name}_bias")

    def pool(self, x: Tensor) -> Tensor:
        """Returns a map between two blocks at half the size."""
        if not self.antialiased:
            return F.max_pool2d(x, 2)
        return self.blur(F.pad(F.max_pool2d(x, 2, stride=1), (_BLUR_PADDING,) * 4, mode="reflect"))

    def reach(self, mask: Tensor, *, pools: bool) -> Tensor:
        """Returns which results of a convolution or a pooling depend on a mask's positions, bool `[h, w]`."""
        felt = mask[None, None].float()
        if not pools:
            felt = F.max_pool2d(felt, 3, stride=1, padding=1)
        elif not self.antialiased:
            felt = F.max_pool2d(felt, 2)
        else:
            felt = F.pad(F.max_pool2d(felt, 2, stride=1), (_BLUR_PADDING,) * 4, mode="reflect")
            felt = F.max_pool2d(felt, 3, stride=2)
        return felt[0, 0] > 0

    def blur(self, x: Tensor) -> Tensor:
        """Returns every second value of a map after a 3x3 binomial filter, without padding."""
        channels = x.shape[1]
        return F.conv2d(x, self.binomial.expand(channels, 1, 3, 3), stride=2, groups=channels)
