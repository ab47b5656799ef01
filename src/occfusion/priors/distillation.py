"""Score distillation sampling: its weights, its times, and the scalar whose gradient it is (paper §4.2).

With `x_t = alpha x + sigma noise` the gradient for the signal x is `g = w(t) (prediction - noise)` (Poole et al.
2022, eq. 3); the Jacobian of the network is left out. For Gaussian data of mean m and variance s^2 its expectation is
`w sigma alpha (x - m) / (alpha^2 s^2 + sigma^2)`.
"""

from __future__ import annotations

from torch import Tensor

WEIGHTINGS = ("sigma2", "uniform")
"""w(t): sigma^2, which is `1 - alpha_bar` of a discrete schedule; or 1."""
SCHEDULES = ("random", "annealed")
"""t: uniform in its range; or linear from its end to its beginning over the stage."""
REDUCTIONS = ("mean", "sum")
"""Over the values of the signal, masked ones included."""


def weight(weighting: str, sigma: float) -> float:
    """Returns w(t) of a time whose noise has the standard deviation `sigma`.

    Raises:
        ValueError: an unknown weighting.
    """
    if weighting not in WEIGHTINGS:
        raise ValueError(f"weighting {weighting!r} is not one of {', '.join(WEIGHTINGS)}")
    return sigma**2 if weighting == "sigma2" else 1.0


def time_at(schedule: str, progress: float, share: float, low: float, high: float) -> float:
    """Returns the diffusion time of a step, `low` to `high`.

    Args:
        schedule: one of `SCHEDULES`.
        progress: part of the stage that is done, 0..1; what `annealed` goes by.
        share: a uniform random number, 0..1; what `random` goes by.
        low: least time.
        high: greatest time.

    Raises:
        ValueError: an unknown schedule.
    """
    if schedule not in SCHEDULES:
        raise ValueError(f"schedule {schedule!r} is not one of {', '.join(SCHEDULES)}")
    at = share if schedule == "random" else 1.0 - min(max(progress, 0.0), 1.0)
    return low + (high - low) * at


def guided(unconditional: Tensor, conditional: Tensor, guidance: float) -> Tensor:
    """Returns the prediction moved from the one without conditions towards, or past, the one with them."""
    return unconditional + guidance * (conditional - unconditional)


def surrogate(signal: Tensor, gradient: Tensor, mask: Tensor, reduction: str = "mean") -> Tensor:
    """Returns a scalar whose gradient for `signal` is exactly `gradient * mask`, divided by the count for `mean`.

    `0.5 sum((z - sg(z - g))^2 mask) / n` with sg the stopped gradient; its value is `0.5 sum(g^2 mask) / n`. Written
    as `z - sg(z) + g`, since a small gradient would be lost in `z - g`.

    Args:
        signal: z, `[B, C, H, W]`.
        gradient: g, of the same shape; taken as a constant.
        mask: 0..1, of a shape that spreads to the same.
        reduction: `mean`: n is the number of the signal's values; `sum`: n is 1.

    Raises:
        ValueError: the shapes differ, or an unknown reduction.
    """
    if signal.shape != gradient.shape:
        raise ValueError(f"the gradient {list(gradient.shape)} does not fit the signal {list(signal.shape)}")
    if reduction not in REDUCTIONS:
        raise ValueError(f"reduction {reduction!r} is not one of {', '.join(REDUCTIONS)}")
    # float32 whatever the signal comes in: half precision would lose small gradients and overflow with large weights
    moved = signal.float() - signal.detach().float() + gradient.detach().float()
    total = 0.5 * (moved.square() * mask).sum()
    return total / signal.numel() if reduction == "mean" else total
