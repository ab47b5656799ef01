"""Poses of an import are moved until the colours of all frames agree; those of few frames are not."""

from __future__ import annotations

import json
import signal
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from scipy.spatial.transform import Rotation

from occfusion.cli.mending import mended_by_colour
from occfusion.data.module import HumanDataModule
from occfusion.errors import DataError
from occfusion.fitting.pipeline import Fit
from occfusion.fitting.quality import landmarks_of, measure, posed
from occfusion.fitting.solver import Solution
from occfusion.footage.clip import Shot
from occfusion.footage.landmarks import KeyPoints
from occfusion.human import Body, load_body
from occfusion.human.pose_spline import PoseSpline
from occfusion.importing.folder import training_overrides, write_folder
from occfusion.run.prepare import make_body, make_data
from occfusion.settings.schema import Settings, load_settings
from occfusion.stages.interruption import Interrupted
from occfusion.synth import SceneSpec, write_scene
from occfusion.synth.motion import smooth_noise

CONF = Path(__file__).parents[2] / "conf"
SPEC = SceneSpec(subject=4, level="clean", image_size=144, frames=24, cameras=2)
LIMBS = [1, 2, 4, 5, 16, 17, 18, 19]


def in_camera(body: Body, data: HumanDataModule) -> Solution:
    """Returns the true bodies with the first camera's axes for the world's."""
    camera, poses = data.camera(0), [data.pose(frame) for frame in range(SPEC.frames)]
    view = camera.viewmat.double().numpy()
    still = torch.zeros(3)
    pelvis = body(poses[0].betas, still, torch.zeros(69), still)[1][0].double().numpy()
    orient, turns, places = (
        torch.stack([getattr(pose, name) for pose in poses]).double().numpy()
        for name in ("global_orient", "body_pose", "transl")
    )
    orient = (Rotation.from_matrix(view[:3, :3]) * Rotation.from_rotvec(orient)).as_rotvec()
    places = (pelvis + places) @ view[:3, :3].T + view[:3, 3] - pelvis
    return Solution(poses[0].betas.double().numpy(), orient, turns, places, camera.K.double().numpy())


def off(solution: Solution, spread: float) -> Solution:
    """Returns the same with limbs turned by errors that are smooth in time, radians."""
    turns = solution.body_pose.reshape(SPEC.frames, 23, 3).copy()
    noise = smooth_noise(np.random.default_rng(2), SPEC.frames, 3 * len(LIMBS), 6.0)
    turns[:, np.array(LIMBS) - 1] += spread * noise.reshape(SPEC.frames, len(LIMBS), 3) / noise.std()
    return replace(solution, body_pose=turns.reshape(SPEC.frames, 69))


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """Returns pictures and masks of one camera, and the bodies in them."""
    root = tmp_path_factory.mktemp("filmed")
    write_scene(root, SPEC, progress=False)
    path = root / SPEC.name / "body.npz"
    words = [
        "dataset=zju", f"dataset.root={root}", f"dataset.scene={SPEC.name}", f"body.path={path}",
        "dataset.occlusion.kind=none", "dataset.test_frames=[0,10,9]",
    ]  # fmt: skip
    with initialize_config_dir(str(CONF), version_base="1.3"):
        settings = load_settings(compose("config", words))
    body, data = load_body(path), make_data(settings, make_body(settings.body))
    data.setup()
    frames = data.spread_train_frames(SPEC.frames)
    assert len(frames) == SPEC.frames
    pictures = [(255 * frame.rgb).round().byte().numpy() for frame in frames]
    numbers = list(range(SPEC.frames))
    sources = SimpleNamespace(
        masks=[frame.visible_mask.numpy() for frame in frames], hidden=None, notes=[],
        clip=SimpleNamespace(pictures=()), intrinsics=SimpleNamespace(source="given"),
        shot=Shot(pictures, numbers, [number / 10 for number in numbers], 1.0, []),
    )  # fmt: skip
    return SimpleNamespace(sources=sources, body=body, path=path, truth=in_camera(body, data))


def fit_of(filmed: SimpleNamespace, solution: Solution) -> Fit:
    marks = landmarks_of(filmed.body, filmed.truth)
    K = filmed.truth.K
    pixels = marks[..., :2] / marks[..., 2:] * K[[0, 1], [0, 1]] + K[:2, 2]
    points = KeyPoints(pixels, np.ones((SPEC.frames, 33)), None, np.ones(SPEC.frames))
    return Fit(solution, measure(filmed.body, solution, points, filmed.sources.masks), points, [])


