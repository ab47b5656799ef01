"""The settings of in-context inpainting: presets, what is refused, and what is looked for before a run."""

import importlib.util
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from occfusion.errors import ConfigError, DataError
from occfusion.inpaint.build_inpainter import check_inpainter, make_inpainter
from occfusion.inpaint.sd15_inpainter import Sd15Inpainter, Sd15InpaintSettings
from tiny_sd15 import write_tiny_painter

CONF = Path(__file__).parents[2] / "conf"
CPU = torch.device("cpu")
FAST: dict[str, Any] = {"resolution": 64, "steps": 2}


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    return write_tiny_painter(tmp_path_factory.mktemp("models"))


def composed(preset: str) -> dict[str, Any]:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        prior = OmegaConf.to_container(compose("config", [f"prior={preset}"]).prior)
    assert isinstance(prior, dict)
    return prior["inpaint"]


def test_presets_are_the_papers_values_and_the_codes() -> None:
    paper, code = composed("sd15"), composed("sd15_code")
    paper["prompt"] = Sd15InpaintSettings(**paper).prompt
    assert paper == asdict(Sd15InpaintSettings())
    assert paper["prompt"] == "the same person standing in two different rooms"
    assert paper["negative_prompt"] is None  # the mask prior's
    assert (paper["steps"], paper["control_scale"], paper["guess_mode"]) == (10, 0.3, True)
    assert code["prompt"].startswith(paper["prompt"] + ", ") and "realistic" in code["prompt"]
    assert "objects in the hands" in code["negative_prompt"] and "malformed" in code["negative_prompt"]
    assert (code["steps"], code["sampler"], code["control_scale"]) == (35, "unipc", 0.3)
    assert {key for key in code if code[key] != paper[key]} == {
        "steps", "prompt", "negative_prompt", "resolution",
    }  # fmt: skip
    Sd15InpaintSettings(**code)


def settings_of(models: dict[str, str], shared: dict[str, Any] | None = None, **own: Any) -> dict[str, Any]:
    return {"name": "sd15", **models, **(shared or {}), "score": {}, "inpaint": {**FAST, **own}}


def test_made_of_the_settings_of_the_prior(models: dict[str, str]) -> None:
    settings = settings_of(models, {"steps": 7, "seed": 4}, control_scale=0.4)
    check_inpainter(settings, CPU)
    made = make_inpainter(settings, CPU)
    assert isinstance(made, Sd15Inpainter)
    assert made.settings == Sd15InpaintSettings(**FAST, control_scale=0.4)
    assert made.shared.steps == 7 and made.describe()["seed"] == 4 and made.describe()["steps"] == 2


@pytest.mark.parametrize("key", ["inpainting", "controlnet"])
def test_missing_model_is_said_before_anything_is_loaded(
    models: dict[str, str], tmp_path: Path, key: str
) -> None:
    for source in ("nobody/has-this", str(tmp_path / "nowhere"), str(tmp_path)):
        settings = settings_of(models, {key: source})
        for ask in (check_inpainter, make_inpainter):
            with pytest.raises(
                DataError, match=rf"prior\.{key}=.*hf download .*prior\.local_files_only=false"
            ):
                ask(settings, CPU)


def test_missing_packages_are_said_before_anything_is_loaded(
    models: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _name: None)
    with pytest.raises(ConfigError, match=r'needs diffusers and transformers,.*"occfusion\[sd15\]"'):
        check_inpainter(settings_of(models), CPU)


@pytest.mark.parametrize(
    ("own", "message"),
    [
        ({"steps": 0}, r"prior\.inpaint\.steps=0: must be at least 1"),
        ({"resolution": 72}, r"prior\.inpaint\.resolution=72: must be a multiple of 16"),
        ({"sampler": "euler"}, r"prior\.inpaint\.sampler='euler': must be dpmsolver"),
        ({"control_scale": -0.1}, r"prior\.inpaint\.control_scale=-0.1: must be at least 0"),
        ({"guidance": float("nan")}, r"prior\.inpaint\.guidance=nan: must be at least 0"),
        ({"negative_prompt": 3}, r"prior\.inpaint\.negative_prompt=3: expected str"),
        ({"prompt": 3}, r"prior\.inpaint\.prompt=3: expected str"),
        ({"guess_mode": "yes"}, r"prior\.inpaint\.guess_mode='yes': expected bool"),
        ({"seed": 3}, r"prior\.inpaint\.seed: unknown; there are prompt"),
    ],
)
def test_wrong_settings_are_refused(models: dict[str, str], own: dict[str, Any], message: str) -> None:
    for ask in (check_inpainter, make_inpainter):
        with pytest.raises(ConfigError, match=message):
            ask(settings_of(models, **own), CPU)


def test_wrong_shared_settings_are_refused(models: dict[str, str]) -> None:
    for shared, message in (
        ({"cpu_offload": True}, "nothing to offload"),
        ({"dtype": "float16"}, "float16 is for GPUs"),
        ({"strength": 1}, r"prior\.strength: unknown"),
    ):
        with pytest.raises(ConfigError, match=message):
            check_inpainter(settings_of(models, shared), CPU)
    with pytest.raises(ConfigError, match=r"prior\.inpaint\.stepz: unknown"):
        check_inpainter({"name": "embedded", "inpaint": {"stepz": 1}}, CPU)
