"""Settings of the training stages; `conf/` holds their values with the paper's numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from occfusion.errors import ConfigError
from occfusion.fields import setting, with_default
from occfusion.human.densify import Densification
from occfusion.priors.distillation import REDUCTIONS, SCHEDULES, WEIGHTINGS

MANY = 10_000_000
"""Steps that no stage takes: the bound of all that counts them."""


@dataclass
class RateSettings:
    """Adam's learning rates by parameter group (GauHuman)."""

    means: float = setting(1.6e-4, "of the centres, at the first step", 0, 10)
    means_final: float = setting(1.6e-6, "of the centres, at the last step", 0, 10)
    sh0: float = setting(2.5e-3, "of the colours", 0, 10)
    sh_rest: float = setting(1.25e-4, "of the higher harmonics", 0, 10)
    opacity: float = setting(5e-2, "of the opacities, as logits", 0, 10)
    scales: float = setting(1e-2, "of the sizes, as logarithms", 0, 10)
    quats: float = setting(1e-3, "of the turns", 0, 10)
    pose: float = setting(3e-4, "of the network of pose corrections", 0, 10)
    pose_turns: float = setting(2e-4, "of the corrections frame by frame, radians", 0, 10)
    pose_places: float = setting(6e-5, "of the same, metres", 0, 10)
    skinning: float = setting(5e-5, "of the network of skinning weights", 0, 10)


@dataclass
class InitSettings:
    """The initialisation stage (paper §4.1)."""

    source: str = setting(
        "prior",
        "`prior`, or `truth`: the data set's own complete masks, an upper bound for synthetic scenes",
        choices=("prior", "truth"),
    )
    threshold: float = setting(0.5, "probability from which on a hidden pixel counts as the person", 0, 1)
    smoothing: float = setting(
        0.5, "weight of the frame before and of the frame after, beside 1 for the frame itself", 0, 10
    )
    calibrate: bool = setting(True, "fit the prior's answers to the scene on what the scene shows")
    max_frames: int | None = setting(
        100,
        "of more occluded frames so many are completed, evenly spread, where other frames tell better; null: all",
        1,
        MANY,
    )


@dataclass
class PriorTrainingSettings:
    """Training of an embedded prior (`stage=prior`)."""

    network: str = setting("silhouette", "the network", choices=("silhouette", "appearance", "completion"))
    widths: list[int] = setting([48, 96, 160], "channels of the network at each level", 1, 4096)
    depth: int = setting(2, "its residual blocks below the first level", 1, 100)
    steps: int = setting(6500, "steps of the training", 1, MANY)
    batch: int = setting(16, "examples a step", 1, 100_000)
    rate: float = setting(8e-4, "greatest learning rate", 0, 10)
    warmup: int = setting(200, "steps in which it is reached", 0, MANY)
    at_end: float = setting(
        0.4, "share of the examples at t = 1, where the prediction is the posterior mean", 0, 1
    )
    averaging: float = setting(0.998, "of the weights: what is kept of their mean at each step", 0, 1)
    examples: int = setting(20_000, "of the silhouette or the completion network's corpus", 1, MANY)
    subjects: int = setting(14, "scenes of the appearance network's corpus", 1, 100_000)
    validation: int = setting(96, "examples that are measured on", 1, MANY)
    start: str | None = setting(
        None, "a `.safetensors` file of the same network, whose weights it begins with; null: from nothing"
    )
    validation_first_second: float = setting(60.0, "of training at which it is measured first", 0.01, 1e6)
    corpus: str | None = setting(None, "folder of the corpus; null: in the run folder")


