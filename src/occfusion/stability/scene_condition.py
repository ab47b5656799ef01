"""What the pictures of a scene say of each group of parameters, and where Adam takes what they do not say.

Residuals are those of least squares: colours over the visible pixels, and the occupancy against the mask where nothing
hides the person, squared by twice. Their Gauss-Newton matrix is that of the real rasteriser and the real avatar.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from occfusion.human import Avatar, Body, Gaussians, PoseSpline
from occfusion.human.rendering import Renderer
from occfusion.inpaint.accumulation import accumulate, paint_observed
from occfusion.splat import Limits, rasterize
from occfusion.stability.gauss_newton import GaussNewton, Residuals, ritz_values
from occfusion.types import Frame

DISCS = 0.95
"""Opacity of Gaussians while the colours behind them are not to shine through, as where the stage begins."""
MASK_WEIGHT = 2.0
"""Of the mask's squares against the colours', as in the recipe."""
FAINTEST, LAST = 1e-8, 1e-12
"""Alpha and transmittance below which nothing is drawn in differences: their steps would be seen otherwise."""
WORST = 1e10
"""Conditions beyond are not told from this one: single precision has no more digits."""
GROUPS = {"means": "means", "scales": "log_scales", "opacity": "opacity_logits", "sh0": "sh0"}
"""Groups of the optimiser that Gaussians have, and their parameters."""
JOINT_NAMES = (
    "pelvis", "left hip", "right hip", "spine 1", "left knee", "right knee", "spine 2", "left ankle", "right ankle",
    "spine 3", "left foot", "right foot", "neck", "left collar", "right collar", "head", "left shoulder",
    "right shoulder", "left elbow", "right elbow", "left wrist", "right wrist", "left hand", "right hand",
)  # fmt: skip


@dataclass(frozen=True)
class Look:
    """How an avatar is drawn and compared in one precision.

    Attributes:
        avatar: whose.
        frames: that it is compared with.
        renderer: that draws it; None: the specification in float64, with thresholds too low to be seen.
    """

    avatar: Avatar
    frames: Sequence[Frame]
    renderer: Renderer | None

    def residuals(self) -> list[Residuals]:
        """Returns the residuals of each frame, `[H, W, 4]`."""
        return [lambda frame=frame: self._of(frame) for frame in self.frames]  # type: ignore[misc]

    def _of(self, frame: Frame) -> Tensor:
        camera = frame.camera
        cloud = self.avatar(frame.pose, camera.centre.to(self.avatar.gaussians.means))
        if self.renderer is not None:
            drawn = self.renderer.draw(cloud, camera)
        else:
            limits = Limits(alpha_min=FAINTEST, stop=LAST, dilation=cloud.dilation)
            drawn = rasterize(
                cloud.means, None, None, cloud.opacities, cloud.colors, camera.viewmat.to(cloud.means),
                camera.K.to(cloud.means), camera.width, camera.height, covariances=cloud.covariances,
                backend="torch", limits=limits,
            )  # fmt: skip
        seen = frame.visible_mask[..., None].to(drawn.rgb)
        told = torch.ones_like(drawn.alpha) if frame.occluded is None else (~frame.occluded).to(drawn.alpha)
        mask = (drawn.alpha - frame.visible_mask.to(drawn.alpha)) * told * MASK_WEIGHT**0.5
        return torch.cat([(drawn.rgb - frame.rgb.to(drawn.rgb)) * seen, mask[..., None]], dim=-1)


def begin(
    body: Body, frames: Sequence[Frame], renderer: Renderer, *, thickness: float, dilation: float
) -> Avatar:
    """Returns an avatar as the optimisation begins it: discs on the body in the colours that the frames show.

    Corrections of poses have a knot for each frame; neither networks nor lamps take part.
    """
    indices = [frame.index for frame in frames]
    avatar = Avatar(
        body,
        sh_degree=0,
        refine_pose=False,
        learn_skinning=False,
        pose_spline=PoseSpline.over(indices, 1),
        dilation=dilation,
        gaussians=Gaussians.on_body(body, 0, thickness=thickness),
    )
    paint_observed(avatar, accumulate(avatar.eval(), frames, renderer, DISCS))
    return avatar.train()


def train(
    avatar: Avatar, frames: Sequence[Frame], renderer: Renderer, rates: dict[str, float], steps: int
) -> None:
    """Fits an avatar by Adam as the stages use it, one frame a step, to the least squares of this study."""
    adam = torch.optim.Adam(avatar.parameter_groups(rates), eps=1e-15)
    residuals = Look(avatar, frames, renderer).residuals()
    for step in range(steps):
        avatar.prepare(step)
        adam.zero_grad(set_to_none=True)
        residuals[step * 7 % len(frames)]().square().mean().backward()
        adam.step()


def in_double(avatar: Avatar, body: Body) -> Avatar:
    """Returns the same avatar in float64, on the body of that precision."""
    gaussians = avatar.gaussians
    double = Gaussians(
        gaussians.means.detach().double(), gaussians.scales.detach().double(), gaussians.sh_degree
    )
    double.load_state_dict(gaussians.state_dict())
    spline = avatar.pose_spline
    assert spline is not None
    other = PoseSpline(spline.first, spline.spacing, spline.knots).double()
    other.load_state_dict(spline.state_dict())
    return Avatar(
        body, sh_degree=gaussians.sh_degree, refine_pose=False, learn_skinning=False, pose_spline=other,
        dilation=avatar.dilation, gaussians=double.double(),
    )  # fmt: skip


# --- what the data say -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Spectrum:
    """How the eigenvalues of a group's Gauss-Newton matrix lie.

    Attributes:
        group: of the optimiser.
        parameters: how many numbers it has.
        largest: eigenvalue.
        below: share of all directions whose eigenvalue is below 1e-2, 1e-4, 1e-6 of the largest.
    """

    group: str
    parameters: int
    largest: float
    below: tuple[float, ...]


def spectrum(look: Look, group: str, steps: int) -> Spectrum:
    """Returns the spectrum of a group by products with the real rasteriser, all others held."""
    parameter = parameter_of(look.avatar, group)
    values, weights = ritz_values(GaussNewton(look.residuals(), [parameter]), steps)
    largest = float(values.max())
    below = tuple(float(weights[values < bound * largest].sum()) for bound in (1e-2, 1e-4, 1e-6))
    return Spectrum(group, parameter.numel(), largest, below)


def condition(values: Tensor) -> Tensor:
    """Returns greatest over least of eigenvalues in ascending order, `[...]` of `[..., n]`, at most `WORST`."""
    return values[..., -1] / torch.maximum(values[..., 0], values[..., -1] / WORST)


def parameter_of(avatar: Avatar, group: str) -> nn.Parameter:
    """Returns the parameter of a group of the optimiser."""
    if group == "pose_turns":
        assert avatar.pose_spline is not None
        return avatar.pose_spline.turns
    found = getattr(avatar.gaussians, GROUPS[group])
    assert isinstance(found, nn.Parameter)
    return found


def mean_blocks(look: Look, samples: int) -> Tensor:
    """Returns each Gaussian's own block of the matrix of the means, all frames together, `[N, 3, 3]`."""
    found = GaussNewton(look.residuals(), [look.avatar.gaussians.means]).samples(samples)[0].double()
    return torch.einsum("kni,knj->nij", found, found) / samples


