"""A training term's precision: what is asked for, what the processor has, and how near the gradient stays."""

from types import SimpleNamespace

import pytest
import torch

from app.test_config import settings_of
from occfusion.errors import ConfigError
from occfusion.perceptual import training_dtype
from occfusion.plan.decisions import Decision
from occfusion.plan.make import precision_decisions
from quality.pictures import noise, waves

CPU = torch.device("cpu")


@pytest.mark.parametrize(
    ("known", "expected"),
    [
        ({"avx2": True, "avx512_bf16": False}, torch.float32),
        ({"avx512_bf16": True}, torch.bfloat16),
        ({"amx_bf16": True}, torch.bfloat16),
    ],
)
def test_auto_takes_what_the_processor_has(monkeypatch, known, expected):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: known)
    assert training_dtype("auto", CPU) == expected
    assert training_dtype("float32", CPU) == torch.float32
    assert training_dtype("bfloat16", CPU) == torch.bfloat16


def test_auto_is_single_where_torch_cannot_tell(monkeypatch):
    monkeypatch.setattr(torch, "cpu", SimpleNamespace())
    assert training_dtype("auto", CPU) == torch.float32


def test_an_unknown_precision_is_refused():
    with pytest.raises(
        ConfigError, match=r"perceptual\.precision=half: choose one of float32, bfloat16, auto"
    ):
        training_dtype("half", CPU)
    with pytest.raises(ConfigError, match=r"perceptual\.precision='half': must be float32, bfloat16 or auto"):
        settings_of("perceptual.precision=half")


@pytest.mark.parametrize("size", [(64, 64), (33, 57)])
@pytest.mark.parametrize(("pictures", "least"), [(noise, 0.99), (waves, 0.8)], ids=["textured", "smooth"])
def test_the_gradient_points_the_same_way(stlpips, size, pictures, least):
    """Smooth pictures are the worst: their features hardly differ. Renderings of a person and the truth have 0.99."""
    a, b = (picture.float() for picture in pictures(*size))
    a = a.clone().requires_grad_()
    half = stlpips.with_dtype(torch.bfloat16)
    assert stlpips.with_dtype(torch.float32) is stlpips and stlpips.network.dtype == torch.float32
    values, gradients = [], []
    for metric in (stlpips, half):
        distance = metric(a, b)
        values.append(float(distance.detach()))
        gradients.append(torch.autograd.grad(distance, a)[0].flatten())
    assert gradients[1].dtype == a.dtype
    assert values[1] == pytest.approx(values[0], rel=0.01)
    assert float(torch.cosine_similarity(*gradients, dim=0)) > least


def test_equal_pictures_have_no_distance_in_either(stlpips):
    a, _ = waves(64, 64)
    assert float(stlpips.with_dtype(torch.bfloat16)(a, a)) == 0


def test_the_plan_says_what_was_chosen(monkeypatch):
    term = [Decision("loss term lpips in refine", True, "refine.lambda_lpips = 0.1")]
    assert precision_decisions(settings_of("perceptual.precision=float32"), term, CPU) == []
    asked = settings_of("perceptual.precision=auto")
    assert precision_decisions(asked, [Decision("loss term lpips", False, "")], CPU) == []
    for known, used, words in ((True, False, "multiplies"), (False, True, "does not multiply")):
        monkeypatch.setattr(torch.cpu, "get_capabilities", lambda known=known: {"amx_bf16": known})
        (decision,) = precision_decisions(asked, term, CPU)
        assert decision.part == "single precision in the perceptual term" and decision.used is used
        assert words in decision.reason and "auto" in decision.reason
