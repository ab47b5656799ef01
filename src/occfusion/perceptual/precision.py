"""In which precision a training step's perceptual term is computed."""

from __future__ import annotations

from typing import Any

import torch

from occfusion.errors import ConfigError

PRECISIONS = ("float32", "bfloat16", "auto")
NATIVE = ("avx512_bf16", "amx_bf16")
"""Names in `torch.cpu.get_capabilities` of instructions that multiply bfloat16; without them it is slower."""


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
