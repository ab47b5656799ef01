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

LEVELS = ("clean", "hard", "camera", "wild")
FILMED = ("camera", "wild")
"""Levels whose pictures a camera took: several lamps, linear light, a lens, a sensor, a segmenter's masks."""
OCCLUDERS = ("none", "boxes", "poles", "furniture", "moving", "counter")
LIGHTS = ("soft", "directional")
MOTIONS = ("varied", "sitting")

MAX_SUBJECT = 999
MIN_SIZE, MAX_SIZE = 16, 1024  # pixels; the nominal capture has 1024
MAX_CAMERAS = 23
MAX_FRAMES = 10_000
MAX_SHORT = 100

FULL_TURN = 360
LITTLE_TURN = 30
"""Degrees that a person of a `-front`, `-back` or `-side` scene turns: two neighbouring cameras are 16 apart."""
VIEWS = {"front": 0, "back": 180, "side": 90}
"""Words of a name for the side that faces the first camera: `facing`, degrees."""

_NAME = re.compile(r"(\d{1,3})-([a-z]+)((?:-[a-z]+\d*)*)")
_NUMBERED = re.compile(r"(facing|turn|short)(\d{1,3})")


@dataclass(frozen=True)
class SceneSpec:
    """A scene; the same spec gives the same files, byte for byte.

    Attributes:
        subject: number of the person, 0..999; from `HELD_OUT_FROM` on held out.
        level: `clean` (the body model explains everything but clothes and light) or `hard`
            (wrinkles, swinging cloth, shadows, poses and shape that are off, masks with errors); `camera` (the exact
            bodies and clothes of `clean`, filmed: `filming`, with a segmenter's masks) or `wild` (the same, with body
            parameters and calibration off as estimators are: `estimator`).
        occluders: real things between the first camera and the person, or `none`; all hide what the person moves
            behind them but `counter`, which hides the same part of the body, from the hips down, in nearly all frames.
        image_size: width and height of the pictures, pixels.
        frames: moments, a tenth of a second apart.
        cameras: how many of the ring of 23.
        light: `soft` from all around as in a capture studio, or `directional`.
        seed: varies motion, wrinkles, errors and occluders of the same person.
        turn: degrees that the body turns about its vertical axis; 360: all round, again and again. Less: to and fro
            within so much.
        facing: where the body turns about, degrees: 0 shows the first camera its front, 180 its back, 90 its right.
        motion: `varied`, or `sitting`: seated throughout, with what head, trunk and arms do in the others.
        short: only so many moments from the beginning, at the pace of a long take; 0: no such limit.
    """

    subject: int = 1
    level: str = "clean"
    occluders: str = "none"
    image_size: int = 512
    frames: int = 100
    cameras: int = MAX_CAMERAS
    light: str = "soft"
    seed: int = 0
    turn: int = FULL_TURN
    facing: int = 0
    motion: str = "varied"
    short: int = 0

    def __post_init__(self) -> None:
        _number("subject", self.subject, 0, MAX_SUBJECT)
        _number("image_size", self.image_size, MIN_SIZE, MAX_SIZE)
        _number("frames", self.frames, 1, MAX_FRAMES)
        _number("cameras", self.cameras, 1, MAX_CAMERAS)
        _number("seed", self.seed, 0, 2**63 - 1)
        _number("turn", self.turn, 0, FULL_TURN)
        _number("facing", self.facing, 0, FULL_TURN - 1)
        _number("short", self.short, 0, MAX_SHORT)
        if self.facing and self.turn == FULL_TURN:
            raise ConfigError(
                f"scene setting facing={self.facing}: who turns all round faces no side; set turn below {FULL_TURN}."
            )
        if self.short:
            object.__setattr__(self, "frames", min(self.frames, self.short))
        _choice("level", self.level, LEVELS)
        _choice("occluders", self.occluders, OCCLUDERS)
        _choice("light", self.light, LIGHTS)
        _choice("motion", self.motion, MOTIONS)

    @property
    def name(self) -> str:
        """Returns the scene's name and folder, for example `101-hard-boxes` or `103-clean-front`."""
        parts = [f"{self.subject:03d}", self.level]
        if self.occluders != "none":
            parts.append(self.occluders)
        if self.turn < FULL_TURN:
            words = [word for word, angle in VIEWS.items() if angle == self.facing]
            parts.append(words[0] if words else f"facing{self.facing}")
            if self.turn != LITTLE_TURN:
                parts.append(f"turn{self.turn}")
        if self.motion == "sitting":
            parts.append("sit")
        if self.short:
            parts.append(f"short{self.short}")
        return "-".join(parts)

    @property
    def is_held_out(self) -> bool:
        """Says whether this is a scene for evaluation only."""
        return self.subject >= HELD_OUT_FROM

    @classmethod
    def parse(cls, name: str) -> SceneSpec:
        """Returns the spec of a name `NNN-level[-word ...]`, other settings as by default.

        Words, in any order: an occluder; `front`, `back`, `side` or `facingN` for who does not turn, and `turnN` for
        another sweep than 30 degrees; `sit`; `shortN`.

        Raises:
            ConfigError: not such a name, or an unknown level or word.
        """
        found = _NAME.fullmatch(name)
        if found is None:
            raise ConfigError(
                f"scene {name!r}: expected NNN-level or NNN-level-words, for example 001-clean, 101-hard-boxes or "
                f"103-clean-front; levels are {', '.join(LEVELS)}, words {', '.join(OCCLUDERS[1:])}, "
                f"{', '.join(VIEWS)}, facingN, turnN, sit, shortN."
            )
        settings: dict[str, int | str] = {}
        for word in found[3].split("-")[1:]:
            for key, value in _setting(name, word).items():
                if key in settings:
                    raise ConfigError(
                        f"scene {name!r}: {word!r} says {key} a second time; expected NNN-level-words."
                    )
                settings[key] = value
        if "facing" in settings:
            settings.setdefault("turn", LITTLE_TURN)
        return cls(subject=int(found[1]), level=found[2], **settings)  # type: ignore[arg-type]

    def as_dict(self) -> dict[str, int | str]:
        """Returns the settings as plain values, for the manifest; those of `ADDED` only where they are set."""
        given = dataclasses.asdict(self)
        return {key: value for key, value in given.items() if key not in ADDED or value != ADDED[key]}


