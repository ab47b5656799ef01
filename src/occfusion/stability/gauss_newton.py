"""Gauss-Newton matrices of least squares, as products and as samples, without ever forming a Jacobian.

Of residuals r(x) the matrix is H = J^t J with J = dr/dx. It says how much the data know of each direction: moving x by
v changes the residuals by v^t H v, in the square. `product` gives H v; `samples` gives vectors whose outer products are
H on average, which is how blocks and diagonals of thousands of parameters are had at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

STEP = 1e-5
"""Of the largest entry of a vector in a difference, in the parameters' units."""
Residuals = Callable[[], Tensor]
"""Residuals at what the parameters hold, of any shape, differentiable."""


@dataclass(frozen=True)
class GaussNewton:
    """The Gauss-Newton matrix of sums of squares at what the parameters hold now.

    Attributes:
        residuals: of each picture; the matrix is the sum of theirs.
        parameters: leaves that require gradients; others count as constant.
    """

    residuals: Sequence[Residuals]
    parameters: Sequence[Tensor]

    def product(self, vectors: Sequence[Tensor]) -> list[Tensor]:
        """Returns H v, where v has one part a parameter.

        J v is a central difference, for rasterisers have a gradient and no forward mode; in float64, and with
        thresholds of the image formation too low to be seen, it has about eight digits.
        """
        largest = max(float(vector.abs().max()) for vector in vectors)
        if largest == 0.0:
            return [torch.zeros_like(vector) for vector in vectors]
        length = STEP / largest
        kept = [parameter.detach().clone() for parameter in self.parameters]

        def moved(sign: float, residual: Residuals) -> Tensor:
            for parameter, before, vector in zip(self.parameters, kept, vectors, strict=True):
                parameter.copy_(before + sign * length * vector)
            return residual()

        total = [torch.zeros_like(vector) for vector in vectors]
        for residual in self.residuals:
            with torch.no_grad():
                try:
                    change = (moved(1.0, residual) - moved(-1.0, residual)) / (2.0 * length)
                finally:
                    for parameter, before in zip(self.parameters, kept, strict=True):
                        parameter.copy_(before)
            for sum_, part in zip(total, self._pulled_back(residual(), change), strict=True):
                sum_ += part
        return total

    def samples(self, count: int) -> list[Tensor]:
        """Returns `count` independent J^t w, w standard normal: one tensor a parameter, `[count, *shape]`.

        The mean of g g^t over them is H, and so is that of each block; the least eigenvalue of a block of n by n is
        found to a factor of about (1 - sqrt(n / count))^2, however bad its condition.
        """
        generator = torch.Generator().manual_seed(0)
        found = [parameter.new_zeros((count, *parameter.shape)) for parameter in self.parameters]
        for residual in self.residuals:
            value = residual()
            for k in range(count):
                noise = torch.randn(value.shape, generator=generator, dtype=value.dtype)
                for all_, part in zip(found, self._pulled_back(value, noise, keep=True), strict=True):
                    all_[k] += part
        return found

    def matrix(self) -> Tensor:
        """Returns the whole matrix of a single, small parameter, column by column, `[n, n]`."""
        (parameter,) = self.parameters
        columns = []
        for k in range(parameter.numel()):
            unit = torch.zeros_like(parameter).view(-1)
            unit[k] = 1.0
            columns.append(self.product([unit.view_as(parameter)])[0].flatten())
        found = torch.stack(columns)
        return 0.5 * (found + found.T)

    def _pulled_back(self, value: Tensor, cotangent: Tensor, *, keep: bool = False) -> list[Tensor]:
        found = torch.autograd.grad(
            value, list(self.parameters), cotangent, allow_unused=True, retain_graph=keep
        )
        return [
            torch.zeros_like(parameter) if gradient is None else gradient
            for gradient, parameter in zip(found, self.parameters, strict=True)
        ]


def ritz_values(matrix: GaussNewton, steps: int) -> tuple[Tensor, Tensor]:
    """Returns eigenvalues of the Gauss-Newton matrix as Lanczos finds them, and the share of directions that each has.

    The first are its extreme eigenvalues from within; the shares are those of a random direction's squared length, so
    that they say how the whole spectrum lies (stochastic Lanczos quadrature).

    Args:
        matrix: whose.
        steps: products at most.
    """
    generator = torch.Generator().manual_seed(0)
    sizes = [parameter.numel() for parameter in matrix.parameters]
    first = torch.randn(sum(sizes), generator=generator, dtype=torch.float64)
    basis, above, below = [first / first.norm()], [], []
    for _ in range(min(steps, sum(sizes))):
        parts = [
            part.view_as(parameter).to(parameter)
            for part, parameter in zip(basis[-1].split(sizes), matrix.parameters, strict=True)
        ]
        found = torch.cat([part.flatten().double() for part in matrix.product(parts)])
        above.append(float(found @ basis[-1]))
        for _ in range(2):  # twice is enough to keep them orthogonal in any condition
            rows = torch.stack(basis)
            found = found - rows.T @ (rows @ found)
        length = float(found.norm())
        if length <= 1e-12 * max(map(abs, above)):
            break
        below.append(length)
        basis.append(found / length)
    count = len(above)
    tridiagonal = torch.diag(torch.tensor(above, dtype=torch.float64))
    side = torch.tensor(below[: count - 1], dtype=torch.float64)
    tridiagonal += torch.diag(side, 1) + torch.diag(side, -1)
    values, vectors = torch.linalg.eigh(tridiagonal)
    return values, vectors[0].square()
