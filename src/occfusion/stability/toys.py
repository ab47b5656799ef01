"""Stiff problems with a known optimum, one for each kind of parameter, and how many steps optimisers need for them.

Each is the smallest thing that has the stiffness of its group: what a camera sees badly is seen the worse the further
the axis is followed, and nothing else changes. All places of an axis are walked at once, row by row.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from occfusion.geometry.rotation import axis_angle_to_matrix

CLOSE = 0.05
"""Share of the distance at the start that counts as arrived."""
ADAM_EPS = 1e-15
"""As the stages have it."""
TURN = torch.tensor([0.5, -0.4, 0.3], dtype=torch.float64)
"""Axis-angle, radians, of the parameters' axes against those of the data: weak directions are those of no parameter."""


@dataclass(frozen=True)
class Toy:
    """A kind of least squares whose condition follows one number.

    Attributes:
        group: of parameters, as in the optimiser.
        places: values of the number that is followed, from well to badly conditioned.
        rate: of the recipe for this group; Adam's learning rate.
        optimum: `[n]`, the same everywhere.
        start: where it is begun, `[n]`.
        residuals: of parameters `[R, n]` at places `[R]`, `[R, m]`; zero at the optimum.
    """

    group: str
    places: tuple[float, ...]
    rate: float
    optimum: Tensor
    start: Tensor
    residuals: Callable[[Tensor, Tensor], Tensor]

    def jacobian(self, x: Tensor, places: Tensor) -> Tensor:
        """Returns dr/dx of each row, `[R, m, n]`; a row depends on its own parameters alone."""
        with torch.enable_grad():
            x = x.detach().requires_grad_()
            r = self.residuals(x, places)
            rows = [torch.autograd.grad(r[:, k].sum(), x, retain_graph=True)[0] for k in range(r.shape[1])]
        return torch.stack(rows, dim=1)

    def condition(self) -> Tensor:
        """Returns the condition of J^t J at the optimum of each place, `[R]`."""
        places = torch.tensor(self.places, dtype=torch.float64)
        x = self.optimum.expand(len(places), -1)
        values = torch.linalg.svdvals(self.jacobian(x, places))
        return (values[:, 0] / values[:, -1]).square()


@dataclass(frozen=True)
class Walk:
    """How an optimiser came along on one problem.

    Attributes:
        group: of the problem.
        place: on its axis.
        condition: of the problem.
        optimiser: name.
        rate: learning rate; None: it has none.
        steps: until it was within 5 % of its distance at the start; None: not in those that it had.
        distance: at the end, as a share of that at the start.
        seconds: until then, or of all steps; of this problem alone.
        curve: (steps, share of the distance left), evenly in the logarithm of steps.
    """

    group: str
    place: float
    condition: float
    optimiser: str
    rate: float | None
    steps: int | None
    distance: float
    seconds: float
    curve: tuple[tuple[int, float], ...]


def toys(rates: dict[str, float]) -> list[Toy]:
    """Returns the problems.

    Args:
        rates: of the optimiser's groups `means`, `pose_turns`, `scales`, `opacity`.
    """
    degrees, leverage = (90.0, 30.0, 10.0, 3.0, 1.0, 0.3, 0.1), (1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 0.001)
    pixels, faint = (2.0, 1.0, 0.5, 0.25, 0.12, 0.06), (0.3, 0.6, 0.9, 0.97, 0.99, 0.997)
    matrix = axis_angle_to_matrix(TURN)

    def row(*values: float) -> Tensor:
        return torch.tensor(values, dtype=torch.float64)

    return [
        # a point before two cameras that look at it from so many degrees apart
        Toy("means", degrees, rates["means"], row(0, 0, 0), matrix @ row(0.004, 0.004, 0.008),
            lambda x, p: _two_cameras(x @ matrix, p)),
        # a limb seen by marks on its axis and one so many limb lengths off it: all that tells its twist
        Toy("pose_turns", leverage, rates["pose_turns"], row(0, 0, 0), matrix @ row(0.03, 0.03, 0.06),
            lambda x, p: _limb(x @ matrix, p)),
        # a blob 4 pixels long and so many wide, with a pixel's own footprint
        Toy("scales", pixels, rates["scales"], row(0, 0), row(0.3, 0.3), _blob),
        # three layers of a pixel, the first two of such an opacity
        Toy("opacity", faint, rates["opacity"], row(0, 0, 0), row(0.3, -0.8, 0.8), _layers),
    ]  # fmt: skip