def along_and_across(look: Look, frame: Frame, samples: int) -> tuple[Tensor, Tensor]:
    """Returns what one picture knows of each Gaussian's place along its line of sight, and across it, `[N]` each."""
    one = Look(look.avatar, [frame], look.renderer)
    found = GaussNewton(one.residuals(), [look.avatar.gaussians.means]).samples(samples)[0].double()
    with torch.no_grad():
        carried = look.avatar.deform(frame.pose)
        sight = nn.functional.normalize(carried.means - frame.camera.centre.to(carried.means), dim=1).double()
        # a gradient by the canonical centre is L^t times the one by the posed centre
        maps = carried.linear.permute(2, 0, 1).double()
        posed = torch.linalg.solve(maps.transpose(1, 2), found.permute(1, 2, 0))
    along = (posed * sight[..., None]).sum(1).square().mean(1)
    return along, (posed.square().mean(2).sum(1) - along) / 2


def pose_matrix(look: Look, frame: Frame) -> Tensor:
    """Returns the whole Gauss-Newton matrix of the 72 angles of one frame's joints, float64, per radian squared.

    Args:
        look: in float64.
        frame: one of its frames.
    """
    avatar = look.avatar
    kept = avatar.pose_spline
    assert kept is not None
    one = _OneFrame(frame.index, kept.at(frame.index)[0].detach())
    try:
        avatar.pose_spline = one
        return GaussNewton(Look(avatar, [frame], look.renderer).residuals(), [one.angles]).matrix()
    finally:
        avatar.pose_spline = kept


class _OneFrame(PoseSpline):
    """Corrections of one frame alone, whose angles are the parameter themselves."""

    def __init__(self, frame: int, angles: Tensor) -> None:
        super().__init__(frame, 1.0, 4)
        self.double()
        self.angles = nn.Parameter(angles.double())

    def at(self, frame_index: float) -> tuple[Tensor, Tensor]:
        """Returns the angles, `[24, 3]`, radians, and no shift."""
        return self.angles, self.places[0]


# --- where Adam goes -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Moved:
    """How far parameters moved, by how much the data say of them.

    Attributes:
        group: of the optimiser.
        share: of the parameters in each of `BINS`.
        distance: root mean square that they moved, in the parameters' unit.
    """

    group: str
    share: tuple[float, ...]
    distance: tuple[float, ...]


BINS = (1e-1, 1e-2, 1e-3, 1e-4, 0.0)
"""Lower ends of what the data know, as shares of the most."""


def moved_by(group: str, known: Tensor, moved: Tensor) -> Moved:
    """Returns how far numbers moved in each bin of what the data know of them.

    Args:
        group: name.
        known: Gauss-Newton diagonal of each.
        moved: by how much, of the same shape.
    """
    relative, shares, distances = (known / known.max()).flatten(), [], []
    above = float("inf")
    for bound in BINS:
        chosen = (relative >= bound) & (relative < above)
        above = bound
        shares.append(float(chosen.double().mean()))
        own = moved.flatten()[chosen]
        distances.append(float(own.double().square().mean().sqrt()) if len(own) else float("nan"))
    return Moved(group, tuple(shares), tuple(distances))


def share_of_weakest(blocks: Tensor, moved: Tensor) -> float:
    """Returns the share of all squared motion that lies along each Gaussian's least known direction; 1/3: any way."""
    weakest = torch.linalg.eigh(blocks).eigenvectors[..., 0]
    return float((moved.double() * weakest).sum(1).square().sum() / moved.double().square().sum())
