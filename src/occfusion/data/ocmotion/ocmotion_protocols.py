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

from occfusion.data.prepare import find_protocol


@dataclass(frozen=True)
class OcMotionProtocol:
    """What a paper does with OcMotion.

    Attributes:
        source: repository, commit and files it was read in.
        sequences: names of the sequences: motion, camera and, where there are several, the clip.
        frames: `[start, stop, step]` of the training frames; up to the end where `stop` is None.
        divisor: the frames' size is the stored one divided by this.
        differs: what the authors' code does otherwise than their text or than this package, or what neither says.
    """

    source: str
    sequences: tuple[str, ...]
    frames: tuple[int, int | None, int]
    divisor: int
    differs: tuple[str, ...]

    @property
    def size_in_words(self) -> str:
        """The size of the frames, for messages."""
        return {2: "half", 4: "a quarter"}[self.divisor] + " of the stored size"


SIX = ("0011_02_1", "0011_02_2", "0013_02", "0038_04", "0039_02", "0041_00")

PROTOCOLS = {
    "paper": OcMotionProtocol(
        "tiangexiang/OccFusion@94f3aba scene/dataset_readers.py (readCamerasOcMotion, readOcMotionInfo), stage0_oc.py",
        SIX,
        (0, 100, 2),
        2,
        (
            "The text names no size of pictures; the code halves the stored one.",
            "The text trains on 50 frames; the code on every second picture in the folder, however many there are, and "
            "where the folder's name is without w2a on the pictures numbered 320 to 374.",
            "The code cuts masks to size by the nearest pixel; here half of a pixel's area has to be the person.",
            "The code turns the root by Rh of mesh_infos.pkl, which is made from the poses used here.",
            "The code halves K as it is; here principal points, which OpenCV counts from the middle of a pixel, are "
            "moved by the half of a pixel that this is at either size.",
            "The code has no program for figures of the visible pixels.",
        ),
    ),
    "wild2avatar": OcMotionProtocol(
        "tiangexiang/Wild2Avatar@daefb62 README.md",
        SIX,
        (0, 100, 1),
        2,
        (
            "The sequences are published and the code is not: the size of pictures in training is not known; half of "
            "the stored one is OccFusion's.",
        ),
    ),
    "occnerf": OcMotionProtocol(
        "tiangexiang/OccNeRF@1cb1ef3 configs/occnerf/ocmotion, core/data/occnerf/train.py",
        ("0011_02", "0014_04"),
        (0, None, 1),
        4,
        (
            "The code reads cameras.pkl and mesh_infos.pkl; here metadata.json, of which its preparation made them.",
            "The code blends soft edges of masks into the background and resizes pictures by Lanczos filtering; here "
            "they are averaged.",
        ),
    ),
}


def describe_ocmotion(name: str) -> dict[str, str]:
    """Returns what a protocol says, in words, for a page that lists them.

    Raises:
        ConfigError: there is none of that name.
    """
    protocol = find_protocol(PROTOCOLS, name, "OcMotion")
    start, stop, step = protocol.frames
    until = "the end" if stop is None else str(stop - 1)
    return {
        "sequences": ", ".join(protocol.sequences),
        "training frames": f"{start} to {until} by {step}",
        "held-out frames": "none",
        "masks": "masks",
        "size": protocol.size_in_words,
        "source": protocol.source,
        "differs": " ".join(protocol.differs),
    }
