"""Inpainting and segmenting with tiny random models; what is missing is said at the start."""

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from made_up_person import made_up_observation
from occfusion.errors import NumericsError
from occfusion.priors.masks import checked_probability
from occfusion.priors.sd15.mask_prior import Sd15MaskPrior, prompts
from occfusion.priors.sd15.pipeline import frame_seed
from occfusion.priors.sd15.settings import Sd15Settings

FAST: dict[str, Any] = {"resolution": 64, "steps": 2}
FRAME = made_up_observation()


@pytest.fixture(scope="module")
def prior(tiny_models: dict[str, str]) -> Sd15MaskPrior:
    return Sd15MaskPrior(Sd15Settings(**tiny_models, **FAST))


def test_mask_is_a_probability_inside_the_region(prior: Sd15MaskPrior) -> None:
    answer = prior.probability(FRAME)
    assert answer.shape == (96, 96) and answer.dtype == np.float32
    assert np.isfinite(answer).all() and answer.min() >= 0.0 and answer.max() <= 1.0
    assert answer.std() > 0.01
    region = prior.region(FRAME)
    assert region is not None
    outside = np.ones((96, 96), bool)
    outside[region.y : region.y + region.height, region.x : region.x + region.width] = False
    assert outside.any() and not answer[outside].any()
    checked = checked_probability(prior, FRAME)
    assert (checked[FRAME.visible] == 1).all() and (checked[FRAME.background] == 0).all()


def test_same_frame_same_mask_other_name_other_noise(
    tiny_models: dict[str, str], prior: Sd15MaskPrior
) -> None:
    first = prior.probability(FRAME)
    again = Sd15MaskPrior(Sd15Settings(**tiny_models, **FAST)).probability(FRAME)
    np.testing.assert_array_equal(first, again)
    assert (prior.probability(dataclasses.replace(FRAME, name="frame 000004")) != first).any()
    assert frame_seed(0, "frame 000003") == 34494935572726925 != frame_seed(1, "frame 000003")


def test_canvas_and_picture_reach_the_models(prior: Sd15MaskPrior, monkeypatch: pytest.MonkeyPatch) -> None:
    region = prior.region(FRAME)
    assert region is not None
    seen = prior.keypoints(FRAME, region)
    given: dict[str, Any] = {}
    original = prior.pipeline

    def watched(**arguments: Any) -> Any:
        given.update(arguments)
        return original(**arguments)

    monkeypatch.setattr(prior, "pipeline", watched)
    filled = prior.inpaint(FRAME, region, seen)
    assert filled.shape == (region.work_height, region.work_width, 3)
    image, mask, canvas = (given[name][0].numpy() for name in ("image", "mask_image", "control_image"))
    known = mask[0] == 0.0
    assert np.unique(mask).tolist() == [0.0, 1.0]
    assert known.mean() == pytest.approx(
        FRAME.visible.mean() * 96**2 / (region.width * region.height), rel=0.1
    )
    core = known & np.roll(known, 2, 1) & np.roll(known, -2, 1) & np.roll(known, 2, 0) & np.roll(known, -2, 0)
    np.testing.assert_allclose(image[:, core].T, np.tile((0.9, 0.2, 0.1), (core.sum(), 1)), atol=1e-6)
    assert (image[:, :4] == 1.0).all()
    assert canvas.max() == 1.0 and not canvas[:, :, 0].any()
    assert given["num_inference_steps"] == 2 and given["controlnet_conditioning_scale"] == 1.0
    fewer = dataclasses.replace(seen, shown=seen.shown & (np.arange(18) < 8))
    assert (prior.inpaint(FRAME, region, fewer) != filled).any()


