"""Settings of the training stages; `conf/optim/` holds their values with the paper's numbers."""

from __future__ import annotations

from dataclasses import dataclass, field

from occfusion.human.densify import Densification


@dataclass
class RateSettings:
    """Adam's learning rates by parameter group (GauHuman).

    Attributes:
        means: of the centres, at the first step.
        means_final: of the centres, at the last step.
        sh0: of the colours.
        sh_rest: of the higher harmonics.
        opacity: of the opacities, as logits.
        scales: of the sizes, as logarithms.
        quats: of the turns.
        pose: of the network of pose corrections.
        pose_turns: of the corrections frame by frame, radians.
        pose_places: of the same, metres.
        skinning: of the network of skinning weights.
    """

    means: float = 1.6e-4
    means_final: float = 1.6e-6
    sh0: float = 2.5e-3
    sh_rest: float = 1.25e-4
    opacity: float = 5e-2
    scales: float = 1e-2
    quats: float = 1e-3
    pose: float = 3e-4
    pose_turns: float = 2e-4
    pose_places: float = 6e-5
    skinning: float = 5e-5


@dataclass
class InitSettings:
    """The initialisation stage (paper §4.1).

    Attributes:
        source: `prior`, or `truth`: the data set's own complete masks, an upper bound for synthetic scenes.
        threshold: probability from which on a hidden pixel counts as the person.
        smoothing: weight of the frame before and of the frame after, beside 1 for the frame itself.
        calibrate: fit the prior's answers to the scene on what the scene shows.
    """

    source: str = "prior"
    threshold: float = 0.5
    smoothing: float = 0.5
    calibrate: bool = True


@dataclass
class PriorTrainingSettings:
    """Training of an embedded prior (`stage=prior`).

    Attributes:
        network: `silhouette` or `appearance`.
        widths: channels of the network at each level.
        depth: its residual blocks below the first level.
        steps: of the training.
        batch: examples a step.
        rate: greatest learning rate.
        warmup: steps in which it is reached.
        at_end: share of the examples at t = 1, where the prediction is the posterior mean.
        averaging: of the weights.
        examples: silhouettes of the silhouette network's corpus.
        subjects: scenes of the appearance network's corpus.
        validation: silhouettes that are measured on.
        validation_first_second: when it is measured first.
        corpus: its folder; null: in the run folder.
    """

    network: str = "silhouette"
    widths: list[int] = field(default_factory=lambda: [48, 96, 160])
    depth: int = 2
    steps: int = 6000
    batch: int = 16
    rate: float = 8e-4
    warmup: int = 200
    at_end: float = 0.4
    averaging: float = 0.998
    examples: int = 20_000
    subjects: int = 14
    validation: int = 96
    validation_first_second: float = 60.0
    corpus: str | None = None


@dataclass
class SdsSettings:
    """Score distillation on the occupancy map (paper §4.2).

    Attributes:
        lambda_pose: weight in the frame's pose; 0: left out.
        lambda_can: weight in the canonical pose; 0: left out.
        posed_probability: the paper's rho: chance that a step takes the frame's pose.
        weighting: w(t): `sigma2`, or `uniform`.
        schedule: of t: `random`, or `annealed` from `t_max` to `t_min` over the stage.
        t_min: least diffusion time, 0..1.
        t_max: greatest diffusion time.
        reduction: `mean` or `sum` over the values of the prior's signal.
        guidance: 1: the score with conditions, 0: the one without (sd15: with the negative prompt).
        every: steps from one term to the next, which then has that many times the weight.
        where: `hidden`: only pixels that are neither seen to show the person nor known background are pushed;
            `everywhere`. In the canonical pose nothing is known.
        evidence: whether the prior is told what is seen, if it takes that.
    """

    lambda_pose: float = 1e4
    lambda_can: float = 1e4
    posed_probability: float = 0.75
    weighting: str = "sigma2"
    schedule: str = "annealed"
    t_min: float = 0.7
    t_max: float = 0.98
    reduction: str = "mean"
    guidance: float = 1.0
    every: int = 2
    where: str = "hidden"
    evidence: bool = True

    @property
    def is_used(self) -> bool:
        """Whether any term has a weight."""
        return self.lambda_pose > 0.0 or self.lambda_can > 0.0


LOGGERS = ("csv", "tensorboard", "wandb")


@dataclass
class LoggerSettings:
    """Where training is logged besides `losses.csv`.

    Attributes:
        name: `csv`: nowhere; `tensorboard`; `wandb`.
        every: steps from one point of a logger's curves to the next.
        pictures_every: steps from one picture to the next; 0: none.
        project: of Weights & Biases.
        offline: whether Weights & Biases only writes files.
    """

    name: str = "csv"
    every: int = 8
    pictures_every: int = 200
    project: str = "occfusion"
    offline: bool = False


