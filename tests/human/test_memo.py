"""What is kept of an avatar belongs to the tensors that it was made of, and not to others in their place."""

import copy
from itertools import pairwise

import torch

from human.test_avatar import CENTRE, start, train
from occfusion.human.memo import Memo, Unchanged
from oracles.people import make_pose

OFTEN = 40
"""Tries until a new tensor has the number of a freed one; Python mostly gives it at the first."""


def test_a_key_is_of_these_tensors_as_they_are():
    a, b = torch.zeros(3), torch.zeros(3)
    before = Unchanged(a, b)
    assert before == Unchanged(a, b) and hash(before) == hash(Unchanged(a, b))
    assert before != Unchanged(b, a) and before != Unchanged(a) and before != Unchanged(a, b.clone())
    assert before != (a, b)
    a.add_(1.0)
    assert before != Unchanged(a, b)


def test_a_freed_tensor_leaves_its_place_to_no_other():
    memo, numbers = Memo(), []
    for value in range(OFTEN):
        tensor = torch.full((2,), float(value))
        numbers.append(id(tensor))
        assert memo.get("kept", Unchanged(tensor), tensor.clone)[0] == value
        del tensor
    assert all(a != b for a, b in pairwise(numbers)), "what is kept keeps its tensor alive"


def test_a_stage_that_takes_an_avatar_over_keeps_nothing_of_the_last_ones_skinning(body):
    """Its offsets may lie where those of the stage before lay, and were written to as often."""
    avatar, optimizer = start(body)
    pose = make_pose(18)
    train(avatar, optimizer, [0, 1], pose)
    wanted = avatar.skinning_offsets + 0.3 * torch.randn(
        avatar.skinning_offsets.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    number, offsets = id(avatar.skinning_offsets), []
    avatar.forget_skinning()
    while len(offsets) < OFTEN and number not in map(id, offsets):
        offsets.append(wanted.clone())
    avatar.skinning_offsets = next((tensor for tensor in offsets if id(tensor) == number), offsets[0])
    avatar.prepare(1)
    fresh = copy.deepcopy(avatar)
    fresh._memo = Memo()
    assert torch.equal(avatar(pose, CENTRE).means, fresh(pose, CENTRE).means)
