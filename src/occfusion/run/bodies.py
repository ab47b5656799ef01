"""The body and the data that settings name; nothing of a run's stages."""

from __future__ import annotations

import importlib
from dataclasses import fields
from typing import TYPE_CHECKING

from occfusion.errors import ConfigError
from occfusion.human import Body, embedded_body, load_body
from occfusion.human.body import without_pose_blend_shapes
from occfusion.settings.schema import BodySettings, Settings, most_seen

if TYPE_CHECKING:
    from occfusion.data.module import HumanDataModule

DATA_MODULES = {
    "synthetic": ("occfusion.data.synthetic", "make_synthetic"),
    "zju": ("occfusion.data.zju.zju_data", "ZjuDataModule"),
    "ocmotion": ("occfusion.data.ocmotion.ocmotion_data", "OcMotionDataModule"),
    "video": ("occfusion.data.video.video_data", "VideoDataModule"),
}
"""What reads each `dataset=`, by module and name; imported when it is needed, since showing an avatar needs no data.
Its arguments are the settings of `occfusion.settings.datasets`."""
REGISTER_SMPL = "register at smpl.is.tue.mpg.de, download the model, and pass body.path=FILE"


def make_body(settings: BodySettings) -> Body:
    """Returns the body that the settings name.

    Raises:
        ConfigError: a licensed body without a file.
    """
    if settings.path is not None:
        body = load_body(settings.path, cut_betas=settings.cut_betas)
        return body if settings.pose_blend_shapes else without_pose_blend_shapes(body)
    if settings.name == "anny":
        return embedded_body()
    raise ConfigError(
        f"body={settings.name} needs body.path: {REGISTER_SMPL}; or use dataset=synthetic, which needs none"
    )


def make_data(settings: Settings, body: Body) -> HumanDataModule:
    """Returns the DataModule that the settings name; nothing but its folder is looked at yet.

    Raises:
        ConfigError: as the module that it is.
    """
    own = settings.dataset
    options = {field.name: getattr(own, field.name) for field in fields(own)}
    name = options.pop("name")
    if name == "synthetic":
        options["fast_dev_run"] = settings.trainer.fast_dev_run
    module, reader = DATA_MODULES[name]
    made: HumanDataModule = getattr(importlib.import_module(module), reader)(
        body=body, seed=settings.seed, **options
    )
    made.most_seen = most_seen(settings)
    return made
