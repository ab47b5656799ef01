"""Motions of InstantAvatar's demo, AIST++ and AMASS, alone and as the poses of a video."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from data import layout_writers
from data.layout_writers import Source
from occfusion.data.video.pose_table import measured_up, read_motion
from occfusion.data.video.video_data import VideoDataModule
from occfusion.errors import ConfigError, DataError
from occfusion.synth import SceneSpec, write_scene
from upstream.instantavatar import smplx_rows
from upstream.motion_files import write_aist_demo, write_aistplusplus, write_amass, write_amass_smplx

SIZE, FRAMES = 64, 3
NEAR = 1e-5


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Source:
    spec = SceneSpec(1, "clean", image_size=SIZE, frames=FRAMES, cameras=1)
    return Source(write_scene(tmp_path_factory.mktemp("embedded"), spec, progress=False))


@pytest.fixture(scope="module")
def rows(source) -> dict[str, np.ndarray]:
    return smplx_rows(source)


def dance(rows: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return rows["global_orient"], rows["body_pose"], rows["transl"]


def standing(up: np.ndarray, frames: int = 5) -> np.ndarray:
    """Turns of people who stand along an axis and look about them."""
    first, _ = cv2.Rodrigues(np.cross([0.0, 1.0, 0.0], up) * np.pi / 2 if abs(up[1]) < 1 else np.zeros(3))
    if up[1] < 0:
        first = np.diag([1.0, -1.0, -1.0])
    about = [cv2.Rodrigues(np.array([0.0, 0.8 * k, 0.0]))[0] for k in range(frames)]
    return np.stack([cv2.Rodrigues(first @ turn)[0].reshape(3) for turn in about])


def posed(source: Source, betas, orient, pose, transl) -> np.ndarray:
    parts = (torch.tensor(np.asarray(part), dtype=torch.float32) for part in (betas, orient, pose, transl))
    return source.body(*parts)[0].double().numpy()


def test_the_demo_of_instantavatar(rows, tmp_path):
    motion = read_motion(write_aist_demo(tmp_path / "aist_demo.npz", *dance(rows)))
    assert motion.betas is None and motion.fps is None and motion.gender is None and len(motion) == FRAMES
    np.testing.assert_array_equal(motion.global_orient, rows["global_orient"].astype(np.float64))
    np.testing.assert_array_equal(motion.body_pose, rows["body_pose"].astype(np.float64))
    np.testing.assert_array_equal(motion.transl, (rows["transl"] - rows["transl"][:1]).astype(np.float64))


@pytest.mark.parametrize("protocol", [4, 5])
@pytest.mark.parametrize("scaling", [93.78, 100.0])
def test_aistplusplus(protocol, scaling, rows, source, tmp_path):
    path = write_aistplusplus(tmp_path / "gBR_sBM.pkl", *dance(rows), scaling, protocol)
    motion = read_motion(path)
    assert (motion.form, motion.betas, motion.fps) == ("AIST++", None, 60.0)
    content = np.float32(scaling)
    for frame in range(FRAMES):
        # theirs, in centimetres: scaled about the body's origin, then shifted
        body = posed(
            source, np.zeros(10), rows["global_orient"][frame], rows["body_pose"][frame], np.zeros(3)
        )
        theirs = content * body + content * rows["transl"][frame]
        ours = posed(
            source, np.zeros(10), motion.global_orient[frame], motion.body_pose[frame], motion.transl[frame]
        )
        assert np.abs(theirs / scaling - ours).max() < NEAR
    stacked = {"smpl_poses": np.concatenate(dance(rows)[:2], axis=1).reshape(FRAMES, 24, 3),
               "smpl_scaling": np.array([scaling]), "smpl_trans": np.zeros((FRAMES, 3))}  # fmt: skip
    layout_writers.save_pickle(path, stacked)
    np.testing.assert_allclose(read_motion(path).body_pose, rows["body_pose"], atol=1e-6)


@pytest.mark.parametrize(
    "gender", [np.array("female"), np.array(b"female"), np.array("female", dtype=object)]
)
def test_amass(gender, rows, source, tmp_path):
    betas = np.linspace(1.0, -0.5, 16)
    path = write_amass(tmp_path / "walk_poses.npz", *dance(rows), betas, gender)
    motion = read_motion(path)
    assert (motion.form, motion.fps, motion.left_out) == ("AMASS, SMPL-H", 120.0, "hands")
    assert motion.gender == (None if gender.dtype == object else "female")
    np.testing.assert_array_equal(motion.betas, betas[None])
    np.testing.assert_array_equal(motion.body_pose[:, :63], rows["body_pose"][:, :63].astype(np.float64))
    assert not motion.body_pose[:, 63:].any()
    np.testing.assert_array_equal(motion.transl, rows["transl"].astype(np.float64))


def test_amass_of_smplx(rows, tmp_path):
    motion = read_motion(write_amass_smplx(tmp_path / "walk_stageii.npz", *dance(rows), np.zeros(16)))
    assert motion.betas is None and "SMPL-X" in motion.left_out and motion.fps == 120.0
    np.testing.assert_array_equal(motion.body_pose[:, :63], rows["body_pose"][:, :63].astype(np.float64))


@pytest.mark.parametrize(
    ("axis", "name"),
    [([0, 1, 0], "y"), ([0, -1, 0], "-y"), ([0, 0, 1], "z"), ([0, 0, -1], "-z"), ([1, 0, 0], "x")],
)
def test_which_way_is_up(axis, name, tmp_path):
    orient = standing(np.array(axis, dtype=float))
    assert measured_up(orient) == name
    motion = read_motion(write_aist_demo(tmp_path / "m.npz", orient, np.zeros((5, 69)), np.zeros((5, 3))))
    assert motion.up == name


def test_who_turns_somersaults_is_up_as_the_form_is_known_for(tmp_path):
    spins = np.stack([[angle, 0.0, 0.0] for angle in np.linspace(0, 2 * np.pi, 9)[:-1]])
    nothing = np.zeros((8, 69)), np.zeros((8, 3))
    assert measured_up(spins) is None
    assert read_motion(write_aist_demo(tmp_path / "m.npz", spins, *nothing)).up is None
    assert read_motion(write_aistplusplus(tmp_path / "m.pkl", spins, *nothing)).up == "y"
    assert (
        read_motion(write_amass(tmp_path / "a.npz", spins, *nothing, np.zeros(16), np.array("male"))).up
        == "z"
    )


def test_motions_that_cannot_be(rows, tmp_path):
    path = tmp_path / "shape.npz"
    np.savez(path, betas=np.zeros(16), gender=np.array("male"))  # lies in every folder of AMASS
    with pytest.raises(DataError, match=r"shape.npz: key 'global_orient' is missing; it has betas"):
        read_motion(path)
    good = dict(np.load(write_amass(tmp_path / "good.npz", *dance(rows), np.zeros(16), np.array("male"))))
    for change, words in (
        ({"mocap_framerate": np.array(0.0)}, "mocap_framerate is 0; it must be positive"),
        ({"trans": good["trans"][:2]}, r"transl has shape \(2, 3\), expected \(3, 3\)"),
        ({"trans": good["trans"] * np.nan}, "row 0, transl holds NaN"),
        ({"poses": good["poses"][:, :99]}, r"poses has shape \(3, 99\)"),
        ({"poses": good["poses"][:0], "trans": good["trans"][:0]}, "holds no frame"),
        ({"betas": np.zeros((2, 10))}, r"betas has shape \(2, 10\)"),
        ({"poses": good["poses"].astype(str)}, "poses has shape"),
    ):
        np.savez(path, **{**good, **change})
        with pytest.raises(DataError, match=words):
            read_motion(path)
    layout_writers.save_pickle(
        tmp_path / "m.pkl", {"smpl_poses": np.zeros((2, 72)), "smpl_trans": np.zeros((2, 3))}
    )
    with pytest.raises(DataError, match=r"m.pkl: key 'smpl_scaling' is missing"):
        read_motion(tmp_path / "m.pkl")
    layout_writers.save_pickle(tmp_path / "m.pkl", [1, 2])
    with pytest.raises(DataError, match=r"holds a list, not a table with smpl_poses"):
        read_motion(tmp_path / "m.pkl")


@pytest.fixture
def video(source, tmp_path) -> Path:
    return layout_writers.write_video(source, tmp_path / "mine")


def opened(folder: Path, source: Source, **settings) -> VideoDataModule:
    return VideoDataModule(folder.parent, folder.name, source.body, **settings)


def test_poses_without_betas_ask_for_them(source, rows, video):
    write_aistplusplus(video / "dance.pkl", *dance(rows))
    with pytest.raises(
        DataError, match=r"dance.pkl: has no betas.*dataset.betas=FILE.npz.*dataset.betas=zeros"
    ):
        opened(video, source, poses="dance.pkl").setup()
    np.savez(video / "shape.npz", betas=rows["betas"], gender=np.array("male"))
    np.save(video / "shape.npy", rows["betas"][None])
    wanted = opened(video, source)
    for betas in ("shape.npz", "shape.npy", rows["betas"].tolist()):
        data = opened(video, source, poses="dance.pkl", betas=betas)
        data.validate()
        for frame in range(FRAMES):
            a, b = wanted.pose(frame), data.pose(frame)
            ours = posed(source, b.betas, b.global_orient, b.body_pose, b.transl)
            assert np.abs(ours - source.vertices(frame)).max() < NEAR
            torch.testing.assert_close(a.transl, b.transl, atol=1e-6, rtol=0)
    mean = opened(video, source, poses="dance.pkl", betas="zeros")
    assert not mean.pose(0).betas.any() and mean.taken.shape.startswith("zeros")
    (video / "poses.npz").unlink()
    opened(video, source, poses="dance.pkl", betas="zeros").setup()  # under any name


def test_sixteen_betas_and_a_body_of_ten(source, rows, video):
    assert source.body.num_betas == 10
    longer = np.concatenate([rows["betas"], [0.0, 0.53, 0, 0, 0, -0.2]])
    write_amass(video / "poses.npz", *dance(rows), longer, np.array("male"))
    with pytest.raises(
        DataError, match=r"betas are 16.*dataset.betas=10 to use the first 10 \(the largest .* is 0.53\)"
    ):
        opened(video, source).setup()
    data = opened(video, source, betas=10)
    data.validate()
    np.testing.assert_allclose(data.pose(0).betas, rows["betas"], rtol=1e-6)
    assert "the first 10 of 16" in data.taken.shape and "0.53" in data.taken.shape
    assert "left out: hands" in data.taken.body
    write_amass(
        video / "poses.npz", *dance(rows), np.concatenate([rows["betas"], np.zeros(6)]), np.array("male")
    )
    data = opened(video, source)
    assert data.pose(0).betas.shape == (10,) and "the other 6 are 0" in data.taken.shape
    for wrong, words in (
        (17, "choose 1 to 16"),
        (0, "choose 1 to 16"),
        ("body", "give a .npz or .npy"),
        (2.5, "give"),
    ):
        with pytest.raises(ConfigError, match=rf"dataset.betas.*{words}"):
            opened(video, source, betas=wrong).setup()
    write_amass_smplx(video / "walk.npz", *dance(rows), np.zeros(16))
    with pytest.raises(DataError, match=r"walk.npz: has no betas of SMPL's"):
        opened(video, source, poses="walk.npz").setup()
