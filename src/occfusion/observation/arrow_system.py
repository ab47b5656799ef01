"""Symmetric systems shaped like an arrow: a chain of blocks, each coupled to the next alone, and a border to them all.

Knots of a spline are such a chain, and what is alike in all frames is the border. The cost of factors and
variances grows with the chain's length; a dense matrix would cost its cube (block Cholesky; variances by Takahashi's
recursion: Erisman and Tinney, "On computing certain elements of the inverse of a sparse matrix", 1975).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular

Floats = NDArray[np.float64]


class ArrowFactor:
    """The Cholesky factor of a positive definite matrix, the chain's blocks first and the border last.

    Args:
        diagonal: blocks of the chain, `[n_i, n_i]` each.
        below: block `i + 1` by block `i`, `[n_{i+1}, n_i]`; one less than those.
        border: chain by border, `[n_i, m]` for each block.
        corner: border by border, `[m, m]`.

    Raises:
        LinAlgError: the matrix is not positive definite.
    """

    def __init__(
        self,
        diagonal: Sequence[Floats],
        below: Sequence[Floats],
        border: Sequence[Floats],
        corner: Floats,
    ) -> None:
        self._sizes = [len(block) for block in diagonal]
        self._lower: list[Floats] = []
        self._links: list[Floats] = []  # of block i to block i - 1
        self._edges: list[Floats] = []
        remaining = corner.copy()
        for i, block in enumerate(diagonal):
            edge = border[i]
            if i:
                link = solve_triangular(self._lower[-1], below[i - 1].T, lower=True, check_finite=False).T
                self._links.append(link)
                block, edge = block - link @ link.T, edge - link @ self._edges[-1]
            lower = cholesky(block, lower=True, check_finite=False)
            self._lower.append(lower)
            self._edges.append(solve_triangular(lower, edge, lower=True, check_finite=False))
            remaining -= self._edges[-1].T @ self._edges[-1]
        self._corner = cholesky(remaining, lower=True, check_finite=False)

    def solve(self, right: Floats) -> Floats:
        """Returns the solution for a right side, `[N]` both, chain first."""
        parts, edge = self._split(right)
        for i, part in enumerate(parts):
            if i:
                part = part - self._links[i - 1] @ parts[i - 1]
            parts[i] = solve_triangular(self._lower[i], part, lower=True, check_finite=False)
            edge = edge - self._edges[i].T @ parts[i]
        edge = solve_triangular(self._corner, edge, lower=True, check_finite=False)
        edge = solve_triangular(self._corner, edge, lower=True, trans=1, check_finite=False)
        for i in reversed(range(len(parts))):
            part = parts[i] - self._edges[i] @ edge
            if i + 1 < len(parts):
                part = part - self._links[i].T @ parts[i + 1]
            parts[i] = solve_triangular(self._lower[i], part, lower=True, trans=1, check_finite=False)
        return np.concatenate([*parts, edge])

    def variance(self) -> Floats:
        """Returns the diagonal of the inverse, `[N]`."""
        whole = solve_triangular(self._corner, np.eye(len(self._corner)), lower=True, check_finite=False)
        found = [(whole**2).sum(axis=0)]
        later: Floats | None = None  # of the block behind: its part of the inverse of the chain alone
        spread: Floats | None = None  # and what the border's uncertainty adds, as a root
        for i in reversed(range(len(self._sizes))):
            lower = self._lower[i]
            inverse = solve_triangular(lower, np.eye(len(lower)), lower=True, check_finite=False)
            own, edge = inverse.T @ inverse, self._edges[i]
            if later is not None and spread is not None:
                gain = self._links[i] @ inverse
                own += gain.T @ later @ gain
                edge = edge - self._links[i].T @ spread
            later, spread = own, inverse.T @ edge
            found.append(np.diag(own) + ((spread @ whole.T) ** 2).sum(axis=1))
        return np.concatenate([*found[:0:-1], found[0]])

    def log_determinant(self) -> float:
        """Returns the logarithm of the determinant."""
        diagonals = [np.diag(lower) for lower in (*self._lower, self._corner)]
        return 2.0 * float(np.log(np.concatenate(diagonals)).sum())

    def _split(self, whole: Floats) -> tuple[list[Floats], Floats]:
        ends = np.cumsum(self._sizes)
        *parts, edge = np.split(whole, ends)
        return parts, edge
