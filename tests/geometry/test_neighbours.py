from __future__ import annotations

import numpy as np
import pytest
import torch

from occfusion.geometry import neighbours


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


def test_too_few():
    with pytest.raises(ValueError, match="only 2"):
        neighbours.nearest_others(torch.zeros(2, 3), k=2)
    assert neighbours.nearest(torch.zeros(0, 3), torch.zeros(2, 3)).indices.shape == (0, 1)
