"""What was measured at some vertices of a mesh, spread to the others."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

ROUNDS = 40
"""How often values are averaged over neighbours."""


def spread_over_mesh(
    total: Floats,
    weight: Floats,
    faces: NDArray[np.int64],
    prior: tuple[float, float] = (0.0, 1e-9),
    rounds: int = ROUNDS,
) -> Floats:
    """Returns `total / weight`, averaged over neighbours on the mesh again and again; weight carries belief, `[V]`.

    Args:
        total: sum of what was measured at each vertex, `[V]`.
        weight: how much was, `[V]`.
        faces: `[F, 3]`.
        prior: a value, and the weight that it has everywhere.
        rounds: how often values are averaged over neighbours.
    """
    a, b = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).T
    degree = np.maximum(np.bincount(a, minlength=len(total)), 1)
    for _ in range(rounds):
        total = 0.5 * total + 0.5 * np.bincount(a, total[b], minlength=len(total)) / degree
        weight = 0.5 * weight + 0.5 * np.bincount(a, weight[b], minlength=len(weight)) / degree
    return (total + prior[0] * prior[1]) / (weight + prior[1])
