"""From the settings of `prior=` to an inpainter."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeVar

import torch

from occfusion.errors import ConfigError
from occfusion.fields import read_record
from occfusion.inpaint.appearance_net import load_appearance_net
from occfusion.inpaint.embedded_inpainter import EmbeddedInpainter, EmbeddedInpainterSettings
from occfusion.inpaint.partial import Inpainter
from occfusion.priors.build_prior import mask_settings

if TYPE_CHECKING:
    from occfusion.inpaint.sd15_inpainter import Sd15InpaintSettings
    from occfusion.priors.sd15.settings import Sd15Settings


S = TypeVar("S")

GROUP = "inpaint"
"""Key of the inpainter's own settings in those of the prior."""


def make_inpainter(settings: Mapping[str, Any], device: torch.device) -> Inpainter:
    """Returns the inpainter of a mapping with the key `name` and, under `inpaint`, its settings; loads its weights.

    Raises:
        ConfigError: an unknown prior, key or type.
        DataError: weights are missing or damaged.
    """
    name = settings.get("name")
    if name == "embedded":
        return EmbeddedInpainter(_own_settings(EmbeddedInpainterSettings, settings), device)
    if name == "sd15":
        from occfusion.inpaint.sd15_inpainter import Sd15Inpainter  # diffusers is an extra

        return Sd15Inpainter(*_sd15_settings(settings), device)
    raise ConfigError(f"prior.name={name!r}: choose embedded or sd15")


def check_inpainter(settings: Mapping[str, Any], device: torch.device) -> None:
    """Looks for what `make_inpainter` needs before hours are spent on what precedes it.

    Raises:
        ConfigError: an unknown key or type, a value or device that is not allowed, or a package is missing.
        DataError: a model of `prior=sd15`, or the file of weights, is missing or damaged.
    """
    if settings.get("name") == "sd15":
        from occfusion.priors.sd15.pipeline import find_inpainting, resolve_placement

        _, shared = _sd15_settings(settings)
        resolve_placement(shared, device)
        find_inpainting(shared)
    else:
        own = _own_settings(EmbeddedInpainterSettings, settings)
        if own.weights is not None:  # small: loaded to see that it can be
            load_appearance_net(own.weights)


def _own_settings(kind: type[S], settings: Mapping[str, Any]) -> S:
    return read_record(kind, dict(settings.get(GROUP) or {}), f"prior.{GROUP}")


def _sd15_settings(settings: Mapping[str, Any]) -> tuple[Sd15InpaintSettings, Sd15Settings]:
    from occfusion.inpaint.sd15_inpainter import Sd15InpaintSettings
    from occfusion.priors.sd15.settings import Sd15Settings

    own = _own_settings(Sd15InpaintSettings, settings)
    return own, read_record(Sd15Settings, mask_settings(settings), "prior")
