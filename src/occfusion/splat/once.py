"""Gradients that can be taken once: what the rasteriser's own derivatives cannot do is said in a sentence."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

import torch
from torch import Tensor

from occfusion.errors import ConfigError

NOT_TWICE = (
    "rasterize: its gradient has no gradient of its own; leave a penalty on gradients of pictures out, or take "
    "differences of first gradients"
)
NOT_TRANSFORMED = (
    "rasterize: torch.func (vmap, grad, jvp, vjp) cannot go through it; call it picture by picture, and take gradients "
    "by backward() or torch.autograd.grad"
)


def refuse_transforms() -> None:
    """Refuses a call from within `torch.func`, whose own errors speak of control flow or of `setup_context`.

    Raises:
        ConfigError: with what to do.
    """
    active = getattr(torch._C, "_are_functorch_transforms_active", None)
    if active is not None and active():
        raise ConfigError(NOT_TRANSFORMED)


class _Refusal(torch.autograd.Function):
    """Hands gradients on, and refuses to be differentiated by what they depend on."""

    @staticmethod
    def forward(ctx, count, *tensors):  # type: ignore[no-untyped-def]
        return tuple(gradient.view_as(gradient) for gradient in tensors[:count])

    @staticmethod
    def backward(ctx, *_):  # type: ignore[no-untyped-def]
        raise ConfigError(NOT_TWICE)


def differentiable_once(backward: Callable[..., Any]) -> Callable[..., Any]:
    """Returns the backward pass with gradients that say so when they are differentiated.

    That of torch (`once_differentiable`) leaves them without a history where the loss is linear in the picture: a
    penalty on them would be left out in silence. The saved tensors must hold the inputs.
    """

    @wraps(backward)
    def once(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        with torch.no_grad():
            found: tuple[Tensor | None, ...] = tuple(backward(ctx, *gradients))
        if not torch.is_grad_enabled():  # nobody asked for `create_graph`
            return found
        given = [tensor for tensor in found if tensor is not None]
        causes = [tensor for tensor in (*ctx.saved_tensors, *gradients) if tensor is not None]
        followed = iter(_Refusal.apply(len(given), *given, *causes))
        return tuple(None if tensor is None else next(followed) for tensor in found)

    return once
