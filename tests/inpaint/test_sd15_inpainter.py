"""In-context inpainting with tiny random models: what reaches them, what comes back, and what is said when."""

import dataclasses
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from made_up_partial import made_up_partial, only_region, painted_like
from occfusion.errors import NumericsError
from occfusion.inpaint import sd15_inpainter as sd15
from occfusion.inpaint.partial import checked_picture
from occfusion.inpaint.sd15_inpainter import Sd15Inpainter, Sd15InpaintSettings
from occfusion.inpaint.side_by_side import right_half
from occfusion.priors.sd15.pipeline import frame_seed
from occfusion.priors.sd15.settings import Sd15Settings
from tiny_sd15 import write_tiny_painter

FAST: dict[str, Any] = {"resolution": 64, "steps": 2}
PARTIAL = made_up_partial()


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    return write_tiny_painter(tmp_path_factory.mktemp("models"))


def make(models: dict[str, str], shared: dict[str, Any] | None = None, **own: Any) -> Sd15Inpainter:
    return Sd15Inpainter(Sd15InpaintSettings(**{**FAST, **own}), Sd15Settings(**models, **(shared or {})))


@pytest.fixture(scope="module")
def inpainter(models: dict[str, str]) -> Sd15Inpainter:
    return make(models)


Watch = Callable[[Sd15Inpainter], dict[str, Any]]


@pytest.fixture
def watch(monkeypatch: pytest.MonkeyPatch) -> Watch:
    """Notes what an inpainter asks its pipeline for; the answer is that of the pipeline."""

    def start(inpainter: Sd15Inpainter) -> dict[str, Any]:
        given: dict[str, Any] = {}
        original = inpainter.pipeline

        def watched(**arguments: Any) -> Any:
            given.update(arguments, calls=given.get("calls", 0) + 1)
            return original(**arguments)

        monkeypatch.setattr(inpainter, "pipeline", watched)
        return given

    return start


def test_only_the_region_is_painted(inpainter: Sd15Inpainter) -> None:
    picture = inpainter.inpaint(PARTIAL)
    assert picture.shape == (96, 96, 3) and picture.dtype == np.float32
    assert np.isfinite(picture).all() and picture.min() >= 0.0 and picture.max() <= 1.0
    checked = checked_picture(inpainter, PARTIAL)
    visible = PARTIAL.observation.visible
    untouched = np.where(visible[..., None], PARTIAL.observation.rgb, 0.0)
    assert PARTIAL.region.any()
    differs = (checked != untouched).any(axis=-1)
    assert differs[PARTIAL.region].mean() > 0.9 and not differs[~PARTIAL.region].any()
    assert checked[PARTIAL.region].std() > 0.01


def test_the_pipeline_is_asked_for_what_the_settings_say(inpainter: Sd15Inpainter, watch: Watch) -> None:
    given = watch(inpainter)
    inpainter.inpaint(PARTIAL)
    region = inpainter.region(PARTIAL.observation)
    assert region is not None
    height, width = region.work_height, region.work_width
    assert max(height, 2 * width) == 64
    assert given["prompt"] == "the same person standing in two different rooms"
    assert given["negative_prompt"] == Sd15Settings().negative_prompt
    assert given["controlnet_conditioning_scale"] == 0.3 and given["guess_mode"] is True
    assert (given["num_inference_steps"], given["guidance_scale"], given["output_type"]) == (2, 7.5, "np")
    assert (given["height"], given["width"]) == (height, 2 * width)
    assert given["generator"].initial_seed() == frame_seed(0, "frame 000003")
    assert given["image"].shape == given["control_image"].shape == (1, 3, height, 2 * width)
    assert given["mask_image"].shape == (1, 1, height, 2 * width)
    mask, canvas = given["mask_image"][0, 0], given["control_image"][0]
    assert mask.unique().tolist() == [0.0, 1.0] and not mask[:, :width].any()
    torch.testing.assert_close(canvas[..., :width], canvas[..., width:])
    assert canvas.max() == 1.0
    left, right = given["image"][0, :, :, :width], given["image"][0, :, :, width:]
    assert left[2].min() > right[2].min() and right[0].min() > left[0].min()  # blue left, red right


def test_own_prompts_seed_and_margin(models: dict[str, str], watch: Watch) -> None:
    own = {
        "negative_prompt": "low",
        "prompt": "lo",
        "control_scale": 0.5,
        "guess_mode": False,
        "guidance": 1.0,
    }
    other = make(models, {"seed": 3, "margin": 2, "negative_prompt": "not this"}, **own)
    given = watch(other)
    assert np.isfinite(other.inpaint(PARTIAL)).all()
    assert (given["negative_prompt"], given["prompt"], given["guess_mode"]) == ("low", "lo", False)
    assert given["generator"].initial_seed() == frame_seed(3, "frame 000003")
    narrow, wide = other.region(PARTIAL.observation), make(models).region(PARTIAL.observation)
    assert narrow is not None and wide is not None and narrow.width < wide.width
    assert make(models, {"negative_prompt": "not this"}).negative_prompt == "not this"