@dataclass
class SdsSettings:
    """Score distillation on the occupancy map (paper §4.2)."""

    lambda_pose: float = setting(1e4, "weight in the frame's pose; 0: left out", 0)
    lambda_can: float = setting(1e4, "weight in the canonical pose; 0: left out", 0)
    posed_probability: float = setting(
        0.75, "the paper's rho: chance that a step takes the frame's pose", 0, 1
    )
    weighting: str = setting("sigma2", "w(t): `sigma2`, or `uniform`", choices=WEIGHTINGS)
    schedule: str = setting(
        "annealed", "of t: `random`, or `annealed` from `t_max` to `t_min` over the stage", choices=SCHEDULES
    )
    t_min: float = setting(0.7, "least diffusion time, 0..1", 0, 1)
    t_max: float = setting(0.98, "greatest diffusion time", 0, 1)
    reduction: str = setting(
        "mean", "`mean` or `sum` over the values of the prior's signal", choices=REDUCTIONS
    )
    guidance: float = setting(
        1.0, "1: the score with conditions, 0: the one without (sd15: with the negative prompt)", 0, 1000
    )
    every: int = setting(
        2, "steps from one term to the next, which then has that many times the weight", 1, 10_000
    )
    where: str = setting(
        "hidden",
        "`hidden`: only pixels that are neither seen to show the person nor known background are pushed; `everywhere`; "
        "in the canonical pose nothing is known",
        choices=("hidden", "everywhere"),
    )
    evidence: bool = setting(True, "whether the prior is told what is seen, if it takes that")

    @property
    def is_used(self) -> bool:
        """Whether any term has a weight."""
        return self.lambda_pose > 0.0 or self.lambda_can > 0.0


LOGGERS = ("csv", "tensorboard", "wandb")


@dataclass
class LoggerSettings:
    """Where training is logged besides `losses.csv`."""

    name: str = setting("csv", "`csv`: nowhere; `tensorboard`; `wandb`", choices=LOGGERS)
    every: int = setting(8, "steps from one point of a logger's curves to the next", 1, MANY)
    pictures_every: int = setting(200, "steps from one picture to the next; 0: none", 0, MANY)
    project: str = setting("occfusion", "of Weights & Biases")
    offline: bool = setting(False, "whether Weights & Biases only writes files")


FULL = 1.0
OUTLINE_WEIGHT = 0.1
"""Of the own outline: 1 held what visible frames go on improving."""


@dataclass
class HiddenSettings:
    """What the mask term holds pixels to where the person may be hidden, and by what weight.

    A complete mask there comes from a prior and a pose that may be off by more than the avatar is, which other frames
    show whole. What no frame shows keeps its complete mask in full.
    """

    target: str = setting(
        "auto",
        "`complete`: the complete masks, as in the paper; `outline`: the avatar's own at the hand-over; `none`; "
        "`auto`: what the plan decides from the video",
        choices=("auto", "complete", "outline", "none"),
    )
    weight: float | None = setting(
        None,
        "of these pixels in the mask term; null: the target's own, 1 for masks and 0.1 for the outline",
        0,
        1,
    )

    @property
    def effective_weight(self) -> float:
        """The weight of these pixels; before a plan has decided, that of complete masks in full."""
        if self.target == "none":
            return 0.0
        own = OUTLINE_WEIGHT if self.target == "outline" else FULL
        return own if self.weight is None else self.weight


@dataclass
class ReferenceSettings:
    """The inpainted pictures of the refinement: where they come from, where they count, and how much."""

    source: str = setting(
        "auto",
        "`prior`: an inpainter; `coarse`: the coarse rendering itself; `auto`: the rendering for `prior=embedded` "
        "and `pixels=unseen`, else the prior; `truth`: the data set's own complete pictures, an upper bound for "
        "synthetic scenes",
        choices=("auto", "prior", "coarse", "truth"),
    )
    weight: float = setting(0.1, "of the L1 towards them; 0: left out", 0)
    pixels: str = setting(
        "unseen",
        "where they count: `unseen`: where the paper's R shows what no frame of the video does; `hidden`: in all of R",
        choices=("unseen", "hidden"),
    )
    perceptual: bool = setting(
        False,
        "whether the SSIM and perceptual terms look at them there too, beside visible pixels; the paper: true",
    )


