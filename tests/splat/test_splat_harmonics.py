"""Spherical harmonics against Legendre polynomials, orthonormality, and the fused kernels."""

from __future__ import annotations

import numba
import numpy as np
import pytest
import torch

from occfusion.splat.backends.numba.geometry import direction_gradient, fill_basis
from occfusion.splat.harmonics import SH_C0, basis, evaluate, num_coefficients
from oracles import splat as oracle


def directions(n: int) -> torch.Tensor:
    d = torch.randn(n, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return d / d.norm(dim=-1, keepdim=True)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colour_matches_legendre(degree: int) -> None:
    d, sh = (
        directions(20),
        torch.randn(20, 16, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64),
    )
    expected = torch.stack([oracle.harmonics_color(sh[i], d[i], degree) for i in range(20)])
    assert torch.allclose(evaluate(sh, d, degree), expected, atol=1e-12)
    assert num_coefficients(degree) == basis(d, degree).shape[-1]


def test_basis_is_orthonormal() -> None:
    """Gauss-Legendre in z times a uniform rule around integrates products of degree 6 exactly."""
    z, weight = (torch.from_numpy(a) for a in np.polynomial.legendre.leggauss(8))
    phi = torch.arange(16, dtype=torch.float64) * (2 * torch.pi / 16)
    z, phi, weight = z[:, None].expand(8, 16), phi.expand(8, 16), weight[:, None] * (2 * torch.pi / 16)
    r = (1 - z * z).sqrt()
    values = basis(torch.stack([r * phi.cos(), r * phi.sin(), z], -1), 3)
    gram = torch.einsum("abi,abj,ab->ij", values, values, weight.expand(8, 16))
    assert torch.allclose(gram, torch.eye(16, dtype=torch.float64), atol=1e-12)


def test_grey_and_black() -> None:
    d = directions(2)
    sh = torch.zeros(2, 1, 3, dtype=torch.float64)
    sh[1] = -1 / SH_C0
    assert evaluate(sh, d, 0).tolist() == [[0.5] * 3, [0.0] * 3]


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_kernels_agree(degree: int) -> None:
    d = directions(10).requires_grad_()
    values = basis(d, degree)
    weights = torch.randn(values.shape[-1], generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    expected = torch.zeros_like(d)
    if degree > 0:
        expected = torch.autograd.grad((values @ weights).sum(), d)[0]
    padded = np.zeros(16)
    padded[: len(weights)] = weights.numpy()
    fill, gradient = numba.njit(fill_basis), numba.njit(direction_gradient)  # as kernels compile them
    for i, (x, y, z) in enumerate(d.tolist()):
        out = np.zeros(16)
        fill(x, y, z, degree, out)
        assert np.allclose(out[: values.shape[-1]], values[i].detach().numpy(), atol=1e-14)
        assert np.allclose(gradient(x, y, z, degree, padded), expected[i].numpy(), atol=1e-12)
