"""What the joints of a rest pose tell of a body: its shape, and whether it is the body they were made with.

HumanNeRF's preparation writes `tpose_joints` and no shape coefficients. Joints at rest are linear in the
coefficients, `J(betas) = J(0) + D betas`: 69 numbers relative to the pelvis for 10 unknowns. Where the rest
pose stands does not matter: its pelvis is left out.

Wherever data hold such joints one rule compares them with the body's own, `joints_remark`.
"""

from __future__ import annotations

import numpy as np

from occfusion.data.posing import USUAL_BETAS, AtRest
from occfusion.data.scene import Array
from occfusion.errors import DataError

ROUNDING = 1e-4
"""Largest distance, in metres, of a joint from the body's own that is rounding.

Joints of a person at rest lie within 2 m, where float32 has steps of 1.2e-7 m: this is 800 of them. The embedded
body meets its own joints within 2e-7 m, by the coefficients they were made with as by those that follow from them.
"""

ANOTHER_BODY = 2e-3
"""Distance, in metres, from which on a body is certainly another one and is refused.

Of the embedded body made 1 % wider, joints lie 8 mm off with the coefficients of the data, made 2 % larger 20 mm. With
coefficients that were fitted to the joints most of that is taken up: 1.9 and 1.5 mm are left, which is remarked only.
Between the two bounds a body may be the right one in another version, and is trained on.
"""

_STEP = 64.0
"""Betas by which the derivatives are taken: joints are linear in betas, and a long way loses fewer digits."""

_DETERMINED = 1e-5
"""Singular values below this share of the largest leave a direction of the shape open."""


def shape_from_joints(rest: Array, body: AtRest) -> Array:
    """Returns the shape coefficients `[10]` whose joints at rest come nearest to `rest`, by least squares.

    With the embedded body (condition 195) and joints rounded to float32 they are right to 5e-6, vertices to 3e-8 m.
    Directions that move no joint stay 0. Whether it is the right body `joints_remark` says.

    Args:
        rest: joints at rest, `[24, 3]`, metres, anywhere.
        body: the body that they were made with.
    """
    count = min(USUAL_BETAS, body.num_betas)
    steps = np.eye(count) * _STEP
    columns = [_bones(body.joints(step)) - _bones(body.joints(-step)) for step in steps]
    directions = np.stack(columns, axis=1) / (2 * _STEP)
    wanted = _bones(rest) - _bones(body.joints(np.zeros(count)))
    return np.asarray(np.linalg.lstsq(directions, wanted, rcond=_DETERMINED)[0])


def joints_remark(given: Array, own: Array, where: str) -> str:
    """Returns a sentence where joints at rest that data hold are near the body's own but not the same, else nothing.

    Args:
        given: of the data, `[24, 3]`, metres, wherever the person stands.
        own: the body's, with the shape coefficients of the same person, `[24, 3]`, metres.
        where: what messages call the given joints.

    Raises:
        DataError: the largest distance is above `ANOTHER_BODY`; gives it in millimetres.
    """
    apart = np.linalg.norm((_bones(given) - _bones(own)).reshape(-1, 3), axis=1)
    if apart.max() <= ROUNDING:
        return ""
    text = (
        f"{where}: joint {int(apart.argmax()) + 1} is {apart.max() * 1000:.3g} mm from where the body has it "
        f"(mean of all joints {apart.mean() * 1000:.3g} mm)"
    )
    if apart.max() <= ANOTHER_BODY:
        return (
            f"{text}, more than the {ROUNDING * 1000:g} mm of rounding: another version or sex of the body?"
        )
    raise DataError(
        f"{text}, and more than {ANOTHER_BODY * 1000:g} mm are refused: these joints were made with another body file. "
        "Name that one (body.path in training, --body of check): the same sex, the same version. For ZJU-MoCap and "
        "OcMotion it is the neutral SMPL with 10 coefficients."
    )


def _bones(joints: Array) -> Array:
    """Returns joints 1 to 23 as seen from the pelvis, `[69]`."""
    return (joints[1:] - joints[:1]).reshape(-1)
