"""Every layout, written from one embedded scene and read back: the same scene, and the same first frames."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from data import layout_writers as writers
from data.layout_writers import Source
from occfusion.data.layouts import find_layout, sequences_in
from occfusion.data.module import HumanDataModule
from occfusion.data.ocmotion.ocmotion_data import OcMotionDataModule
from occfusion.data.video.video_data import VideoDataModule
from occfusion.data.zju.zju_data import ZjuDataModule
from occfusion.errors import ConfigError, DataError
from occfusion.synth import SceneSpec, write_scene
from occfusion.synth.studio import make_cameras

SIZE, FRAMES, CAMERAS = 96, 5, 3
SPEC = SceneSpec(1, "clean", image_size=SIZE, frames=FRAMES, cameras=CAMERAS)
ALL_FRAMES = {"train_frames": [0, None, 1], "occlusion": "none"}


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Source:
    return Source(write_scene(tmp_path_factory.mktemp("embedded"), SPEC, progress=False))


@pytest.fixture(scope="module")
def written(source, tmp_path_factory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("layouts")
    return {
        "original": source.folder,
        "stamped": writers.write_stamped(source, root),
        "refined": writers.write_refined(source, root),
        "humannerf": writers.write_humannerf(source, root / "377"),
        "wild": writers.write_humannerf_wild(source, root / "wild"),
        "w2a": writers.write_w2a(source, root),
        "chomp": writers.write_chomp(source, root / "raw"),
        "video": writers.write_video(source, root / "mine"),
    }


def opened(kind: str, path: Path, source: Source, **settings) -> HumanDataModule:
    settings = {**ALL_FRAMES, **settings}
    match kind:
        case "w2a":
            settings = {"image_size": SIZE, **settings}
            return OcMotionDataModule(path.parent, "0013_02", source.body, **settings)
        case "chomp":
            settings = {
                "person": 1, "numbered_masks": True, "test_cameras": None, "image_size": SIZE, **settings
            }  # fmt: skip
            return OcMotionDataModule(path, "0013_02", source.body, **settings)
        case "video":
            return VideoDataModule(path.parent, path.name, source.body, **settings)
        case _:
            return ZjuDataModule(path.parent, path.name, source.body, **settings)


KINDS = ("original", "stamped", "refined", "humannerf", "wild", "w2a", "chomp", "video")
MOVED_WORLD = ("wild",)
"""Layouts whose world is the first frame's: what stays the same is what the camera sees."""


@pytest.mark.parametrize("kind", KINDS)
def test_cameras_bodies_pictures_and_masks_come_back(kind, written, source):
    data = opened(kind, written[kind], source)
    data.validate()
    assert data.train_indices == tuple(range(FRAMES))
    rig = make_cameras(CAMERAS, SIZE)
    cameras = range(CAMERAS) if kind in ("original", "stamped", "refined", "chomp") else range(1)
    for index in cameras:
        camera = data.camera(index)
        np.testing.assert_allclose(camera.K.numpy(), rig[index].K, rtol=1e-5)
        if kind not in MOVED_WORLD:
            np.testing.assert_allclose(camera.viewmat.numpy(), rig[index].viewmat, atol=1e-5)
    for frame in data.train_frames():
        k, view = frame.index, frame.camera.viewmat.double().numpy()
        picture, mask = source.picture(k)[..., ::-1], source.mask(k) > 0
        np.testing.assert_array_equal(frame.visible_mask.numpy(), mask)
        np.testing.assert_allclose(frame.rgb.numpy() * 255, picture * mask[..., None], atol=1e-3)
        pose = frame.pose
        vertices, _ = source.body(pose.betas, pose.global_orient, pose.body_pose, pose.transl)
        seen = vertices.double().numpy() @ view[:3, :3].T + view[:3, 3]
        truth = source.vertices(k) @ rig[0].R.T + rig[0].T
        np.testing.assert_allclose(seen, truth, atol=1e-5)
        if kind not in MOVED_WORLD:
            np.testing.assert_allclose(vertices.numpy(), source.vertices(k), atol=1e-5)


