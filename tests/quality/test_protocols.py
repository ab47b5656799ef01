"""Evaluation presets, the un-normalised perceptual call, and the tables by camera and frame."""

import csv
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir

from occfusion.errors import ConfigError
from occfusion.evaluation.evaluate import ImageRow, write_grouped_csv
from occfusion.perceptual import load_perceptual
from occfusion.run.evaluation import evaluation_metric
from occfusion.settings.schema import EvaluationSettings, Settings, load_settings

CONF = Path(__file__).parents[2] / "conf"


def settings(*overrides: str) -> Settings:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return load_settings(compose("config", ["variant=A", *overrides]))


def test_presets_differ_from_the_default_as_they_say() -> None:
    default = vars(settings().evaluation)
    changed = {
        name: {k: v for k, v in vars(settings(f"evaluation={name}").evaluation).items() if v != default[k]}
        for name in ("paper", "gauhuman", "occnerf", "ocmotion")
    }
    assert changed == {
        "paper": {"perceptual_every": 1},
        "gauhuman": {"training_views": False, "perceptual_every": 1, "perceptual_inputs": "unit"},
        "occnerf": {"training_stride": 1, "perceptual_every": 1},
        "ocmotion": {"held_out": False, "training_stride": 1, "perceptual_every": 1, "curve": False},
    }
    assert settings("evaluation=paper", "evaluation.perceptual_every=3").evaluation.perceptual_every == 3


def test_unknown_inputs_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"perceptual_inputs.*centred or unit"):
        settings("evaluation.perceptual_inputs=raw")


def test_unit_inputs_have_a_name_and_values_of_their_own() -> None:
    metric = load_perceptual("stlpips")
    unit = evaluation_metric(EvaluationSettings(perceptual_inputs="unit"), metric)
    assert unit is not None and unit.name == "ST-LPIPS (VGG, inputs 0..1)" and metric.name == "ST-LPIPS (VGG)"
    assert unit.network is metric.network
    assert evaluation_metric(EvaluationSettings(), metric) is metric
    assert evaluation_metric(EvaluationSettings(perceptual=False), metric) is None
    generator = torch.Generator().manual_seed(1)
    a, b = torch.rand(2, 40, 40, 3, generator=generator)
    other = load_perceptual("stlpips", centred=False)
    assert float(unit(a, b)) == float(other(a, b)) != float(metric(a, b))
    assert other.name == unit.name and unit.with_unit_inputs() is unit


def test_means_by_camera_and_by_frame(tmp_path: Path) -> None:
    rows = [
        ImageRow(0, 1, "full", 9, psnr=20.0, ssim=0.5, lpips=0.1, mask_iou=1.0, depth_error_mm=10.0),
        ImageRow(5, 1, "full", 9, psnr=30.0, ssim=0.7, lpips=None, mask_iou=0.5, depth_error_mm=20.0),
        ImageRow(0, 2, "full", 9, psnr=40.0, ssim=0.9, lpips=None, mask_iou=None),
        ImageRow(0, 0, "hidden"),
    ]
    write_grouped_csv(tmp_path / "c.csv", rows, "camera")
    write_grouped_csv(tmp_path / "f.csv", rows, "frame")
    with (tmp_path / "c.csv").open() as file:
        assert list(csv.reader(file)) == [
            [
                "camera",
                "region",
                "images",
                "lpips_images",
                "depth_images",
                "psnr",
                "ssim",
                "lpips",
                "mask_iou",
                "depth_error_mm",
                "spill",
                "holes",
            ],
            ["1", "full", "2", "1", "2", "25", "0.6", "0.1", "0.75", "15", "", ""],
            ["2", "full", "1", "0", "0", "40", "0.9", "", "", "", "", ""],
        ]
    with (tmp_path / "f.csv").open() as file:
        assert [row[:6] for row in csv.reader(file)][1:] == [
            ["0", "full", "2", "1", "1", "30"],
            ["5", "full", "1", "0", "1", "30"],
        ]
