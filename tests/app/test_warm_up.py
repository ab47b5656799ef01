"""The training clock counts training: compiled code is made ready before it starts."""

import gc
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numba
import pytest
import torch
from numba.core import event

from occfusion.human.kernels import compile_kernels, compile_meanwhile
from occfusion.human.rendering import Renderer
from occfusion.perceptual import load_perceptual, surround
from occfusion.perceptual.kernels import finish_tiles, pool_places, sum_distances, transform_tiles
from occfusion.splat.backends.numba import ahead
from occfusion.stages import clock

Train = Callable[..., tuple[Path, dict[str, Any]]]
ROOT = Path(__file__).parents[2]
FIGURE_KERNELS: list[Any] = [transform_tiles, finish_tiles, pool_places, sum_distances]
CASE = """
import sys
from hydra import compose, initialize_config_dir
from numba.core.registry import CPUDispatcher
from occfusion.run import app
from occfusion.stages.optim import OptimStage

def compiled():
    modules = [m for name, m in list(sys.modules.items()) if name.startswith("occfusion.")]
    kernels = {id(v): v for m in modules for v in vars(m).values() if isinstance(v, CPUDispatcher)}
    options = {k: k.targetoptions for k in kernels.values()}
    parts = [k for k, o in options.items() if o.get("forceinline") or o.get("inline") == "always"]  # of kernels
    return {f"{k.__module__}.{k.__name__}": list(k.signatures) for k in options if k not in parts}

at_start = {}
original = OptimStage.on_train_start

def start(self):
    at_start.update(compiled())
    original(self)

OptimStage.on_train_start = start
with initialize_config_dir(sys.argv[1], version_base="1.3"):
    app.run(compose("config", sys.argv[2:]), folder_chosen_by_user=True)
# Those that figures and embedded scenes alone need are compiled for these: no training waits for them.
assert len(at_start) >= 20, at_start
others = ("occfusion.perceptual.kernels", "occfusion.synth")
# Training has these in float32, and what looks at videos in float64.
either = ("occfusion.geometry.rotation_kernels.fill_rotations", "occfusion.geometry.skinning_kernels.fill_bones")
expected = {k: 0 if k.startswith(others) else 1 + (k in either) for k in at_start}
assert {k: len(s) for k, s in at_start.items()} == expected, at_start
late = [k for k, s in compiled().items() if s != at_start.get(k) and not k.startswith(others)]
assert late == [], late
"""


@pytest.mark.parametrize("variant", ["A", pytest.param("D", marks=pytest.mark.slow)])
def test_training_compiles_nothing(scene_root: Path, tmp_path: Path, variant: str) -> None:
    """In a process of its own, for this one has compiled everything long ago."""
    overrides = [
        f"variant={variant}", "optim.steps=3", "optim.densify=true", "optim.sh_every=1", "dataset=zju", "body=anny",
        f"dataset.root={scene_root}", "dataset.scene=001-clean", f"body.path={scene_root}/001-clean/body.npz",
        f"output_dir={tmp_path / 'run'}", "evaluation.perceptual=false",
        "dataset.test_cameras=[1]", "evaluation.pictures=false", "evaluation.curve=false", "rasterizer=numba",
    ]  # fmt: skip
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", CASE, str(ROOT / "conf"), *overrides], cwd=tmp_path, env=environment,
        capture_output=True, text=True, timeout=280, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "optim: rasteriser numba ready after " in done.stdout


def test_a_second_process_compiles_while_the_data_are_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    """Once, where nothing is cached; it starts none itself, and whoever trains waits for it."""

    class Started:
        def __init__(self, command: list[str], env: dict[str, str], **_: Any) -> None:
            self.program, self.environment, self.waited = command[2], env, 0
            started.append(self)

        def wait(self) -> None:
            self.waited += 1

    started: list[Started] = []
    cold = SimpleNamespace(signatures=[])
    monkeypatch.setattr(ahead, "project_backward_part", cold)
    monkeypatch.setattr(ahead, "is_cached", lambda kernel: kernel is not cold)
    monkeypatch.setattr(ahead, "usable_cores", lambda: 2)
    monkeypatch.setattr(ahead.subprocess, "Popen", Started)
    compile_meanwhile(Renderer("torch"))
    assert not started
    renderer = Renderer("numba")
    compile_meanwhile(renderer)
    compile_meanwhile(renderer)
    (helper,) = started
    assert "compile_kernels" in helper.program and "surround.warm_up" in helper.program and not helper.waited
    compile_kernels(renderer)
    assert helper.waited == 1
    count = len(started)  # this pretends that it has left nothing
    with monkeypatch.context() as within:
        within.setattr(os, "environ", helper.environment)
        compile_meanwhile(renderer)
    assert len(started) == count


def test_the_clock_stands_still_until_the_kernels_are_ready(
    train: Train, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def slowly(renderer: Renderer) -> float:
        passed.append(1000.0)
        time.sleep(0.1)  # what takes longer than 0.05 s is told
        return warm_up(renderer)

    passed, now, warm_up = [0.0], clock.synchronised_time, Renderer.warm_up
    monkeypatch.setattr(clock, "synchronised_time", lambda: now() + sum(passed))
    monkeypatch.setattr(Renderer, "warm_up", slowly)
    _, metrics = train("optim.steps=2")
    assert len(passed) == 2 and 0 < metrics["train_seconds"]["optim"] < 1000
    assert "before the training clock" in capsys.readouterr().out


def test_figures_take_the_kernels_that_the_second_process_compiles() -> None:
    """Of the same types: another would be compiled in the first seconds of a training."""
    before = [len(kernel.signatures) for kernel in FIGURE_KERNELS]
    surround.warm_up()
    known = [list(kernel.signatures) for kernel in FIGURE_KERNELS]
    assert all(known) and before <= [len(signatures) for signatures in known]
    pictures = torch.zeros(2, 40, 50, 3)
    pictures[:, 10:30, 10:20] = torch.rand(2, 20, 10, 3, generator=torch.Generator().manual_seed(0))
    assert load_perceptual("stlpips").over_black(*pictures) > 0
    assert [list(kernel.signatures) for kernel in FIGURE_KERNELS] == known


def test_nothing_is_collected_while_a_kernel_compiles() -> None:
    seen: list[bool] = []

    class Watch(event.Listener):
        def on_start(self, _: event.Event) -> None:
            seen.append(gc.isenabled())

        def on_end(self, _: event.Event) -> None:
            pass

    with event.install_listener("numba:compile", Watch()):  # called behind the one that pauses the collector
        assert numba.njit(_twice)(2) == 4
    assert seen and not any(seen) and gc.isenabled()
    gc.disable()
    try:
        numba.njit(_twice)(2.0)
        assert not gc.isenabled()  # nor turned on where it was off
    finally:
        gc.enable()


def _twice(x: Any) -> Any:
    return 2 * x


@pytest.mark.parametrize("backend", ["torch", "numba"])
def test_warming_up_leaves_random_numbers_and_modes_alone(backend: str) -> None:
    before = torch.get_rng_state()
    with torch.inference_mode():
        assert Renderer(backend).warm_up() > 0
    assert torch.equal(before, torch.get_rng_state())
