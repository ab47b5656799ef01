from __future__ import annotations

import pytest

from occfusion.errors import ConfigError
from occfusion.synth import HELD_OUT_FROM, LEVELS, OCCLUDERS, SceneSpec


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
    ],
)
def test_wrong_names_are_explained(name: str, wanted: str) -> None:
    with pytest.raises(ConfigError, match=wanted):
        SceneSpec.parse(name)


@pytest.mark.parametrize(
    "setting",
    [
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
