"""Names that settings had once: each is refused with what takes its place, and left out of the runs of then."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from occfusion.errors import ConfigError

RENAMED = {
    "optim.mask_hidden": "optim.hidden.weight, with optim.hidden.target=complete",
    "refine.mask_hidden": "refine.hidden.weight, with refine.hidden.target=complete; 0: refine.hidden.target=none",
    "refine.mask_hidden_fitting": "refine.hidden.weight, with refine.hidden.target=complete",
    "refine.mask_target": "refine.hidden.target",
    "refine.mask_outline": "refine.hidden.weight, with refine.hidden.target=outline",
    "refine.source": "refine.references.source",
    "refine.lambda_gen": "refine.references.weight",
    "refine.gen_pixels": "refine.references.pixels",
    "refine.lpips_pixels": "refine.references.perceptual: false for `visible`, true for `all`",
    "prior.score.local_files_only": "prior.local_files_only",
    "prior.score.dtype": "prior.dtype",
    "prior.score.device": "prior.device",
    "dataset._target_": "dataset.name",
}
"""Settings that have another name now, and which."""
REMOVED = (
    "trainer.strategy", "optim.lambda_correction", "refine.lambda_correction", "optim.sds.start_step", "optim.sh_frame",
    "prior.completion.draws", "prior.completion.samples", "prior.completion.steps", "prior.completion.seed",
    "optim.surface.depth", "optim.surface.extent", "optim.surface.tilt",
    "refine.surface.depth", "refine.surface.extent", "refine.surface.tilt",
)  # fmt: skip
"""Settings that are gone.

A trained avatar does not depend on them: its file names the frame that `sh_frame` chose, and is refused where that is
another.
"""


def refuse_old_names(keys: Iterable[str]) -> None:
    """Refuses a setting by a name that it had once.

    Args:
        keys: dotted names of settings.

    Raises:
        ConfigError: with the name that it has now.
    """
    for key in keys:
        if key in RENAMED:
            raise ConfigError(f"setting {key}: has another name now: {RENAMED[key]}")
        if key in REMOVED:
            raise ConfigError(f"setting {key}: there is no such setting any more; leave it out")


def without_old_names(config: Mapping[str, Any], group: str = "") -> dict[str, Any]:
    """Returns the settings of a run, as its folder keeps them, without those whose names are not known any more."""
    kept = {}
    for name, value in config.items():
        key = f"{group}{name}"
        if key not in RENAMED and key not in REMOVED:
            kept[name] = without_old_names(value, f"{key}.") if isinstance(value, Mapping) else value
    return kept


def dotted(config: Mapping[str, Any], group: str = "") -> Iterable[str]:
    """Yields the dotted names of nested settings."""
    for name, value in config.items():
        yield f"{group}{name}"
        if isinstance(value, Mapping):
            yield from dotted(value, f"{group}{name}.")
