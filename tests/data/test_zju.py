"""The ZJU-MoCap DataModule on a hand-made scene: geometry, cut-out, truth, loaders, laziness."""

from __future__ import annotations

import builtins
import io
import shutil

import cv2
import lightning as L
import numpy as np
import pytest
import torch

from data.tiny_scene import write_tiny_scene
from occfusion.data.occlusion import OcclusionSettings
from occfusion.data.zju.zju_data import ZjuDataModule
from oracles.pictures import area_scaled, undistorted


def module(scene, **settings) -> ZjuDataModule:
    settings = {"image_size": 64, "occlusion": "none", **settings}
    return ZjuDataModule(scene.root, scene.name, scene.body, **settings)


def stored_mask(scene, frame, camera=0, folder="mask") -> np.ndarray:
    return cv2.imread(str(scene.mask(frame, camera, folder)), cv2.IMREAD_UNCHANGED) > 0


def stored_picture(scene, frame, camera=0, folder="") -> np.ndarray:
    path = scene.folder / folder / scene.picture(frame, camera).relative_to(scene.folder)
    return cv2.imread(str(path))[..., ::-1]


def same_frame(a, b) -> bool:
    def tensors(frame):
        pose, camera = frame.pose, frame.camera
        yield from (frame.rgb, frame.visible_mask, camera.K, camera.viewmat)
        yield from (pose.betas, pose.global_orient, pose.body_pose, pose.transl)

    return a.name == b.name and all(torch.equal(x, y) for x, y in zip(tensors(a), tensors(b), strict=True))


def test_the_posed_body_projects_into_the_mask(tiny):
    data = module(tiny)
    for frame in (data.train_frame(4), data.test_frame(2, 1)):
        pose, camera = frame.pose, frame.camera
        vertices, _ = tiny.body(pose.betas, pose.global_orient, pose.body_pose, pose.transl)
        # first against EasyMocap's rule as the scene's writer applied it, in metres
        np.testing.assert_allclose(vertices.numpy(), tiny.world[frame.index], atol=1e-5)
        seen = vertices @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        pixels = seen @ camera.K.T
        place = torch.floor(pixels[:, :2] / pixels[:, 2:]).long()
        mask = frame.visible_mask
        assert mask[place[:, 1], place[:, 0]].float().mean() > 0.98
        body = np.zeros(mask.shape, np.uint8)
        body[place[:, 1], place[:, 0]] = 1
        body = cv2.dilate(body, cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))) > 0  # as it was drawn
        assert (body & mask.numpy()).sum() / (body | mask.numpy()).sum() > 0.9


def test_frames_are_the_pictures_cut_out(tiny):
    data = module(tiny, train_camera=1)
    for frame in data.train_frames():
        picture, mask = stored_picture(tiny, frame.index, 1), stored_mask(tiny, frame.index, 1)
        np.testing.assert_array_equal(frame.visible_mask.numpy(), mask)
        np.testing.assert_allclose(frame.rgb.numpy() * 255, picture * mask[..., None], atol=1e-4)
        assert torch.equal(frame.truth.rgb, frame.rgb) and torch.equal(frame.truth.mask, frame.visible_mask)
        assert not frame.occluded.any() and frame.complete_mask is None
        assert frame.name == f"Camera_B2/{frame.index:06d}" and frame.camera_index == 1
        assert (frame.camera.width, frame.camera.height) == (64, 64)


def test_the_camera_centre_is_in_metres(tiny):
    data = module(tiny)
    for camera in range(3):
        wanted = -tiny.R[camera].T @ tiny.T[camera]
        np.testing.assert_allclose(data.camera(camera).centre.numpy(), wanted, atol=1e-5)
        assert 2.8 < np.linalg.norm(wanted) < 3.4