def written(filmed: SimpleNamespace, solution: Solution, output: Path) -> tuple[Fit, dict[str, Any]]:
    """Writes an import of the bodies with its poses mended; returns what became of them."""
    fit = fit_of(filmed, solution)

    def mend(folder: Path) -> tuple[Fit, dict[str, Any]]:
        words = [*training_overrides(folder, filmed.path, 1.0), "trainer.enable_progress_bar=false"]
        return mended_by_colour(filmed.body, filmed.sources, fit, folder, words, seed=0)

    found = write_folder(output, filmed.sources, fit, filmed.body, embedded=False, facts={}, mend=mend)
    return found, json.loads((output / "import.json").read_text())["mended_by_colour"]


def off_by(filmed: SimpleNamespace, solution: Solution) -> float:
    """Returns how far joints are off in the picture, pixels, root mean square."""
    both = []
    for one in (solution, filmed.truth):
        joints = np.stack([found for _, found in posed(filmed.body, one)]) @ filmed.truth.K.T
        both.append(joints[..., :2] / joints[..., 2:])
    return float(np.sqrt(np.square(both[0] - both[1]).mean()))


@pytest.mark.slow
def test_limbs_that_are_off_are_moved_to_where_colours_have_them(filmed, tmp_path):
    wrong = off(filmed.truth, 0.06)
    found, told = written(filmed, wrong, tmp_path / "clip")
    before, after = off_by(filmed, wrong), off_by(filmed, found.solution)
    print("off by", before, after, told)
    assert told["taken"] and told["degrees"] > 0.5
    assert after < 0.7 * before
    with np.load(tmp_path / "clip" / "poses.npz") as rows:
        assert np.array_equal(rows["body_pose"], found.solution.body_pose)
    assert not [path for path in tmp_path.iterdir() if path.name != "clip"]  # no run folder is left


@pytest.mark.slow
def test_exact_poses_stay_where_they_are(filmed, tmp_path):
    found, told = written(filmed, filmed.truth, tmp_path / "clip")
    print("exact", off_by(filmed, found.solution), told)
    assert off_by(filmed, found.solution) < 0.3


def test_few_frames_are_left_alone(filmed, tmp_path):
    few = SimpleNamespace(**vars(filmed.sources) | {"shot": filmed.sources.shot.at(range(5))})
    fit = fit_of(filmed, filmed.truth)
    found, facts = mended_by_colour(filmed.body, few, fit, tmp_path, [], seed=0)
    assert found is fit and facts["mended_by_colour"]["taken"] is False
    assert not any(tmp_path.iterdir())


def mended_with(filmed: SimpleNamespace, folder: Path, found: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Mends true poses by corrections that were made up, or by a training that ends in an error."""

    def learned(_settings: Settings) -> PoseSpline:
        if isinstance(found, Exception):
            raise found
        return found

    monkeypatch.setattr("occfusion.run.mending.learned_corrections", learned)
    clip = folder / "of mine (1), it's" / "clip"  # signs that Hydra has another use for
    clip.parent.mkdir()
    fit, words = fit_of(filmed, filmed.truth), training_overrides(clip, filmed.path, 1.0)
    return fit, mended_by_colour(filmed.body, filmed.sources, fit, clip, words, seed=0)


def test_corrections_that_leave_the_masks_are_not_taken(filmed, tmp_path, monkeypatch):
    spline = PoseSpline.over(range(SPEC.frames), 2)
    spline.places.data[:, 0] = 0.05  # metres, across the picture
    fit, (found, facts) = mended_with(filmed, tmp_path, spline, monkeypatch)
    assert found is fit and facts["mended_by_colour"]["taken"] is False
    assert "off the masks" in facts["mended_by_colour"]["said"]


def test_a_folder_that_cannot_be_trained_on_keeps_its_poses(filmed, tmp_path, monkeypatch):
    fit, (found, facts) = mended_with(filmed, tmp_path, DataError("masks/000003.png: is empty"), monkeypatch)
    assert found is fit and "masks/000003.png" in facts["mended_by_colour"]["said"]


@pytest.mark.parametrize(
    ("number", "raised"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit)]
)
def test_a_signal_stops_the_import(filmed, tmp_path, monkeypatch, number, raised):
    with pytest.raises(raised):
        mended_with(filmed, tmp_path, Interrupted(number, "nowhere"), monkeypatch)
    assert not any(path.is_file() or path.name.startswith(".") for path in tmp_path.rglob("*"))
