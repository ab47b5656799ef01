"""The initialisation stage: what is written, what is not computed again, and what a broken prior leads to."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from occfusion.data.zju.zju_data import ZjuDataModule
from occfusion.errors import DataError, NumericsError
from occfusion.files.images import read_mask
from occfusion.files.run_folder import RunFolder
from occfusion.human import Body, load_body
from occfusion.observation import frames as frames_module
from occfusion.observation.clothes import measure_thickness
from occfusion.observation.frames import Observation, ObservedFrames, observe_frames
from occfusion.priors.calibration import STILL, Calibration, calibrate
from occfusion.priors.embedded.network_file import save_net
from occfusion.priors.embedded.silhouette_net import SILHOUETTE, load_silhouette_net
from occfusion.priors.masks import MaskPrior
from occfusion.settings.stages import InitSettings
from occfusion.stages import framewise
from occfusion.stages.init import InitStage, frames_to_complete
from occfusion.types import Frame

SCENE = "001-clean"


class CountingPrior(MaskPrior):
    """Answers with one value, and counts how often it was asked."""

    name = "counting"

    def __init__(self, value: float = 0.5) -> None:
        self.value, self.asked = value, 0

    def describe(self) -> dict[str, Any]:
        return {"prior": self.name, "value": self.value}

    def probability(self, observation: Observation) -> np.ndarray:
        self.asked += 1
        return np.full(observation.visible.shape, self.value, np.float32)


@pytest.fixture(scope="module")
def body(scene_root: Path) -> Body:
    return load_body(scene_root / SCENE / "body.npz")


@pytest.fixture(scope="module")
def data(scene_root: Path, body: Body) -> ZjuDataModule:
    return ZjuDataModule(scene_root, SCENE, body, image_size=96, occlusion={"kind": "strip", "share": 0.5})


@pytest.fixture(scope="module")
def observed_frames(data: ZjuDataModule, body: Body) -> ObservedFrames:
    return observe_frames(lambda k: data.train_frame(k, truth=False), data.train_indices, body)


Make = Callable[..., InitStage]


@pytest.fixture
def make(data: ZjuDataModule, body: Body, observed_frames: ObservedFrames, tmp_path: Path) -> Make:
    def stage(prior: MaskPrior, **settings: Any) -> InitStage:
        def read(k: int) -> Frame:
            return data.train_frame(k, truth=False)

        return InitStage(
            prior,
            body,
            observed_frames,
            read,
            InitSettings(**settings),
            RunFolder(tmp_path).masks,
            {"data": "x"},
        )

    return stage


def run(stage: InitStage, data: ZjuDataModule) -> None:
    for position in stage.wanted:
        stage.predict_step(data.train_frame(position, truth=False), 0)
        stage.on_predict_batch_end()


def test_occluded_frames_are_completed_and_the_others_passed_through(
    make: Make, data: ZjuDataModule, observed_frames: ObservedFrames
) -> None:
    prior = CountingPrior(0.9)
    stage = make(prior, smoothing=0.0)
    run(stage, data)
    occluded = [observed_frame.evidence.occluded for observed_frame in observed_frames]
    assert any(occluded)
    assert not all(occluded)
    assert prior.asked == sum(occluded)
    for position, observed_frame in enumerate(observed_frames):
        frame = data.train_frame(position)
        mask = read_mask(stage.folder.picture(observed_frame.index))
        visible = frame.visible_mask.numpy()
        assert not (visible & ~mask).any()
        assert not (mask & observed_frame.evidence.background).any()
        if not observed_frame.evidence.occluded:
            assert (mask == visible).all()
        uncertainty = stage.folder.path / "uncertainty" / f"{observed_frame.index:06d}.png"
        assert uncertainty.is_file() is observed_frame.evidence.occluded


@pytest.mark.parametrize("most", [1, 3])
def test_of_many_occluded_frames_some_are_completed_and_no_others_are_asked_for(
    make: Make, data: ZjuDataModule, observed_frames: ObservedFrames, most: int
) -> None:
    occluded = [k for k, observed_frame in enumerate(observed_frames) if observed_frame.evidence.occluded]
    assert len(occluded) > most
    prior = CountingPrior(0.9)
    stage = make(prior, max_frames=most)
    chosen = stage.wanted
    assert len(chosen) == most and set(chosen) <= set(occluded)
    assert most == 1 or {chosen[0], chosen[-1]} == {occluded[0], occluded[-1]}
    run(stage, data)
    assert prior.asked == most  # neighbours that are not completed are no help in smoothing either
    written = {path.name for path in stage.folder.path.glob("*.png")}
    assert written == {stage.folder.picture(observed_frames[k].index).name for k in chosen}
    assert stage.finish() == {"completed": most, "frames": len(observed_frames), "consistency": None}
    whole = make(CountingPrior(0.9), max_frames=len(occluded))
    assert len(whole.wanted) == len(observed_frames)


def test_of_a_long_video_some_frames_are_looked_at_and_others_when_they_are_asked_for(
    data: ZjuDataModule, body: Body, observed_frames: ObservedFrames, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is found of a frame is the same either way; decisions, and masks that suffice, go by some."""
    monkeypatch.setattr(frames_module, "JUDGED", 4)
    looked: list[int] = []

    def read(position: int) -> Frame:
        looked.append(position)
        return data.train_frame(position, truth=False)

    found, count = observe_frames(read, data.train_indices, body), len(observed_frames)
    assert len(found) == count > 8 and looked == found.sample and len(looked) == 4
    assert (looked[0], looked[-1]) == (0, count - 1)
    assert [own.index for own in found.judged] == [data.train_indices[k] for k in looked]
    occluded = sum(own.evidence.occluded for own in found.judged)
    assert occluded > 1
    assert set(frames_to_complete(found, occluded - 1)) < set(found.sample) and len(looked) == 4
    for position, wanted in enumerate(observed_frames):
        own = found[position]
        assert own.index == wanted.index == found.indices[position] and found.positions[own.index] == position
        for name in ("hidden", "background", "maybe_hidden", "hidden_share", "occluded", "outside_share"):
            assert np.array_equal(getattr(own.evidence, name), getattr(wanted.evidence, name)), name
        assert np.array_equal(own.vertices, wanted.vertices)
    assert sorted(looked) == list(range(count)) and found[-1] is found[count - 1]
    # where those do not suffice, all are looked at
    every = [k for k in range(count) if found[k].evidence.occluded]
    again = observe_frames(read, data.train_indices, body)
    assert frames_to_complete(again, len(every) - 1) == frames_to_complete(observed_frames, len(every) - 1)
    assert frames_to_complete(again, None) == list(range(count))