def test_the_right_half_of_the_answer_is_cut_back(
    inpainter: Sd15Inpainter, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = dataclasses.replace(inpainter.settings, resolution=0)
    exact = Sd15Inpainter(own, inpainter.shared)
    region = exact.region(PARTIAL.observation)
    assert region is not None
    answer = painted_like(0, region.height, 2 * region.width)
    monkeypatch.setattr(exact, "pipeline", lambda **_: SimpleNamespace(images=[answer]), raising=False)
    picture = exact.inpaint(PARTIAL)
    rows, columns = np.nonzero(PARTIAL.region & (PARTIAL.alpha == 1.0))
    expected = right_half(answer)[rows - region.y, columns - region.x]
    np.testing.assert_allclose(picture[rows, columns], expected, atol=1e-6)


def test_same_frame_same_picture_other_name_other_noise(
    models: dict[str, str], inpainter: Sd15Inpainter
) -> None:
    first = inpainter.inpaint(PARTIAL)
    np.testing.assert_array_equal(inpainter.inpaint(PARTIAL), first)
    np.testing.assert_array_equal(make(models).inpaint(PARTIAL), first)
    assert (inpainter.inpaint(made_up_partial(name="frame 000004")) != first).any()


def test_context_and_skeleton_matter(inpainter: Sd15Inpainter) -> None:
    first = inpainter.inpaint(PARTIAL)
    green = PARTIAL.coarse[..., [0, 2, 1]]
    assert (inpainter.inpaint(dataclasses.replace(PARTIAL, coarse=green)) != first)[PARTIAL.region].any()
    observation = PARTIAL.observation
    moved = dataclasses.replace(observation, keypoints=observation.keypoints + np.array([0.2, 0.1, 0.0]))
    assert (inpainter.inpaint(dataclasses.replace(PARTIAL, observation=moved)) != first).any()


def test_frames_without_a_region_load_nothing(
    models: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("loaded")

    monkeypatch.setattr(sd15, "make_pipeline", refuse)
    idle = make(models)
    assert idle.describe()["inpainting_hash"]
    whole = only_region(PARTIAL, PARTIAL.observation.visible)
    visible = PARTIAL.observation.visible
    np.testing.assert_array_equal(idle.inpaint(whole)[visible], PARTIAL.observation.rgb[visible])
    observation = PARTIAL.observation
    beside = dataclasses.replace(observation, vertices=observation.vertices + np.array([50.0, 0.0, 0.0]))
    away = idle.inpaint(dataclasses.replace(PARTIAL, observation=beside))
    np.testing.assert_array_equal(away[PARTIAL.region], PARTIAL.coarse[PARTIAL.region])
    with pytest.raises(AssertionError, match="loaded"):
        idle.inpaint(PARTIAL)


@pytest.mark.parametrize("part", ["unet", "vae"])
def test_not_finite_is_named_not_hidden(models: dict[str, str], part: str) -> None:
    broken = make(models)
    with torch.no_grad():
        for parameter in getattr(broken.pipeline, part).parameters():
            parameter.fill_(torch.nan)
    np.testing.assert_array_equal(np.isnan(broken.inpaint(PARTIAL)).all(axis=-1), PARTIAL.region)
    with pytest.raises(
        NumericsError, match=r"inpainter sd15, frame frame 000003: .*not finite.*dtype=float32"
    ):
        checked_picture(broken, PARTIAL)


def test_half_precision_memory_options_and_samplers_run(
    models: dict[str, str], inpainter: Sd15Inpainter
) -> None:
    lean = make(models, {"attention_slicing": True, "vae_slicing": True, "dtype": "float32"})
    np.testing.assert_allclose(lean.inpaint(PARTIAL), inpainter.inpaint(PARTIAL), atol=1e-4)
    assert lean.describe() == inpainter.describe()
    half = make(models, {"dtype": "bfloat16"}, sampler="dpmsolver++")
    assert type(half.pipeline.scheduler).__name__ == "DPMSolverMultistepScheduler"
    assert type(inpainter.pipeline.scheduler).__name__ == "UniPCMultistepScheduler"
    assert np.isfinite(half.inpaint(PARTIAL)).all()


def test_description_names_what_decides_the_pictures(
    models: dict[str, str], inpainter: Sd15Inpainter, tmp_path: Path
) -> None:
    described = inpainter.describe()
    assert described["inpainter"] == "sd15" and described["dtype"] == "float32"
    assert {*asdict(Sd15InpaintSettings()), "margin", "self_occlusion", "seed"} <= set(described)
    assert described["negative_prompt"] == Sd15Settings().negative_prompt
    assert not any(str(value).startswith("/") for value in described.values())
    moved = {key: str(shutil.copytree(folder, tmp_path / key)) for key, folder in models.items()}
    assert make(moved).describe() == described
    config = Path(moved["controlnet"]) / "config.json"
    config.write_text(config.read_text() + "\n")
    changed = make(moved).describe()
    assert {key for key in changed if changed[key] != described[key]} == {"controlnet_hash"}
    for shared in ({"seed": 1}, {"margin": 4}, {"self_occlusion": 0.1}, {"negative_prompt": "low"}):
        assert make(models, shared).describe() != described
    assert make(models, {"steps": 3, "prompt": "low", "resolution": 8}).describe() == described


def test_nothing_of_it_is_imported_unless_a_frame_is_painted() -> None:
    code = (
        "import sys, occfusion.inpaint.build_inpainter, occfusion.inpaint.sd15_inpainter\n"
        "print([m for m in ('diffusers', 'transformers', 'huggingface_hub', 'accelerate') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "[]", done.stderr
