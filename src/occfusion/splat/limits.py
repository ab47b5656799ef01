"""The named constants of the image formation, each with its reason (`docs/reference/conventions.md`)."""

from __future__ import annotations

from dataclasses import dataclass

NEAR = 0.01
"""Metres. Gaussians at or nearer than this are culled before anything is divided by their depth."""

FRUSTUM_MARGIN = 0.3
"""Share of the half field of view added on each side of the picture before the centre used for the
projection's Jacobian is clamped: the linearisation is meaningless far outside the picture."""

QUATERNION_FLOOR = 1e-12
"""A quaternion whose largest component is smaller names no rotation: it stands for the identity and
gets no gradient (the gradient of the normalisation grows like the inverse of the norm)."""

COMPENSATION_FLOOR = 1e-6
"""Smallest squared mass ratio of the anti-aliasing; its root times any opacity is below `alpha_min`,
so no visible splat is touched, while the root keeps a finite gradient for flat Gaussians."""


@dataclass(frozen=True)
class Limits:
    """The cut-offs of the image formation; the defaults are those of 3DGS.

    Attributes:
        alpha_max: cap of a splat's alpha, so that transmittance never becomes zero and the gradient
            can divide by 1 - alpha. A capped alpha has no gradient.
        alpha_min: smaller alphas are dropped: half a grey level of an 8-bit picture and less.
        stop: blending of a pixel ends once its transmittance is below this; the splat that crosses
            it is included, so alpha is never short by more than this.
        dilation: square pixels added to the diagonal of each projected covariance, the pixel's own
            footprint: a splat is never thinner than about half a pixel.
    """

    alpha_max: float = 0.999
    alpha_min: float = 1.0 / 255.0
    stop: float = 1e-4
    dilation: float = 0.3


DEFAULT_LIMITS = Limits()