def test_the_strip_of_the_first_frames_is_what_is_found(
    data: ZjuDataModule, observed_frames: ObservedFrames
) -> None:
    shares = [float((~f.visible_mask & f.truth.mask).sum() / f.truth.mask.sum()) for f in data.train_frames()]
    for share, observed_frame in zip(shares, observed_frames, strict=True):
        if share == 0.0:
            assert not observed_frame.evidence.occluded
        if share > 0.15:
            assert observed_frame.evidence.occluded


def test_an_interrupted_run_continues_and_other_settings_begin_anew(make: Make, data: ZjuDataModule) -> None:
    prior = CountingPrior()
    stage = make(prior, smoothing=0.0)
    run(stage, data)
    first = prior.asked
    removed = stage.folder.picture(next(m.index for m in stage.observed_frames if m.evidence.occluded))
    removed.unlink()
    again = make(prior, smoothing=0.0)
    assert len(again.wanted) == 1
    run(again, data)
    assert prior.asked == first + 1
    assert removed.is_file()
    assert make(prior, smoothing=0.0).wanted == []
    assert len(make(prior, smoothing=0.5).wanted) == len(stage.observed_frames)
    assert len(make(CountingPrior(0.4), smoothing=0.0).wanted) == len(stage.observed_frames)


def test_nan_stops_with_the_prior_and_the_frame_named(make: Make, data: ZjuDataModule) -> None:
    stage = make(CountingPrior(float("nan")), smoothing=0.0)
    position = next(k for k, m in enumerate(stage.observed_frames) if m.evidence.occluded)
    frame = data.train_frame(position, truth=False)
    with pytest.raises(NumericsError, match=rf"prior counting, frame {frame.name}.*not finite"):
        stage.predict_step(frame, 0)
    assert not stage.folder.picture(frame.index).exists()


