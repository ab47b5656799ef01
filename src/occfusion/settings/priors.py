"""Settings of the priors, one record for each `prior=`: of masks, of the score that is distilled, of the inpainter."""

from __future__ import annotations

from dataclasses import dataclass, field

from occfusion.inpaint.completion import CompletionSettings
from occfusion.inpaint.embedded_inpainter import EmbeddedInpainterSettings
from occfusion.inpaint.sd15_inpainter import Sd15InpaintSettings
from occfusion.priors.embedded.silhouette_prior import EmbeddedSettings
from occfusion.priors.sd15.settings import Sd15ScoreModels, Sd15Settings


@dataclass(frozen=True)
class EmbeddedPriorSettings(EmbeddedSettings):
    """Our own networks, whose weights are in the package."""

    name: str = "embedded"
    inpaint: EmbeddedInpainterSettings = field(default_factory=EmbeddedInpainterSettings)
    completion: CompletionSettings = field(default_factory=CompletionSettings)


@dataclass(frozen=True)
class Sd15PriorSettings(Sd15Settings):
    """The paper's prior, Stable Diffusion 1.5; models, memory, margin and seed are those of masks for all three."""

    name: str = "sd15"
    score: Sd15ScoreModels = field(default_factory=Sd15ScoreModels)
    inpaint: Sd15InpaintSettings = field(default_factory=Sd15InpaintSettings)
    completion: CompletionSettings = field(default_factory=CompletionSettings)


PriorSettings = EmbeddedPriorSettings | Sd15PriorSettings
PRIORS: dict[str, type[EmbeddedPriorSettings] | type[Sd15PriorSettings]] = {
    "embedded": EmbeddedPriorSettings,
    "sd15": Sd15PriorSettings,
}