@dataclass
class SurfaceSettings:
    """What holds Gaussians to the body where the video leaves them free; weights in multiples of `lambda_rgb`.

    What was seen from many directions is left alone. The paper has none of it.
    """

    outline: float = setting(
        1.0, "weight of the outline, against body and clothes, in views from sides that no frame shows", 0
    )
    backface: float = setting(
        1.0, "weight of what shines through from the body's other side where no frame shows it", 0
    )
    hold: bool = setting(
        True,
        "bound how far Gaussians stand off clothes and body, and reach out of them, where the depth is not known; in "
        "the refinement, colours learn as fast as the pictures show them in front",
    )
    every: int = setting(
        4, "steps from one such view to the next, which then has that many times the weight", 1, 10_000
    )

    @property
    def is_used(self) -> bool:
        """Whether any term has a weight."""
        return self.hold or self.are_views_used

    @property
    def are_views_used(self) -> bool:
        """Whether views from other sides are drawn."""
        return self.outline > 0 or self.backface > 0


@dataclass
class AvatarSettings:
    """What the stages that train an avatar have in common: weights, schedules and rates.

    The weights are those of the colours' L1 on visible pixels, the occupancy's L2 against the masks, the structural and
    the perceptual term.
    """

    steps: int = setting(1200, "steps of the stage", 1, MANY)
    lambda_rgb: float = setting(1e4, "weight of the colours' L1 on visible pixels", 0)
    lambda_mask: float = setting(2e4, "weight of the occupancy's L2 against the masks", 0)
    lambda_ssim: float = setting(
        1e3, "weight of the structural term; the paper has none in its refinement", 0
    )
    ssim_margin: int = setting(
        1, "pixels at the edge of the visible mask that the structural term does not see", 0, 64
    )
    lambda_lpips: float = setting(1e3, "weight of the perceptual term", 0)
    perceptual_every: int = setting(
        8, "steps from one perceptual term to the next, which then has that many times the weight", 1, 10_000
    )
    perceptual_from: float = setting(0.0, "share of the stage's steps that go by without it", 0, 1)
    perceptual_crop: int | None = setting(
        128, "side of its random crop, pixels; null: the whole picture", 32, 2048
    )
    hidden: HiddenSettings = field(default_factory=HiddenSettings)
    surface: SurfaceSettings = field(default_factory=SurfaceSettings)
    sh_degree: int = setting(1, "highest band of spherical harmonics", 0, 3)
    sh_every: int = setting(1000, "steps from one band to the next, counted over all stages", 1, MANY)
    densify: bool = setting(False, "whether Gaussians are added, joined and removed")
    densification: Densification = field(default_factory=Densification)
    rates: RateSettings = field(default_factory=RateSettings)
    rates_at_end: float = setting(
        1.0, "factor on all rates at the stage's last step, reached exponentially; 1: none", 0, 1
    )

    @property
    def first_perceptual_step(self) -> int:
        """The first step that has the perceptual term."""
        return math.ceil(self.perceptual_from * self.steps / self.perceptual_every) * self.perceptual_every

    def term_weights(self) -> dict[str, float]:
        """Returns the weight of each loss term, by its name."""
        return {
            "rgb": self.lambda_rgb, "mask": self.lambda_mask, "ssim": self.lambda_ssim, "lpips": self.lambda_lpips
        }  # fmt: skip

    def check(self, group: str) -> None:
        """Refuses what does not go together.

        Raises:
            ConfigError: naming the settings.
        """
        if not any(self.term_weights().values()):
            raise ConfigError(
                f"settings {group}.lambda_*: all weights are zero, so there is nothing to train"
            )
        target, weight = self.hidden.target, self.hidden.weight
        if weight is not None and target in ("auto", "none"):
            raise ConfigError(
                f"setting {group}.hidden.weight={weight:g}: {group}.hidden.target={target} has no weight to choose; "
                f"choose {group}.hidden.target=complete"
            )


