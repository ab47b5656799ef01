"""Embedded people: procedural subjects in motion, written to disk in ZJU-MoCap's layout."""

from __future__ import annotations

from occfusion.synth.spec import HELD_OUT_FROM, LEVELS, LIGHTS, OCCLUDERS, VIEWS, SceneSpec, with_turn
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
