"""Protocols of the papers against the numbers in their code, written out here.

tiangexiang/OccFusion@94f3aba7 `scene/dataset_readers.py`; skhu101/GauHuman@72ea9381, the same path;
tiangexiang/OccNeRF@8c4223a6 `configs/occnerf/zju_mocap/*/occnerf.yaml`, `tools/prepare_zju_mocap/*.yaml` and
`core/data/occnerf/train.py`; chungyiweng/humannerf@7389c404 `tools/prepare_zju_mocap/*.yaml`;
mikeqzy/3dgs-avatar-release@1cf79171 `configs/dataset/zjumocap_*_mono.yaml`; taconite/arah-release@e591e31b
`configs/arah-zju/*-mono_4gpus.yaml`; zju3dv/instant-nvr@d72d66f2 `configs/inb/inb_*.yaml`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hydra import compose, initialize_config_dir

from data.tiny_scene import write_tiny_scene
from occfusion.data.occlusion import OcclusionSettings, plan
from occfusion.data.prepare import Selection, held_out_cameras, held_out_range, train_range
from occfusion.data.silhouette import Silhouette
from occfusion.data.zju.zju_data import ZjuDataModule
from occfusion.data.zju.zju_protocols import PRESETS, describe, place_strip, select
from occfusion.errors import ConfigError

CONF = Path(__file__).parents[2] / "conf"
FRAMES = {
    "313": 1470,
    "315": 2185,
    "377": 617,
    "386": 646,
    "387": 654,
    "390": 1171,
    "392": 556,
    "393": 658,
    "394": 859,
}
NOTHING = Selection(0, None, None, None)


def frames_of(protocol: str, subject: str) -> tuple[tuple[int, ...], tuple[int, ...]]:
    chosen = select(PRESETS[protocol], f"CoreView_{subject}", NOTHING)
    total = FRAMES[subject]
    return train_range(chosen.train_frames, total), held_out_range(chosen.test_frames, total)


def held_out(protocol: str, cameras: int = 23) -> tuple[int, ...]:
    preset = PRESETS[protocol]
    chosen = select(preset, "CoreView_377", NOTHING)
    return held_out_cameras(chosen.test_cameras, preset.train_camera, cameras)


def occluded(protocol: str, subject: str) -> int:
    train, _ = frames_of(protocol, subject)
    person = np.zeros((8, 1024), bool)
    person[2:6, 300:600] = True
    settings = place_strip(PRESETS[protocol], f"my_{subject}", OcclusionSettings("strip"))
    hidden = plan(settings, [Silhouette.of(person)] * len(train), f"my_{subject}", train)
    boxes = [box is not None for box in hidden]
    assert boxes == sorted(boxes, reverse=True)
    return sum(boxes)


@pytest.mark.parametrize("protocol", ["paper", "gauhuman", "instant-nvr"])
def test_a_hundred_frames_by_five(protocol):
    for subject in ("377", "386", "387", "392", "393", "394"):
        train, test = frames_of(protocol, subject)
        assert train == tuple(range(0, 500, 5)) and len(train) == 100
        assert test == tuple(30 * k for k in range(17)) and test[-1] == 480
        assert occluded(protocol, subject) == 80  # k < 0.8 * 100


@pytest.mark.parametrize(
    ("subject", "frames", "until"),
    [("377", 570, 456), ("386", 540, 432), ("387", 540, 432), ("392", 556, 444), ("393", 658, 526),
     ("394", 475, 380)],
)  # fmt: skip
def test_occnerf_hides_what_its_settings_say(subject, frames, until):
    train, test = frames_of("occnerf", subject)
    assert train == tuple(range(frames)) and test == tuple(range(0, frames, 30))
    assert occluded("occnerf", subject) == until


def test_frames_are_counted_in_the_sequence_even_where_some_show_nobody():
    person = np.zeros((8, 1024), bool)
    person[2:6, 300:600] = True
    settings = OcclusionSettings("strip", mid=450, width=60, until=4)
    numbers = (0, 2, 3, 4, 5)  # 1 showed nobody
    hidden = plan(settings, [Silhouette.of(person)] * 5, "x", numbers)
    assert [box is not None for box in hidden] == [True, True, True, False, False]


@pytest.mark.parametrize(
    ("subject", "frames"),
    [("313", 1000), ("315", 2000), ("377", 570), ("386", 540), ("387", 540), ("390", 1171), ("392", 556),
     ("393", 658), ("394", 475)],
)  # fmt: skip
def test_humannerfs_stretches(subject, frames):
    assert frames_of("humannerf", subject)[0] == tuple(range(frames))
    if subject in ("377", "386", "393", "394"):
        train, test = frames_of("3dgs-avatar", subject)
        assert train == tuple(range(frames)) and test == tuple(range(0, frames, 30))


def test_arahs_monocular_settings():
    train, test = frames_of("arah", "377")
    assert train == tuple(range(500)) and test == tuple(range(500, 617, 10))
    assert held_out("arah") == (0,)


def test_cameras_masks_and_sizes():
    assert held_out("paper") == tuple(range(1, 23))  # the text's; the released code opens camera 1 alone
    assert held_out("gauhuman") == held_out("instant-nvr") == (0, 1, 2, 3, *range(5, 23))
    for protocol in ("occnerf", "humannerf", "3dgs-avatar"):
        assert held_out(protocol) == tuple(range(1, 23))
    masks = {name: preset.masks for name, preset in PRESETS.items()}
    assert masks == {
        "paper": "mask", "gauhuman": "mask", "instant-nvr": "schp", "occnerf": "mask+mask_cihp",
        "humannerf": "mask+mask_cihp", "3dgs-avatar": "mask_cihp", "arah": "mask_cihp",
    }  # fmt: skip
    assert {preset.image_size for preset in PRESETS.values()} == {512}


def test_the_number_of_hidden_frames_is_the_protocols_only_with_its_frames():
    place = lambda **settings: place_strip(  # noqa: E731
        PRESETS["occnerf"], "392", OcclusionSettings("strip", **settings)
    )
    assert place().until == 444 and place(fraction=0.5).until is None and place(until=3).until == 3
    own = place_strip(PRESETS["occnerf"], "392", OcclusionSettings("strip"), own_frames=True)
    assert own.until is None and (own.mid, own.width) == (417, 78)
    assert "until" not in repr(place())  # runs that were begun before it was known go on
    with pytest.raises(ConfigError, match=r"dataset.occlusion.until='all'"):
        OcclusionSettings("strip", until="all")


def test_the_size_is_the_protocols_unless_one_is_given(tmp_path):
    scene = write_tiny_scene(tmp_path, frames=1, cameras=1)
    assert ZjuDataModule(scene.root, scene.name, scene.body).image_size == 512
    assert ZjuDataModule(scene.root, scene.name, scene.body, image_size=64).image_size == 64
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", ["dataset=zju", "dataset.protocol=occnerf"])
    assert config.dataset.image_size is None and config.dataset.fit == "auto"
    assert config.dataset.occlusion.until is None and config.body.pose_blend_shapes is True


@pytest.mark.parametrize("name", PRESETS)
def test_every_protocol_says_what_it_is_and_where_it_was_read(name):
    words = describe(name)
    assert all(words.values()) and "@" in words["source"]
    assert words["longer side"] == "512 px"


def test_words_of_a_protocol():
    paper, arah, occnerf = describe("paper"), describe("arah"), describe("occnerf")
    assert paper["training frames"] == "every 5th from 0 below 500"
    assert (
        paper["held-out frames"] == "every 30th from 0 below 500"
        and paper["held-out cameras"] == "all others"
    )
    assert "camera 1, alone" in paper["differs"]
    assert arah["training frames"] == "every frame from 0 below 500"
    assert arah["held-out frames"] == "every 10th from 500" and arah["held-out cameras"] == "0"
    assert "392: 556" in occnerf["training frames"] and occnerf["strip"] == "OccNeRF's"