def test_a_body_outside_the_picture_is_named(data: ZjuDataModule, body: Body) -> None:
    frame = data.train_frame(0, truth=False)
    pose = type(frame.pose)(**{**vars(frame.pose), "transl": frame.pose.transl + 100.0})
    with pytest.raises(DataError, match=f"{frame.name}.*outside the picture"):
        observe_frames(lambda _: type(frame)(**{**vars(frame), "pose": pose}), [0], body)


def test_a_frame_with_everything_hidden_is_completed_and_counted(
    data: ZjuDataModule, body: Body, tmp_path: Path
) -> None:
    frame = data.train_frame(0, truth=False)
    nothing = type(frame)(**{**vars(frame), "visible_mask": torch.zeros_like(frame.visible_mask)})
    observed_frames = observe_frames(lambda _: nothing, [0], body)
    stage = InitStage(
        CountingPrior(0.9),
        body,
        observed_frames,
        lambda _: nothing,
        InitSettings(),
        RunFolder(tmp_path).masks,
        {},
    )
    record = stage.predict_step(nothing, 0)
    assert record["status"] == "completed, nothing seen"
    assert record["hidden_share"] > 0.7


def test_manifest_says_with_what(make: Make, data: ZjuDataModule) -> None:
    stage = make(CountingPrior(), smoothing=0.5)
    stage.calibration = Calibration(STILL, np.zeros(6890))
    run(stage, data)
    stage.write_manifest(consistency=stage.consistency())
    content = json.loads(stage.folder.manifest.read_text())
    assert content["identity"]["prior"] == "counting"
    assert content["identity"]["data"] == "x"
    assert content["calibration"]["weights"] == [1.0, 0.0, 0.0]
    assert set(content["frames"]) == {f"{m.index:06d}" for m in stage.observed_frames}
    assert 0.0 < content["consistency"] <= 1.0


def test_a_stage_that_was_killed_behind_its_last_mask_tells_its_calibration(
    make: Make, data: ZjuDataModule
) -> None:
    whole = make(CountingPrior(0.5))
    whole.complete(whole.wanted, progress=False)
    whole.finish()
    told = json.loads(whole.folder.manifest.read_text())
    assert told["calibration"] is not None
    again = make(CountingPrior(0.5))
    again.read_again()
    assert not again.wanted
    again.complete([], progress=False)
    again.finish()
    assert json.loads(whole.folder.manifest.read_text()) == told


