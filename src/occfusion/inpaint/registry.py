"""From the settings of `prior=` to an inpainter."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from occfusion.errors import ConfigError
from occfusion.inpaint.embedded import EmbeddedInpainter, EmbeddedInpainterSettings
from occfusion.inpaint.partial import Inpainter
from occfusion.priors.registry import typed_settings

GROUP = "inpaint"
"""Key of the inpainter's own settings in those of the prior."""


def make_inpainter(settings: Mapping[str, Any], device: torch.device) -> Inpainter:
    """Returns the inpainter of a mapping with the key `name` and, under `inpaint`, its settings; loads its weights.

    Raises:
        ConfigError: an unknown prior, key or type.
        DataError: weights are missing or damaged.
    """
    name, own = settings.get("name"), dict(settings.get(GROUP) or {})
    if name == "embedded":
        return EmbeddedInpainter(typed_settings(EmbeddedInpainterSettings, own, f"prior.{GROUP}"), device)
    raise ConfigError(f"prior.name={name!r}: choose embedded")
