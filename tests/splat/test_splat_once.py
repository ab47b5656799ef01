"""What the rasteriser's derivatives cannot do is said in a sentence; a forked child can draw and differentiate."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable

import pytest
import torch
from splat_scenes import make_scene
from torch import Tensor

from occfusion.errors import ConfigError
from occfusion.splat import rasterize

backends = pytest.mark.parametrize("backend", ["torch", "numba"])
TRANSFORMS: dict[str, Callable[[Callable[[Tensor], Tensor], Tensor], object]] = {
    "vmap": lambda draw, means: torch.func.vmap(draw)(torch.stack([means, means])),
    "grad": lambda draw, means: torch.func.grad(draw)(means),
    "vjp": lambda draw, means: torch.func.vjp(draw, means),
    "jvp": lambda draw, means: torch.func.jvp(draw, (means,), (torch.ones_like(means),)),
    "jacrev": lambda draw, means: torch.func.jacrev(draw)(means),
}


def brightness(backend: str) -> tuple[Callable[[Tensor], Tensor], Tensor]:
    scene = make_scene(n=20, width=24, height=16, degree=1, dtype=torch.float32)
    arguments = {**scene.arguments(), "backend": backend}
    means = scene.tensors["means"].detach().clone().requires_grad_()
    return lambda given: rasterize(**{**arguments, "means": given}).rgb.sum(), means


@backends
@pytest.mark.parametrize("transform", TRANSFORMS)
def test_transforms_of_functions_are_refused_with_what_to_do(backend: str, transform: str) -> None:
    draw, means = brightness(backend)
    with pytest.raises(ConfigError, match=r"torch\.func .*picture by picture"):
        TRANSFORMS[transform](draw, means.detach())
    assert torch.isfinite(draw(means.detach())), "a call after it was refused too"


@backends
def test_a_gradient_of_the_gradient_is_refused_where_it_is_asked_for(backend: str) -> None:
    """Of a linear loss as well, whose gradients had no history: a penalty on them was left out in silence."""
    draw, means = brightness(backend)
    (plain,) = torch.autograd.grad(draw(means), means)
    for loss in (draw(means), draw(means) ** 2):
        (followed,) = torch.autograd.grad(loss, means, create_graph=True)
        assert followed.requires_grad
        with pytest.raises(ConfigError, match="no gradient of its own"):
            (followed.square().sum() + means.square().sum()).backward()
    assert torch.equal(torch.autograd.grad(draw(means), means, create_graph=True)[0], plain)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a system without fork")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_child_draws_and_differentiates() -> None:
    """Threads do not survive a fork: a child that waited for its parent's would hang."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        draw, means = brightness("numba")
        (expected,) = torch.autograd.grad(draw(means), means)
        child = os.fork()
        if child == 0:
            signal.alarm(20)
            code = 1
            try:
                code = int(not torch.equal(torch.autograd.grad(draw(means), means)[0], expected))
            finally:
                os._exit(code)
        _, status = os.waitpid(child, 0)
    finally:
        torch.set_num_threads(before)
    assert os.waitstatus_to_exitcode(status) == 0, "-14: the child hung"