def test_a_long_video_writes_its_manifest_less_often(
    make: Make, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Written after each frame, the manifest of 2000 frames would cost more than their masks."""
    stage, written = make(CountingPrior()), list[int]()
    monkeypatch.setattr(framewise, "write_json", lambda _, content: written.append(len(content["frames"])))
    monkeypatch.setattr(framewise, "digests", lambda *_: {})
    frames = 2000
    for frame in range(frames):
        stage.records[f"{frame:06d}"] = {}
        stage.on_predict_batch_end()
        assert len(stage.records) - written[-1] < 2 * (
            1 + frame // framewise.WRITTEN_EACH
        )  # lost if it is killed now
    assert written[:100] == list(range(1, 101))
    assert sum(written) <= framewise.WRITTEN_EACH * frames


# -- calibration ----------------------------------------------------------------------------------------------


def test_a_prior_that_knows_nothing_is_calibrated_to_the_body(
    data: ZjuDataModule, body: Body, observed_frames: ObservedFrames
) -> None:
    found = calibrate(CountingPrior(0.5), observed_frames, lambda k: data.train_frame(k, truth=False), body)
    assert found.pixels > 100
    assert found.weights[1] > 0.5
    assert found.after is not None
    assert found.before is not None
    assert found.after > found.before + 0.2


def test_nothing_to_learn_leaves_the_answer_as_it_is(body: Body, data: ZjuDataModule) -> None:
    frame = data.train_frame(0, truth=False)
    nothing = type(frame)(**{**vars(frame), "visible_mask": torch.zeros_like(frame.visible_mask)})
    observed_frames = observe_frames(lambda _: nothing, [0], body)
    found = calibrate(CountingPrior(), observed_frames, lambda _: nothing, body)
    assert found.weights == STILL
    answer = np.random.default_rng(0).random((96, 96)).astype(np.float32)
    assert np.array_equal(found.apply(answer, observed_frames[0], frame.camera, body), answer)


def test_thickness_of_clothes_is_what_stands_off_the_body(data: ZjuDataModule, body: Body) -> None:
    import cv2

    from occfusion.observation.bodyview import view_body

    frames = []
    for position in range(len(data.train_indices)):
        frame = data.train_frame(position, truth=False)
        observed_frame = observe_frames([frame].__getitem__, [0], body)[0]
        camera = frame.camera
        covered = (
            view_body(*vars(observed_frame.projected).values(), body.faces.numpy(), 96, 96).coverage > 0.5
        )
        dressed = cv2.dilate(covered.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
        frames.append(type(frame)(**{**vars(frame), "visible_mask": torch.from_numpy(dressed)}))
    observed_frames = observe_frames(frames.__getitem__, range(len(frames)), body)
    found = measure_thickness(observed_frames, lambda k: frames[k], body, range(len(frames)))
    pixel = float(np.median(observed_frames[0].projected.depths)) / float(camera.K[0, 0])
    assert found.mean() == pytest.approx(pixel, rel=0.25)
    naked = [
        type(f)(**{**vars(f), "visible_mask": torch.from_numpy(m.evidence.background)})
        for f, m in zip(frames, observed_frames, strict=True)
    ]
    for frame, observed_frame in zip(naked, observed_frames, strict=True):
        covered = (
            view_body(*vars(observed_frame.projected).values(), body.faces.numpy(), 96, 96).coverage > 0.5
        )
        frame.visible_mask.copy_(torch.from_numpy(covered))
    bare = measure_thickness(
        observe_frames(naked.__getitem__, range(len(naked)), body),
        lambda k: naked[k],
        body,
        range(len(naked)),
    )
    assert bare.mean() < 0.35 * pixel


# -- weights --------------------------------------------------------------------------------------------------


def test_weights_come_back_and_a_changed_value_is_noticed(tmp_path: Path) -> None:
    net, card = load_silhouette_net()
    path = tmp_path / "w.safetensors"
    save_net(path, net, SILHOUETTE, card["size"], card["widths"], card["depth"], {"data": "test"})
    back, again = load_silhouette_net(path)
    assert again["data"] == "test"
    for a, b in zip(net.parameters(), back.parameters(), strict=True):
        assert torch.equal(a, b)
    content = bytearray(path.read_bytes())
    content[-3] ^= 0x40
    path.write_bytes(content)
    with pytest.raises(DataError, match="hash"):
        load_silhouette_net(path)
    path.write_bytes(bytes(content[: len(content) // 2]))
    with pytest.raises(DataError, match=r"w\.safetensors"):
        load_silhouette_net(path)
    with pytest.raises(DataError, match="no such file"):
        load_silhouette_net(tmp_path / "none.safetensors")
