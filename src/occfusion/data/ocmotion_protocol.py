"""Who trains on what of OcMotion: the protocols of three papers, by name.

| | `paper` (OccFusion) | `wild2avatar` | `occnerf` |
|---|---|---|---|
| sequences | six, of 100 frames each | the same | `0011_02` and `0014_04`, as its authors cut them |
| training frames | every second of 100 | all 100 | all |
| size | half of the stored one | half of the stored one | a quarter of the stored one |
| camera, masks | the one of the cut; `masks` | the same | the same |
| figures | visible pixels of the training frames | the same | the same |

Nothing is held out: other cameras are occluded too, and the cut has no pictures of them.
"""

from __future__ import annotations

from dataclasses import dataclass

from occfusion.errors import ConfigError


@dataclass(frozen=True)
class OcMotionProtocol:
    """What a paper does with OcMotion.

    Attributes:
        sequences: names of the sequences: motion, camera and, where there are several, the clip.
        frames: `[start, stop, step]` of the training frames; up to the end where `stop` is None.
        divisor: the frames' size is the stored one divided by this.
        differs: what the authors' code does otherwise than their text, or what neither says.
    """

    sequences: tuple[str, ...]
    frames: tuple[int, int | None, int]
    divisor: int
    differs: str

    @property
    def size_in_words(self) -> str:
        """The size of the frames, for messages."""
        return {2: "half", 4: "a quarter"}[self.divisor] + " of the stored size"


SIX = ("0011_02_1", "0011_02_2", "0013_02", "0038_04", "0039_02", "0041_00")

PROTOCOLS = {
    "paper": OcMotionProtocol(
        SIX,
        (0, 100, 2),
        2,
        "OccFusion's text names no size; its code halves the stored one, cuts the mask to size by nearest pixel "
        "where this package asks for half of a pixel's area, counts every mask value but 0 as the person where "
        "soft edges count from 128 on here, and takes every second of all pictures in the folder, however many "
        "there are. Its code computes no figures of the visible pixels.",
    ),
    "wild2avatar": OcMotionProtocol(
        SIX,
        (0, 100, 1),
        2,
        "Wild2Avatar published the sequences and no code; the size of its pictures in training is not known, and "
        "half of the stored one is OccFusion's.",
    ),
    "occnerf": OcMotionProtocol(
        ("0011_02", "0014_04"),
        (0, None, 1),
        4,
        "OccNeRF's size is that of its configurations of OcMotion (resize_img_scale 0.25); its code blends the "
        "edges of masks into the background and resizes pictures with Lanczos filtering.",
    ),
}


def find_ocmotion_protocol(name: str) -> OcMotionProtocol:
    """Returns the protocol of a name.

    Raises:
        ConfigError: there is none of that name.
    """
    if name not in PROTOCOLS:
        raise ConfigError(f"dataset.protocol={name!r}: for OcMotion choose one of {', '.join(PROTOCOLS)}.")
    return PROTOCOLS[name]