def test_only_shown_joints_inside_prompt_the_segmenter(prior: Sd15MaskPrior) -> None:
    region = prior.region(FRAME)
    assert region is not None
    seen = prior.keypoints(FRAME, region)
    assert len(prompts(seen, region)) == 18
    hidden = dataclasses.replace(seen, shown=np.arange(18) != 4)
    np.testing.assert_array_equal(prompts(hidden, region), np.delete(seen.pixels, 4, axis=0) - 0.5)
    outside = seen.pixels.copy()
    outside[[0, 1]] = (-1.0, 5.0), (5.0, region.work_height)
    assert len(prompts(dataclasses.replace(seen, pixels=outside), region)) == 16


def test_mask_of_the_highest_predicted_iou_is_taken(
    prior: Sd15MaskPrior, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Output:
        pred_masks = torch.stack([torch.full((16, 16), v) for v in (-4.0, 4.0, 0.0)])[None, None]
        iou_scores = torch.tensor([[[0.3, 0.9, 0.8]]])

    monkeypatch.setattr(prior, "segmenter", lambda **_: Output)
    picture, points = np.zeros((64, 48, 3), np.float32), np.array([[3.0, 4.0]])
    mask = prior.segment(picture, points)
    assert mask.shape == (64, 48)
    np.testing.assert_allclose(mask, torch.sigmoid(torch.tensor(4.0)).item(), rtol=1e-6)
    Output.iou_scores = torch.tensor([[[0.3, np.nan, 0.8]]])
    assert np.isnan(prior.segment(picture, points)).all()


def test_body_or_joints_outside_the_picture_add_nothing(prior: Sd15MaskPrior) -> None:
    beside = FRAME.vertices + np.array([50.0, 0.0, 0.0])
    assert not prior.probability(dataclasses.replace(FRAME, vertices=beside)).any()
    unseen = FRAME.keypoints + np.array([0.0, 0.0, 5.0])
    assert not prior.probability(dataclasses.replace(FRAME, keypoints=unseen)).any()


@pytest.mark.parametrize("part", ["unet", "segmenter"])
def test_not_finite_is_named_not_hidden(tiny_models: dict[str, str], part: str) -> None:
    prior = Sd15MaskPrior(Sd15Settings(**tiny_models, **FAST))
    network = prior.pipeline.unet if part == "unet" else prior.segmenter
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.fill_(torch.nan)
    assert np.isnan(prior.probability(FRAME)).any()
    with pytest.raises(
        NumericsError, match=r"prior sd15, frame frame 000003: .* not\s+finite.*dtype=float32"
    ):
        checked_probability(prior, FRAME)


def test_memory_options_leave_the_mask_as_it_is(tiny_models: dict[str, str], prior: Sd15MaskPrior) -> None:
    lean = Sd15Settings(**tiny_models, **FAST, attention_slicing=True, vae_slicing=True, dtype="float32")
    frugal = Sd15MaskPrior(lean)
    np.testing.assert_allclose(frugal.probability(FRAME), prior.probability(FRAME), atol=1e-4)
    assert frugal.describe() == prior.describe()


def test_half_precision_and_other_samplers_run(tiny_models: dict[str, str]) -> None:
    options = {"dtype": "bfloat16", "sampler": "unipc", "guidance": 1.0}
    assert np.isfinite(Sd15MaskPrior(Sd15Settings(**tiny_models, **FAST, **options)).probability(FRAME)).all()


def test_description_names_what_decides_the_masks(
    tiny_models: dict[str, str], prior: Sd15MaskPrior, tmp_path: Path
) -> None:
    described = prior.describe()
    assert (
        described["steps"] == 2 and described["dtype"] == "float32" and "plain clothes" in described["prompt"]
    )
    assert not any(str(value).startswith("/") for value in described.values())
    moved = {key: str(shutil.copytree(folder, tmp_path / key)) for key, folder in tiny_models.items()}
    assert Sd15MaskPrior(Sd15Settings(**moved, **FAST)).describe() == described
    config = Path(moved["inpainting"]) / "scheduler" / "scheduler_config.json"
    config.write_text(config.read_text().replace("0.012", "0.013"))
    changed = Sd15MaskPrior(Sd15Settings(**moved, **FAST)).describe()
    assert {key for key in changed if changed[key] != described[key]} == {"inpainting_hash"}
