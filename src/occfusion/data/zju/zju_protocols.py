"""Who trains on what on ZJU-MoCap: the protocols of the paper and of its peers, by name.

Each states frames, cameras, masks and size of picture as the code of its paper has them, and in `differs` what
that code does otherwise than here or than its text. `describe` gives the same in words. What is given by hand
(`dataset.*`) wins. Where a strip is asked for, it is the protocol's; those that hide nothing themselves take the
paper's (`dataset.occlusion.kind=none` trains as they do).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from occfusion.data.occlusion import STRIPS, OcclusionSettings, zju_subject
from occfusion.data.prepare import MAX_STEP, TEST_EVERY, TRAIN_FRAMES, Selection, find_protocol

Range = Sequence[int | None]
"""`[start, stop, step]`; a stop of None is the end of the sequence."""

HALF_SIZE = 512
"""Half of ZJU-MoCap's 1024 pixels, which every protocol measures at."""

OCCNERF_STRIPS = {**STRIPS, "387": (451, 66), "394": (423, 64)}
"""(mid, width) of OccNeRF's strips; four of the six are the paper's."""

STRETCHES = {"377": 570, "386": 540, "387": 540, "392": 556, "393": 658, "394": 475}
"""How many frames of each of six subjects HumanNeRF, OccNeRF and 3DGS-Avatar use, from the first on.

Their files say -1 or 0 for 392 and 393: all."""

HUMANNERF_STRETCHES = {**STRETCHES, "313": 1000, "315": 2000}

OCCNERF_UNTIL = {"377": 456, "386": 432, "387": 432, "392": 444, "393": 526, "394": 380}
"""Frames below these are occluded: 0.8 of the stretch, rounded down."""

STRETCH_TEST_STEP = 30


@dataclass(frozen=True)
class Preset:
    """A protocol.

    Attributes:
        source: repository, commit and files it was read in.
        train_camera: index of the camera trained on.
        test_cameras: held-out cameras; None for all others.
        stretch: how many frames are used from the first on, by subject; a subject that is not named uses all.
            None: `train_frames` and `test_frames` hold for every subject.
        train_frames: trained on, where there is no stretch; None for the paper's 100 frames by 5.
        test_frames: held out, likewise.
        masks: mask folders.
        image_size: longer side of the pictures in pixels.
        strips: (mid, width) by subject, columns of a picture 1024 wide.
        until: frames below this number are occluded, by subject; elsewhere the first 80 % of the training frames.
        differs: what the code does otherwise than its text, or than this package with these settings.
    """

    source: str
    train_camera: int = 0
    test_cameras: tuple[int, ...] | None = None
    stretch: Mapping[str, int] | None = None
    train_frames: Range | None = None
    test_frames: Range | None = None
    masks: str = "mask"
    image_size: int = HALF_SIZE
    strips: Mapping[str, tuple[int, int]] = field(default_factory=lambda: dict(STRIPS))
    until: Mapping[str, int] = field(default_factory=dict)
    differs: tuple[str, ...] = ()

    def frames(self, scene: str) -> tuple[Range | None, Range | None]:
        """Returns the training and the held-out `[start, stop, step]`; None for the paper's."""
        if self.stretch is None:
            return self.train_frames, self.test_frames
        stop = self.stretch.get(zju_subject(scene) or "")
        return [0, stop, 1], [0, stop, STRETCH_TEST_STEP]


_HIDES_NOTHING = "It hides nothing; dataset.occlusion.kind=none trains as it does."
_BORDER = "In training it leaves out the pixels within 2 of the mask's edge (5 x 5 erosion, dilation); here all count."

