"""Every layout as its own programs write it, trained from folder to figures."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from safetensors.torch import load_file
from scipy import sparse

from data import layout_writers
from data.layout_writers import Source
from occfusion.run import app
from occfusion.synth import SceneSpec, write_scene
from upstream import chumpy_objects as chumpy
from upstream import humannerf, instantavatar, motion_files, ocmotion, zju_mocap

CONF = Path(__file__).parents[2] / "conf"
SIZE, FRAMES, CAMERAS = 96, 6, 3
ALL = (f"dataset.train_frames=[0,{FRAMES},1]", f"dataset.test_frames=[0,{FRAMES},2]")
STAGES = ("init", "optim", "refine")
WITHOUT_LAYOUT = ("evaluation.curve=false", "optim.unseen_colors=nearest")
"""What costs most of a step, and reads nothing that a layout gives."""


@dataclass(frozen=True)
class Written:
    """The embedded scene that all layouts are written from, and the one body file of all of them."""

    source: Source
    body: Path

    def zju(self) -> zju_mocap.SmplBody:
        return zju_mocap.SmplBody(self.source, self.body)

    def ocmotion(self) -> ocmotion.UpstreamSmpl:
        return ocmotion.UpstreamSmpl(self.source, self.body)

    def humannerf(self) -> humannerf.Smpl:
        return humannerf.Smpl.of(self.body)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Written:
    spec = SceneSpec(1, "clean", image_size=SIZE, frames=FRAMES, cameras=CAMERAS)
    root = tmp_path_factory.mktemp("scenes")
    written = Written(Source(write_scene(root, spec, progress=False)), root / "smpl.npz")
    written.zju()  # writes the file; OcMotion's stand-in writes the very same
    return written


def train(written: Written, run: Path, *overrides: str) -> dict[str, Any]:
    fixed = (f"body.path={written.body}", f"output_dir={run}", "trainer.enable_progress_bar=false")
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", [*fixed, *overrides])
    return app.run(config, folder_chosen_by_user=True)


# --- the layouts: each writes itself into a folder and returns what chooses it ----------------------


def original(written: Written, root: Path) -> tuple[str, ...]:
    zju_mocap.write_original(written.source, root, written.zju())
    return ("dataset=zju", "dataset.scene=CoreView_377", "dataset.masks=mask+mask_cihp")


def subject_313(written: Written, root: Path) -> tuple[str, ...]:
    zju_mocap.write_stamped(written.source, root, written.zju())
    return ("dataset=zju", "dataset.scene=CoreView_313")


def subject_315_of_old(written: Written, root: Path) -> tuple[str, ...]:
    zju_mocap.write_stamped(written.source, root, written.zju(), 315, ("params",))
    return ("dataset=zju", "dataset.scene=CoreView_315", "body.pose_blend_shapes=false")


def refined(written: Written, root: Path, masks: str) -> tuple[str, ...]:
    zju_mocap.write_refined(written.source, root, written.zju())
    return ("dataset=zju", "dataset.scene=my_377", f"dataset.masks={masks}")


def humannerf_zju(written: Written, root: Path) -> tuple[str, ...]:
    humannerf.write_zju(written.source, root / "377", written.humannerf())
    return ("dataset=zju", "dataset.scene=377")


def humannerf_wild(written: Written, root: Path) -> tuple[str, ...]:
    smpl = written.humannerf()
    humannerf.write_wild(humannerf.weak_rows(written.source, smpl, SIZE), root / "mine", smpl, SIZE)
    return ("dataset=zju", "dataset.scene=mine")


def occnerf(written: Written, root: Path) -> tuple[str, ...]:
    smpl = written.humannerf()
    humannerf.write_zju(written.source, root / "377", smpl, occnerf=True)
    humannerf.write_eval(written.source, root / "377_eval", smpl, skip=2)
    return ("dataset=zju", "dataset.scene=377")


def ocmotion_cut(written: Written, root: Path) -> tuple[str, ...]:
    ocmotion.write_cut(written.source, written.ocmotion(), root)
    return ("dataset=ocmotion", "dataset.scene=0013_02", f"dataset.image_size={SIZE}")


def ocmotion_raw(written: Written, root: Path) -> tuple[str, ...]:
    ocmotion.write_raw(written.source, written.ocmotion(), root)
    return ("dataset=ocmotion", "dataset.scene=0013_02", f"dataset.image_size={SIZE}")


def peoplesnapshot(written: Written, root: Path) -> tuple[str, ...]:
    folder = instantavatar.write_peoplesnapshot(written.source, root / "someone", exact=False)
    instantavatar.write_track(written.source, folder, "anim_nerf_train", 0, FRAMES - 1, 1)
    return ("dataset=video", "dataset.scene=someone")


def neuman(written: Written, root: Path) -> tuple[str, ...]:
    instantavatar.write_neuman(written.source, root / "lab")
    return ("dataset=video", "dataset.scene=lab")


def own_footage(written: Written, root: Path) -> tuple[str, ...]:
    layout_writers.write_video(written.source, root / "mine")
    return ("dataset=video", "dataset.scene=mine", "dataset.occluded=false", "dataset.test_cameras=[0]")


def own_footage_with_amass(written: Written, root: Path) -> tuple[str, ...]:
    folder, rows = (
        layout_writers.write_video(written.source, root / "mine"),
        instantavatar.smplx_rows(written.source),
    )
    parts = (rows[key] for key in ("global_orient", "body_pose", "transl"))
    motion_files.write_amass(folder / "walk_poses.npz", *parts, rows["betas"], np.array("neutral"))
    return ("dataset=video", "dataset.scene=mine", "dataset.poses=walk_poses.npz")


Layout = Callable[[Written, Path], tuple[str, ...]]
LAYOUTS: dict[str, tuple[Layout, str, str, int]] = {
    # what data are said to be, what else is said of them, and how many cameras are held out
    "original": (original, "original ZJU-MoCap", "new_params/{i}.npy, the newer fit", 2),
    "313": (subject_313, "original ZJU-MoCap", "new_params/{i}.npy, the newer fit", 2),
    "315, the older fit": (subject_315_of_old, "original ZJU-MoCap", "params/{i}.npy, the older fit", 2),
    "refined": (partial(refined, masks="mask"), "refined ZJU-MoCap", "mask/: every value", 2),
    "refined, schp": (partial(refined, masks="schp"), "refined ZJU-MoCap", "schp/: every value", 2),
    "HumanNeRF": (humannerf_zju, "humannerf", "least squares", 0),
    "HumanNeRF, wild": (humannerf_wild, "humannerf", "K changes", 0),
    "OccNeRF": (occnerf, "humannerf", "held out: 2 cameras of 377_eval/", 2),
    "Wild2Avatar": (ocmotion_cut, "OcMotion as Wild2Avatar cut it", "+ trans", 0),
    "OcMotion": (ocmotion_raw, "OcMotion as released", "of person 0", 0),
    "PeopleSnapshot": (peoplesnapshot, "video, as InstantAvatar's", "anim_nerf_train.npz", 0),
    "NeuMan": (neuman, "video, as InstantAvatar's", "poses_optimized.npz", 0),
    "own footage": (own_footage, "video", "no mark of InstantAvatar's", 1),
    "own footage, AMASS": (own_footage_with_amass, "video", "walk_poses.npz", 0),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_every_layout_trains_from_folder_to_figures(name: str, written: Written, tmp_path: Path) -> None:
    """All stages of E, with half of the person hidden, and the figures of one picture."""
    write, layout, said, held_out = LAYOUTS[name]
    chosen = write(written, tmp_path / "data")
    run = tmp_path / "run"
    metrics = train(
        written, run, *chosen, f"dataset.root={tmp_path / 'data'}", *ALL, "dataset.occlusion.kind=box",
        "trainer.fast_dev_run=true", *WITHOUT_LAYOUT,
    )  # fmt: skip
    taken = json.loads((run / "environment.json").read_text())["data"]
    assert taken["layout"].startswith(layout) and said in " ".join(taken.values()), taken
    plan = json.loads((run / "plan.json").read_text())
    assert plan["scene"]["findings"] == []  # nothing is doubtful about a folder that is as it should be
    decisions = {entry["part"]: entry for entry in plan["decisions"]}
    for stage in STAGES:
        assert decisions[f"stage {stage}"]["used"], decisions[f"stage {stage}"]
    assert list((run / "masks").glob("*.png")) and list((run / "inpainted").glob("*.png"))
    first, last = (load_file(run / stage / "avatar.safetensors") for stage in STAGES[1:])
    assert not all(torch.equal(first[key], last[key]) for key in first)
    regions = metrics["regions"]
    assert regions["visible"]["images"] == 1 and math.isfinite(regions["visible"]["psnr"])
    assert 0 <= regions["visible"]["lpips"] < 1
    assert metrics["images"] == (1 if held_out else 0)
    assert (regions["full"]["psnr"] is not None) == bool(held_out)
    assert json.loads((run / "metrics.json").read_text())["regions"] == regions


# --- what training gains -----------------------------------------------------------------------------

START, GAIN = 16.0, 10.0
"""PSNR in decibels on the training views: what one step a stage must reach, and what 60 must gain over it.

