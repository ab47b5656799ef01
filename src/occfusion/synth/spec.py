"""What scene to make: a few numbers that determine every byte of it."""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass

from occfusion.errors import ConfigError

HELD_OUT_FROM = 100
"""Subjects from this number on are for evaluation: nothing is ever trained or tuned on them.

Their motions come from other stretches of the recordings and from other movements than those of the
subjects below it.
"""

LEVELS = ("clean", "hard")
OCCLUDERS = ("none", "boxes", "poles", "furniture", "moving")
LIGHTS = ("soft", "directional")

MAX_SUBJECT = 999
MIN_SIZE, MAX_SIZE = 16, 1024  # pixels; the nominal capture has 1024
MAX_CAMERAS = 23
MAX_FRAMES = 10_000

_NAME = re.compile(r"(\d{1,3})-([a-z]+)(?:-([a-z]+))?")


@dataclass(frozen=True)
class SceneSpec:
    """A scene; the same spec gives the same files, byte for byte.

    Attributes:
        subject: number of the person, 0..999; from `HELD_OUT_FROM` on held out.
        level: `clean` (the body model explains everything but clothes and light) or `hard`
            (wrinkles, swinging cloth, shadows, poses and shape that are off, masks with errors).
        occluders: real things between the first camera and the person, or `none`.
        image_size: width and height of the pictures, pixels.
        frames: moments, a tenth of a second apart.
        cameras: how many of the ring of 23.
        light: `soft` from all around as in a capture studio, or `directional`.
        seed: varies motion, wrinkles, errors and occluders of the same person.
    """

    subject: int = 1
    level: str = "clean"
    occluders: str = "none"
    image_size: int = 512
    frames: int = 100
    cameras: int = MAX_CAMERAS
    light: str = "soft"
    seed: int = 0

    def __post_init__(self) -> None:
        _number("subject", self.subject, 0, MAX_SUBJECT)
        _number("image_size", self.image_size, MIN_SIZE, MAX_SIZE)
        _number("frames", self.frames, 1, MAX_FRAMES)
        _number("cameras", self.cameras, 1, MAX_CAMERAS)
        _number("seed", self.seed, 0, 2**63 - 1)
        _choice("level", self.level, LEVELS)
        _choice("occluders", self.occluders, OCCLUDERS)
        _choice("light", self.light, LIGHTS)

    @property
    def name(self) -> str:
        """Returns the scene's name and folder, for example `101-hard-boxes`."""
        base = f"{self.subject:03d}-{self.level}"
        return base if self.occluders == "none" else f"{base}-{self.occluders}"

    @property
    def is_held_out(self) -> bool:
        """Says whether this is a scene for evaluation only."""
        return self.subject >= HELD_OUT_FROM

    @classmethod
    def parse(cls, name: str) -> SceneSpec:
        """Returns the spec of a name `NNN-level[-occluders]`, other settings as by default.

        Raises:
            ConfigError: not such a name, or an unknown level or kind of occluder.
        """
        found = _NAME.fullmatch(name)
        if found is None:
            raise ConfigError(
                f"scene {name!r}: expected NNN-level or NNN-level-occluders, for example 001-clean or "
                f"101-hard-boxes; levels are {', '.join(LEVELS)}, occluders {', '.join(OCCLUDERS)}."
            )
        occluders = found[3] or "none"
        if occluders not in OCCLUDERS and f"{occluders}s" in OCCLUDERS:
            raise ConfigError(f"scene {name!r}: unknown occluders {occluders!r}; did you mean {occluders}s?")
        return cls(subject=int(found[1]), level=found[2], occluders=occluders)

    def as_dict(self) -> dict[str, int | str]:
        """Returns the settings as plain values, for the manifest."""
        return dataclasses.asdict(self)


def _number(name: str, value: object, least: int, most: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        raise ConfigError(f"scene setting {name}={value!r}: expected a whole number from {least} to {most}.")


def _choice(name: str, value: object, known: tuple[str, ...]) -> None:
    if value not in known:
        raise ConfigError(f"scene setting {name}={value!r}: expected one of {', '.join(known)}.")