PRESETS = {
    "paper": Preset(
        "tiangexiang/OccFusion@94f3aba scene/dataset_readers.py (readZJUMoCapRefineInfo)",
        differs=(
            "The paper measures the 22 other cameras; the released code opens the first of them, camera 1, alone.",
            "The released reader of ZJU-MoCap stops with an error before it has read a picture: its caller leaves "
            "out an argument, and a path is used before it is set.",
        ),
    ),
    "gauhuman": Preset(
        "skhu101/GauHuman@72ea938 scene/dataset_readers.py (readZJUMoCapRefineInfo)",
        train_camera=4,
        differs=(
            _HIDES_NOTHING,
            "It counts 23 cameras whatever annots.npy holds: 313 and 315, which have 21, stop with an error.",
        ),
    ),
    "instant-nvr": Preset(
        "zju3dv/instant-nvr@d72d66f configs/inb/inb_377.yaml, and its tpose_dataset.py",
        train_camera=4,
        masks="schp",
        differs=(
            _HIDES_NOTHING,
            _BORDER,
            "It reads mask_cihp where schp is missing, picture by picture; here dataset.masks=mask_cihp asks for it.",
        ),
    ),
    "occnerf": Preset(
        "tiangexiang/OccNeRF@8c4223a configs/occnerf/zju_mocap/*/occnerf.yaml, tools/prepare_zju_mocap, "
        "core/data/occnerf/train.py",
        stretch=STRETCHES,
        masks="mask+mask_cihp",
        strips=OCCNERF_STRIPS,
        until=OCCNERF_UNTIL,
        differs=(
            "Its figures are on a white background, per visible pixel, per ray through the person's box and whole.",
            "It halves the pictures by Lanczos resampling; here they are averaged.",
        ),
    ),
    "humannerf": Preset(
        "chungyiweng/humannerf@7389c40 tools/prepare_zju_mocap, configs/human_nerf/zju_mocap",
        stretch=HUMANNERF_STRETCHES,
        masks="mask+mask_cihp",
        differs=(
            _HIDES_NOTHING,
            "Its code renders the training camera alone; every 30th frame of the others is how OccNeRF's and "
            "3DGS-Avatar's code measures its stretches.",
            "It halves the pictures by Lanczos resampling; here they are averaged.",
        ),
    ),
    "3dgs-avatar": Preset(
        "mikeqzy/3dgs-avatar-release@1cf7917 configs/dataset/zjumocap_*_mono.yaml",
        stretch=STRETCHES,
        masks="mask_cihp",
        differs=(_HIDES_NOTHING,),
    ),
    "arah": Preset(
        "taconite/arah-release@e591e31 configs/arah-zju/*-mono_4gpus.yaml, preprocess_datasets, im2mesh/data",
        test_cameras=(0,),
        train_frames=(0, 500, 1),
        test_frames=(500, None, 10),
        masks="mask_cihp",
        differs=(
            _HIDES_NOTHING,
            "It trains at 1024 pixels and measures at 512, on poses that were not trained on; here both are at 512.",
            "It leaves out moments without a body file; here dataset.train_frames has to.",
            "When it measures, it keeps the pixels within 2 of the mask's edge with their background.",
        ),
    ),
}


def describe(name: str) -> dict[str, str]:
    """Returns what a protocol says, in words, for a page that lists them.

    Raises:
        ConfigError: there is none of that name.
    """
    preset = find_protocol(PRESETS, name, "ZJU-MoCap")
    if preset.stretch is not None:
        stretch = ", ".join(f"{subject}: {count}" for subject, count in sorted(preset.stretch.items()))
        train = f"every frame of the first ({stretch}; others: all)"
        test = f"every {STRETCH_TEST_STEP}th of these"
    else:
        paper = (0, TRAIN_FRAMES * MAX_STEP, MAX_STEP), (0, TRAIN_FRAMES * MAX_STEP, TEST_EVERY * MAX_STEP)
        train, test = (
            _range_in_words(given or own)
            for given, own in zip((preset.train_frames, preset.test_frames), paper, strict=True)
        )
    others = "all others" if preset.test_cameras is None else ", ".join(map(str, preset.test_cameras))
    return {
        "training camera": str(preset.train_camera),
        "training frames": train,
        "held-out frames": test,
        "held-out cameras": others,
        "masks": preset.masks,
        "longer side": f"{preset.image_size} px",
        "strip": "OccNeRF's" if preset.strips == OCCNERF_STRIPS else "the paper's",
        "source": preset.source,
        "differs": " ".join(preset.differs),
    }


def select(preset: Preset, scene: str, asked: Selection) -> Selection:
    """Returns what is asked for, filled from the protocol where nothing is."""
    train, test = preset.frames(scene)
    return replace(
        asked,
        test_cameras=preset.test_cameras if asked.test_cameras is None else asked.test_cameras,
        train_frames=train if asked.train_frames is None else asked.train_frames,
        test_frames=test if asked.test_frames is None else asked.test_frames,
    )


def place_strip(
    preset: Preset, scene: str, occlusion: OcclusionSettings, *, own_frames: bool = False
) -> OcclusionSettings:
    """Returns the occlusion with the protocol's strip for this subject, where none is given by hand.

    Args:
        preset: the protocol.
        scene: the sequence's name.
        occlusion: what is asked for.
        own_frames: the training frames were given by hand, so that the protocol's number of occluded ones means
            nothing.
    """
    subject = zju_subject(scene) or ""
    strip = preset.strips.get(subject)
    if strip is None or occlusion.kind != "strip":
        return occlusion
    mid = strip[0] if occlusion.mid is None else occlusion.mid
    width = strip[1] if occlusion.width is None else occlusion.width
    until = occlusion.until
    if until is None and not own_frames and occlusion.fraction == OcclusionSettings.fraction:
        until = preset.until.get(subject)
    return replace(occlusion, mid=mid, width=width, until=until)


def _range_in_words(frames: Range) -> str:
    start, stop, step = frames
    each = "every frame" if step == 1 else f"every {step}th"
    return f"{each} from {start}" + ("" if stop is None else f" below {stop}")