@dataclass
class AvatarSettings:
    """What the stages that train an avatar have in common: schedules and rates.

    Attributes:
        steps: of the stage.
        perceptual_every: steps from one perceptual term to the next, which then has that many times the weight.
        perceptual_crop: side of its random crop, pixels.
        sh_degree: highest band of spherical harmonics.
        sh_every: steps from one band to the next, counted over all stages.
        densify: whether Gaussians are added, joined and removed.
        densification: thresholds and schedule, in steps of the stage.
        rates: Adam's.
        rates_at_end: factor on all rates at the stage's last step, reached exponentially; 1: none.
    """

    steps: int = 1200
    perceptual_every: int = 8
    perceptual_crop: int = 128
    sh_degree: int = 1
    sh_every: int = 1000
    densify: bool = False
    densification: Densification = field(default_factory=Densification)
    rates: RateSettings = field(default_factory=RateSettings)
    rates_at_end: float = 1.0


@dataclass
class OptimSettings(AvatarSettings):
    """The optimisation stage (paper §4.2).

    Attributes:
        pixels: `visible`: the paper's M; `all`: the whole crop.
        lambda_rgb: weight of the colours' L1.
        lambda_mask: weight of the occupancy's L2 against the masks.
        lambda_ssim: weight of the structural term.
        lambda_lpips: weight of the perceptual term.
        mask_hidden: weight of complete masks in the mask term where the person may be hidden, 0..1; the paper: 1.
        gaussians: at the start, at least (`Gaussians.on_body`); 0: one on each vertex of the body.
        dilation: of the splats in pictures, square pixels; 3DGS: 0.3. Its pictures and the refinement's have the same.
        thickness: of the Gaussians at the start, which then lie flat on the body, m; 0: they are round.
        observed_colors: Gaussians start with the colours that the video shows, instead of grey; the paper: grey.
        key_light: estimate a lamp from the video, by which colours change as surfaces turn; the paper has none.
        refine_pose: GauHuman's network of pose corrections.
        pose_knots: training frames from one knot to the next of the corrections frame by frame; 0: none.
        learn_skinning: GauHuman's network of skinning weights.
        skinning_every: steps from one evaluation of it to the next.
        sds: score distillation.
    """

    pixels: str = "visible"
    mask_hidden: float = 1.0
    lambda_rgb: float = 1e4
    lambda_mask: float = 2e4
    lambda_ssim: float = 1e3
    lambda_lpips: float = 1e3
    gaussians: int = 20_000
    dilation: float = 0.02
    thickness: float = 0.002
    observed_colors: bool = True
    key_light: bool = True
    refine_pose: bool = True
    pose_knots: int = 4
    learn_skinning: bool = True
    skinning_every: int = 4
    sds: SdsSettings = field(default_factory=SdsSettings)


@dataclass
class RefineSettings(AvatarSettings):
    """The refinement stage (paper §4.3).

    Attributes:
        source: of the references: `prior`; `coarse`: the coarse rendering itself, to see what inpainting adds;
            `truth`: the data set's own complete pictures, an upper bound for synthetic scenes.
        mask_hidden: weight of complete masks in the mask term where the person may be hidden, 0..1; the paper: 1.
        mask_hidden_fitting: the same where poses fit as given, and complete masks with them.
        mask_target: what the mask term holds these pixels to: `outline`: where poses fit as given, the avatar's own at
            the hand-over; `complete`: the complete masks, as in the paper, with the weights above.
        mask_outline: weight of the own outline, 0..1.
        lambda_rgb: weight of the colours' L1 on visible pixels.
        lambda_mask: weight of the occupancy's L2 against the masks.
        lambda_gen: weight of the L1 towards the references.
        lambda_lpips: weight of the perceptual term.
        lambda_ssim: weight of the structural term; the paper has none here.
        gen_pixels: where references count: `unseen`: where the paper's R shows what no frame of the video does;
            `hidden`: in all of R.
        lpips_pixels: what the SSIM and perceptual terms look at: `visible`; `all`: at those pixels of the
            references as well.
    """

    source: str = "prior"
    mask_hidden: float = 0.0
    mask_hidden_fitting: float = 0.2
    mask_target: str = "outline"
    mask_outline: float = 0.1
    gen_pixels: str = "unseen"
    lpips_pixels: str = "visible"
    steps: int = 1800
    lambda_rgb: float = 1.0
    lambda_mask: float = 2.0
    lambda_gen: float = 0.1
    lambda_lpips: float = 0.1
    lambda_ssim: float = 0.2
    perceptual_every: int = 16
    densify: bool = True
    densification: Densification = field(
        default_factory=lambda: Densification(
            after_step=0, before_step=601, gradient=4e-4, from_body=0.15, max_gaussians=15_000
        )
    )
    rates_at_end: float = 0.3