In every family one step reaches 19.0, as Gaussians start in the observed colours, and 60 gain 12.3. A wrong convention
misses the start and mostly the gain: body poses the other way round 12.7 and 8.9, axes of joints exchanged 13.3 and
8.1, the root turned about the origin in place of the pelvis 9.8 and 2.0, all of the body shifted by its pelvis at rest
11.6 and 15.5: a constant shift is learnt, so that the gain alone would not tell.
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["original", "HumanNeRF", "Wild2Avatar", "PeopleSnapshot"])
def test_training_gains_what_wrong_conventions_do_not(name: str, written: Written, tmp_path: Path) -> None:
    write, *_ = LAYOUTS[name]
    chosen = (*write(written, tmp_path / "data"), f"dataset.root={tmp_path / 'data'}", *ALL)
    light = (
        "dataset.occlusion.kind=box", "optim.lambda_lpips=0", "refine.lambda_lpips=0", "evaluation.perceptual=false",
        "evaluation.curve=false", "evaluation.pictures=false", "evaluation.held_out=false",
        "evaluation.training_stride=1", "optim.unseen_colors=nearest",
    )  # fmt: skip
    psnr = []
    for steps in (1, 60):
        asked = (f"trainer.max_steps={steps}", f"optim.steps={steps}", f"refine.steps={steps}")
        metrics = train(written, tmp_path / f"{steps} steps", *chosen, *light, *asked)
        assert metrics["regions"]["visible"]["images"] == FRAMES
        psnr.append(metrics["regions"]["visible"]["psnr"])
    assert psnr[0] > START and psnr[1] - psnr[0] > GAIN, psnr


