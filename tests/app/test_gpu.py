"""Runs on a CUDA device; left out where none is named. Kernels of gsplat are compiled where it is installed.

CUDA_VISIBLE_DEVICES=0 python -m pytest tests/app/test_gpu.py
"""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning as L
import pytest
import torch

from app.conftest import UNMEASURED
from occfusion.human.rendering import Renderer
from occfusion.motion.performance import perform
from occfusion.run.loaded import load_run
from occfusion.show.views import TRAIN
from occfusion.splat.backends import registry
from occfusion.stages.interruption import Interrupted, SignalGuard

pytestmark = [
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device is named"),
    pytest.mark.slow,
    pytest.mark.timeout(600),
]

Train = Callable[..., tuple[Path, dict[str, Any]]]
WHOLE = (
    "variant=E", "optim.steps=100", "refine.steps=100", "optim.lambda_lpips=0.1", "refine.lambda_lpips=0.1",
    "evaluation.perceptual=true", "optim.align_poses=true", "evaluation.turntable=4",
)  # fmt: skip


@pytest.mark.parametrize("backend", ["torch", "auto"])
def test_the_whole_method_ends_as_on_the_cpu(
    train: Train, backend: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Pictures and gradients differ by rounding, and so does what comes of a hundred steps of each stage.

    What is recorded of a step is held against its function on the way, and nothing is found to differ.
    """
    _, here = train(*WHOLE, "trainer.accelerator=cpu", folder="cpu")
    folder, there = train(*WHOLE, "trainer.accelerator=gpu", f"rasterizer={backend}", folder="gpu")
    ours, theirs = here["regions"]["full"], there["regions"]["full"]
    assert theirs["psnr"] == pytest.approx(ours["psnr"], abs=0.4)
    assert theirs["lpips"] == pytest.approx(ours["lpips"], rel=0.1)
    assert theirs["mask_iou"] == pytest.approx(ours["mask_iou"], abs=0.01)
    assert (folder / "report.md").is_file()
    assert "CUDA graph" not in caplog.text


@pytest.mark.parametrize("variant", ["D", "E"])
def test_the_papers_recipe_runs_with_all_of_its_networks(train: Train, variant: str) -> None:
    """Score distillation, inpainting, and densification by clones and splits."""
    rounds = "{after_step: 5, every: 10, before_step: 35}"
    _, figures = train(
        f"variant={variant}", "recipe=paper", "plan=full", "optim.steps=40", "refine.steps=30",
        "trainer.accelerator=gpu", "optim.densify=true", f"optim.densification={rounds}",
    )  # fmt: skip
    assert figures["regions"]["full"]["psnr"] > 15.0


def test_a_stopped_run_goes_on(train: Train, monkeypatch: pytest.MonkeyPatch) -> None:
    """From its checkpoint, whose tensors come back to the device."""
    wanted = ("optim.steps=30", "stage=optim", "trainer.accelerator=gpu")
    usual = SignalGuard.on_train_batch_end

    def stop_after_ten(self: SignalGuard, trainer: L.Trainer, *rest: Any) -> None:
        if trainer.global_step == 10:
            signal.raise_signal(signal.SIGTERM)
        usual(self, trainer, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(SignalGuard, "on_train_batch_end", stop_after_ten)
        with pytest.raises(Interrupted):
            train(*wanted)
    _, figures = train(*wanted)
    assert figures["regions"]["full"]["images"] > 0


def test_an_avatar_is_drawn_alike_on_both(train: Train) -> None:
    """The best backend of either device; float32 differs by rounding, and by what it does to the ends of splats."""
    folder, _ = train("optim.steps=30", "stage=optim", "trainer.accelerator=gpu", *UNMEASURED)
    run = load_run(folder)
    pose = perform(run.clip, run.avatar.body, run.betas).pose(0)
    camera, shown = run.views(TRAIN)[0].camera, list[torch.Tensor]()
    for device in ("cpu", "cuda"):
        avatar = run.avatar.to(device)
        with torch.inference_mode():
            cloud = avatar(pose.to(device), camera.to(device).centre)
            shown.append(Renderer("auto", device).draw(cloud, camera).rgb.cpu())
    assert (shown[0] - shown[1]).abs().max() < 0.02
    assert (shown[0] - shown[1]).abs().mean() < 1e-4


def test_the_best_backend_is_the_fast_one() -> None:
    """gsplat where it is installed: then its self-test has passed on this device."""
    name, reason = registry._choose("cuda", torch.float32)
    installed = "not installed" not in reason
    assert name == ("gsplat" if installed else "torch"), reason
