"""The reader on a written embedded scene, with the real body: the whole way from disk to pixels."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from occfusion.data.zju.zju_data import ZjuDataModule
from occfusion.human import load_body
from occfusion.synth import SceneSpec, write_scene

SIZE = 128
FINE = 8
"""Outlines are drawn this much larger and then averaged: the share of each pixel that is covered."""


@pytest.fixture(scope="module", params=["none", "boxes"])
def data(request, tmp_path_factory) -> ZjuDataModule:
    spec = SceneSpec(1, "clean", request.param, image_size=SIZE, frames=3, cameras=3)
    folder = write_scene(tmp_path_factory.mktemp("embedded"), spec, progress=False)
    module = ZjuDataModule(folder.parent, spec.name, load_body(folder / "body.npz"), occlusion="none")
    module.validate()
    return module


def posed(data, frame) -> np.ndarray:
    pose = frame.pose
    vertices, _ = data.poser.body(pose.betas, pose.global_orient, pose.body_pose, pose.transl)
    return vertices.numpy()


def outline(data, frame, shift: float) -> np.ndarray:
    """The body's filled outline, moved by `shift` pixels to the right."""
    camera = frame.camera
    seen = posed(data, frame) @ camera.viewmat[:3, :3].numpy().T + camera.viewmat[:3, 3].numpy()
    pixels = seen @ camera.K.numpy().T
    corners = (pixels[:, :2] / pixels[:, 2:] + [shift, 0.0]) * FINE - 0.5  # OpenCV draws with centres at 0
    fine = np.zeros((SIZE * FINE, SIZE * FINE), np.uint8)
    for triangle in np.rint(corners * 16).astype(np.int32)[data.poser.body.faces.numpy()]:
        cv2.fillConvexPoly(fine, triangle, 255, shift=4)
    return cv2.resize(fine, (SIZE, SIZE), interpolation=cv2.INTER_AREA) >= 128


def test_no_doubts(data):
    assert data.findings == []


def test_vertices_are_those_that_the_writer_posed(data):
    folder = data._open()[0].scene.root
    for frame in data.train_frames():
        wanted = np.load(folder / "new_vertices" / f"{frame.index}.npy")
        np.testing.assert_allclose(posed(data, frame), wanted, atol=1e-5)


def test_the_body_lies_in_the_mask_and_is_not_half_a_pixel_off(data):
    frames = [data.train_frame(0), data.test_frame(0, 1), data.test_frame(0, 2)]
    shifts = np.linspace(-0.75, 0.75, 7)
    fits = np.zeros(len(shifts))
    for frame in frames:
        mask = frame.truth.mask.numpy()
        for k, shift in enumerate(shifts):
            body = outline(data, frame, shift)
            fits[k] += (body & mask).sum() / (body | mask).sum() / len(frames)
    assert fits[3] > 0.8  # a naked body in a clothed mask
    # clothes and hair widen the outline to the left and right alike, so the best place is the true one
    best = np.polyfit(shifts, fits, 2)
    assert abs(-best[1] / (2 * best[0])) < 0.2


def test_occluders_hide_part_of_the_truth(data):
    rendered = data.scene_name.endswith("boxes")
    shares = data.summary()["visible_share"].values()
    assert all((share < 0.95) == rendered for share in shares)
    for frame in data.train_frames():
        assert bool(frame.occluded.any()) == rendered
        assert not (frame.visible_mask & frame.occluded).any()
        assert (frame.visible_mask & ~frame.truth.mask).sum() == 0
