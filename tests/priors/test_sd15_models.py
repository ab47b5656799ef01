"""Loading what `prior=sd15` needs: settings are checked, and what is missing or damaged is said at the start."""

import importlib.util
import shutil
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import huggingface_hub
import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from safetensors.torch import load_file, save_file

from occfusion.errors import ConfigError, DataError
from occfusion.priors.build_prior import make_mask_prior
from occfusion.priors.sd15.loading import require_packages
from occfusion.priors.sd15.mask_prior import Sd15MaskPrior
from occfusion.priors.sd15.score_prior import Sd15ScoreSettings
from occfusion.priors.sd15.settings import Sd15Settings

CONF = Path(__file__).parents[2] / "conf"
PUBLISHED = [
    "README.md", "model_index.json", "tokenizer/vocab.json", "tokenizer/merges.txt", "unet/config.json",
    "unet/diffusion_pytorch_model.bin", "unet/diffusion_pytorch_model.fp16.safetensors",
    "vae/diffusion_pytorch_model.fp16.safetensors", "text_encoder/pytorch_model.bin",
    "text_encoder/model.fp16.safetensors", "safety_checker/config.json", "safety_checker/model.fp16.safetensors",
    "sd-v1-5-inpainting.ckpt", "inpainting.py",
]  # fmt: skip


def composed(preset: str) -> dict[str, Any]:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        prior = OmegaConf.to_container(compose("config", [f"prior={preset}"]).prior)
    assert isinstance(prior, dict) and prior.pop("name") == "sd15"
    return prior


def test_presets_are_the_papers_values_and_the_codes() -> None:
    paper, code = composed("sd15"), composed("sd15_code")
    score = paper.pop("score")
    assert code.pop("score") == score
    for group in ("inpaint", "completion"):  # of other stages
        del paper[group], code[group]
    assert asdict(Sd15ScoreSettings(**score)) == asdict(Sd15ScoreSettings())
    for preset in (paper, code):
        preset |= {key: getattr(Sd15Settings(**preset), key) for key in ("prompt", "negative_prompt")}
    assert paper == asdict(Sd15Settings())
    assert (paper["steps"], paper["control_scale"]) == (10, 1.0)
    assert paper["prompt"].startswith(
        "clean background, high contrast to background, a person only, plain clothes"
    )
    assert paper["negative_prompt"].endswith("missing fingers, cropped, worst quality, low quality, blurry")
    assert {key for key in code if code[key] != paper[key]} == {"steps", "prompt", "resolution"}
    assert code["prompt"] == paper["prompt"] + ", two arms, two legs, one head" and code["steps"] == 15


@pytest.mark.parametrize(
    ("key", "published"),
    [
        ("inpainting", "stable-diffusion-v1-5/stable-diffusion-inpainting"),
        ("controlnet", "lllyasviel/sd-controlnet-openpose"),
        ("segmenter", "syscv-community/sam-hq-vit-huge"),
    ],
)
def test_missing_model_is_said_at_the_start(
    tiny_models: dict[str, str], tmp_path: Path, key: str, published: str
) -> None:
    # no such id in an empty cache, no such folder, a folder that holds nothing
    for source in ("nobody/has-this", str(tmp_path / "nowhere"), str(tmp_path)):
        with pytest.raises(DataError) as raised:
            make_mask_prior({"name": "sd15", **tiny_models, key: source}, torch.device("cpu"))
        message = str(raised.value)
        assert f"prior.{key}={source}" in message and "prior.local_files_only=false" in message
        assert f"hf download {source if source == 'nobody/has-this' else published} --exclude" in message
        assert "prior=embedded" in message


def test_pickled_weights_are_not_read(tiny_models: dict[str, str], tmp_path: Path) -> None:
    folder = Path(shutil.copytree(tiny_models["controlnet"], tmp_path / "controlnet"))
    weights = folder / "diffusion_pytorch_model.safetensors"
    weights.rename(weights.with_suffix(".bin"))
    with pytest.raises(
        DataError, match=r"lacks diffusion_pytorch_model.safetensors; its .bin files are pickles"
    ):
        Sd15MaskPrior(Sd15Settings(**{**tiny_models, "controlnet": str(folder)}))


def test_truncated_weights_are_named(tiny_models: dict[str, str], tmp_path: Path) -> None:
    folder = Path(shutil.copytree(tiny_models["controlnet"], tmp_path / "controlnet"))
    weights = folder / "diffusion_pytorch_model.safetensors"
    weights.write_bytes(weights.read_bytes()[:5000])
    with pytest.raises(DataError, match=r"prior\.controlnet: the model in .*controlnet does not load"):
        Sd15MaskPrior(Sd15Settings(**{**tiny_models, "controlnet": str(folder)}))


