"""The true surface of an embedded person: made again from the settings that its scene was written with."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

from occfusion.data.scene import Surface
from occfusion.synth.actor import Actor
from occfusion.synth.manifest import MANIFEST, written_spec
from occfusion.synth.spec import SceneSpec

KEPT_FRAMES = 64
"""Surfaces held in memory, 0.3 MB each: held-out views come camera by camera, so the same few moments recur."""


def true_surface(folder: Path) -> Callable[[int], Surface] | None:
    """Returns what gives the surface at a moment, clothes and hair included; None where it is not known.

    It is known of scenes that this version of the generator has written. Nothing is built before the first call.
    """
    if not (folder / MANIFEST).is_file():
        return None
    spec = written_spec(folder)
    if spec is None:
        return None

    @lru_cache(maxsize=KEPT_FRAMES)
    def surface(frame: int) -> Surface:
        actor = _actor(spec)
        return Surface(actor.vertices(frame)[0], actor.figure.faces)

    return surface


@lru_cache(maxsize=2)
def _actor(spec: SceneSpec) -> Actor:
    return Actor(spec)
