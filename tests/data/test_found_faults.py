"""What once trained on without a word, or ended in a traceback: refused or said before any work."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from data.test_zju import module
from data.tiny_scene import TinyScene, write_tiny_scene
from occfusion.errors import DataError
from occfusion.files import images


@pytest.fixture
def scene(tmp_path: Path) -> TinyScene:
    return write_tiny_scene(tmp_path)


def test_a_mask_of_another_size_in_the_training_camera(scene: TinyScene) -> None:
    cv2.imwrite(str(scene.mask(3)), np.ones((30, 40), np.uint8))
    with pytest.raises(
        DataError, match=r"000003\.png: 40 x 30 pixels, but its picture 000003\.png has 64 x 64"
    ):
        module(scene, occlusion="strip").validate()


@pytest.mark.parametrize("key", ["poses", "Rh"])
def test_joints_turned_by_a_million_radians(scene: TinyScene, key: str) -> None:
    wild = {**scene.parameters[2], key: scene.parameters[2][key] + 1e6}
    scene.save_parameters(2, wild)
    with pytest.raises(DataError, match=r"frame 2: a joint is turned by 1e\+06.* radians"):
        module(scene).validate()


def test_held_out_views_that_are_trained_on_are_not_measured(scene: TinyScene) -> None:
    both = module(scene, train_camera=0, test_cameras=[0, 1], test_frames=[0, 6, 2])
    both.validate()
    assert both.test_views == ((0, 1), (2, 1), (4, 1))
    assert any("3 of 6 held-out views are trained on" in finding for finding in both.findings)
    # other moments of the training camera are held out, and so is what is asked for alone
    later = module(scene, test_cameras=[0], train_frames=[0, 4, 1], test_frames=[4, 6, 1])
    assert later.test_views == ((4, 0), (5, 0))
    alone = module(scene, test_cameras=[0], test_frames=[0, 6, 2])
    alone.validate()
    assert alone.test_views == ((0, 0), (2, 0), (4, 0)) and not alone.findings


def test_held_out_masks_that_show_nobody_are_said(scene: TinyScene) -> None:
    for camera in (1, 2):
        for frame in range(6):
            cv2.imwrite(str(scene.mask(frame, camera)), np.zeros((64, 64), np.uint8))
    data = module(scene)
    data.validate()
    assert any("no mask of the 2 held-out cameras shows a person" in finding for finding in data.findings)


@pytest.mark.parametrize("keys", [("R",), ("R", "T")])
@pytest.mark.parametrize("tested", [[1], [2]])
def test_exchanged_cameras_are_refused(scene: TinyScene, keys: tuple[str, ...], tested: list[int]) -> None:
    """Also where the run does not read the other one: the training camera is wrong all the same.

    The places of this scene's cameras differ too little for the sentence to be sure of what was exchanged.
    """
    annots = scene.annots()
    for key in keys:
        values = annots["cams"][key]
        values[0], values[1] = values[1], values[0]
    scene.save_annots(annots)
    with pytest.raises(DataError, match="of cameras Camera_B1 and Camera_B2 are exchanged: as they are"):
        module(scene, test_cameras=tested, test_frames=[0, 6, 1]).validate()


def test_a_camera_that_is_wrong_by_itself_is_said_and_not_called_exchanged(scene: TinyScene) -> None:
    annots = scene.annots()
    annots["cams"]["R"][1] = cv2.Rodrigues(np.array([0.0, 0.0, 1.2]))[0] @ annots["cams"]["R"][1]
    scene.save_annots(annots)
    turned = module(scene, test_frames=[0, 6, 1])
    turned.validate()
    assert any("overlap badly" in finding and "Camera_B2" in finding for finding in turned.findings)


def test_poses_in_reverse_order_are_refused(scene: TinyScene) -> None:
    moved = []
    for frame, values in enumerate(scene.parameters):  # as if the person walked through the picture
        pixels = 10 * frame - 25
        mask = cv2.imread(str(scene.mask(frame)), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(scene.mask(frame)), np.roll(mask, pixels, axis=1))
        moved.append({**values, "Th": values["Th"] + np.array([[3.0 * pixels / scene.K[0, 0], 0.0, 0.0]])})
        scene.save_parameters(frame, moved[-1])
    walking = module(scene, test_cameras=[0], test_frames=[0, 6, 1])
    walking.validate()
    assert not walking.findings
    for frame, values in enumerate(reversed(moved)):
        scene.save_parameters(frame, values)
    with pytest.raises(DataError, match=r"misses the person's mask in camera Camera_B1: \d% of the mask"):
        module(scene, test_cameras=[0], test_frames=[0, 6, 1]).validate()


def test_300_shape_components(scene: TinyScene) -> None:
    """Zeros behind those of the body are left out; others are refused with the name of their file."""
    more = np.concatenate([scene.parameters[2]["shapes"], np.zeros((1, 290))], axis=1)
    scene.save_parameters(2, {**scene.parameters[2], "shapes": more})
    module(scene).validate()
    more[0, 200] = 0.1
    scene.save_parameters(2, {**scene.parameters[2], "shapes": more})
    with pytest.raises(DataError, match=r"frame 2 \(.*2\.npy\), betas: 300 shape components"):
        module(scene).validate()


def test_a_held_out_picture_that_is_cut_short_is_found_before_anything_is_decoded(
    scene: TinyScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of PNG and of JPEG files, small and large ones: their beginnings are sound, their ends are not."""
    whole = scene.picture(4, 2).read_bytes()
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3)).astype(np.uint8)
    jpeg = cv2.imencode(".jpg", noise, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    assert len(jpeg) > 4096 > 1000, "larger than what is read of its beginning"
    decode = images._decode
    for content in (whole[:-20], whole[: len(whole) // 2], jpeg[:-2], jpeg[:4096]):
        scene.picture(4, 2).write_bytes(content)
        with monkeypatch.context() as patch:

            def undecoded(path: Path, *rest: object, **more: object) -> object:
                assert path != scene.picture(4, 2)
                return decode(path, *rest, **more)  # type: ignore[arg-type]

            patch.setattr(images, "_decode", undecoded)
            with pytest.raises(DataError, match=r"B3/000004\.png: the picture is cut short"):
                module(scene, test_frames=[0, 6, 1]).validate()
    for content in (whole, jpeg, jpeg + bytes(100), jpeg + bytes(5000)):  # some cameras write behind the end
        scene.picture(4, 2).write_bytes(content)
        module(scene, test_frames=[0, 6, 1]).validate()


def test_a_held_out_picture_of_a_form_that_is_refused_is_found_before_training(scene: TinyScene) -> None:
    cv2.imwrite(str(scene.picture(4, 2)), np.zeros((64, 65, 3), np.uint8))
    with pytest.raises(DataError, match="65 x 64 pixels"):
        module(scene, test_frames=[0, 6, 1]).validate()
    scene.picture(4, 2).write_text("garbage")
    with pytest.raises(DataError, match="neither a PNG nor a JPEG"):
        module(scene, test_frames=[0, 6, 1]).validate()
    scene.picture(4, 2).unlink()
    with pytest.raises(DataError, match=r"000004\.png: file not found"):
        module(scene, test_frames=[0, 6, 1]).validate()
