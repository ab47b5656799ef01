"""PeopleSnapshot and NeuMan as InstantAvatar's scripts write them."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from hydra import compose, initialize_config_dir

from data import layout_writers
from data.layout_writers import Source
from occfusion.data.video.pose_tracks import open_tracks
from occfusion.data.video.video_data import VideoDataModule
from occfusion.data.video.video_protocols import INSTANT_AVATAR
from occfusion.errors import ConfigError, DataError
from occfusion.run.prepare import make_data
from occfusion.settings.schema import load_settings
from occfusion.synth import SceneSpec, write_scene
from upstream.instantavatar import (
    FRESH,
    romp_camera,
    smplx_rows,
    write_neuman,
    write_peoplesnapshot,
    write_track,
)

SIZE, FRAMES = 64, 18
NEAR = 1e-5
"""A hundredth of a millimetre."""


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Source:
    spec = SceneSpec(1, "clean", image_size=SIZE, frames=FRAMES, cameras=1)
    return Source(write_scene(tmp_path_factory.mktemp("embedded"), spec, progress=False))


def opened(folder: Path, source: Source, **settings) -> VideoDataModule:
    return VideoDataModule(folder.parent, folder.name, source.body, **settings)


def whole_number_projection(source: Source, vertices: np.ndarray) -> np.ndarray:
    """Upstream's: a point seen through K at (x, y) falls on the pixel whose numbers are x and y."""
    seen = vertices @ source.extrinsics(0)[:3, :3].T + source.extrinsics(0)[:3, 3]
    pixels = seen @ source.cams["K"][0].T
    return pixels[:, :2] / pixels[:, 2:]


def require_same(data: VideoDataModule, source: Source, pictures: list[int]) -> None:
    """Checks vertices, projection and masks of each training frame against the scene itself."""
    frames = list(data.train_frames())
    assert len(frames) == len(pictures)
    for frame, picture in zip(frames, pictures, strict=True):
        pose, camera = frame.pose, frame.camera
        vertices = (
            source.body(pose.betas, pose.global_orient, pose.body_pose, pose.transl)[0].double().numpy()
        )
        assert np.abs(vertices - source.vertices(picture)).max() < NEAR
        view = camera.viewmat.double().numpy()
        seen = (vertices @ view[:3, :3].T + view[:3, 3]) @ camera.K.double().numpy().T
        theirs = whole_number_projection(source, source.vertices(picture))
        # the middle of the first pixel is 0 for them and 0.5 for us
        np.testing.assert_allclose(seen[:, :2] / seen[:, 2:], theirs + 0.5, atol=2e-3)
        np.testing.assert_array_equal(frame.visible_mask.numpy(), source.mask(picture) > 0)


def test_peoplesnapshot_before_its_poses_are_refined(source, tmp_path):
    data = opened(write_peoplesnapshot(source, tmp_path / "someone"), source)
    data.validate()
    require_same(data, source, list(range(FRAMES)))
    taken = data.taken
    assert taken.layout == "video, as InstantAvatar's scripts write it"
    assert "thetas" in taken.body and "one row a picture" in taken.body
    assert "first pixel is 0" in taken.centres and "masks are arrays" in taken.centres
    assert taken.masks.startswith("masks/, .npy files") and taken.others == ""
    assert taken.shape == "betas of poses.npz, 10, one for all"


def test_a_refined_track_is_read_first_and_its_pictures_are_found_out(source, tmp_path):
    folder = write_peoplesnapshot(source, tmp_path / "someone", exact=False)
    write_track(source, folder, "anim_nerf_train", 0, FRAMES - 1, 2)
    write_track(source, folder, "anim_nerf_val", 3, 3, 4)
    data = opened(folder, source)
    data.validate()
    require_same(data, source, list(range(0, FRAMES, 2)))
    taken = data.taken
    assert "9 rows for the pictures [0, 17, 2], known by nearness to poses.npz" in taken.body
    assert taken.pictures == "images/, 9 of 18; 9 dropped because no pose track covers them"
    assert "poses.npz (dataset.poses=poses.npz reads it)" in taken.others
    assert "poses/anim_nerf_val.npz" in taken.others
    first = opened(folder, source, poses="poses.npz")
    assert len(first.train_indices) == FRAMES
    far = np.abs(first.pose(0).transl.numpy() - data.pose(0).transl.numpy())
    np.testing.assert_allclose(far, [FRESH, 0, 0], atol=1e-6)


