"""Who trains on what on ZJU-MoCap: the protocols of the paper and of its peers, by name.

| | `paper` | `gauhuman` | `occnerf` |
|---|---|---|---|
| training camera (index) | 0 | 4 | 0 |
| training frames | 0 to 495 by 5 | 0 to 495 by 5 | every frame of the subject's stretch |
| held-out moments | 0 to 480 by 30 | 0 to 480 by 30 | every 30th of the stretch |
| held-out cameras | all others | all others | all others |
| masks | `mask` | `mask` | `mask+mask_cihp` |
| strip | the paper's table | the paper's table | OccNeRF's table |

The strip hides the first 80 % of the training frames in all of them. `dataset.*` given by hand wins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from occfusion.data.occlusion import STRIPS, OcclusionSettings, zju_subject
from occfusion.data.prepare import Selection
from occfusion.errors import ConfigError

OCCNERF_STRIPS = {**STRIPS, "387": (451, 66), "394": (423, 64)}
"""(mid, width) of OccNeRF's strips; four of the six are the paper's."""

OCCNERF_FRAMES = {"377": 570, "386": 540, "387": 540, "392": 556, "393": 658, "394": 475}
"""How many frames of each subject OccNeRF uses, from the first on."""

OCCNERF_TEST_STEP = 30


@dataclass(frozen=True)
class Preset:
    """A protocol.

    Attributes:
        train_camera: index of the camera trained on.
        masks: mask folders.
        strips: (mid, width) by subject, columns of a picture 1024 wide.
        stretch: frames used, by subject; None for the paper's 100 frames by 5.
    """

    train_camera: int = 0
    masks: str = "mask"
    strips: dict[str, tuple[int, int]] = field(default_factory=lambda: dict(STRIPS))
    stretch: dict[str, int] | None = None

    def frames(self, scene: str) -> tuple[Sequence[int | None] | None, Sequence[int | None] | None]:
        """Returns the training and the held-out `[start, stop, step]`; None for the paper's."""
        if self.stretch is None:
            return None, None
        stop = self.stretch.get(zju_subject(scene) or "")
        return [0, stop, 1], [0, stop, OCCNERF_TEST_STEP]


PRESETS = {
    "paper": Preset(),
    "gauhuman": Preset(train_camera=4),
    "occnerf": Preset(masks="mask+mask_cihp", strips=OCCNERF_STRIPS, stretch=OCCNERF_FRAMES),
}


def find_preset(name: str) -> Preset:
    """Returns the protocol of a name.

    Raises:
        ConfigError: there is none of that name.
    """
    if name not in PRESETS:
        raise ConfigError(f"dataset.protocol={name!r}: choose one of {', '.join(PRESETS)}.")
    return PRESETS[name]


def select(preset: Preset, scene: str, asked: Selection) -> Selection:
    """Returns what is asked for, filled from the protocol where nothing is."""
    train, test = preset.frames(scene)
    return replace(
        asked,
        train_frames=train if asked.train_frames is None else asked.train_frames,
        test_frames=test if asked.test_frames is None else asked.test_frames,
    )


def place_strip(preset: Preset, scene: str, occlusion: OcclusionSettings) -> OcclusionSettings:
    """Returns the occlusion with the protocol's strip for this subject, where none is given by hand."""
    strip = preset.strips.get(zju_subject(scene) or "")
    if strip is None or occlusion.kind != "strip":
        return occlusion
    mid = strip[0] if occlusion.mid is None else occlusion.mid
    width = strip[1] if occlusion.width is None else occlusion.width
    return replace(occlusion, mid=mid, width=width)
