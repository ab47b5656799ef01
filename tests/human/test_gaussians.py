from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

from occfusion.geometry.normals import vertex_normals
from occfusion.geometry.rotation import axis_angle_to_matrix
from occfusion.human.deform import PoseRefiner, SkinningField, encode_positions, skinning_weights
from occfusion.human.gaussians import (
    MAX_SCALE,
    MIN_SCALE,
    PARAMETERS,
    Gaussians,
    means_rate,
    starting_sizes,
)


def test_start_on_the_body(body):
    gaussians = Gaussians.on_body(body, 2)
    vertices = body.da_vertices().numpy()
    assert np.array_equal(gaussians.means.detach().numpy(), vertices)
    assert gaussians.vertex_index.tolist() == list(range(40))
    for n in range(40):
        squares = sorted(((vertices[n] - v) ** 2).sum() for m, v in enumerate(vertices) if m != n)[:3]
        want = min(max(math.sqrt(sum(squares) / 3), MIN_SCALE), MAX_SCALE)
        assert gaussians.scales[n].tolist() == pytest.approx([want] * 3)
    assert gaussians.opacities.tolist() == pytest.approx([0.1] * 40)
    assert gaussians.sh_rest.shape == (40, 8, 3) and gaussians.sh_degree == 2
    assert not gaussians.sh0.any() and not gaussians.sh_rest.any()


def test_sizes_at_the_start_are_distances_to_three_neighbours():
    """Against all distances; points that coincide have the least size, not none: its logarithm is asked for."""
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    apart = (points[:, None] - points).norm(dim=2).sort(dim=1).values[:, 1:4]
    torch.testing.assert_close(starting_sizes(points), apart.square().mean(dim=1).sqrt())
    points[:5] = points[0]
    assert bool((starting_sizes(points)[:5] == MIN_SCALE).all())
    assert bool(starting_sizes(points).log().isfinite().all())


def test_bands_up_to_a_degree():
    gaussians = Gaussians(torch.zeros(2, 3), torch.ones(2, 3), 2)
    with torch.no_grad():
        gaussians.sh0.fill_(1.0)
        gaussians.sh_rest.copy_(torch.arange(48.0).view(2, 8, 3))
    assert [gaussians.sh(d).shape[1] for d in range(3)] == [1, 4, 9]
    assert torch.equal(gaussians.sh(1), gaussians.sh(2)[:, :4])


@pytest.mark.stiff
@pytest.mark.parametrize("value", [-1e4, -90.0, -13.0, 0.0, 13.0, 90.0, 1e4])
def test_extreme_raw_values_are_bounded_and_come_back(value):
    gaussians = Gaussians(torch.zeros(3, 3), torch.ones(3, 3), 0)
    with torch.no_grad():
        gaussians.log_scales.fill_(value)
        gaussians.opacity_logits.fill_(value)
    assert MIN_SCALE * 0.999 <= float(gaussians.scales.min().detach()) <= MAX_SCALE * 1.001
    assert 5e-6 < float(gaussians.opacities.min().detach()) < 1 - 5e-6
    gaussians.constrain()
    (gaussians.scales.sum() + gaussians.opacities.sum()).backward()
    # back at the bound, the gradient is alive again
    assert bool((gaussians.log_scales.grad > 0).all()) and bool((gaussians.opacity_logits.grad > 0).all())


@pytest.mark.stiff
def test_quaternions_are_kept_at_a_sane_length():
    gaussians = Gaussians(torch.zeros(4, 3), torch.ones(4, 3), 0)
    with torch.no_grad():
        gaussians.raw_quats.copy_(
            torch.tensor([[0.0, 0, 0, 0], [1e-20, 0, 0, 0], [0, 1.1, 0, 0], [0, 0, 3e15, 0]])
        )
    gaussians.constrain()
    assert gaussians.raw_quats.norm(dim=1).tolist() == pytest.approx([1.0, 1.0, 1.1, 1.0])
    gaussians.roots()[:, 0].sum().backward()
    # the one without a direction starts over, with a gradient
    assert torch.isfinite(gaussians.raw_quats.grad).all() and gaussians.raw_quats.grad[0].any()


@pytest.mark.parametrize("size", [0, 3, 60])
def test_state_of_another_size(body, size):
    gaussians, other = Gaussians.on_body(body, 1), Gaussians(torch.rand(size, 3), torch.rand(size, 3), 1)
    revision = gaussians.revision
    gaussians.load_state_dict(other.state_dict())
    assert gaussians.num_gaussians == size and gaussians.revision > revision
    for name in (*PARAMETERS, "vertex_index"):
        assert torch.equal(getattr(gaussians, name), getattr(other, name).to(getattr(gaussians, name)))


def test_rate_of_the_means():
    for step in (0, 10, 1200, 15_000, 30_000, 99_999):
        share = min(step / 30_000, 1)
        assert means_rate(step) == pytest.approx(1.6e-4 * (1.6e-6 / 1.6e-4) ** share)
    assert means_rate(5, initial=0.0) == 0.0


# -- the networks


def test_encoding_written_out():
    positions = torch.tensor([[0.1, -0.7, 1.3]], dtype=torch.float64)
    got = encode_positions(positions, 3)[0].tolist()
    phases = [2.0**k * x for k in range(3) for x in (0.1, -0.7, 1.3)]
    assert got == pytest.approx([0.1, -0.7, 1.3, *map(math.sin, phases), *map(math.cos, phases)])


