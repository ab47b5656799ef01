from __future__ import annotations

import hashlib
import importlib.util
from pathlib import Path

import pytest
import torch

from occfusion.errors import ConfigError
from occfusion.perceptual import load_perceptual
from occfusion.perceptual.network import layer_shapes
from occfusion.perceptual.weights import load_lpips


@pytest.fixture(scope="module")
def vgg_file(tmp_path_factory) -> Path:
    """A file with the keys and shapes of torchvision's VGG16 trunk, untrained."""
    state, position = {}, 0
    for name, shape in layer_shapes().items():
        if name.endswith("_1") and name != "conv1_1":
            position += 1
        state[f"features.{position}.weight"] = torch.full(shape, float(position))
        state[f"features.{position}.bias"] = torch.full(shape[:1], -float(position))
        position += 2
    path = tmp_path_factory.mktemp("vgg") / "vgg16.pth"
    torch.save(state, path)
    return path


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_lpips_takes_the_users_backbone_and_installed_heads(vgg_file):
    weights = load_lpips(vgg_file, vgg_sha256=sha256(vgg_file)[:8])
    # torchvision counts convolutions, activations and poolings: the 13th convolution is layer 28
    positions = [int(w.flatten()[0]) for w, _ in weights.convolutions.values()]
    assert positions == [0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28]
    assert [len(head) for head in weights.heads] == [64, 128, 256, 512, 512]
    # the mean of LPIPS's published heads, version 0.1, first block
    assert float(weights.heads[0].mean()) > 0


def test_another_vgg_is_not_called_lpips(vgg_file):
    with pytest.raises(ConfigError, match=r"perceptual\.vgg_path.*not the published file.*397923af"):
        load_perceptual("lpips", vgg_file)


def test_what_is_missing_is_named(tmp_path):
    with pytest.raises(
        ConfigError, match=r"perceptual\.vgg_path.*https://download\.pytorch\.org/models/vgg16-397923af"
    ):
        load_perceptual("lpips")
    with pytest.raises(ConfigError, match="no such file"):
        load_perceptual("lpips", tmp_path / "absent.pth")
    with pytest.raises(ConfigError, match="stlpips or lpips"):
        load_perceptual("vgg")


def test_a_missing_package_is_named_with_its_cure(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"pip install .*stlpips_pytorch==0\.0\.2"):
        load_perceptual("stlpips")


def test_other_networks_and_broken_files_are_refused(tmp_path, vgg_file):
    state = torch.load(vgg_file, weights_only=True)
    del state["features.28.bias"]
    lacking = tmp_path / "lacking.pth"
    torch.save(state, lacking)
    with pytest.raises(ConfigError, match=r"features\.28\.bias is missing"):
        load_lpips(lacking, vgg_sha256=sha256(lacking))
    state["features.28.bias"] = torch.zeros(3)
    torch.save(state, lacking)
    with pytest.raises(ConfigError, match=r"features\.28\.bias is of shape \[3\], expected \[512\]"):
        load_lpips(lacking, vgg_sha256=sha256(lacking))
    cut = tmp_path / "cut.pth"
    cut.write_bytes(vgg_file.read_bytes()[:5000])
    with pytest.raises(ConfigError, match="cannot be loaded"):
        load_lpips(cut, vgg_sha256=sha256(cut))
    listing = tmp_path / "list.pth"
    torch.save([1, 2], listing)
    with pytest.raises(ConfigError, match="no table of weights"):
        load_lpips(listing, vgg_sha256=sha256(listing))


def test_a_file_that_would_run_code_is_refused(tmp_path):
    class Payload:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "ran",))

    bad = tmp_path / "bad.pth"
    torch.save({"features.0.weight": Payload()}, bad)
    with pytest.raises(ConfigError, match="cannot be loaded"):
        load_lpips(bad, vgg_sha256=sha256(bad))
    assert not (tmp_path / "ran").exists()
