"""Which picture belongs to which mask, and cameras that are given anew for each frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from occfusion.data.cameras import FixedCamera
from occfusion.data.folder_contents import like, partners, pictures_in, pngs_in, require_same, strays
from occfusion.data.ocmotion.ocmotion_data import PAPER_SEQUENCES, OcMotionDataModule
from occfusion.data.scene import BodyParameters
from occfusion.data.video.video_data import VideoDataModule
from occfusion.errors import ConfigError, DataError
from occfusion.files.naming import natural

K = np.array([[100.0, 0, 32], [0, 100, 32], [0, 0, 1]])


def paths(*names: str) -> dict[str, Path]:
    return {name: Path(f"{name}.png") for name in names}


def test_numbers_in_names_sort_by_value():
    names = ["frame_10", "frame_9", "frame_010", "a", "frame_1b"]
    assert sorted(names, key=natural) == ["a", "frame_1b", "frame_9", "frame_010", "frame_10"]
    assert sorted(reversed(names), key=natural) == sorted(names, key=natural)  # also where values are equal


def test_pictures_of_a_folder(tmp_path):
    for name in ("b_10.png", "b_9.JPG", "notes.txt", "b_11.jpeg"):
        (tmp_path / name).touch()
    assert list(pictures_in(tmp_path)) == ["b_9", "b_10", "b_11"]
    for name in (".b_12.png", "._b_9.JPG"):
        (tmp_path / name).touch()
    assert list(pictures_in(tmp_path)) == ["b_9", "b_10", "b_11"] and list(pngs_in(tmp_path)) == ["b_10"]
    assert strays(tmp_path, pngs_in(tmp_path).values()) == [
        "._b_9.JPG",
        ".b_12.png",
        "b_9.JPG",
        "b_11.jpeg",
        "notes.txt",
    ]
    assert like(["b_9", "c_1", "b_1x"], ["b_0010"]) == ["b_9"]
    (tmp_path / "b_10.png").rename(tmp_path / "b_10.jpg")
    assert list(pngs_in(tmp_path)) == ["b_9", "b_10", "b_11"]
    (tmp_path / "b_9.png").touch()
    assert pictures_in(tmp_path, prefer=".png")["b_9"].name == "b_9.png"
    assert pictures_in(tmp_path, prefer=".jpg")["b_9"].name == "b_9.JPG"
    with pytest.raises(DataError, match=r"b_9\..*there is also b_9"):
        pictures_in(tmp_path)
    with pytest.raises(DataError, match="holds no pictures"):
        pictures_in(Path(__file__).parent)
    with pytest.raises(DataError, match="cannot be read"):
        pictures_in(tmp_path / "absent")


def test_partners_by_name_and_by_number():
    assert partners(["a", "b"], paths("b", "a"), Path("m")) == (Path("a.png"), Path("b.png"))
    found = partners(["image_0001", "image_0002"], paths("mask_1", "mask_2"), Path("m"))
    assert found == (Path("mask_1.png"), Path("mask_2.png"))
    with pytest.raises(DataError, match="nothing for the picture 'x_3'"):
        partners(["x_3"], paths("m_4"), Path("m"))
    assert partners(["x_3"], paths("m_3", "m_4"), Path("m"), more=True) == (Path("m_3.png"),)
    with pytest.raises(DataError, match="'m_4' belongs to no picture"):
        partners(["x_3"], paths("m_3", "m_4"), Path("m"))


def test_sets_of_frames_name_what_is_missing():
    require_same(["a"], "one", ["a"], "two")
    with pytest.raises(DataError, match=r"two: has no 'f_2' and 1 more, which one has \(3 against 1"):
        require_same(["f_10", "f_2", "f_1"], "one", ["f_1"], "two")
    with pytest.raises(DataError, match=r"one: has no 'g', which two has"):
        require_same(["f"], "one", ["f", "g"], "two")


def camera(views, intrinsics=None) -> FixedCamera:
    where = [f"frame {k}" for k in range(len(views))]
    return FixedCamera("c", intrinsics or [K] * len(views), views, None, where, 0.5)


def shifted(x: float) -> np.ndarray:
    view = np.eye(4)
    view[:3, 3] = (x, 0, 3)
    return view


def test_a_camera_that_stands_still_leaves_the_body_alone():
    body = BodyParameters(np.zeros(10), np.zeros(3), np.zeros(69), np.ones(3))
    fixed = camera([shifted(0), shifted(1e-7), shifted(0.5)])
    assert fixed.carry(1, body, np.zeros(3)) is body
    moved = fixed.carry(2, body, np.array([0.0, -0.2, 0.0]))
    np.testing.assert_allclose(moved.transl, [1.5, 1, 1], atol=1e-12)
    np.testing.assert_array_equal(moved.global_orient, body.global_orient)
    np.testing.assert_allclose(fixed.calibration.K[:2, 2], 32.5)


def test_cameras_that_cannot_stand_still_are_refused():
    with pytest.raises(DataError, match="frame 1: the intrinsics differ"):
        camera([shifted(0)] * 2, [K, K * [[1.1], [1.1], [1]]])
    zoomed = FixedCamera(
        "c", [K, K * [[1.1], [1.1], [1]]], [shifted(0)] * 2, None, ["a", "b"], 0.5, may_zoom=True
    )
    assert zoomed.zooms and zoomed.at(0).K[0, 0] == 100 and np.isclose(zoomed.at(1).K[0, 0], 110)
    assert (
        np.isclose(zoomed.at(1).K[0, 2], 35.7) and not zoomed.moves and camera([shifted(0), shifted(1)]).moves
    )
    with pytest.raises(DataError, match=r"frame 0, extrinsics has the last row .* transposed"):
        camera([shifted(1).T])
    with pytest.raises(DataError, match=r"looks like millimetres"):
        camera([shifted(3000)])
    with pytest.raises(DataError, match=r"frame 0, extrinsics has shape"):
        camera([np.eye(3)])
    np.testing.assert_array_equal(camera([shifted(2)[:3]]).calibration.t, [2, 0, 3])


@pytest.mark.parametrize("module", [OcMotionDataModule, VideoDataModule])
def test_root_and_scene_must_be_given(module):
    with pytest.raises(ConfigError, match=r"dataset\.root and dataset\.scene"):
        module(None, None, None)


def test_the_papers_sequences_are_named_where_one_is_missing(tmp_path):
    with pytest.raises(DataError, match=", ".join(PAPER_SEQUENCES)):
        OcMotionDataModule(tmp_path, "0013", None).setup()
    with pytest.raises(ConfigError, match=r"dataset\.layout='zju'"):
        OcMotionDataModule(tmp_path, "0013", None, layout="zju")
    with pytest.raises(ConfigError, match=r"numbered_masks needs dataset\.person"):
        OcMotionDataModule(tmp_path, "0013", None, numbered_masks=True)


def test_a_camera_for_pictures_of_another_size(tmp_path):
    import cv2

    from data.tiny_scene import TinyBody

    for folder in ("images", "masks"):
        (tmp_path / "v" / folder).mkdir(parents=True)
        cv2.imwrite(str(tmp_path / "v" / folder / "0.png"), np.ones((48, 64), np.uint8))
    zeros = {"global_orient": np.zeros((1, 3)), "body_pose": np.zeros((1, 69)), "transl": np.zeros((1, 3))}
    np.savez(tmp_path / "v" / "poses.npz", betas=np.zeros((1, 10)), **zeros)
    np.savez(tmp_path / "v" / "cameras.npz", intrinsic=K, extrinsic=shifted(0), width=128, height=96)
    with pytest.raises(DataError, match=r"calibrated for 128 x 96 pixels, but 0.png has 64 x 48"):
        VideoDataModule(tmp_path, "v", TinyBody(4)).setup()
    np.savez(tmp_path / "v" / "cameras.npz", intrinsic=K, extrinsic=np.zeros((7, 4, 4)))
    with pytest.raises(DataError, match=r"extrinsic has shape \(7, 4, 4\)"):
        VideoDataModule(tmp_path, "v", TinyBody(4)).setup()
