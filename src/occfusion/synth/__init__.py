"""Embedded people: procedural subjects in motion, written to disk in ZJU-MoCap's layout."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from occfusion.synth.spec import HELD_OUT_FROM, LEVELS, LIGHTS, OCCLUDERS, VIEWS, SceneSpec, with_turn

if TYPE_CHECKING:
    from occfusion.synth.writer import write_scene

__all__ = [
    "HELD_OUT_FROM",
    "LEVELS",
    "LIGHTS",
    "OCCLUDERS",
    "VIEWS",
    "SceneSpec",
    "with_turn",
    "write_scene",
]


def __getattr__(name: str) -> Any:
    """Imports the writer when it is asked for: who only turns rotations or reads a scene's name needs no painter."""
    if name != "write_scene":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return importlib.import_module(f"{__name__}.writer").write_scene
