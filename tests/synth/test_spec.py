from __future__ import annotations

from dataclasses import replace

import pytest

from occfusion.errors import ConfigError
from occfusion.synth import HELD_OUT_FROM, LEVELS, OCCLUDERS, SceneSpec, with_turn


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("occluders", OCCLUDERS)
def test_names_come_back(level: str, occluders: str) -> None:
    spec = SceneSpec(subject=7, level=level, occluders=occluders)
    assert SceneSpec.parse(spec.name) == spec
    assert spec.name.endswith(level) == (occluders == "none")


@pytest.mark.parametrize(
    ("name", "wanted"),
    [
        ("", "NNN-level"),
        ("clean", "NNN-level"),
        ("1001-clean", "NNN-level"),
        ("-1-clean", "NNN-level"),
        ("001-Clean", "NNN-level"),
        ("001-clean-boxes-x", "NNN-level"),
        ("001-clean\n", "NNN-level"),
        ("../001-clean", "NNN-level"),
        ("001-easy", "level='easy'.*clean, hard"),
        ("001-hard-trees", "occluders='trees'.*furniture"),
        ("101-hard-pole", "did you mean poles"),
        ("101-hard-front-back", "'back' says facing a second time"),
        ("101-hard-turn20-turn30", "turn a second time"),
        ("101-hard-turn361", "turn=361"),
        ("101-hard-facing360-turn20", "facing=360"),
        ("101-hard-back-turn360", "turns all round faces no side"),
        ("101-hard-short101", "short=101"),
        ("101-hard-turn", "occluders='turn'"),
    ],
)
def test_wrong_names_are_explained(name: str, wanted: str) -> None:
    with pytest.raises(ConfigError, match=wanted):
        SceneSpec.parse(name)


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("occluders", OCCLUDERS)
@pytest.mark.parametrize(
    ("words", "settings"),
    [
        ("front", {"turn": 30, "facing": 0}),
        ("back", {"turn": 30, "facing": 180}),
        ("side", {"turn": 30, "facing": 90}),
        ("facing45", {"turn": 30, "facing": 45}),
        ("back-turn90", {"turn": 90, "facing": 180}),
        ("front-turn0", {"turn": 0, "facing": 0}),
        ("sit", {"motion": "sitting"}),
        ("short10", {"short": 10, "frames": 10}),
        ("front-sit-short30", {"turn": 30, "motion": "sitting", "short": 30, "frames": 30}),
    ],
)
def test_words_combine_with_levels_and_occluders(level, occluders, words, settings) -> None:
    spec = SceneSpec(subject=103, level=level, occluders=occluders, **settings)
    base = f"103-{level}" if occluders == "none" else f"103-{level}-{occluders}"
    assert spec.name == f"{base}-{words}"
    assert SceneSpec.parse(spec.name) == spec
    backwards = "-".join([f"103-{level}", *reversed(spec.name.split("-")[2:])])
    assert SceneSpec.parse(backwards) == spec


def test_turn_alone_is_a_turn_before_the_camera() -> None:
    assert SceneSpec.parse("003-clean-turn90").name == "003-clean-front-turn90"
    assert SceneSpec.parse("003-clean-turn360").name == "003-clean"


def test_a_short_scene_stays_short_whatever_frames_are_asked() -> None:
    short = SceneSpec.parse("003-clean-short10")
    assert replace(short, frames=100).frames == 10
    assert replace(short, frames=4).frames == 4


def test_settings_beside_the_name() -> None:
    scene = SceneSpec.parse("003-clean")
    assert with_turn(scene, None, None) == scene
    assert with_turn(scene, 40, None).name == "003-clean-front-turn40"
    assert with_turn(scene, None, 180).name == "003-clean-back"
    assert with_turn(SceneSpec.parse("003-clean-back"), 90, None).name == "003-clean-back-turn90"
    assert with_turn(SceneSpec.parse("003-clean-back"), 360, None) == scene
    with pytest.raises(ConfigError, match="faces no side"):
        with_turn(scene, 360, 90)


def test_manifests_of_earlier_scenes_keep_their_words() -> None:
    earlier = ["subject", "level", "occluders", "image_size", "frames", "cameras", "light", "seed"]
    assert list(SceneSpec().as_dict()) == earlier
    assert SceneSpec.parse("001-clean-back-sit").as_dict().keys() - earlier == {"turn", "facing", "motion"}


@pytest.mark.parametrize(
    "setting",
    [
        {"turn": 361},
        {"turn": -1},
        {"facing": 360, "turn": 10},
        {"short": 101},
        {"motion": "flying"},
        {"image_size": 1025},
        {"image_size": 0},
        {"frames": 0},
        {"cameras": 24},
        {"subject": -1},
        {"seed": -1},
        {"light": "candle"},
        {"image_size": 256.0},
        {"frames": True},
    ],
)
def test_settings_out_of_range_are_named(setting: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match=next(iter(setting))):
        SceneSpec(**setting)  # type: ignore[arg-type]


def test_numbers_from_one_hundred_on_are_held_out() -> None:
    assert HELD_OUT_FROM == 100
    assert not SceneSpec(subject=99).is_held_out
    assert SceneSpec(subject=100).is_held_out
