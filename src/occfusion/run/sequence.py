"""The sequence that a run learns from, kept in its folder: poses and cameras, so that showing it needs no data."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from occfusion.data.video.pose_table import measured_up
from occfusion.files.run_folder import RunFolder
from occfusion.motion import Clip, write_clip
from occfusion.run.bodies import make_body, make_data
from occfusion.settings.schema import Settings
from occfusion.show.views import HELD_OUT, TRAIN, View, write_views
from occfusion.synth.motion import TAKE_RATE

if TYPE_CHECKING:
    from occfusion.data.module import HumanDataModule


def record_sequence(folder: RunFolder, data: HumanDataModule, settings: Settings) -> None:
    """Writes the poses and cameras of a run's frames, training ones first in the list of cameras."""
    write_clip(folder.motion, own_clip(data, settings))
    (trained,) = data.train_cameras
    training = (
        View(data.camera_at(frame, trained), frame, trained, f"training, frame {frame}")
        for frame in data.train_indices
    )
    held_out = (
        View(data.camera_at(frame, camera), frame, camera, f"camera {camera}, frame {frame}")
        for frame, camera in data.test_views
    )
    write_views(folder.cameras, {TRAIN: training, HELD_OUT: held_out})


def own_clip(data: HumanDataModule, settings: Settings) -> Clip:
    """Returns the poses of the frames that were asked for and of held-out ones, in order of time."""
    frames = sorted({*data.sequence, *data.test_indices})
    poses = [data.pose(frame) for frame in frames]
    orient = np.stack([pose.global_orient.double().numpy() for pose in poses])
    step = int(np.median(np.diff(frames))) if len(frames) > 1 else 1
    return Clip(
        data.scene_name,
        orient,
        np.stack([pose.body_pose.double().numpy().reshape(-1) for pose in poses]),
        np.stack([pose.transl.double().numpy() for pose in poses]),
        TAKE_RATE / step if settings.dataset.name == "synthetic" else None,
        measured_up(orient) or "y",
        poses[0].betas.double().numpy(),
        np.asarray(frames, dtype=np.float64),
    )


def ensure_sequence(folder: RunFolder, settings: Settings) -> None:
    """Writes the record of the sequence where a run is older than it; its data are read for that.

    Raises:
        OccfusionError: the data are not where they were, or have changed.
    """
    if folder.motion.is_file() and folder.cameras.is_file():
        return
    body = make_body(settings.body)
    data = make_data(settings, body)
    if settings.registration == "auto":
        data.register(body.faces.cpu().numpy())
    record_sequence(folder, data, settings)