def test_the_strip_hides_the_training_camera_and_keeps_the_truth(tiny):
    data, clean = module(tiny, occlusion="strip"), module(tiny)
    data.validate()
    shares = data.summary()["visible_share"]
    for frame, whole in zip(data.train_frames(), clean.train_frames(), strict=True):
        occluded = frame.occluded
        if frame.index >= 5:  # after 80 % of six frames
            assert not occluded.any() and same_frame(frame, whole)
            continue
        columns = occluded.any(0)
        assert torch.equal(occluded, columns.expand_as(occluded)) and 0 < columns.sum() < 20
        assert torch.equal(frame.truth.rgb, whole.rgb) and torch.equal(frame.truth.mask, whole.visible_mask)
        assert torch.equal(frame.visible_mask, whole.visible_mask & ~occluded)
        assert torch.equal(frame.rgb, whole.rgb * frame.visible_mask[..., None])
        share = frame.visible_mask.sum() / whole.visible_mask.sum()
        assert shares[str(frame.index)] == pytest.approx(float(share), abs=1e-4)
    hidden = [1 - share for share in shares.values()][:5]
    assert abs(np.mean(hidden) - 0.5) < 0.1
    for frame, whole in zip(data.test_dataloader(), clean.test_dataloader(), strict=True):
        assert same_frame(frame, whole) and not frame.occluded.any()


def test_training_frames_are_given_without_the_truth(tiny):
    data = module(tiny, occlusion="strip")
    frame = data.frame_at(0)
    assert frame.truth is None and frame.occluded is None
    assert frame.rgb[~frame.visible_mask].abs().max() == 0


def test_rendered_occluders(tmp_path):
    scene = write_tiny_scene(tmp_path, occluders=True)
    data = module(scene)
    data.validate()
    for frame in data.train_frames():
        visible, whole = stored_mask(scene, frame.index), stored_mask(scene, frame.index, 0, "mask_complete")
        picture = stored_picture(scene, frame.index)
        clean = stored_picture(scene, frame.index, 0, "images_complete")
        np.testing.assert_array_equal(frame.visible_mask.numpy(), visible)
        np.testing.assert_array_equal(frame.truth.mask.numpy(), whole)
        np.testing.assert_array_equal(frame.occluded.numpy(), whole & ~visible)
        np.testing.assert_allclose(frame.rgb.numpy() * 255, picture * visible[..., None], atol=1e-4)
        np.testing.assert_allclose(frame.truth.rgb.numpy() * 255, clean * whole[..., None], atol=1e-4)
        share = data.summary()["visible_share"][str(frame.index)]
        assert share == pytest.approx(visible.sum() / whole.sum(), abs=1e-4)
    held_out = data.test_frame(0, 2)
    np.testing.assert_array_equal(held_out.visible_mask.numpy(), stored_mask(scene, 0, 2, "mask_complete"))
    assert not np.array_equal(stored_mask(scene, 0, 2), stored_mask(scene, 0, 2, "mask_complete"))


def test_distorted_and_scaled_pictures_against_the_oracle(tmp_path):
    distortion = (-0.2, 0.05, 0.002, -0.001, 0.01)
    scene = write_tiny_scene(tmp_path, frames=1, distortion=distortion)
    frame = module(scene, image_size=32).train_frame(0)
    K = scene.K.copy()
    K[:2, 2] += 0.5  # annots.npy counts pixel centres from 0
    mask = stored_mask(scene, 0)
    cut = stored_picture(scene, 0) * mask[..., None].astype(float)
    rgb = area_scaled(undistorted(cut, K, np.array(distortion)), 32, 32)
    coverage = area_scaled(undistorted(mask[..., None] * 255.0, K, np.array(distortion)), 32, 32)[..., 0]
    sure = np.abs(coverage - 128) > 4
    np.testing.assert_array_equal(frame.visible_mask.numpy()[sure], (coverage >= 128)[sure])
    assert np.abs(frame.rgb.numpy() * 255 - rgb * frame.visible_mask.numpy()[..., None]).max() <= 3
    K[:2] /= 2
    np.testing.assert_allclose(frame.camera.K.numpy(), K, rtol=1e-6)
    pose = frame.pose
    vertices, _ = scene.body(pose.betas, pose.global_orient, pose.body_pose, pose.transl)
    seen = vertices @ frame.camera.viewmat[:3, :3].T + frame.camera.viewmat[:3, 3]
    pixels = seen @ frame.camera.K.T
    place = torch.floor(pixels[:, :2] / pixels[:, 2:]).long()
    assert frame.visible_mask[place[:, 1], place[:, 0]].float().mean() > 0.93


