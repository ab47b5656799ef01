"""From the settings of `prior=` to a prior."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch

from occfusion.errors import ConfigError
from occfusion.fields import read_record
from occfusion.priors.embedded.silhouette_prior import EmbeddedMaskPrior, EmbeddedScore, EmbeddedSettings
from occfusion.priors.masks import MaskPrior
from occfusion.priors.score import ScorePrior

if TYPE_CHECKING:
    from occfusion.priors.sd15.score_prior import Sd15ScoreSettings


OTHERS = ("score", "inpaint", "completion")
"""Keys of the settings of `prior=` that are not the mask prior's."""


def make_mask_prior(settings: Mapping[str, Any], device: torch.device) -> MaskPrior:
    """Returns the prior of a mapping with the key `name` and its settings; loads its weights.

    Raises:
        ConfigError: an unknown prior, key or type.
        DataError: weights are missing or damaged.
    """
    name, options = settings.get("name"), mask_settings(settings)
    if name == "embedded":
        return EmbeddedMaskPrior(read_record(EmbeddedSettings, options, "prior"), device)
    if name == "sd15":
        from occfusion.priors.sd15.mask_prior import Sd15MaskPrior  # diffusers is an extra
        from occfusion.priors.sd15.settings import Sd15Settings

        return Sd15MaskPrior(read_record(Sd15Settings, options, "prior"), device)
    raise ConfigError(f"prior.name={name!r}: choose embedded or sd15")


def mask_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the mask prior's own settings: all of `prior` but its name and the groups in it."""
    return {key: value for key, value in settings.items() if key not in ("name", *OTHERS)}


def make_score_prior(settings: Mapping[str, Any], device: torch.device) -> ScorePrior[Any]:
    """Returns the prior whose score is distilled, of the same mapping as `make_mask_prior`; loads its weights.

    Raises:
        ConfigError: an unknown prior, key or type.
        DataError: weights are missing or damaged.
    """
    name = settings.get("name")
    if name == "embedded":
        return EmbeddedScore(settings.get("weights"), device)
    if name == "sd15":
        from occfusion.priors.sd15.score_prior import Sd15Score

        return Sd15Score(_score_settings(settings), device)
    raise ConfigError(f"prior.name={name!r}: choose embedded or sd15")


def check_score_prior(settings: Mapping[str, Any]) -> None:
    """Looks for the models of `make_score_prior` without loading them, before hours are spent on what precedes it.

    Raises:
        ConfigError: an unknown key or type, or a package is missing.
        DataError: a model is missing or incomplete.
    """
    if settings.get("name") == "sd15":
        from occfusion.priors.sd15.score_prior import find_score_models

        find_score_models(_score_settings(settings))


def _score_settings(settings: Mapping[str, Any]) -> Sd15ScoreSettings:
    from occfusion.priors.sd15.score_prior import Sd15ScoreSettings

    shared = {key: settings[key] for key in ("local_files_only", "dtype", "device") if key in settings}
    return read_record(Sd15ScoreSettings, {**shared, **(settings.get("score") or {})}, "prior")
