"""Builds the body and the data of a run from its settings."""

from __future__ import annotations

import inspect
from collections.abc import Callable

from hydra.utils import get_object

from occfusion.data.module import HumanDataModule
from occfusion.errors import ConfigError
from occfusion.human import Body, embedded_body, load_body
from occfusion.human.unblended import without_pose_blend_shapes
from occfusion.settings.schema import BodySettings, Settings

TARGET_PREFIX = "occfusion."
"""Data sets are named by import path; nothing outside this package is ever instantiated from a file."""
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
        ConfigError: unknown keys, or an import path outside this package.
    """
    options = dict(settings.dataset)
    target, name = str(options.pop("_target_", "")), options.pop("name", "?")
    if not target.startswith(TARGET_PREFIX):
        raise ConfigError(f"setting dataset._target_: {target!r} is not in this package")
    make: Callable[..., HumanDataModule] = get_object(target)
    if settings.trainer.fast_dev_run and "fast_dev_run" in inspect.signature(make).parameters:
        options["fast_dev_run"] = True
    try:
        inspect.signature(make).bind(body=body, seed=settings.seed, **options)
    except TypeError as error:
        raise ConfigError(f"settings dataset.* do not fit dataset={name}: {error}") from error
    return make(body=body, seed=settings.seed, **options)