def _two_cameras(x: Tensor, degrees: Tensor) -> Tensor:
    """Returns where two cameras at 3 m see a point, less where they see the origin, in metres at its depth."""
    found = []
    for side in (-0.5, 0.5):
        angle = side * degrees.deg2rad()
        across = angle.cos() * x[:, 0] - angle.sin() * x[:, 2]
        along = angle.sin() * x[:, 0] + angle.cos() * x[:, 2]
        found += [across / (1 + along / 3), x[:, 1] / (1 + along / 3)]
    return torch.stack(found, dim=1)


def _limb(turn: Tensor, leverage: Tensor) -> Tensor:
    """Returns how far marks of a limb moved in the picture; it leans, so that both of its other turns are seen."""
    one, none = torch.ones_like(leverage), torch.zeros_like(leverage)
    marks = torch.stack(
        [torch.stack([0.6 * one, none, 0.8 * one], 1), torch.stack([none, leverage, none], 1)], dim=1
    )
    moved = marks @ axis_angle_to_matrix(turn).transpose(1, 2)
    return (moved - marks)[..., :2].flatten(1)


def _blob(x: Tensor, pixels: Tensor) -> Tensor:
    """Returns the picture of a blob less the right one; x are logarithms of its two lengths over the right ones."""
    places = torch.arange(-8, 9, dtype=x.dtype)

    def picture(lengths: Tensor) -> Tensor:
        variances = lengths.square() + 0.3
        across = (-0.5 * places.square() / variances[:, :1]).exp()
        along = (-0.5 * places.square() / variances[:, 1:]).exp()
        return (across[:, :, None] * along[:, None, :]).flatten(1)

    right = torch.stack([torch.full_like(pixels, 4.0), pixels], dim=1)
    return picture(right * x.exp()) - picture(right)


def _layers(x: Tensor, first: Tensor) -> Tensor:
    """Returns the colour of a stack less the right one; x are opacity logits less the right ones."""
    colors = torch.tensor([[1.0, 0.2, 0.1], [0.1, 1.0, 0.3], [0.2, 0.1, 1.0]], dtype=x.dtype)
    right = torch.stack([first, first, torch.full_like(first, 0.5)], dim=1)

    def color(opacities: Tensor) -> Tensor:
        through = torch.cumprod(torch.cat([torch.ones_like(first)[:, None], 1 - opacities[:, :-1]], dim=1), 1)
        return (through * opacities) @ colors

    return color((right.logit() + x).sigmoid()) - color(right)


# --- optimisers ------------------------------------------------------------------------------------------------

Step = Callable[[Tensor, Tensor, int], Tensor]
"""Next parameters `[R, n]` from those at hand, the places `[R]` and the number of the step, from 1."""


def adam(toy: Toy, rate: float, axes: Tensor | None = None) -> Step:
    """Returns the steps of Adam as the stages use it.

    Args:
        toy: the problem.
        rate: learning rate.
        axes: directions that it scales by themselves, as columns, `[R, n, n]`; None: those of the parameters.
    """
    moments: list[Tensor] = []

    def step(x: Tensor, places: Tensor, number: int) -> Tensor:
        with torch.enable_grad():
            x = x.detach().requires_grad_()
            (gradient,) = torch.autograd.grad(toy.residuals(x, places).square().sum(), x)
        if axes is not None:
            gradient = torch.einsum("rij,ri->rj", axes, gradient)
        if not moments:
            moments.extend([torch.zeros_like(gradient), torch.zeros_like(gradient)])
        moments[0].lerp_(gradient, 0.1)
        moments[1].lerp_(gradient.square(), 0.001)
        root = (moments[1] / (1 - 0.999**number)).sqrt() + ADAM_EPS
        move = moments[0] / (1 - 0.9**number) / root
        if axes is not None:
            move = torch.einsum("rij,rj->ri", axes, move)
        return x.detach() - rate * move

    return step


def own_axes(toy: Toy) -> Tensor:
    """Returns the eigenvectors of J^t J where a problem is begun, `[R, n, n]`."""
    places = torch.tensor(toy.places, dtype=torch.float64)
    jacobian = toy.jacobian(toy.start.expand(len(places), -1), places)
    return torch.linalg.eigh(jacobian.transpose(1, 2) @ jacobian).eigenvectors