def with_turn(spec: SceneSpec, turn: int | None, facing: int | None) -> SceneSpec:
    """Returns the scene of a person who turns so much, facing that way; None leaves what the scene says.

    Raises:
        ConfigError: out of range, or a side for somebody who turns all round.
    """
    if turn is None:
        turn = LITTLE_TURN if facing is not None and spec.turn == FULL_TURN else spec.turn
    if facing is None:
        facing = spec.facing if turn < FULL_TURN else 0
    return dataclasses.replace(spec, turn=turn, facing=facing)


ADDED: dict[str, int | str] = {"turn": FULL_TURN, "facing": 0, "motion": "varied", "short": 0}
"""Settings that manifests of earlier scenes do not name, with the value that those scenes have."""


def _setting(name: str, word: str) -> dict[str, int | str]:
    """Returns what a word of a scene's name sets."""
    if word in VIEWS:
        return {"facing": VIEWS[word]}
    if word == "sit":
        return {"motion": "sitting"}
    if (numbered := _NUMBERED.fullmatch(word)) is not None:
        return {numbered[1]: int(numbered[2])}
    if word not in OCCLUDERS and f"{word}s" in OCCLUDERS:
        raise ConfigError(f"scene {name!r}: unknown occluders {word!r}; did you mean {word}s?")
    return {"occluders": word}


def _number(name: str, value: object, least: int, most: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        raise ConfigError(f"scene setting {name}={value!r}: expected a whole number from {least} to {most}.")


def _choice(name: str, value: object, known: tuple[str, ...]) -> None:
    if value not in known:
        raise ConfigError(f"scene setting {name}={value!r}: expected one of {', '.join(known)}.")
