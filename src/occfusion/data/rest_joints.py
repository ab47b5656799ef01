"""What the joints of a rest pose tell of a body: its shape, and whether it is the body they were made with.

HumanNeRF's preparation writes `tpose_joints` and no shape coefficients. Joints at rest are linear in the
coefficients, `J(betas) = J(0) + D betas`: 69 numbers relative to the pelvis for 10 unknowns. Where the rest
pose stands does not matter: its pelvis is left out.
"""

from __future__ import annotations

import numpy as np

from occfusion.data.posing import USUAL_BETAS, AtRest
from occfusion.data.scene import Array
from occfusion.errors import DataError

SAME_JOINTS = 1e-4
"""Largest distance, in metres, of a joint from the body's own that is rounding.

Joints of a person at rest lie within 2 m, where float32 has steps of 1.2e-7 m: this is 800 of them. The embedded
body meets its own joints within 7e-8 m; one made 1 % larger leaves 0.7 mm, one made 1 % wider 1.9 mm.
"""

_STEP = 64.0
"""Betas by which the derivatives are taken: joints are linear in betas, and a long way loses fewer digits."""

_DETERMINED = 1e-5
"""Singular values below this share of the largest leave a direction of the shape open."""


def shape_from_joints(rest: Array, body: AtRest, where: str) -> Array:
    """Returns the shape coefficients `[10]` whose joints at rest are `rest`, by least squares.

    With the embedded body (condition 195) and joints rounded to float32 they are right to 5e-6, vertices to 3e-8 m.
    Directions that move no joint stay 0.

    Args:
        rest: joints at rest, `[24, 3]`, metres, anywhere.
        body: the body that they were made with.
        where: what messages call them.

    Raises:
        DataError: no shape of this body has these joints; gives what is left in millimetres.
    """
    count = min(USUAL_BETAS, body.num_betas)
    steps = np.eye(count) * _STEP
    columns = [_bones(body.joints(step)) - _bones(body.joints(-step)) for step in steps]
    directions = np.stack(columns, axis=1) / (2 * _STEP)
    wanted = _bones(rest) - _bones(body.joints(np.zeros(count)))
    betas = np.asarray(np.linalg.lstsq(directions, wanted, rcond=_DETERMINED)[0])
    require_joints(rest, betas, body, where)
    return betas


def require_joints(rest: Array, betas: Array, body: AtRest, where: str) -> None:
    """Raises DataError unless a body of these coefficients has these joints at rest, wherever it stands.

    Args:
        rest: joints at rest, `[24, 3]`, metres.
        betas: shape coefficients `[B]`.
        body: the body; one that stands in for another is not asked.
        where: what messages call the joints.

    Raises:
        DataError: it has others; gives the largest distance in millimetres.
    """
    apart = np.linalg.norm((_bones(rest) - _bones(body.joints(betas))).reshape(-1, 3), axis=1)
    if body.stands_in or apart.max() <= SAME_JOINTS:
        return
    joint = int(apart.argmax()) + 1
    raise DataError(
        f"{where}: joint {joint} is {apart.max() * 1000:.3g} mm from where the body has it, and more than "
        f"{SAME_JOINTS * 1000:g} mm is no rounding (mean of all joints {apart.mean() * 1000:.3g} mm): these joints "
        "were made with another body file. Name that one (body.path in training, --body of check): the same sex, the "
        "same version."
    )


def _bones(joints: Array) -> Array:
    """Returns joints 1 to 23 as seen from the pelvis, `[69]`."""
    return (joints[1:] - joints[:1]).reshape(-1)