# --- the body file -----------------------------------------------------------------------------------


def write_official(npz: Path, target: Path) -> Path:
    """SMPL's own file with the numbers of another: Python 2's protocol 2, shapes as a chumpy array, float64."""
    with np.load(npz) as archive:
        arrays = dict(archive)
    regressor = arrays["J_regressor"].astype(np.float64)
    kintree = np.stack([arrays["kintree_table"][0], np.arange(24)]).astype(np.int64)
    kintree[0, 0] = 2**32 - 1
    content = {
        "J_regressor_prior": sparse.csc_matrix(regressor),
        "f": arrays["f"].astype(np.uint32),
        "J_regressor": sparse.csc_matrix(regressor),
        "kintree_table": kintree.astype(np.uint32),
        "J": regressor @ arrays["v_template"],
        "weights": arrays["weights"].astype(np.float64),
        "posedirs": arrays["posedirs"].astype(np.float64),
        "bs_style": "lbs",
        "v_template": arrays["v_template"].astype(np.float64),
        "shapedirs": chumpy.ch(arrays["shapedirs"]),
        "bs_type": "lrotmin",
    }
    target.write_bytes(chumpy.dumps(content, python=2, protocol=2))
    return target


def test_the_official_body_file_gives_the_same_first_step(written: Written, tmp_path: Path) -> None:
    chosen = (*original(written, tmp_path / "data"), f"dataset.root={tmp_path / 'data'}", *ALL, "variant=A",
              "trainer.fast_dev_run=true", "evaluation.perceptual=false", "evaluation.pictures=false")  # fmt: skip
    official = write_official(written.body, tmp_path / "basicModel_neutral_lbs_10_207_0_v1.0.0.pkl")
    train(written, tmp_path / "npz", *chosen)
    train(Written(written.source, official), tmp_path / "pkl", *chosen)
    ours, theirs = (load_file(tmp_path / run / "optim" / "avatar.safetensors") for run in ("npz", "pkl"))
    assert ours.keys() == theirs.keys()
    different = [key for key, value in ours.items() if not torch.equal(theirs[key], value)]
    assert not different
