"""Front and back of a body as pictures: against rays, and there and back."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from occfusion.human.body import embedded_body
from occfusion.human.unfolded import MARGIN, UnfoldedBody


@pytest.fixture(scope="module")
def unfolded() -> UnfoldedBody:
    return UnfoldedBody(embedded_body(), 96)


def test_pictures_show_the_places_that_rays_meet_first():
    """Oracle: every triangle against the ray through a pixel, by its edge functions."""
    body = embedded_body()
    unfolded = UnfoldedBody(body, 96)
    points, faces = body.da_vertices().double().numpy(), body.faces.numpy()
    drawn = unfolded.unfold(torch.from_numpy(points).float()).numpy()
    low, high = points.min(axis=0), points.max(axis=0)
    extent = (high - low)[:2].max() / (1.0 - 2.0 * MARGIN)
    a, b, c = (points[faces[:, k]] for k in range(3))
    rng, checked = np.random.default_rng(0), 0
    for row, column in rng.integers(0, 96, (400, 2)):
        x = (column + 0.5 - 48.0) / 96.0 * extent + 0.5 * (low + high)[0]
        y = 0.5 * (low + high)[1] - (row + 0.5 - 48.0) / 96.0 * extent
        whole = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
        v = ((x - a[:, 0]) * (c[:, 1] - a[:, 1]) - (y - a[:, 1]) * (c[:, 0] - a[:, 0])) / whole
        w = ((b[:, 0] - a[:, 0]) * (y - a[:, 1]) - (b[:, 1] - a[:, 1]) * (x - a[:, 0])) / whole
        met = (v > 1e-3) & (w > 1e-3) & (v + w < 1.0 - 1e-3)
        if not met.any():
            continue
        depth = (a + v[:, None] * (b - a) + w[:, None] * (c - a))[met, 2]
        assert unfolded.mask[:, row, column].all()
        np.testing.assert_allclose(
            drawn[:, :, row, column], [[x, y, depth.max()], [x, y, depth.min()]], atol=2e-3
        )
        checked += 1
    assert checked > 20


def test_what_varies_slowly_comes_back(unfolded):
    points = embedded_body().da_vertices()
    values = torch.stack([points[:, 0], points[:, 1], torch.ones(len(points))], dim=1)
    back = unfolded.fold(unfolded.unfold(values))
    assert float((back - values).abs().mean()) < 0.004
    torch.testing.assert_close(back[:, 2], values[:, 2])


def test_front_and_back_are_told_apart(unfolded):
    pictures = torch.zeros(2, 1, 96, 96)
    pictures[1] = 1.0
    sides = unfolded.fold(pictures)[:, 0]
    points = embedded_body().da_vertices()
    chest = (points[:, 0].abs() < 0.08) & (points[:, 1] > 0.2) & (points[:, 1] < 0.35)
    assert float(sides[chest & (points[:, 2] > 0.06)].max()) == 0.0
    assert float(sides[chest & (points[:, 2] < -0.06)].min()) == pytest.approx(1.0)
