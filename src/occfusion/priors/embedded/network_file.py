"""Weights of the embedded priors: half-precision safetensors with their own hash and model card inside."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from occfusion.errors import DataError
from occfusion.files.atomic import write_bytes
from occfusion.files.jsonfile import parse_json

MAX_BYTES = 64_000_000

Net = TypeVar("Net", bound=nn.Module)
Card = dict[str, Any]


def digest(tensors: dict[str, Tensor]) -> str:
    """Returns the SHA-256 of names, shapes and values."""
    content = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name].detach().cpu().contiguous()
        content.update(f"{name} {tensor.dtype} {list(tensor.shape)}".encode())
        content.update(tensor.reshape(-1).view(torch.uint8).numpy().tobytes())
    return content.hexdigest()


def save_net(
    path: Path,
    net: nn.Module,
    kind: str,
    size: int,
    widths: list[int],
    depth: int,
    card: Card,
    version: int = 1,
) -> None:
    """Writes a network's weights in half precision, with what is needed to build it and what is known of it.

    Args:
        path: `.safetensors`.
        net: the network.
        kind: of network: what `load_net` is asked for.
        size: pixels a side of the crop that it works on.
        widths: it was made with.
        depth: it was made with.
        card: data, seeds, times and figures, as JSON can hold them.
        version: of its conditions and its prediction.
    """
    tensors = {name: value.detach().cpu().half().contiguous() for name, value in net.state_dict().items()}
    content = {"network": kind, "size": size, "widths": widths, "depth": depth, "version": version}
    content["sha256"] = digest(tensors)
    write_bytes(path, save(tensors, metadata={"occfusion": json.dumps(card | content)}))


def load_net(
    path: str | Path | None,
    kind: str,
    size: int,
    make: Callable[[tuple[int, ...], int], Net],
    setting: str,
    version: int = 1,
) -> tuple[Net, Card]:
    """Returns a network, ready to evaluate, and its card.

    Args:
        path: a file of `save_net`; None: the package's.
        kind: of network.
        size: pixels a side of its crop.
        make: builds it from widths and depth.
        setting: that names the file, for errors.
        version: of its conditions and its prediction; files without one are of version 1.

    Raises:
        DataError: the file is missing, damaged, of another network or version, or its values do not fit its hash.
    """
    if path is None:
        with resources.as_file(resources.files("occfusion") / "assets" / f"{kind}_prior.safetensors") as own:
            return load_net(own, kind, size, make, setting, version)
    path = Path(path)
    if not path.is_file():
        raise DataError(
            f"{path}: no such file; train a prior with `python train.py stage=prior prior_training={kind}`, or leave "
            f"{setting} unset"
        )
    if path.stat().st_size > MAX_BYTES:
        raise DataError(f"{path}: {path.stat().st_size} bytes are too many for a prior of kind {kind}")
    try:
        with safe_open(path, framework="pt") as file:
            card = parse_json((file.metadata() or {})["occfusion"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
        if card["network"] != kind or card["size"] != size:
            raise KeyError("network")
        if (found := card.get("version", 1)) != version:
            raise DataError(
                f"{path}: weights of version {found} of the {kind} prior, not {version}; "
                f"train it again with `python train.py stage=prior prior_training={kind}`, or leave {setting} unset"
            )
        if digest(tensors) != card["sha256"]:
            raise DataError(
                f"{path}: its values do not fit the hash in its card; the file is damaged, get it again"
            )
        net = make(tuple(int(width) for width in card["widths"]), int(card["depth"]))
        net.load_state_dict({name: value.float() for name, value in tensors.items()})
    except (SafetensorError, KeyError, ValueError, TypeError, RuntimeError) as error:
        raise DataError(f"{path}: no {kind} prior of this version ({str(error).splitlines()[0]})") from error
    net = net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return net.eval().requires_grad_(False), card