def test_skinning_field_equals_its_layers_in_loops():
    field = SkinningField(frequencies=10, width=16).double()
    positions = torch.randn(5, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    got = field(positions).detach().numpy()
    layers = {name: value.detach().numpy() for name, value in field.named_parameters()}

    def layer(name, x):
        return layers[f"{name}.weight"] @ x + layers[f"{name}.bias"]

    for n, x in enumerate(encode_positions(positions, 10).numpy()):
        assert x.shape == (63,)
        h = np.maximum(layer("second", np.maximum(layer("first", x), 0)), 0)
        h = np.maximum(layer("fourth", np.maximum(layer("third", np.concatenate([x, h])), 0)), 0)
        assert np.allclose(got[n], layer("last", h), atol=1e-14)


def test_skinning_weights_are_weights_whatever_the_offsets():
    body_weights = torch.eye(24, dtype=torch.float64)[:3]
    assert torch.allclose(
        skinning_weights(body_weights, torch.zeros(3, 24).double()), body_weights, atol=3e-8
    )
    generator = torch.Generator().manual_seed(1)
    for size in (1.0, 30.0, 1e4):
        offsets = torch.randn(3, 24, generator=generator, dtype=torch.float64) * size
        weights = skinning_weights(body_weights, offsets)
        assert (weights >= 0).all() and torch.allclose(weights.sum(1), torch.ones(3).double(), atol=1e-12)
    want = (body_weights[0] + 1e-9) * offsets.mul(0).add(0.5)[0].exp()
    assert torch.allclose(
        skinning_weights(body_weights[:1], torch.full((1, 24), 0.5).double())[0], want / want.sum()
    )


def test_refiner_multiplies_from_the_right_and_leaves_the_root():
    refiner = PoseRefiner().double()
    with torch.no_grad():
        refiner.layers[-1].bias.copy_(torch.randn(69, generator=torch.Generator().manual_seed(2)))
    body_pose = torch.randn(69, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    rotations = axis_angle_to_matrix(torch.randn(24, 3, generator=torch.Generator().manual_seed(4)).double())
    refined = refiner(body_pose, rotations)
    assert torch.equal(refined[0], rotations[0])
    corrections = axis_angle_to_matrix(refiner.layers(body_pose).view(23, 3))
    assert torch.equal(corrections, axis_angle_to_matrix(refiner.corrections(body_pose)))
    for k in range(23):
        assert torch.allclose(refined[k + 1], rotations[k + 1] @ corrections[k], atol=1e-14)
    fresh = PoseRefiner().double()(body_pose, rotations)
    assert (fresh - rotations).abs().max() < 1e-3


def test_network_gradients():
    torch.manual_seed(5)
    refiner, field = PoseRefiner(width=8).double(), SkinningField(frequencies=2, width=8).double()
    body_pose = torch.randn(69, dtype=torch.float64, requires_grad=True)
    assert gradcheck(lambda p: refiner(p, torch.eye(3).double().expand(24, 3, 3)), body_pose, fast_mode=True)
    assert gradcheck(field, torch.randn(3, 3, dtype=torch.float64, requires_grad=True))


def test_more_than_vertices_lie_in_the_middles_of_the_largest_faces(body):
    plain, more = Gaussians.on_body(body, 1), Gaussians.on_body(body, 1, len(body.v_template) + 12)
    n = plain.num_gaussians
    assert more.num_gaussians == n + 12
    assert torch.equal(more.means[:n], plain.means)
    corners = body.da_vertices()[body.faces].double()
    a, b, c = corners.unbind(dim=1)
    areas = ((b - a).cross(c - a, dim=1)).norm(dim=1)
    middles = corners.mean(dim=1)
    taken = torch.cdist(more.means[n:].detach().double(), middles).argmin(dim=1)
    assert len(set(taken.tolist())) == 12
    rest = torch.ones(len(areas), dtype=torch.bool)
    rest[taken] = False
    assert areas[taken].min() >= areas[rest].max() * (1 - 1e-6)
    nearest = torch.cdist(more.means.detach(), body.da_vertices()).argmin(dim=1)
    assert torch.equal(more.vertex_index, nearest)


def test_no_more_than_a_face_each(body):
    every = Gaussians.on_body(body, 0, 10**9)
    assert every.num_gaussians == len(body.v_template) + len(body.faces)
    assert every.scales.isfinite().all() and (every.scales > 0).all()
    assert Gaussians.on_body(body, 0, 5).num_gaussians == len(body.v_template)


def test_flat_gaussians_lie_on_the_body(body):
    thickness = 0.002
    flat, plain = Gaussians.on_body(body, 0, thickness=thickness), Gaussians.on_body(body, 0)
    assert torch.equal(flat.means, plain.means)
    roots = flat.roots().detach().double()
    normals = torch.from_numpy(vertex_normals(body.da_vertices().double().numpy(), body.faces.numpy()))
    along = torch.einsum("nij,ni->nj", roots, normals[flat.vertex_index].double()).norm(dim=1)
    want = plain.scales[:, 2].clamp(max=thickness).double()
    on_a_face = normals[flat.vertex_index].norm(dim=1) > 0.5  # a vertex of no face has no normal
    assert (along / want - 1)[on_a_face].abs().max() < 1e-3
    assert torch.equal(flat.scales[:, :2], plain.scales[:, :2])