def test_a_held_out_track_follows_the_training_track_when_its_pictures_are_known(source, tmp_path):
    folder = write_peoplesnapshot(source, tmp_path / "someone", exact=False)
    write_track(source, folder, "anim_nerf_train", 0, 15, 2)
    write_track(source, folder, "anim_nerf_test", 16, 17, 1)
    alone = opened(folder, source)
    assert len(alone.train_indices) == 8 and "anim_nerf_test.npz, because" in alone.taken.others
    both = opened(
        folder, source, track_frames=[[0, 16, 2], [16, 18, 1]], test_cameras=[0], test_frames=[8, None, 1]
    )
    require_same(both, source, [*range(0, 16, 2), 16, 17])
    assert both.test_views == ((8, 0), (9, 0))


def test_a_track_that_could_lie_anywhere_is_asked_about(source, tmp_path):
    folder = write_peoplesnapshot(source, tmp_path / "someone")
    write_track(source, folder, "train", 0, FRAMES - 1, 2)
    (folder / "poses.npz").unlink()
    with pytest.raises(
        DataError, match=r"9 rows for 18 pictures.*dataset.track_frames=.*\[0,17,2\], \[0,9,1\]"
    ):
        opened(folder, source).setup()
    given = opened(folder, source, track_frames=[0, None, 2])
    require_same(given, source, list(range(0, FRAMES, 2)))
    assert "known by dataset.track_frames" in given.taken.body
    for wrong, words in (
        ([0, None, 3], "6 of the 18 pictures .* has 9 rows"),
        ([0, 1], "whole numbers"),
        (3, "give"),
    ):
        with pytest.raises(ConfigError, match=rf"dataset.track_frames.*{words}"):
            opened(folder, source, track_frames=wrong).setup()


def test_a_track_shifted_from_the_first_picture_is_asked_about(source, tmp_path):
    folder = write_peoplesnapshot(source, tmp_path / "someone")
    write_track(source, folder, "train", 5, 14, 1)
    with pytest.raises(DataError, match=r"10 rows for 18 pictures, and which ones cannot be told"):
        opened(folder, source).setup()


def test_other_pose_files_by_name(source, tmp_path):
    folder = write_peoplesnapshot(source, tmp_path / "someone")
    with pytest.raises(ConfigError, match=r"dataset.poses='fine.npz': .* has no such file; it has poses.npz"):
        opened(folder, source, poses="fine.npz").setup()


def test_pictures_after_the_last_mask_are_dropped_and_counted(source, tmp_path):
    data = opened(write_peoplesnapshot(source, tmp_path / "someone", extra_pictures=2), source)
    require_same(data, source, list(range(FRAMES)))
    assert data.taken.pictures == "images/, 18 of 20; 2 dropped for want of a mask"


@pytest.mark.parametrize("subject", ["male-3-casual", "male-4-casual", "female-3-casual", "female-4-casual"])
def test_the_tracks_of_the_four_subjects(subject, source, tmp_path):
    """114 training rows of male-3-casual, one for validation and 55 held out, as its author counts them."""
    folder, ranges = tmp_path / subject, INSTANT_AVATAR[subject]
    counts = {"male-3-casual": (114, 55), "male-4-casual": (110, 36), "female-3-casual": (112, 51),
              "female-4-casual": (84, 48)}  # fmt: skip
    assert (len(ranges.train), len(ranges.test)) == counts[subject]
    rows = {
        key: np.resize(value, (900, *value.shape[1:]))
        for key, value in smplx_rows(source).items()
        if key != "betas"
    }
    (folder / "poses").mkdir(parents=True)
    for split, pictures in {"train": ranges.train, "val": ranges.test[:1], "test": ranges.test}.items():
        np.savez(
            folder / "poses" / f"anim_nerf_{split}.npz", betas=np.zeros((1, 10), np.float32),
            **{key: value[list(pictures)] for key, value in rows.items()},
        )  # fmt: skip
    count = ranges.test.stop + 3
    tracks = open_tracks(folder, count)
    assert [track.pictures for track in tracks.read] == [ranges.train, ranges.test]
    assert all("settings for" in track.known_by for track in tracks.read)
    shifted = {key: np.concatenate([value[5:count], value[:5]]) for key, value in rows.items()}
    noise = np.random.default_rng(0).normal(0, 1.0, (count, 69))
    shifted["body_pose"] = (noise + np.arange(count)[:, None]).astype(
        np.float32
    )  # every picture a pose of its own
    track = {key: value[7 : 7 + len(ranges.train)] for key, value in shifted.items()}
    np.savez(folder / "poses.npz", betas=np.zeros(10), **shifted)
    np.savez(folder / "poses" / "anim_nerf_train.npz", betas=np.zeros((1, 10)), **track)
    with pytest.raises(DataError, match="nearer to those of other pictures"):
        open_tracks(folder, count)