@pytest.mark.parametrize(
    ("key", "file"),
    [
        ("controlnet", "diffusion_pytorch_model.safetensors"),
        ("segmenter", "model.safetensors"),
        ("inpainting", "unet/diffusion_pytorch_model.fp16.safetensors"),
        ("inpainting", "vae/diffusion_pytorch_model.fp16.safetensors"),
        ("inpainting", "text_encoder/model.fp16.safetensors"),
    ],
)
def test_weights_that_lack_a_tensor_are_not_filled_with_noise(
    tiny_models: dict[str, str], tmp_path: Path, key: str, file: str
) -> None:
    folder = Path(shutil.copytree(tiny_models[key], tmp_path / key))
    tensors = load_file(folder / file)
    dropped = next(name for name in tensors if name.endswith("weight"))
    del tensors[dropped]
    save_file(tensors, folder / file, metadata={"format": "pt"})
    with pytest.raises(DataError, match=rf"prior\.{key}: .* does not load .*lack 1 tensors of a \w+, first "):
        Sd15MaskPrior(Sd15Settings(**{**tiny_models, key: str(folder)}))


def test_download_takes_only_what_is_loaded(
    tiny_models: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: dict[str, dict[str, Any]] = {}

    def download(source: str, **options: Any) -> str:
        calls[source] = options
        return tiny_models[source.split("/")[1]]

    monkeypatch.setattr(huggingface_hub, "snapshot_download", download)
    ids = {key: f"owner/{key}" for key in tiny_models}
    Sd15MaskPrior(Sd15Settings(**ids, local_files_only=False, controlnet_revision="abc"))
    assert {key: call["revision"] for key, call in calls.items()} == {
        "owner/inpainting": None, "owner/controlnet": "abc", "owner/segmenter": None,
    }  # fmt: skip
    for options in calls.values():
        assert options["local_files_only"] is False
        taken = list(
            huggingface_hub.utils.filter_repo_objects(PUBLISHED, allow_patterns=options["allow_patterns"])
        )
        assert not any(name.endswith((".bin", ".ckpt", ".py")) or "safety_checker" in name for name in taken)
    wanted = calls["owner/inpainting"]["allow_patterns"]
    assert set(huggingface_hub.utils.filter_repo_objects(PUBLISHED, allow_patterns=wanted)) == {
        "model_index.json", "tokenizer/vocab.json", "tokenizer/merges.txt", "unet/config.json",
        "unet/diffusion_pytorch_model.fp16.safetensors", "vae/diffusion_pytorch_model.fp16.safetensors",
        "text_encoder/model.fp16.safetensors",
    }  # fmt: skip

    def fails(*_: Any, **__: Any) -> str:
        raise OSError("no network\nmore")

    monkeypatch.setattr(huggingface_hub, "snapshot_download", fails)
    with pytest.raises(
        DataError, match=r"prior\.inpainting=owner/inpainting was not downloaded: no network\. Get it"
    ):
        Sd15MaskPrior(Sd15Settings(**ids, local_files_only=False))


def test_missing_packages_are_said_at_the_start(
    tiny_models: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _name: None)
    with pytest.raises(
        ConfigError, match=r'needs diffusers and transformers,.*pip install "occfusion\[sd15\]"'
    ):
        make_mask_prior({"name": "sd15", **tiny_models}, torch.device("cpu"))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "accelerate" else name)
    with pytest.raises(ConfigError, match=r"needs accelerate \(prior.cpu_offload=true\)"):
        require_packages(cpu_offload=True)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"steps": 0}, "prior.steps=0: must be at least 1"),
        ({"resolution": 100}, "prior.resolution=100: must be a multiple of 8"),
        ({"sampler": "euler"}, "prior.sampler='euler': must be dpmsolver"),
        ({"dtype": "half"}, "prior.dtype='half': must be auto, float32"),
        ({"dtype": "float16"}, "float16 is for GPUs"),
        ({"cpu_offload": True}, "nothing to offload"),
        ({"device": "moon"}, "prior.device='moon'"),
        ({"step": 3}, "prior.step: unknown"),
        ({"prompt": 3}, "expected str"),
    ],
)
def test_wrong_settings_are_refused(
    tiny_models: dict[str, str], options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        make_mask_prior({"name": "sd15", **tiny_models, **options}, torch.device("cpu"))


def test_nothing_of_it_is_imported_unless_asked() -> None:
    """Without Lightning, whose torchmetrics imports transformers wherever it is installed."""
    code = (
        "import contextlib, sys, torch, occfusion, occfusion.priors.sd15.mask_prior\n"
        "from occfusion.errors import DataError\n"
        "from occfusion.priors.build_prior import make_mask_prior\n"
        "with contextlib.suppress(DataError):\n"  # it may have no weights yet
        "    make_mask_prior({'name': 'embedded'}, torch.device('cpu'))\n"
        "print([m for m in ('diffusers', 'transformers', 'huggingface_hub', 'accelerate') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "[]", done.stderr
