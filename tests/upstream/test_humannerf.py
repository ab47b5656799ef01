"""HumanNeRF's and OccNeRF's folders as their own scripts write them, against their own formula."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir

from data.layout_writers import Source
from occfusion.__main__ import main as run_verb
from occfusion.data.body_convention import read_body
from occfusion.data.layouts import sequences_in
from occfusion.data.posing import ANOTHER_BODY, ROUNDING, Poser, joints_remark, shape_from_joints
from occfusion.data.zju.zju_data import ZjuDataModule
from occfusion.errors import DataError
from occfusion.human import Body, load_body
from occfusion.run import app
from occfusion.synth import SceneSpec, write_scene
from upstream import humannerf as upstream
from upstream.humannerf import Row, Smpl

SIZE, FRAMES, CAMERAS = 96, 4, 3
MILLIMETRE = 1e-3
ALL = {"train_frames": [0, None, 1], "occlusion": "none"}


@pytest.fixture(autouse=True)
def wide_terminal(monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "400")


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Source:
    spec = SceneSpec(1, "clean", image_size=SIZE, frames=FRAMES, cameras=CAMERAS)
    return Source(write_scene(tmp_path_factory.mktemp("embedded"), spec, progress=False))


@pytest.fixture(scope="module")
def smpl(source) -> Smpl:
    return Smpl.of(source.folder / "body.npz")


@pytest.fixture(scope="module")
def other(source, tmp_path_factory) -> tuple[Path, Smpl, Body]:
    """A second body: 2 % wider, with pose blend shapes, in a file of its own."""
    path = tmp_path_factory.mktemp("other") / "wider.npz"
    with np.load(source.folder / "body.npz") as archive:
        arrays = dict(archive)
    arrays["v_template"] = arrays["v_template"] * np.array([1.02, 1, 1], dtype=np.float32)
    noise = np.random.default_rng(5).normal(size=(len(arrays["v_template"]), 3, 207))
    arrays["posedirs"] = (0.5 * MILLIMETRE * noise).astype(np.float32)
    np.savez(path, **arrays)
    return path, Smpl(arrays), load_body(path)


@pytest.fixture(scope="module")
def wild(source, smpl, tmp_path_factory) -> tuple[Path, dict[str, Row]]:
    folder = tmp_path_factory.mktemp("monocular") / "monocular"
    rows = upstream.write_wild(upstream.weak_rows(source, smpl, SIZE), folder, smpl, SIZE)
    upstream.leave_strays(folder)
    return folder, rows


def opened(folder: Path, body: Body, **settings) -> ZjuDataModule:
    return ZjuDataModule(folder.parent, folder.name, body, **{**ALL, **settings})


def agree(data: ZjuDataModule, body: Body, rows: dict[str, Row], pixel: float) -> None:
    """Vertices before the camera within 0.01 mm, pixels, masks: all frames."""
    frames = list(data.train_frames())
    assert [frame.name for frame in frames] == list(rows)
    for frame, row in zip(frames, rows.values(), strict=True):
        pose, view = frame.pose, frame.camera.viewmat.double().numpy()
        vertices = body(pose.betas, pose.global_orient, pose.body_pose, pose.transl)[0].double().numpy()
        seen = vertices @ view[:3, :3].T + view[:3, 3]
        assert np.linalg.norm(seen - row.in_camera(), axis=1).max() < 1e-5
        pixels = (seen @ frame.camera.K.double().numpy().T)[:, :2] / seen[:, 2:]
        assert np.abs(pixels - 0.5 - row.pixels()).max() < pixel
        np.testing.assert_array_equal(frame.visible_mask.numpy(), row.mask > 0)


def test_zju_mocap_without_betas(source, smpl, tmp_path):
    rows = upstream.write_zju(source, tmp_path / "377", smpl)
    meshes = upstream.load(tmp_path / "377" / "mesh_infos.pkl")
    assert set(meshes["frame_000000"]) == {"Rh", "Th", "poses", "joints", "tpose_joints"}
    assert set(upstream.load(tmp_path / "377" / "canonical_joints.pkl")) == {"joints"}
    data = opened(tmp_path / "377", source.body)
    data.validate()
    agree(data, source.body, rows, 1e-3)
    for frame in range(FRAMES):
        np.testing.assert_allclose(
            data.pose(frame).betas.numpy(), source.parameters(frame)["shapes"][0], atol=1e-5
        )
    taken = data.taken
    assert "least squares" in taken.shape and "stands still" in taken.cameras and "origin" in taken.body
    assert "4 of 4" in taken.pictures and taken.centres == "0 (OpenCV)"
    assert "canonical_joints.pkl" in taken.others and "config.yaml" in taken.others


def test_footage_with_a_weak_perspective_camera(wild, source, capsys):
    folder, rows = wild
    data = opened(folder, source.body)
    data.validate()
    agree(data, source.body, rows, 0.02)
    focal = [frame.camera.K[0, 0].item() for frame in data.train_frames()]
    assert np.allclose(focal, [row.K[0, 0] for row in rows.values()]) and len(set(focal)) == FRAMES
    assert 47 < rows["000000"].in_camera()[:, 2].mean() < 48
    taken = data.taken
    assert "K changes" in taken.cameras and "moves" in taken.cameras and "pelvis" in taken.body
    for stray in (
        "metadata.json",
        "images/out.mp4",
        "images/.DS_Store",
        "images/._000000.png",
        "images/000000.jpg",
    ):
        assert stray in taken.others, taken.others
    code = run_verb(["check", str(folder), "--body", str(source.folder / "body.npz"), "--strict",
                     "--overlay", str(folder.parent / "overlay.png")])  # fmt: skip
    said = " ".join(capsys.readouterr().out.split())
    assert code == 0 and "humannerf: 4 frames" in said, said


def test_training_where_the_lens_zooms(wild, source, tmp_path):
    folder, _ = wild
    light = (
        "trainer.enable_progress_bar=false", "optim.lambda_lpips=0", "evaluation.perceptual=false",
        "evaluation.training_stride=2", "trainer.max_steps=2", "optim.steps=2", "evaluation.pictures=false",
        "variant=gauhuman", "dataset=zju", f"dataset.root={folder.parent}", f"dataset.scene={folder.name}",
        "dataset.occlusion.kind=none", "dataset.train_frames=[0,4,1]",
    )  # fmt: skip
    conf = Path(__file__).parents[2] / "conf"
    with initialize_config_dir(str(conf), version_base="1.3"):
        overrides = [f"body.path={source.folder / 'body.npz'}", f"output_dir={tmp_path / 'run'}", *light]
        metrics = app.run(compose("config", overrides), folder_chosen_by_user=True)
    # 15.9 dB; nobody there or a black person: 5.2, a person 0.4 m from its place: 6.0
    assert metrics["regions"]["visible"]["psnr"] > 12 and metrics["regions"]["visible"]["mask_iou"] > 0.85


def test_another_body_is_refused_in_millimetres(source, smpl, other, tmp_path):
    _, wider_smpl, wider = other
    upstream.write_zju(source, tmp_path / "377", smpl)
    rows = upstream.write_zju(source, tmp_path / "378", wider_smpl)
    agree(opened(tmp_path / "378", wider), wider, rows, 1e-3)
    for name, wrong in (("377", wider), ("378", source.body)):
        with pytest.raises(
            DataError, match=r"mesh_infos.pkl, frame_000000, tpose_joints: joint \d+ is [\d.]+ mm"
        ):
            opened(tmp_path / name, wrong).validate()
    upstream.write_zju(source, tmp_path / "392", smpl, occnerf=True)
    with pytest.raises(DataError, match=r"more than 2 mm are refused.*another body file.*--body"):
        opened(tmp_path / "392", wider).validate()


def test_the_limit_lies_far_from_rounding_and_from_other_bodies(source, smpl, other):
    _, wider_smpl, wider = other
    own, far = Poser(source.body), Poser(wider)
    rng = np.random.default_rng(2)
    for _ in range(5):
        betas = rng.normal(size=10)
        for poser, model in ((own, smpl), (far, wider_smpl)):
            joints = model(np.zeros(72), betas)[1]
            rounded = joints.astype(np.float32).astype(float) + rng.normal(size=3)
            found = shape_from_joints(rounded, poser)
            assert np.abs(found - betas).max() < 2e-5
            apart = np.linalg.norm(
                poser.joints(found) - poser.pelvis(found) - joints + joints[0], axis=1
            ).max()
            assert apart < ROUNDING / 100 and joints_remark(rounded, poser.joints(found), "here") == ""
        joints = smpl(np.zeros(72), betas)[1]
        with pytest.raises(DataError, match=r"here: joint \d+ is [\d.]+ mm .*more than 2 mm") as caught:
            joints_remark(joints, far.joints(shape_from_joints(joints, far)), "here")
        assert float(str(caught.value).split(" is ")[1].split(" mm")[0]) * MILLIMETRE > 1.5 * ANOTHER_BODY
        with pytest.raises(DataError, match="another body file"):
            joints_remark(smpl(np.zeros(72), betas + 0.1)[1], own.joints(betas), "here")


@pytest.mark.parametrize(
    ("millimetres", "says"), [(0.09, ""), (0.11, "remark"), (1.9, "remark"), (2.1, "refusal")]
)
def test_one_rule_for_joints_at_rest(millimetres, says, source):
    """Where the person stands is nothing; one joint elsewhere is rounding, a remark or another body."""
    own = source.rest_joints(np.zeros(10))
    given = own + np.array([3.0, -1.0, 2.0])
    given[7, 1] += millimetres * MILLIMETRE
    if says == "refusal":
        with pytest.raises(DataError, match=rf"here: joint 7 is {millimetres} mm .*mean of all joints 0\.09"):
            joints_remark(given, own, "here")
        return
    remark = joints_remark(given, own, "here")
    assert bool(remark) == (says == "remark")
    assert f"joint 7 is {millimetres} mm" in remark or not remark


@pytest.mark.parametrize("occnerf", [False, True])
def test_a_body_of_another_version_is_remarked_in_training_and_in_check(
    occnerf, source, smpl, tmp_path, capsys
):
    """Joints are 0.5 mm off where betas are given, 0.4 mm where the shape is fitted to the joints."""
    upstream.write_zju(source, tmp_path / "377", smpl, occnerf=occnerf)
    with np.load(source.folder / "body.npz") as archive:
        arrays = dict(archive)
    arrays["v_template"] = arrays["v_template"] * np.float32(1.0005 if occnerf else 1.005)
    np.savez(tmp_path / "version.npz", **arrays)
    data = opened(tmp_path / "377", load_body(tmp_path / "version.npz"))
    data.validate()
    (remark,) = data.findings
    assert (
        "mesh_infos.pkl, frame_000000, tpose_joints: joint" in remark and "another version or sex" in remark
    )
    assert 0.3 < float(remark.split(" is ")[1].split(" mm")[0]) < 0.6
    run_verb(["check", str(tmp_path / "377"), "--body", str(tmp_path / "version.npz"),
              "--overlay", str(tmp_path / "overlay.png")])  # fmt: skip
    assert "another version or sex of the body?" in " ".join(
        capsys.readouterr().out.replace("│", " ").split()
    )
    right = opened(tmp_path / "377", source.body)
    right.validate()
    assert not right.findings


def test_check_without_a_body_file_stays_rough(wild, capsys):
    code = run_verb(["check", str(wild[0]), "--overlay", str(wild[0].parent / "rough.png")])
    said = " ".join(capsys.readouterr().out.split())
    assert code == 0 and "the embedded body stands in" in said, said


def test_tables_may_have_more_frames_than_there_are_pictures(wild, source, tmp_path):
    folder = Path(shutil.copytree(wild[0], tmp_path / "cut"))
    (folder / "images" / "000001.png").unlink()
    data = opened(folder, source.body)
    data.validate()
    agree(data, source.body, {name: row for name, row in wild[1].items() if name != "000001"}, 0.02)
    assert "images/, 3 of 3; 1 rows of cameras.pkl without a picture" in data.taken.pictures
    assert "masks/000001.png" in data.taken.others
    shutil.copy(folder / "images" / "000002.png", folder / "images" / "000009.png")
    with pytest.raises(DataError, match=r"cameras.pkl: has no '000009', which .*images has"):
        opened(folder, source.body).validate()
    for path in (folder / "images").glob("*.png"):
        path.rename(path.with_name(f"im{path.name}"))
    with pytest.raises(
        DataError, match=r"none of its .* pictures.* is named in cameras.pkl, which has 4 frames"
    ):
        opened(folder, source.body).validate()


def test_tables_of_other_frames_and_rows_without_joints_are_named(source, smpl, tmp_path):
    folder = tmp_path / "377"
    upstream.write_zju(source, folder, smpl)
    meshes = upstream.load(folder / "mesh_infos.pkl")
    cut = {name: dict(row) for name, row in meshes.items()}
    del cut["frame_000002"]["tpose_joints"]
    upstream.dump(folder / "mesh_infos.pkl", cut)
    with pytest.raises(DataError, match=r"canonical_joints.pkl: key 'avg_betas' is missing"):
        opened(folder, source.body).validate()
    (folder / "canonical_joints.pkl").unlink()
    with pytest.raises(DataError, match=r"frame_000002 has neither betas nor tpose_joints"):
        opened(folder, source.body).validate()
    upstream.dump(folder / "mesh_infos.pkl", {name: meshes[name] for name in list(meshes)[1:]})
    with pytest.raises(DataError, match=r"mesh_infos.pkl: has no 'frame_000000', which .*cameras.pkl has"):
        opened(folder, source.body).validate()


def test_a_root_rotation_in_poses_turns_about_the_pelvis(source, smpl, tmp_path):
    upstream.write_zju(source, tmp_path / "377", smpl)
    meshes = upstream.load(tmp_path / "377" / "mesh_infos.pkl")
    rows = upstream.write_zju(source, tmp_path / "378", smpl)
    turn = np.array([0.2, -0.1, 0.3], dtype=np.float32)
    for name, mesh in meshes.items():
        mesh["poses"] = np.concatenate([turn, mesh["poses"][3:]])
        betas = source.parameters(0)["shapes"][0]
        rows[name].vertices = upstream.placed(smpl(mesh["poses"], betas)[0], mesh["Rh"], mesh["Th"])
    upstream.dump(tmp_path / "377" / "mesh_infos.pkl", meshes)
    agree(opened(tmp_path / "377", source.body), source.body, rows, 1e-3)


# --- OccNeRF -------------------------------------------------------------------------------------------


@pytest.fixture
def pair(source, smpl, tmp_path) -> tuple[Path, dict[str, Row], dict[str, Row]]:
    rows = upstream.write_zju(source, tmp_path / "377", smpl, occnerf=True)
    return tmp_path / "377", rows, upstream.write_eval(source, tmp_path / "377_eval", smpl, skip=2)


def test_occnerf_with_its_held_out_cameras(pair, source, capsys):
    folder, rows, held_out = pair
    data = opened(folder, source.body, test_frames=[0, None, 2])
    data.validate()
    assert not data.findings
    agree(data, source.body, rows, 1e-3)
    assert "betas of mesh_infos.pkl" in data.taken.shape and "all_cameras.pkl" in data.taken.others
    assert "held out: 2 cameras of 377_eval/ at 2 moments" in data.taken.pictures
    assert data.test_views == ((0, 1), (2, 1), (0, 2), (2, 2))
    for frame, camera in data.test_views:
        view = data.test_frame(frame, camera)
        row = held_out[view.name]
        assert view.name == f"camera_{camera + 1:02d}_frame_{frame:06d}"
        np.testing.assert_array_equal(view.truth.mask.numpy(), row.mask > 0)
        pose, viewmat = view.pose, view.camera.viewmat.double().numpy()
        vertices = (
            source.body(pose.betas, pose.global_orient, pose.body_pose, pose.transl)[0].double().numpy()
        )
        seen = vertices @ viewmat[:3, :3].T + viewmat[:3, 3]
        assert np.linalg.norm(seen - row.in_camera(), axis=1).max() < 1e-5
    assert data.summary()["test_images"] == 4 and len(data.summary()["hash"]) == 16
    with pytest.raises(DataError, match=r"camera_02 at frame 1.png: file not found"):
        opened(folder, source.body, test_frames=[1, 2, 1]).validate()
    assert sequences_in(folder.parent) == [folder]
    code = run_verb(["check", str(folder.parent), "--body", str(source.folder / "body.npz"), "--strict",
                     "--overlay", str(folder.parent / "overlay.png")])  # fmt: skip
    said = " ".join(capsys.readouterr().out.split())
    assert code == 0 and "all there: 4 frames of 3 cameras" in said and "fit in all 2" in said, said


def test_held_out_moments_are_those_that_are_there(pair, source):
    folder, *_ = pair
    path = folder.with_name("377_eval") / "cameras.pkl"
    upstream.dump(path, {name: row for name, row in upstream.load(path).items() if name.endswith("2")})
    data = opened(folder, source.body)
    data.validate()
    assert data.test_views == ((2, 1), (2, 2))  # the protocol's would be moment 0


def test_held_out_cameras_alone_are_named_for_what_they_are(pair, source):
    folder, *_ = pair
    alone = folder.with_name("377_eval")
    with pytest.raises(
        DataError, match=r"held-out views of 2 cameras in one table.*OccNeRF.*Open 377: these"
    ):
        opened(alone, source.body).setup()
    shutil.rmtree(folder)
    with pytest.raises(DataError, match=r"Open 377, which is missing: prepare it too"):
        opened(alone, source.body).setup()
    with pytest.raises(DataError, match=r"named like it, with _eval added"):
        opened(Path(alone.rename(folder.with_name("evaluation"))), source.body).setup()


def test_held_out_cameras_of_another_sequence_are_refused(pair, source):
    folder, *_ = pair
    path = folder.with_name("377_eval") / "mesh_infos.pkl"
    meshes = upstream.load(path)
    meshes["camera_03_frame_000002"]["Th"] = meshes["camera_03_frame_000002"]["Th"] + 0.01
    upstream.dump(path, meshes)
    with pytest.raises(DataError, match=r"camera_03_frame_000002: Th differs by 0.01 .*not of one sequence"):
        opened(folder, source.body).setup()
    del meshes["camera_03_frame_000002"]
    upstream.dump(path, meshes)
    with pytest.raises(DataError, match=r"377_eval.mesh_infos.pkl: has no 'camera_03_frame_000002'"):
        opened(folder, source.body).setup()
    cameras = upstream.load(path.with_name("cameras.pkl"))
    upstream.dump(path.with_name("cameras.pkl"), {"000001": cameras["camera_02_frame_000000"]})
    with pytest.raises(DataError, match=r"'000001' is no name of a held-out view.*does not end in _eval"):
        opened(folder, source.body).setup()
    cameras["camera_02_frame_000002"]["extrinsics"] = cameras["camera_03_frame_000002"]["extrinsics"]
    upstream.dump(path.with_name("cameras.pkl"), cameras)
    with pytest.raises(DataError, match=r"held-out camera must stand still"):
        opened(folder, source.body).setup()
    path.unlink()
    data = opened(folder, source.body)
    data.setup()
    assert data.test_cameras == () and "../377_eval" in data.taken.others


# --- EasyMocap -----------------------------------------------------------------------------------------


def test_easymocap_poses_without_a_root(source, smpl):
    """`zju_smpl/easymocap_to_neuralbody.py` of zju3dv/neuralbody @ 301ab711418dd118b59eed833e34aa4d39e1cc0b hands on
    EasyMocap's `poses` of `(1, 69)` as they are, and poses its body with three zeros before them (thread 146 of its
    tracker)."""
    values = {key: np.array(value.tolist()) for key, value in source.parameters(1).items()}
    values["poses"] = values["poses"][:, 3:]
    found = read_body(values, Poser(source.body).pelvis, "params/1.npy")
    parts = (found.betas, found.global_orient, found.body_pose, found.transl)
    vertices = source.body(*(torch.tensor(part, dtype=torch.float32) for part in parts))[0].double().numpy()
    whole = np.concatenate([np.zeros(3), values["poses"][0]])
    truth = upstream.placed(smpl(whole, values["shapes"][0])[0], values["Rh"][0], values["Th"][0])
    assert np.linalg.norm(vertices - truth, axis=1).max() < 1e-5
    with pytest.raises(DataError, match=r"poses has shape \(1, 78\), expected 72"):
        read_body(values | {"poses": np.zeros((1, 78))}, Poser(source.body).pelvis, "params/1.npy")
