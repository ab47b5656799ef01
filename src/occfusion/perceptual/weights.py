"""Finds the published weights of the perceptual metrics, in installed packages or a user's file."""

from __future__ import annotations

import hashlib
import importlib.util
import pickle
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from occfusion.errors import ConfigError
from occfusion.perceptual.network import BLOCKS, layer_names, layer_shapes

STLPIPS_SHA256 = "44597da68f49c1837c100ff52299050f274d102eb102e5837178c79be6f0e250"
"""`vgg_shift_tolerant.pth` of the package stlpips_pytorch 0.0.2."""
VGG_SHA256_PREFIX = "397923af"
"""torchvision writes the first digits of the hash into the file's name, vgg16-397923af.pth."""
HEADS_SHA256 = "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868"
"""LPIPS's linear heads for VGG, version 0.1: the same 7 kB file in the wheels of torchmetrics and lpips."""
_HEADS_PLACES = (
    ("torchmetrics", "functional/image/lpips_models/vgg.pth"),
    ("lpips", "weights/v0.1/vgg.pth"),
)


@dataclass(frozen=True)
class MetricWeights:
    """The weights of a perceptual metric.

    Attributes:
        convolutions: weight and bias of each layer of `network.layer_names`.
        heads: non-negative weight of each channel, `[C]`, for each of the five blocks.
    """

    convolutions: dict[str, tuple[Tensor, Tensor]]
    heads: list[Tensor]


def load_stlpips() -> MetricWeights:
    """Returns the weights of ST-LPIPS from the installed package, whose code is not imported.

    Raises:
        ConfigError: the package is missing, or its file is not the published one.
    """
    path = _package_file("stlpips_pytorch", "weights/vST0.0/vgg_shift_tolerant.pth")
    if path is None:
        raise ConfigError(
            "perceptual.name=stlpips: the weights of ST-LPIPS come with the package stlpips_pytorch, which "
            "is not installed; run: pip install --no-deps stlpips_pytorch==0.0.2"
        )
    state = _load_checked(path, STLPIPS_SHA256, "perceptual.name=stlpips", "reinstall stlpips_pytorch==0.0.2")
    # each block is a slice whose layers are counted on through pooling (2 layers) and activations
    keys, position = [], 0
    for number, block in enumerate(BLOCKS, 1):
        position += 2 if number > 1 else 0
        for _ in block:
            keys.append(f"net.slice{number}.{position}")
            position += 2
    return MetricWeights(_convolutions(state, keys, path), _heads(state, path))


def load_lpips(vgg_path: Path | str | None, *, vgg_sha256: str = VGG_SHA256_PREFIX) -> MetricWeights:
    """Returns the weights of LPIPS (VGG, version 0.1): the user's VGG16, and heads from a package.

    Args:
        vgg_path: torchvision's `vgg16-397923af.pth`.
        vgg_sha256: first digits of that file's hash.

    Raises:
        ConfigError: no path, no such file, or not the published file; no package with the heads.
    """
    what = "perceptual.name=lpips"
    if vgg_path is None:
        raise ConfigError(
            f"{what} needs perceptual.vgg_path, torchvision's VGG16 weights: download "
            "https://download.pytorch.org/models/vgg16-397923af.pth (528 MB) and give its path, or use "
            "perceptual.name=stlpips, whose weights are installed"
        )
    path = Path(vgg_path).expanduser()
    if not path.is_file():
        raise ConfigError(f"perceptual.vgg_path={path}: no such file; give torchvision's vgg16-397923af.pth")
    state = _load_checked(path, vgg_sha256, "perceptual.vgg_path", "download vgg16-397923af.pth again")
    keys, position = [], 0
    for block in BLOCKS:
        for _ in block:
            keys.append(f"features.{position}")
            position += 2
        position += 1
    return MetricWeights(_convolutions(state, keys, path), _lpips_heads(what))


def _lpips_heads(what: str) -> list[Tensor]:
    for package, inside in _HEADS_PLACES:
        path = _package_file(package, inside)
        if path is not None:
            state = _load_checked(path, HEADS_SHA256, what, f"reinstall {package}")
            return _heads(state, path)
    raise ConfigError(
        f"{what}: its linear heads come with torchmetrics or lpips; run: pip install torchmetrics"
    )


def _package_file(package: str, inside: str) -> Path | None:
    """Returns a file of an installed package without importing it."""
    spec = importlib.util.find_spec(package)
    for folder in (spec.submodule_search_locations or []) if spec is not None else []:
        path = Path(folder) / inside
        if path.is_file():
            return path
    return None


def _load_checked(path: Path, sha256: str, what: str, cure: str) -> Mapping[str, Tensor]:
    try:
        with path.open("rb") as file:
            found = hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise ConfigError(f"{what}: {path} cannot be read ({error.strerror})") from error
    if not found.startswith(sha256):
        raise ConfigError(
            f"{what}: {path} is not the published file (sha256 {found[:12]}, expected {sha256[:12]}); {cure}"
        )
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise ConfigError(f"{what}: {path} cannot be loaded ({error}); {cure}") from error
    if not isinstance(state, Mapping):
        raise ConfigError(f"{what}: {path} holds no table of weights; {cure}")
    return state


def _convolutions(
    state: Mapping[str, Tensor], keys: list[str], path: Path
) -> dict[str, tuple[Tensor, Tensor]]:
    return {
        name: (
            _tensor(state, f"{key}.weight", layer_shapes()[name], path),
            _tensor(state, f"{key}.bias", layer_shapes()[name][:1], path),
        )
        for name, key in zip(layer_names(), keys, strict=True)
    }


def _heads(state: Mapping[str, Tensor], path: Path) -> list[Tensor]:
    return [
        _tensor(state, f"lin{i}.model.1.weight", (1, block[-1], 1, 1), path).flatten()
        for i, block in enumerate(BLOCKS)
    ]


def _tensor(state: Mapping[str, Tensor], key: str, shape: tuple[int, ...], path: Path) -> Tensor:
    value = state.get(key)
    if value is None or tuple(value.shape) != shape:
        found = "missing" if value is None else f"of shape {list(value.shape)}"
        raise ConfigError(
            f"{path}: weight {key} is {found}, expected {list(shape)}; is it another network's?"
        )
    return value.detach().float()