def test_new_params_are_preferred_and_params_used_without_them(tmp_path):
    scene = write_tiny_scene(tmp_path, frames=2)
    shutil.copytree(scene.folder / "new_params", scene.folder / "params")
    old = dict(scene.parameters[0], Th=np.array([[9.0, 9.0, 9.0]]))
    scene.save_parameters(0, old, "params")
    moved = module(scene).pose(0).transl
    shutil.rmtree(scene.folder / "new_params")
    assert (module(scene).pose(0).transl - moved).norm() > 10


def test_the_union_of_both_masks(tmp_path):
    scene = write_tiny_scene(tmp_path, frames=1)
    other = np.zeros((64, 64), np.uint8)
    other[:3, :3] = 7
    for camera in range(3):
        path = scene.mask(0, camera, "mask_cihp")
        path.parent.mkdir(parents=True)
        cv2.imwrite(str(path), other)
    both = module(scene, masks="mask+mask_cihp").train_frame(0).visible_mask.numpy()
    np.testing.assert_array_equal(both, stored_mask(scene, 0) | (other > 0))
    np.testing.assert_array_equal(
        module(scene, masks="mask_cihp").train_frame(0).visible_mask.numpy(), other > 0
    )


def test_frames_without_a_person_are_left_out_and_counted(tmp_path):
    scene = write_tiny_scene(tmp_path)
    for frame in (1, 3):
        cv2.imwrite(str(scene.mask(frame)), np.zeros((64, 64), np.uint8))
    cv2.imwrite(str(scene.mask(0, 1)), np.zeros((64, 64), np.uint8))
    data = module(scene)
    data.validate()
    assert data.train_indices == (0, 2, 4, 5) and data.summary()["frames_left_out"] == [1, 3]
    assert any("2 training frames show no person" in finding for finding in data.findings)
    assert [(f.index, f.camera_index) for f in data.test_dataloader()] == [(0, 2)]


def test_a_badly_fitting_body_is_reported(tmp_path):
    scene = write_tiny_scene(tmp_path)
    for frame, values in enumerate(scene.parameters):
        scene.save_parameters(frame, dict(values, Th=values["Th"] + [[0.25, 0.0, 0.0]]))
    data = module(scene)
    data.validate()
    assert any("overlap by only" in finding for finding in data.findings)
    assert data.summary()["findings"] == data.findings


def test_selection(tiny):
    data = module(tiny, train_camera=2, test_cameras=[0], train_frames=[1, None, 2], test_frames=[0, 4, 3])
    assert data.train_indices == (1, 3, 5) and data.test_indices == (0, 3)
    assert data.test_cameras == (0,) and data.train_cameras == (2,)
    assert data.test_views == ((0, 0), (3, 0)) and data.scene_name == "tiny"
    assert [f.index for f in data.train_frames()] == [1, 3, 5]


def test_of_many_training_frames_some_are_taken_evenly(tiny):
    every, some = module(tiny), module(tiny, max_train_frames=3)
    assert some.train_indices == (1, 3, 5)  # the middles of thirds
    assert some.test_indices == every.test_indices
    assert "3 of 6 training frames" in some.taken.pictures and "of 6" not in every.taken.pictures
    assert some.summary()["taken"]["pictures"] == some.taken.pictures
    assert some.summary()["hash"] != every.summary()["hash"]
    assert module(tiny, max_train_frames=6).summary() == every.summary()
    # the occlusion is that of the frames that are trained on
    hidden = module(tiny, max_train_frames=3, occlusion=OcclusionSettings("strip"))
    shares = [frame.occluded.any().item() for frame in hidden.train_frames()]
    assert shares == [True, True, False]


def test_frames_that_no_step_sees_are_not_looked_at(tiny):
    every, some = module(tiny), module(tiny)
    some.most_seen = 3
    assert some.train_indices == (1, 3, 5) and some.sequence == every.train_indices == every.sequence
    assert some.summary()["frames_unseen"] == 3 and every.summary()["frames_unseen"] == 0
    assert "3 of 6 training frames, evenly spread (steps see no more)" in some.taken.pictures
    few = module(tiny, max_train_frames=2)
    few.most_seen = 3
    assert few.summary() == module(tiny, max_train_frames=2).summary()
    assert few.sequence == few.train_indices == (1, 4)


