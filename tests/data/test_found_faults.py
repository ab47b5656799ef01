"""What once trained on without a word, or ended in a traceback: refused or said before any work."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from data.test_zju import module
from data.tiny_scene import TinyScene, write_tiny_scene
from occfusion.errors import DataError


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