@pytest.mark.parametrize("kind", KINDS[1:])
def test_the_first_training_frames_are_the_same(kind, written, source):
    original, data = opened("original", written["original"], source), opened(kind, written[kind], source)
    for step in range(7):
        a, b = original.frame_at(step), data.frame_at(step)
        assert a.index == b.index
        assert torch.equal(a.visible_mask, b.visible_mask) and torch.equal(a.rgb, b.rgb)
        torch.testing.assert_close(a.camera.K, b.camera.K, rtol=1e-5, atol=1e-4)
        torch.testing.assert_close(a.pose.body_pose, b.pose.body_pose, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("kind", ["original", "stamped", "refined"])
def test_held_out_views_of_other_cameras(kind, written, source):
    data = opened(kind, written[kind], source, test_frames=[0, None, 4])
    assert data.test_views == tuple((frame, camera) for camera in (1, 2) for frame in (0, 4))
    for frame, camera in data.test_views:
        view = data.test_frame(frame, camera)
        np.testing.assert_array_equal(view.truth.mask.numpy(), source.mask(frame, camera) > 0)


@pytest.mark.parametrize("kind", ["w2a", "chomp", "video"])
def test_what_real_occluders_hide_is_not_claimed_to_be_known(kind, written, source):
    data = opened(kind, written[kind], source)
    frame = data.train_frame(0)
    assert frame.truth is None and frame.occluded is None
    strip = opened(kind, written[kind], source, occlusion={"kind": "strip", "width": 100, "fraction": 1.0})
    hidden = strip.train_frame(0)
    assert hidden.truth is None and hidden.occluded is None
    assert 0 < hidden.visible_mask.sum() < frame.visible_mask.sum()
    assert hidden.rgb[~hidden.visible_mask].abs().max() == 0


def test_footage_without_occluders_has_its_truth(written, source):
    frame = opened("video", written["video"], source, occluded=False).train_frame(0)
    assert torch.equal(frame.truth.mask, frame.visible_mask) and not frame.occluded.any()


def test_held_out_frames_of_the_one_camera(written, source):
    data = opened("video", written["video"], source, train_frames=[0, 3, 1], test_cameras=[0],
                  test_frames=[3, None, 1])  # fmt: skip
    data.validate()
    assert data.test_views == ((3, 0), (4, 0)) and data.test_frame(4, 0).truth is None


def test_a_camera_that_moves_is_carried_over_to_the_person(source, tmp_path):
    import json

    target = writers.write_w2a(source, tmp_path)
    rows = json.loads((target / "metadata.json").read_text())
    rng = np.random.default_rng(3)
    for frame, row in enumerate(rows.values()):  # each frame in a world of its own
        motion = np.eye(4)
        motion[:3, :3] = cv2.Rodrigues(rng.normal(size=3))[0]
        motion[:3, 3] = rng.normal(size=3)
        _, orient, _, transl = source.smplx(frame)
        pelvis = source.pelvis(np.array(row["betas"]))
        row["cam_extrinsics"] = (np.array(row["cam_extrinsics"]) @ np.linalg.inv(motion)).tolist()
        turned = motion[:3, :3] @ cv2.Rodrigues(orient)[0]
        row["poses"][:3] = cv2.Rodrigues(turned)[0].reshape(3).tolist()
        row["trans"] = (motion[:3, :3] @ (pelvis + transl) + motion[:3, 3] - pelvis).tolist()
    (target / "metadata.json").write_text(json.dumps(rows))
    data = opened("w2a", target, source)
    data.validate()
    camera = make_cameras(1, SIZE)[0]
    for frame in data.train_frames():
        pose, view = frame.pose, frame.camera.viewmat.double().numpy()
        vertices, _ = source.body(pose.betas, pose.global_orient, pose.body_pose, pose.transl)
        seen = vertices.double().numpy() @ view[:3, :3].T + view[:3, 3]
        np.testing.assert_allclose(seen, source.vertices(frame.index) @ camera.R.T + camera.T, atol=2e-5)


def test_layouts_are_told_apart(written):
    names = {"original": "original", "stamped": "original", "refined": "refined", "humannerf": "humannerf",
             "wild": "humannerf", "w2a": "w2a", "chomp": "chomp", "video": "video"}  # fmt: skip
    assert {kind: find_layout(path) for kind, path in written.items()} == names
    found = {path.name for path in sequences_in(written["video"].parent)}
    assert found == {"CoreView_313", "my_377", "377", "wild", "0013_02_w2a", "raw", "mine"}


def test_a_folder_of_no_layout(tmp_path):
    (tmp_path / "notes").mkdir()
    with pytest.raises(DataError, match=r"no layout.*video: cameras.npz.*The folder has nothing"):
        find_layout(tmp_path / "notes")


@pytest.mark.parametrize(
    ("kind", "other", "words"),
    [
        ("w2a", ZjuDataModule, "layout 'w2a', which dataset=ocmotion reads; this data set reads refined"),
        ("video", ZjuDataModule, "layout 'video', which dataset=video reads"),
        ("refined", VideoDataModule, "layout 'refined', which dataset=zju reads"),
        (
            "humannerf",
            OcMotionDataModule,
            "layout 'humannerf', which dataset=zju reads; this data set reads w2a",
        ),
        ("chomp", VideoDataModule, "layout 'chomp', which dataset=ocmotion reads"),
    ],
)
def test_the_data_set_that_reads_a_layout_is_named(kind, other, words, written, source):
    with pytest.raises(DataError, match=words):
        other(written[kind].parent, written[kind].name, source.body).setup()


def test_the_wanted_person_of_several(written, source):
    by_id = opened("chomp", written["chomp"], source)
    assert not by_id.train_frame(0).visible_mask[:2, :2].any()
    everyone = opened("chomp", written["chomp"], source, numbered_masks=False)
    assert everyone.train_frame(0).visible_mask[:2, :2].all()
    everyone.validate()
    assert any("the people 7 are annotated beside person 1" in finding for finding in everyone.findings)
    by_id.validate()
    assert not by_id.findings
    assert opened("chomp", written["chomp"], source, person=7).train_indices == (0,)
    with pytest.raises(ConfigError, match=r"dataset.person=4: the sequence has the people 1, 7"):
        opened("chomp", written["chomp"], source, person=4).validate()
    with pytest.raises(
        ConfigError, match=r"dataset.scene='0099': the annotations in .*annot have 0001_01, 0013_02"
    ):
        OcMotionDataModule(written["chomp"], "0099", source.body).validate()


@pytest.mark.parametrize("kind", ["w2a", "video"])
def test_how_much_is_hidden_is_estimated_from_the_body(kind, source, tmp_path):
    path = (
        writers.write_w2a(source, tmp_path) if kind == "w2a" else writers.write_video(source, tmp_path / "v")
    )
    clear = opened(kind, path, source).summary()
    assert clear["visible_share_is"] == "estimated" and clear["occluded_frames"] == 0, clear
    mask = sorted((path / "masks").iterdir())[2]
    stored = cv2.imread(str(mask))
    stored[SIZE // 2 :] = 0
    cv2.imwrite(str(mask), stored)
    hidden = opened(kind, path, source)
    hidden.validate()
    shares = list(hidden.summary()["visible_share"].values())
    assert hidden.summary()["occluded_frames"] == 1 and shares[2] < 0.75 < 0.9 < min(shares[:2] + shares[3:])


def test_masks_that_cannot_mean_a_person_are_reported(source, tmp_path):
    path = writers.write_video(source, tmp_path / "v")
    for mask in (path / "masks").iterdir():
        cv2.imwrite(str(mask), 255 - cv2.imread(str(mask)))
    data = opened("video", path, source)
    with pytest.raises(DataError, match="misses the person's mask"):
        data.validate()
    for number, mask in enumerate(sorted((path / "masks").iterdir())):
        picture = source.mask(number) * np.uint8(255)
        cv2.imwrite(str(mask), np.full_like(picture, 255) if number == 1 else picture)
    data = opened("video", path, source)
    data.validate()
    assert any(
        "more than 90% of the picture in 1 frames, first 1; is it inverted" in f for f in data.findings
    )


@pytest.mark.parametrize("width", [72, 156])
def test_poses_under_the_names_of_aist_and_amass(width, source, tmp_path):
    path = writers.write_video(source, tmp_path / "v")
    wanted = opened("video", path, source)
    with np.load(path / "poses.npz") as archive:
        values = dict(archive)
    poses = np.zeros((FRAMES, width))
    poses[:, :3], poses[:, 3:66] = values["global_orient"], values["body_pose"][:, :63]
    if width == 72:
        poses[:, 66:] = values["body_pose"][:, 63:]
    np.savez(path / "poses.npz", poses=poses, trans=values["transl"], betas=values["betas"][0])
    data = opened("video", path, source)
    data.validate()
    for frame in range(FRAMES):
        a, b = wanted.pose(frame), data.pose(frame)
        assert torch.equal(a.global_orient, b.global_orient) and torch.equal(a.transl, b.transl)
        same = 69 if width == 72 else 63
        assert torch.equal(a.body_pose[:same], b.body_pose[:same]) and torch.equal(a.betas, b.betas)
    np.savez(path / "poses.npz", poses=poses[:, :50], trans=values["transl"], betas=values["betas"])
    with pytest.raises(DataError, match=r"poses has shape \(5, 50\)"):
        opened("video", path, source).validate()
