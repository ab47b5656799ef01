from __future__ import annotations

import numpy as np
import pytest
import torch

from occfusion.geometry import neighbours


@pytest.fixture(params=["tree", "blocks"], autouse=True)
def way(request, monkeypatch):
    """Either way on the CPU."""
    monkeypatch.setattr(neighbours, "by_tree", getattr(neighbours, f"by_{request.param}"))


def test_equal_brute_force(monkeypatch):
    monkeypatch.setattr(neighbours, "_BLOCK_ELEMENTS", 100)  # several blocks
    rng = np.random.default_rng(0)
    points, references = rng.normal(size=(23, 3)), rng.normal(size=(31, 3)) + 5
    found = neighbours.nearest(torch.tensor(points), torch.tensor(references), k=4)
    for n, point in enumerate(points):
        lengths = np.array([np.sqrt(((point - r) ** 2).sum()) for r in references])
        order = lengths.argsort()[:4]
        assert found.indices[n].tolist() == order.tolist()
        assert np.allclose(found.distances[n], lengths[order], atol=1e-7)
    assert neighbours.nearest(torch.tensor(points), torch.tensor(references)).indices.tolist() == [
        [int(i)] for i in found.indices[:, 0]
    ]


def test_others_never_name_the_point_itself_even_among_coinciding_ones():
    points = torch.cat([torch.zeros(7, 3), torch.tensor([[1.0, 0, 0], [1.2, 0, 0]])])
    found = neighbours.nearest_others(points, k=2)
    own = torch.arange(len(points))[:, None]
    assert not (found.indices == own).any()
    assert not found.distances[:7].any()
    assert found.indices[7, 0] == 8 and found.distances[7, 0] == pytest.approx(0.2)


def test_far_from_the_origin_keeps_millimetres():
    points = torch.tensor(
        [[1000.0, 1000, 1000], [1000.001, 1000, 1000], [1000.003, 1000, 1000]], dtype=torch.float64
    )
    found = neighbours.nearest_others(points)
    assert found.indices[:, 0].tolist() == [1, 0, 1]
    assert found.distances[:, 0].tolist() == pytest.approx([0.001, 0.001, 0.002], rel=1e-6)


@pytest.mark.parametrize("spread", [1e-6, 1.0, 1e6])
def test_both_ways_agree_on_bodies_of_any_size(spread):
    points, references = torch.rand(2, 700, 3, generator=torch.Generator().manual_seed(1)) * spread
    references[:300, 2] = 0  # a plane
    found, other = neighbours.nearest(points, references, 6), neighbours.by_blocks(points, references, 6)
    assert (found.indices == other.indices).float().mean() > 0.999, "but for ties by rounding"
    assert torch.allclose(found.distances, other.distances, rtol=1e-5, atol=1e-7 * spread)
    assert found.distances.dtype == points.dtype and found.indices.dtype == torch.int64


def test_not_finite():
    points = torch.zeros(4, 3)
    points[2, 1] = float("nan")
    for pair in ((points, torch.zeros(4, 3)), (torch.zeros(4, 3), points)):
        with pytest.raises(ValueError, match="not all finite"):
            neighbours.nearest(*pair)


def test_too_few():
    with pytest.raises(ValueError, match="only 2"):
        neighbours.nearest_others(torch.zeros(2, 3), k=2)
    assert neighbours.nearest(torch.zeros(0, 3), torch.zeros(2, 3)).indices.shape == (0, 1)
