"""EasyMocap's body parameters in smplx's convention: both sides written out and compared."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from data.tiny_scene import TinyBody
from occfusion.data.body_convention import easymocap_to_smplx


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("root", [False, True])
def test_both_conventions_give_the_same_vertices(seed, root):
    rng = np.random.default_rng(seed)
    body, betas = TinyBody(), torch.tensor(rng.normal(size=10))
    poses = torch.tensor(0.4 * rng.normal(size=72))
    if not root:
        poses[:3] = 0
    Rh, Th = 2.0 * rng.normal(size=3), rng.normal(size=3)
    # EasyMocap: pose the body, then turn it about the origin and shift it
    upright, _ = body(betas, poses[:3], poses[3:], torch.zeros(3))
    wanted = upright.double().numpy() @ cv2.Rodrigues(Rh)[0].T + Th
    _, joints = body(betas, torch.zeros(3), torch.zeros(69), torch.zeros(3))
    orient, transl = easymocap_to_smplx(Rh, Th, poses[:3].numpy(), joints[0].double().numpy())
    found, _ = body(betas, torch.tensor(orient), poses[3:], torch.tensor(transl))
    np.testing.assert_allclose(found.numpy(), wanted, atol=2e-6)


def test_rotation_vector_is_kept_where_it_can_be():
    Rh = np.array([0.0, 4.0, 0.0])  # beyond pi: a round trip through matrices would change it
    orient, _ = easymocap_to_smplx(Rh, np.zeros(3), np.zeros(3), np.ones(3))
    np.testing.assert_array_equal(orient, Rh)