def levenberg_marquardt(toy: Toy) -> Step:
    """Returns damped Gauss-Newton steps: the damping falls where a step helps and grows where it does not."""
    damping: list[Tensor] = []

    def step(x: Tensor, places: Tensor, _: int) -> Tensor:
        if not damping:
            damping.append(torch.full_like(places, 1e-2))
        jacobian, r = toy.jacobian(x, places), toy.residuals(x, places)
        matrix = jacobian.transpose(1, 2) @ jacobian
        # Marquardt's scaling by the diagonal, and a little of the whole where a diagonal entry is nothing
        scale = torch.diagonal(matrix, dim1=1, dim2=2)
        floor = 1e-12 * scale.amax(dim=1, keepdim=True)
        damped = matrix + torch.diag_embed(damping[0][:, None] * (scale + floor))
        move = torch.linalg.solve(damped, jacobian.transpose(1, 2) @ r[..., None])[..., 0]
        better = toy.residuals(x - move, places).square().sum(1) < r.square().sum(1)
        damping[0] = torch.where(better, damping[0] / 5, damping[0] * 4).clamp(1e-15, 1e10)
        return torch.where(better[:, None], x - move, x)

    return step


def walk(toy: Toy, name: str, rate: float | None, step: Step, steps: int) -> list[Walk]:
    """Returns how an optimiser comes along at all places of a problem."""
    places, conditions = torch.tensor(toy.places, dtype=torch.float64), toy.condition()
    x = toy.start.expand(len(places), -1).clone()
    far = (toy.start - toy.optimum).norm()
    arrived, curves = [0] * len(places), [[(0, 1.0)] for _ in places]
    looks, left = _looks(steps), torch.ones(len(places), dtype=torch.float64)
    started, done = time.process_time(), steps
    for number in range(1, steps + 1):
        x = step(x, places, number)
        left = (x - toy.optimum).norm(dim=1) / far
        if number in looks:
            for curve, share in zip(curves, left.tolist(), strict=True):
                curve.append((number, share))
        for k in torch.nonzero(left <= CLOSE).flatten().tolist():
            arrived[k] = arrived[k] or number
        if all(arrived):
            done = number
            break
    each = (time.process_time() - started) / done / len(places)
    return [
        Walk(toy.group, place, float(condition), name, rate, first or None, float(share), each * (first or done),
             tuple(curve))
        for place, condition, first, share, curve in zip(
            toy.places, conditions, arrived, left, curves, strict=True
        )
    ]  # fmt: skip


def walks(all_: Sequence[Toy], steps: int) -> list[Walk]:
    """Returns how each optimiser comes along on each problem: Adam at the recipe's rate and at a tenth of it too."""
    found = []
    for toy in all_:
        found += walk(toy, "Adam", toy.rate, adam(toy, toy.rate), steps)
        found += walk(toy, "Adam, a tenth of the rate", toy.rate / 10, adam(toy, toy.rate / 10), steps)
        found += walk(toy, "Adam along own axes", toy.rate, adam(toy, toy.rate, own_axes(toy)), steps)
        found += walk(toy, "Levenberg-Marquardt", None, levenberg_marquardt(toy), min(steps, 200))
    return found


def handed_over(ratio: float, *, fresh: bool, steps: int = 1800) -> float:
    """Returns the share of a new target's distance that is left after so many steps of a second stage.

    A first stage finds its optimum by Adam with a loss `ratio` times as large; then the target moves by 0.5.

    Args:
        ratio: of the losses, before to after.
        fresh: whether the second stage begins with moments of its own, as ours does, or with those of the first.
        steps: of each stage.
    """
    x = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    for scale, target in ((ratio, 0.5), (1.0, 1.0)):
        if target == 0.5 or fresh:
            optimiser = torch.optim.Adam([x], lr=1e-3, eps=ADAM_EPS)
        for _ in range(steps):
            optimiser.zero_grad()
            (scale * (x - target).square().sum()).backward()
            optimiser.step()
    return abs(float(x.detach()) - 1.0) / 0.5


def _looks(steps: int) -> set[int]:
    return {round(10**power) for power in torch.linspace(0, math.log10(max(steps, 1)), 40).tolist()}
