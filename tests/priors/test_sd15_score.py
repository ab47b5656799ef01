"""The score of prior=sd15 with tiny random models: plumbing, precision, and what is asked how often."""

import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

from occfusion.errors import ConfigError, DataError
from occfusion.human import embedded_body
from occfusion.observation.crop import view_canonical
from occfusion.priors.build_prior import check_score_prior, make_score_prior
from occfusion.priors.score import Draw, distil
from occfusion.priors.sd15.score_prior import Sd15Score, Sd15ScoreSettings
from tiny_sd15 import write_tiny_controlnet, write_tiny_inpainting

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    root = tmp_path_factory.mktemp("score")
    write_tiny_inpainting(root / "model", channels_in=4)
    write_tiny_controlnet(root / "controlnet")
    return {"model": str(root / "model"), "controlnet": str(root / "controlnet")}


@pytest.fixture(scope="module")
def prior(models: dict[str, str]) -> Sd15Score:
    return Sd15Score(Sd15ScoreSettings(**models))


def loss_of(
    prior: Sd15Score, occupancy: torch.Tensor, mask: torch.Tensor, guidance: float = 0.0
) -> torch.Tensor:
    conditions = prior.encode_conditions(view_canonical(embedded_body(), 0, prior.size))
    noise = torch.randn(1, *prior.signal_shape, generator=torch.Generator().manual_seed(0))
    draw = Draw(0.6, noise)
    return distil(
        prior, occupancy, mask, conditions, draw, weighting="sigma2", guidance=guidance, reduction="mean"
    )


def test_gradient_reaches_the_picture_and_not_the_models(prior: Sd15Score) -> None:
    occupancy = torch.rand(256, 256).requires_grad_()
    mask = torch.zeros(256, 256)
    mask[:128] = 1.0
    loss = loss_of(prior, occupancy, mask)
    loss.backward()
    assert occupancy.grad is not None
    assert bool(occupancy.grad.isfinite().all())
    assert occupancy.grad[:128].any()
    assert not occupancy.grad[128:].any()
    parts = (prior.vae, prior.unet, prior.controlnet)
    assert not any(p.requires_grad or p.grad is not None for part in parts for p in part.parameters())


def test_canvas_and_prompts_are_conditions(prior: Sd15Score, monkeypatch: pytest.MonkeyPatch) -> None:
    body = embedded_body()
    front, side = (prior.encode_conditions(view_canonical(body, turn, prior.size)) for turn in (0, 4))
    assert front.shape == (1, 3, 256, 256)
    assert float(front.max()) > 0.5
    noisy = torch.randn(1, *prior.signal_shape)
    asked: list[torch.Tensor] = []
    original = prior._predict

    def counted(noisy: torch.Tensor, t: float, canvas: torch.Tensor, text: torch.Tensor) -> torch.Tensor:
        asked.append(text)
        return original(noisy, t, canvas, text)

    monkeypatch.setattr(prior, "_predict", counted)
    negative = prior.predict_noise(noisy, 0.5, front, 0.0)
    assert len(asked) == 1 and asked[0] is prior.negative
    positive = prior.predict_noise(noisy, 0.5, front, 1.0)
    assert len(asked) == 2 and asked[1] is prior.positive
    both = prior.predict_noise(noisy, 0.5, front, 3.0)
    assert len(asked) == 4
    torch.testing.assert_close(both, negative + 3.0 * (positive - negative))
    assert not torch.equal(negative, prior.predict_noise(noisy, 0.5, side, 0.0))


def test_levels_are_the_models_schedule(prior: Sd15Score) -> None:
    assert len(prior.kept) == 1000
    for t in (0.0, 0.02, 0.5, 1.0):
        alpha, sigma = prior.levels(t)
        assert alpha**2 + sigma**2 == pytest.approx(1.0)
    assert prior.levels(0.02)[0] > 0.98
    assert prior.levels(1.0)[0] < 0.1


def test_latents_are_made_in_float32_whatever_the_networks_are(models: dict[str, str]) -> None:
    half = Sd15Score(Sd15ScoreSettings(**models, dtype="bfloat16"))
    assert half.vae.dtype == torch.float32
    assert half.unet.dtype == half.controlnet.dtype == torch.bfloat16
    assert half.encode(torch.rand(1, 1, 256, 256)).dtype == torch.float32
    assert bool(loss_of(half, torch.rand(256, 256), torch.ones(256, 256)).isfinite())


def settings_of(models: dict[str, str], **more: Any) -> dict[str, Any]:
    return {"name": "sd15", "local_files_only": True, "steps": 10, "score": {**models, **more}}


def test_made_of_the_settings_of_the_prior(models: dict[str, str]) -> None:
    made = make_score_prior(settings_of(models, negative_prompt="low"), CPU)
    assert made.describe()["negative_prompt"] == "low"
    assert made.describe()["model_hash"]
    assert "model" not in made.describe()


def test_wrong_models_are_named(models: dict[str, str], tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"prior\.score\.model=.*no such folder.*hf download"):
        check_score_prior(settings_of({**models, "model": str(tmp_path / "nowhere")}))
    with pytest.raises(ConfigError, match=r"prior\.strength: unknown"):
        check_score_prior(settings_of(models, strength=1))
    write_tiny_inpainting(tmp_path / "inpainting")
    with pytest.raises(DataError, match=r"prior\.score\.model.*it is for inpainting"):
        make_score_prior(settings_of({**models, "model": str(tmp_path / "inpainting")}), CPU)
    shutil.rmtree(tmp_path / "inpainting")