@dataclass
class OptimSettings(AvatarSettings):
    """The optimisation stage (paper §4.2)."""

    pixels: str = setting(
        "visible", "`visible`: the paper's M; `all`: the whole crop", choices=("visible", "all")
    )
    gaussians: int = setting(
        20_000,
        "at the start, at least (`Gaussians.on_body`); 0: one on each vertex of the body",
        0,
        1_000_000,
    )
    dilation: float = setting(
        0.02, "of the splats in pictures of both stages, square pixels; 3DGS: 0.3", 0.01, 1.0
    )
    thickness: float = setting(
        0.002, "of the Gaussians at the start, which then lie flat on the body, m; 0: they are round", 0, 0.05
    )
    observed_colors: bool = setting(
        True, "Gaussians start with the colours that the video shows, instead of grey; the paper: grey"
    )
    unseen_colors: str = setting(
        "auto",
        "colours of what no frame shows: `nearest`: of what is seen nearby; `prior`: a network completes them; `auto`: "
        "the network where the video leaves much of the body unseen",
        choices=("auto", "nearest", "prior"),
    )
    key_light: bool = setting(
        True, "estimate a lamp from the video, by which colours change as surfaces turn; the paper has none"
    )
    refine_pose: bool = setting(True, "GauHuman's network of pose corrections")
    pose_knots: int = setting(
        4,
        "training frames from one knot to the next of the corrections frame by frame, fewer where outlines say so; "
        "0: none",
        0,
        10_000,
    )
    align_poses: bool = setting(
        True,
        "whether these corrections begin where the outlines of masks have the body, and learn as far as the video "
        "tells that poses are off; the networks of pose and skinning are left out then",
    )
    learn_skinning: bool = setting(True, "GauHuman's network of skinning weights")
    skinning_every: int = setting(8, "steps from one evaluation of it to the next", 1, 10_000)
    sds: SdsSettings = field(default_factory=SdsSettings)

    def check(self, group: str) -> None:
        """Refuses what does not go together.

        Raises:
            ConfigError: naming the settings.
        """
        super().check(group)
        if self.hidden.target == "outline":
            raise ConfigError(
                f"setting {group}.hidden.target=outline: the avatar has no outline of its own before the refinement; "
                f"choose auto, complete or none"
            )
        if self.sds.t_max < self.sds.t_min:
            raise ConfigError(
                f"setting {group}.sds.t_max={self.sds.t_max:g}: must be {group}.sds.t_min={self.sds.t_min:g} or more"
            )


@dataclass
class RefineSettings(AvatarSettings):
    """The refinement stage (paper §4.3)."""

    references: ReferenceSettings = field(default_factory=ReferenceSettings)
    steps: int = with_default(AvatarSettings, "steps", 900)
    lambda_rgb: float = with_default(AvatarSettings, "lambda_rgb", 1.0)
    lambda_mask: float = with_default(AvatarSettings, "lambda_mask", 2.0)
    lambda_ssim: float = with_default(AvatarSettings, "lambda_ssim", 0.2)
    lambda_lpips: float = with_default(AvatarSettings, "lambda_lpips", 0.1)
    perceptual_every: int = with_default(AvatarSettings, "perceptual_every", 16)
    perceptual_from: float = with_default(AvatarSettings, "perceptual_from", 0.5)
    densify: bool = with_default(AvatarSettings, "densify", True)
    densification: Densification = field(
        default_factory=lambda: Densification(
            after_step=0,
            every=100,
            before_step=501,
            gradient=4e-4,
            from_body=0.15,
            divide=True,
            narrower=1.5,
            max_gaussians=15_000,
        )
    )
    rates_at_end: float = with_default(AvatarSettings, "rates_at_end", 0.3)

    def term_weights(self) -> dict[str, float]:
        """Returns the weight of each loss term, by its name."""
        return {**super().term_weights(), "gen": self.references.weight}