def test_the_protocol_trains_and_holds_out_by_the_name_of_the_subject(source, tmp_path, monkeypatch):
    from occfusion.data.video import video_protocols

    small = video_protocols.Ranges(range(0, 12, 2), range(12, 18, 3))
    monkeypatch.setitem(INSTANT_AVATAR, "male-3-casual", small)
    folder = write_peoplesnapshot(source, tmp_path / "male-3-casual", exact=False)
    every = opened(folder, source, protocol="instantavatar")
    assert every.train_indices == tuple(range(0, 12, 2)) and every.test_views == ((12, 0), (15, 0))
    write_track(source, folder, "anim_nerf_train", 0, 11, 2)
    write_track(source, folder, "anim_nerf_test", 12, 17, 3)
    data = opened(folder, source, protocol="instantavatar")
    data.validate()
    require_same(data, source, list(range(0, 12, 2)))
    assert data.train_indices == tuple(range(6)) and data.test_views == ((6, 0), (7, 0))
    by_hand = opened(folder, source, protocol="instantavatar", test_cameras=[])
    assert by_hand.test_views == ()
    (folder / "poses" / "anim_nerf_test.npz").unlink()
    with pytest.raises(ConfigError, match=r"pictures 12 to 15 are not among the 6 of .* dataset.test_frames"):
        opened(folder, source, protocol="instantavatar").setup()
    with pytest.raises(ConfigError, match=r"dataset.protocol=instantavatar: says nothing of 'someone'"):
        VideoDataModule(tmp_path, "someone", source.body, protocol="instantavatar")
    with pytest.raises(ConfigError, match=r"dataset.protocol='paper': choose instantavatar"):
        VideoDataModule(tmp_path, "someone", source.body, protocol="paper")


def test_neuman_is_read_from_the_optimized_poses(source, tmp_path):
    data = opened(write_neuman(source, tmp_path / "lab"), source)
    data.validate()
    require_same(data, source, list(range(FRAMES)))
    taken = data.taken
    assert taken.body.startswith("poses_optimized.npz (smplx's names)")
    assert "poses.npz (dataset.poses=poses.npz reads it)" in taken.others
    assert "masks_sam/ (dataset.masks=masks_sam reads it)" in taken.others
    assert "first pixel is 0 (InstantAvatar's: poses_optimized.npz" in taken.centres


def test_a_fit_with_an_avatar_goes_before_the_optimized_poses(source, tmp_path):
    folder = write_neuman(source, tmp_path / "seattle", optimized=False)
    shutil.copy(folder / "poses.npz", folder / "poses_optimized.npz")
    write_track(source, folder, "train", 0, 41, 1)
    data = opened(folder, source)
    require_same(data, source, list(range(FRAMES)))
    assert data.taken.body.startswith("poses/train.npz")


def test_the_first_estimate_alone_still_reads_and_its_camera_is_known(source, tmp_path):
    folder = write_neuman(source, tmp_path / "mine", optimized=False, camera=romp_camera(SIZE, SIZE))
    data = opened(folder, source)
    data.setup()
    assert data.taken.body.startswith("poses.npz")
    assert "the camera is the one that ROMP assumes" in data.taken.centres
    np.testing.assert_allclose(data.camera(0).K[:2, 2], [SIZE / 2 + 0.5] * 2)


def test_a_camera_that_another_script_has_written_over_is_reported(source, tmp_path):
    folder = write_peoplesnapshot(source, tmp_path / "someone")
    np.savez(folder / "cameras.npz", **romp_camera(SIZE, SIZE))
    write_track(source, folder, "anim_nerf_train", 0, FRAMES - 1, 1)
    data = opened(folder, source)
    data.setup()
    assert "written over it" in data._open()[0].scene.remarks[0]


@pytest.mark.parametrize(("asked", "shift"), [("auto", 0.0), (0.5, 0.0), (0, 0.5), (0.0, 0.5)])
def test_pixel_centres_of_other_footage(asked, shift, source, tmp_path):
    folder = layout_writers.write_video(source, tmp_path / "mine")
    with np.load(folder / "cameras.npz") as archive:
        stored = archive["intrinsic"]
    data = opened(folder, source, pixel_centres=asked)
    np.testing.assert_allclose(data.camera(0).K.numpy()[:2, 2], stored[:2, 2] + shift, rtol=1e-6)
    assert (
        "no mark of InstantAvatar's" if asked == "auto" else "dataset.pixel_centres"
    ) in data.taken.centres