class Probe(L.LightningModule):
    """Takes steps and remembers which frame each saw."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.seen: list[tuple[int, int]] = []

    def training_step(self, frame, _batch_idx):
        self.seen.append((self.global_step, frame.index))
        return (self.weight * frame.rgb.mean()).sum()

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.1)


def fit(data, steps, folder, checkpoint=None) -> tuple[Probe, L.Trainer]:
    probe = Probe()
    trainer = L.Trainer(
        max_steps=steps, max_epochs=-1, accelerator="cpu", logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False, default_root_dir=folder,
    )  # fmt: skip
    trainer.fit(probe, datamodule=data, ckpt_path=checkpoint, weights_only=True)
    return probe, trainer


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("stop", [4, 6, 9])
def test_a_resumed_training_sees_the_frames_of_an_uninterrupted_one(tiny, tmp_path, stop):
    whole, _ = fit(module(tiny, seed=5), 14, tmp_path)
    assert [step for step, _ in whole.seen] == list(range(14))
    data = module(tiny, seed=5)
    assert [frame for _, frame in whole.seen] == [data.frame_at(step).index for step in range(14)]
    first, trainer = fit(module(tiny, seed=5), stop, tmp_path)
    trainer.save_checkpoint(tmp_path / "a.ckpt")
    rest, _ = fit(module(tiny, seed=5), 14, tmp_path, tmp_path / "a.ckpt")
    assert first.seen + rest.seen == whole.seen


def test_only_what_is_used_is_read(tiny, monkeypatch):
    opened: list[str] = []
    true_open = io.open

    def record(file, *args, **kwargs):
        opened.append(str(file))
        return true_open(file, *args, **kwargs)

    monkeypatch.setattr(io, "open", record)
    monkeypatch.setattr(builtins, "open", record)
    data = module(tiny, train_frames=[0, 4, 2], test_cameras=[2])
    data.frame_at(0)
    read = {path for path in opened if str(tiny.folder) in path}
    assert any("annots.npy" in path for path in read)
    assert not any("Camera_B2" in path or "Camera_B3" in path for path in read)
    pictures = {path for path in read if path.endswith(".png") and "mask" not in path}
    assert len(pictures) <= 2  # one decoded, perhaps another one's header
    masks = {path for path in read if "mask" in path}
    assert masks == {str(tiny.mask(0)), str(tiny.mask(2))}


def test_decoded_frames_are_kept_within_the_bound(tiny, monkeypatch):
    import occfusion.data.packing as packing

    decoded: list[str] = []
    true_read = packing.read_rgb
    monkeypatch.setattr(packing, "read_rgb", lambda path: decoded.append(str(path)) or true_read(path))
    kept, fresh = module(tiny), module(tiny)
    kept.setup()
    monkeypatch.setattr("occfusion.data.module.CACHE_BYTES", 0)
    for step in range(18):
        assert same_frame(kept.frame_at(step), fresh.frame_at(step))
    assert len(decoded) == 6 + 18


def test_the_summary_hash_follows_the_data_and_the_settings(tmp_path):
    scene = write_tiny_scene(tmp_path)
    first = module(scene).summary()["hash"]
    assert first == module(scene).summary()["hash"]
    assert first != module(scene, occlusion=OcclusionSettings("strip")).summary()["hash"]
    assert first != module(scene, train_frames=[0, 5, 1]).summary()["hash"]
    # what is only measured on has a hash of its own: mending it does not cost the training
    other = module(scene, train_camera=2, test_cameras=[0], test_frames=[0, 4, 3]).summary()
    mended = module(scene, train_camera=2, test_cameras=[1], test_frames=[0, 4, 2]).summary()
    assert other["hash"] == mended["hash"] and other["held_out_hash"] != mended["held_out_hash"]
    scene.save_parameters(2, dict(scene.parameters[2], Th=np.array([[0.0, 0.0, 0.01]])))
    assert first != module(scene).summary()["hash"]
