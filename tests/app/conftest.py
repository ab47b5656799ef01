"""A tiny embedded scene on disk and a way to run the application on it as `train.py` would."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_dir

from occfusion.run import app
from occfusion.synth import SceneSpec, write_scene

CONF = Path(__file__).parents[2] / "conf"
SCENE = "001-clean"


@pytest.fixture(scope="session")
def scene_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("scenes")
    spec = SceneSpec.parse(SCENE)
    write_scene(
        root, type(spec)(**{**vars(spec), "image_size": 96, "frames": 10, "cameras": 3}), progress=False
    )
    return root


@pytest.fixture
def train(scene_root: Path, tmp_path: Path) -> Callable[..., tuple[Path, dict[str, Any]]]:
    def run(*overrides: str, folder: str = "run", chosen: bool = True) -> tuple[Path, dict[str, Any]]:
        return run_tiny(scene_root, tmp_path / folder, *overrides, chosen=chosen)

    return run


UNMEASURED = ("evaluation.held_out=false", "evaluation.training_views=false", "evaluation.pictures=false")
"""Of tests that look at parameters alone."""


@pytest.fixture(scope="session")
def short_run(scene_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of a few steps, for tests that only look at its avatar."""
    without = ["evaluation.curve=false", "evaluation.pictures=false", "evaluation.training_views=false"]
    return run_tiny(
        scene_root, tmp_path_factory.mktemp("short") / "run", "stage=optim", "optim.steps=12", *without
    )[0]


def run_tiny(
    scene_root: Path, folder: Path, *overrides: str, chosen: bool = True
) -> tuple[Path, dict[str, Any]]:
    fixed = [
        "variant=A", "dataset=zju", f"dataset.root={scene_root}", f"dataset.scene={SCENE}",
        f"body.path={scene_root / SCENE / 'body.npz'}", f"output_dir={folder}",
        "trainer.enable_progress_bar=false", "optim.lambda_lpips=0", "refine.lambda_lpips=0",
        "evaluation.perceptual=false", "evaluation.turntable=0",
        # two thirds of a tiny run's time; tests of their own have them, and whole runs in `test_quality.py`
        "optim.align_poses=false", "optim.unseen_colors=nearest", "evaluation.curve_images=1",
        "evaluation.training_stride=9", "dataset.test_frames=[0,10,9]",
    ]  # fmt: skip
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", [*fixed, *overrides])
    return folder, app.run(config, folder_chosen_by_user=chosen)
