"""Protocols by name against table 2.4 of the method's facts, as numbers written out here."""

from __future__ import annotations

import numpy as np
import pytest

from data.tiny_scene import write_tiny_scene
from occfusion.data.occlusion import OcclusionSettings
from occfusion.data.prepare import Selection, held_out_range, train_range
from occfusion.data.zju.zju_data import ZjuDataModule
from occfusion.data.zju.zju_protocols import PRESETS, place_strip, select
from occfusion.errors import ConfigError

FRAMES = {"377": 617, "386": 646, "387": 654, "392": 556, "393": 658, "394": 859}
NOTHING = Selection(0, None, None, None)


def strip(protocol: str, scene: str) -> tuple[float, float]:
    placed = place_strip(PRESETS[protocol], scene, OcclusionSettings("strip"))
    return placed.mid, placed.width


@pytest.mark.parametrize("protocol", ["paper", "gauhuman"])
def test_the_papers_frames(protocol):
    chosen = select(PRESETS[protocol], "CoreView_377", NOTHING)
    assert train_range(chosen.train_frames, 617) == tuple(range(0, 500, 5))
    assert held_out_range(chosen.test_frames, 617) == tuple(range(0, 481, 30))


@pytest.mark.parametrize(
    ("subject", "frames", "occluded"),
    [("377", 570, 456), ("386", 540, 432), ("387", 540, 432), ("392", 556, 444.8), ("393", 658, 526.4),
     ("394", 475, 380)],
)  # fmt: skip
def test_occnerfs_frames(subject, frames, occluded):
    chosen = select(PRESETS["occnerf"], f"my_{subject}", NOTHING)
    train = train_range(chosen.train_frames, FRAMES[subject])
    assert train == tuple(range(frames)) and abs(0.8 * len(train) - occluded) < 1
    assert held_out_range(chosen.test_frames, FRAMES[subject]) == tuple(range(0, frames, 30))


def test_strips_of_both_tables():
    assert strip("paper", "CoreView_387") == (448, 50) and strip("occnerf", "CoreView_387") == (451, 66)
    assert strip("paper", "my_394") == (418, 64) and strip("occnerf", "394") == (423, 64)
    for subject, place in {"377": (460, 70), "386": (415, 80), "392": (417, 78), "393": (434, 68)}.items():
        assert strip("paper", subject) == strip("occnerf", subject) == strip("gauhuman", subject) == place
    assert strip("paper", "CoreView_313") == (None, None)


def test_what_is_given_by_hand_wins():
    asked = Selection(0, None, [0, 9, 1], [3, 4, 1])
    assert select(PRESETS["occnerf"], "377", asked) == asked
    placed = place_strip(PRESETS["paper"], "377", OcclusionSettings("strip", mid=1.0))
    assert (placed.mid, placed.width) == (1.0, 70)
    moving = OcclusionSettings("moving")
    assert place_strip(PRESETS["paper"], "377", moving) is moving


def test_the_module_follows_its_protocol(tmp_path):
    scene = write_tiny_scene(tmp_path, name="CoreView_387", cameras=5, frames=2)
    body = scene.body

    def module(**settings):
        return ZjuDataModule(tmp_path, scene.name, body, **settings)

    assert module().train_cameras == (0,) and module(protocol="gauhuman").train_cameras == (4,)
    assert module(protocol="gauhuman", train_camera=1).train_cameras == (1,)
    assert module(protocol="gauhuman").test_cameras == (0, 1, 2, 3)
    columns = np.flatnonzero(module().train_frame(0).occluded[0].numpy())
    assert (columns[0], columns[-1] + 1) == (round(423 / 16), round(473 / 16))
    with pytest.raises(ConfigError, match=r"dataset.protocol='neuman'"):
        module(protocol="neuman")
    with pytest.raises(ConfigError, match=r"dataset.layout='raw'"):
        module(layout="raw")