def test_pixel_centres_are_said_by_the_file_itself(source, tmp_path):
    folder = write_neuman(source, tmp_path / "mine")
    with np.load(folder / "cameras.npz") as archive:
        values = dict(archive)
    np.savez(folder / "cameras.npz", **values, pixel_centres=0.5)
    data = opened(folder, source)
    np.testing.assert_allclose(data.camera(0).K.numpy()[:2, 2], values["intrinsic"][:2, 2], rtol=1e-6)
    assert "cameras.npz says so" in data.taken.centres
    np.savez(folder / "cameras.npz", **values, pixel_centres=1.0)
    with pytest.raises(DataError, match=r"cameras.npz, pixel_centres is 1; it must be 0 or 0.5"):
        opened(folder, source).setup()
    with pytest.raises(ConfigError, match=r"dataset.pixel_centres='half': choose auto, 0 or 0.5"):
        opened(folder, source, pixel_centres="half").setup()


def test_masks_as_arrays_of_every_kind(source, tmp_path):
    folder = write_peoplesnapshot(source, tmp_path / "someone")
    path, mask = folder / "masks" / "mask_0002.npy", source.mask(2)
    for stored in (mask.astype(bool), mask.astype(np.float32), mask[..., None], mask.astype(np.int64) * 255,
                   np.asfortranarray(mask), mask.astype(np.float64) * 0.9 + (mask - 0.0) * 0.1):  # fmt: skip
        np.save(path, stored)
        np.testing.assert_array_equal(opened(folder, source).train_frame(2).visible_mask.numpy(), mask > 0)
    for stored, words in (
        (np.array({"a": 1}, dtype=object), "a mask is"),
        (np.zeros((SIZE, SIZE, 3)), "a mask is"),
        (mask - 2.0, "no values below 0"),
        (mask * np.nan, "no values below 0"),
        (mask * 7.5, "share of the person"),
        (np.ones((SIZE, SIZE // 2), np.uint8), f"{SIZE // 2} x {SIZE} pixels"),
    ):
        np.save(path, stored, allow_pickle=True)
        with pytest.raises(DataError, match=words):
            opened(folder, source).validate()
    path.write_bytes(b"\x93NUMPY\x01\x00")
    with pytest.raises(DataError, match=r"mask_0002.npy: not a NumPy file"):
        opened(folder, source).validate()


def test_arrays_may_number_people(source, tmp_path):
    folder = write_peoplesnapshot(source, tmp_path / "someone")
    for frame in range(FRAMES):
        numbers = source.mask(frame) * np.uint8(4)
        numbers[:2, :2] = 9
        np.save(folder / "masks" / f"mask_{frame:04d}.npy", numbers)
    data = opened(folder, source, person=4)
    require_same(data, source, list(range(FRAMES)))
    assert "value 4 (dataset.person)" in data.taken.masks


def test_a_picture_beside_its_array_changes_nothing(source, tmp_path):
    folder = write_peoplesnapshot(source, tmp_path / "someone")
    for frame in range(FRAMES):
        cv2.imwrite(str(folder / "masks" / f"mask_{frame:04d}.png"), source.mask(frame) * 255)
    require_same(opened(folder, source), source, list(range(FRAMES)))


def test_forms_that_others_must_convert_first(source, tmp_path):
    neuman = tmp_path / "bike"
    for name in ("images", "segmentations", "sparse"):
        (neuman / name).mkdir(parents=True)
    np.save(neuman / "alignments.npy", {"00000.png": np.zeros((4, 3))}, allow_pickle=True)
    with pytest.raises(DataError, match=r"NeuMan's own form.*process-sequence.sh"):
        opened(neuman, source).setup()
    raw = tmp_path / "female-1-casual"
    raw.mkdir()
    for name in ("camera.pkl", "masks.hdf5", "reconstructed_poses.hdf5"):
        (raw / name).write_bytes(b"")
    with pytest.raises(DataError, match=r"PeopleSnapshot as released.*preprocess_PeopleSnapshot.py"):
        opened(raw, source).setup()


def test_all_of_it_can_be_asked_for_on_the_command_line(source, tmp_path):
    folder = write_peoplesnapshot(source, tmp_path / "someone")
    write_track(source, folder, "train", 2, 17, 3)
    asked = (
        "track_frames=[2,18,3]",
        "betas=[0.5,-0.25]",
        "pixel_centres=0.5",
        "poses=poses/train.npz",
        "protocol=null",
    )
    with initialize_config_dir(str(Path(__file__).parents[2] / "conf"), version_base="1.3"):
        config = compose(
            "config",
            [
                "dataset=video",
                f"dataset.root={tmp_path}",
                "dataset.scene=someone",
                *(f"dataset.{key}" for key in asked),
            ],
        )
    data = make_data(load_settings(config), source.body)
    assert isinstance(data, VideoDataModule)
    assert data.train_indices == tuple(range(6)) and data.pose(0).betas.tolist() == [0.5, -0.25]
    assert data.taken.centres == "the middle of the first pixel is 0.5 (dataset.pixel_centres)"
