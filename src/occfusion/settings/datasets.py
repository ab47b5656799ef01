"""Settings of the data sets, one record for each `dataset=`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from occfusion.data.layouts import OCMOTION, ZJU
from occfusion.data.occlusion import OcclusionSettings
from occfusion.data.ocmotion.ocmotion_protocols import PROTOCOLS as OCMOTION_PROTOCOLS
from occfusion.data.prepare import MAX_SIZE, MIN_SIZE
from occfusion.data.video.video_protocols import PROTOCOLS as VIDEO_PROTOCOLS
from occfusion.data.zju.zju_layout import AUTO_FIT, FITS
from occfusion.data.zju.zju_protocols import PRESETS
from occfusion.fields import setting, with_default
from occfusion.synth.spec import LIGHTS

Frames = list[int | None] | None
LAST_CAMERA = 10_000
MANY_FRAMES = 100_000


@dataclass
class DatasetSettings:
    """What every data set has."""

    name: str = ""
    root: str | None = setting(None, "the folder that holds the subjects or sequences")
    scene: str | int | None = setting(None, "the subject or sequence, a folder in it")
    image_size: int | None = setting(
        None,
        "longer side in pixels after scaling; pictures are never enlarged; null: the protocol's",
        MIN_SIZE,
        MAX_SIZE,
    )
    train_camera: int | None = setting(
        0, "index of the one camera that is trained on; null: the protocol's", 0, LAST_CAMERA
    )
    test_cameras: list[int] | None = setting(
        None, "held-out cameras; null: the protocol's, or all the others", 0, LAST_CAMERA
    )
    train_frames: Frames = setting(
        None, "[start, stop, step] of those trained on; null: the protocol's, cut to the scene"
    )
    test_frames: Frames = setting(None, "the same of the held-out ones; null: the protocol's")
    max_train_frames: int | None = setting(
        None,
        "of more training frames so many are taken, evenly spread; null: as many as steps see",
        1,
        MANY_FRAMES,
    )
    masks: str | None = setting(None, "the folder of masks; null: the protocol's")
    occlusion: OcclusionSettings = field(default_factory=OcclusionSettings)


@dataclass
class SyntheticSettings(DatasetSettings):
    """An embedded person, written in ZJU-MoCap's layout and read by its reader."""

    name: str = "synthetic"
    root: str | None = setting(
        "data/synthetic", "folder of the written scenes; each size and length has a folder of its own there"
    )
    scene: str | int | None = setting(
        "001-clean", "`NNN-level[-words]`, for example `001-clean`, `101-hard-boxes`, `103-clean-front`"
    )
    image_size: int | None = setting(
        256, "width and height in pixels of the written pictures", MIN_SIZE, MAX_SIZE
    )
    frames: int = setting(100, "moments of the written scene", 1, MANY_FRAMES)
    cameras: int = setting(23, "of the ring around the person", 1, LAST_CAMERA)
    light: str = setting("soft", "of the scene", choices=LIGHTS)
    turn: int | None = setting(
        None, "degrees that the person turns, to and fro; 360: all round; null: as the scene's name says"
    )
    facing: int | None = setting(
        None, "side that the first camera sees, degrees: 0 front, 180 back; null: as the name says"
    )
    train_frames: Frames = setting(None, "[start, stop, step]; null: 100 frames, as the paper")
    test_frames: Frames = setting(None, "the same of the held-out ones; null: every sixth of the 100")
    masks: str | None = setting("mask", "the folder of masks")
    occlusion: OcclusionSettings = field(default_factory=lambda: OcclusionSettings("strip"))


@dataclass
class ZjuSettings(DatasetSettings):
    """ZJU-MoCap in any of its forms."""

    name: str = "zju"
    layout: str = setting("auto", "the form of the folder; auto: found out", choices=("auto", *ZJU))
    protocol: str = setting("paper", "whose cameras, frames, masks, strips and size", choices=tuple(PRESETS))
    fit: str = setting(
        AUTO_FIT, "the folder of body parameters; auto: the newest there is", choices=(AUTO_FIT, *FITS)
    )
    train_camera: int | None = with_default(DatasetSettings, "train_camera", None)
    masks: str | None = setting(
        None, "`mask`, `mask_cihp`, `schp`, or `mask+mask_cihp` for the union; null: the protocol's"
    )
    occlusion: OcclusionSettings = field(default_factory=lambda: OcclusionSettings("strip"))


@dataclass
class OcMotionSettings(DatasetSettings):
    """OcMotion: Wild2Avatar's cut or CHOMP's raw release."""

    name: str = "ocmotion"
    scene: str | int | None = setting(
        None, "e.g. `0013_02`: camera 02 of sequence 0013; raw: `0013` for all its cameras"
    )
    layout: str = setting("auto", "the form of the folder; auto: found out", choices=("auto", *OCMOTION))
    protocol: str = setting("paper", "whose frames and size", choices=tuple(OCMOTION_PROTOCOLS))
    test_cameras: list[int] | None = setting(
        [], "held-out cameras, none of which has a truth; null: all the others", 0, LAST_CAMERA
    )
    masks: str | None = setting(
        None, "the folder of masks; null: `masks` in the cut, `mask` in the raw release"
    )
    person: int | None = setting(None, "id among several people; null: the one in the most frames")
    numbered_masks: bool = setting(False, "whether masks hold the people's ids")


@dataclass
class VideoSettings(DatasetSettings):
    """One's own footage, and PeopleSnapshot or NeuMan as InstantAvatar prepares them."""

    name: str = "video"
    layout: str = setting(
        "auto", "video, where the folder has another layout too; auto: found out", choices=("auto", "video")
    )
    image_size: int | None = with_default(DatasetSettings, "image_size", 512)
    test_cameras: list[int] | None = setting(
        None, "[0]: hold out `test_frames` of the one camera; a protocol does so by itself", 0, 0
    )
    protocol: str | None = setting(
        None, "whose pictures are trained on and held out, by the scene's name", choices=VIDEO_PROTOCOLS
    )
    train_frames: Frames = setting(
        None,
        "[start, stop, step] among the pictures that have a pose and a mask; null: the protocol's, or all",
    )
    masks: str | None = setting("masks", "the folder of masks")
    person: int | None = setting(None, "value of the person in masks that number several")
    occluded: bool = setting(
        True, "whether things may stand before the person; false: all of it is always seen"
    )
    poses: str | None = setting(
        None,
        "a pose file in the folder, also one of AIST++ or AMASS; null: what InstantAvatar's program reads",
    )
    track_frames: list[Any] | None = setting(
        None,
        "[start, stop, step] of the pictures that the pose file covers, or one list a file; null: found out",
    )
    betas: int | list[float] | str | None = setting(
        None, "the person's shape: null, the pose file's; 10, the first ten of them; zeros; numbers; a file"
    )
    pixel_centres: float | str = setting(
        "auto",
        "where the first pixel's middle is for cx and cy as stored: 0 (InstantAvatar), 0.5 (COLMAP), or auto",
    )


DATASETS: dict[str, type[DatasetSettings]] = {
    "synthetic": SyntheticSettings,
    "zju": ZjuSettings,
    "ocmotion": OcMotionSettings,
    "video": VideoSettings,
}
