"""Systems shaped like an arrow, against the dense matrix."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import LinAlgError

from occfusion.observation.arrow_system import ArrowFactor


def arrow(sizes: list[int], border: int, scale: float = 1.0, seed: int = 0):
    """A dense positive definite matrix of that shape, and its parts; `scale` spreads its diagonal."""
    rng = np.random.default_rng(seed)
    total, ends = sum(sizes) + border, np.cumsum([0, *sizes])
    blocks = [slice(a, b) for a, b in pairwise(ends)]
    edge = slice(ends[-1], total)
    root = np.zeros((total, total))  # a lower triangle of the same shape keeps it, and is a factor
    for i, own in enumerate(blocks):
        root[own, own] = np.tril(rng.normal(size=(sizes[i], sizes[i])))
        if i:
            root[own, blocks[i - 1]] = rng.normal(size=(sizes[i], sizes[i - 1]))
    root[edge] = rng.normal(size=(border, total))
    root[edge, edge] = np.tril(root[edge, edge])
    root[np.diag_indices(total)] = 3.0 + rng.random(total)
    root *= scale ** rng.uniform(-1, 1, total)[:, None]
    dense = root @ root.T
    parts = (
        [dense[b, b] for b in blocks],
        [dense[b, a] for a, b in pairwise(blocks)],
        [dense[b, edge] for b in blocks],
        dense[edge, edge],
    )
    return dense, parts


@pytest.mark.parametrize("sizes", [[4], [3, 3], [5, 2, 6, 1]])
@pytest.mark.parametrize("scale", [1.0, 1e3])
def test_solution_and_variance_are_those_of_the_dense_matrix(sizes: list[int], scale: float) -> None:
    dense, parts = arrow(sizes, 4, scale)
    factor = ArrowFactor(*parts)
    right = np.random.default_rng(1).normal(size=len(dense))
    # in its own units, in which the dense inverse is exact as well
    unit = np.sqrt(np.diag(dense))
    inverse = np.linalg.inv(dense / unit[:, None] / unit) / unit[:, None] / unit
    np.testing.assert_allclose(factor.variance(), np.diag(inverse), rtol=1e-8)
    solution = factor.solve(right)
    np.testing.assert_allclose(solution * unit, inverse @ right * unit, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(dense @ solution, right, atol=1e-6)
    whole = np.linalg.slogdet(dense / unit[:, None] / unit)[1] + 2.0 * np.log(unit).sum()
    assert factor.log_determinant() == pytest.approx(whole, rel=1e-9)


def test_parts_are_left_as_they_are() -> None:
    _, parts = arrow([3, 3], 2)
    copies = [np.copy(block) for part in parts[:3] for block in part] + [parts[3].copy()]
    ArrowFactor(*parts).variance()
    for block, copy in zip([b for part in parts[:3] for b in part] + [parts[3]], copies, strict=True):
        np.testing.assert_array_equal(block, copy)


def test_what_is_not_positive_definite_is_refused() -> None:
    _, (diagonal, below, border, corner) = arrow([3, 3], 2)
    with pytest.raises(LinAlgError):
        ArrowFactor(diagonal, below, border, corner - 1e3 * np.eye(2))
