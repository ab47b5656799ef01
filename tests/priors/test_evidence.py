"""What masks and meshes say of occluders, on pictures made by hand."""

import numpy as np
import pytest

from occfusion.priors.evidence import HIDDEN_SHARE, gather_evidence, person_size

SIZE = 100


def person() -> np.ndarray:
    body = np.zeros((SIZE, SIZE), bool)
    body[10:90, 40:60] = True
    return body


def test_a_whole_person_is_not_occluded() -> None:
    found = gather_evidence([person()], [person()])[0]
    assert not found.occluded
    assert found.hidden_share == 0.0
    assert not found.hidden.any()
    assert (found.background == ~person()).all()


def test_a_strip_is_found_and_what_lies_near_it_is_not_called_background() -> None:
    seen = person()
    seen[40:60] = False
    found = gather_evidence([person()], [seen])[0]
    assert found.occluded
    assert 0.15 < found.hidden_share < 0.4
    assert found.hidden[50, 50]
    assert not found.background[50, 62]  # clothes may stand off here
    assert found.background[50, 95]
    assert found.background[15, 70]
    assert not (found.background & seen).any()
    assert not (found.maybe_hidden & seen).any()
    assert found.maybe_hidden[50, 62] and not found.maybe_hidden[50, 95]


def test_what_lies_between_hidden_parts_may_be_hidden() -> None:
    body = np.zeros((SIZE, SIZE), bool)
    body[10:40, 40:60] = body[44:74, 40:60] = True  # a skirt may fill the gap
    body[40:44, 56:60] = True
    seen = body.copy()
    seen[:, :50] = False
    found = gather_evidence([body], [seen])[0]
    assert found.maybe_hidden[42, 42:50].all()
    assert not (found.maybe_hidden & seen).any()
    assert not found.maybe_hidden[:, 70:].any()


def test_a_sliver_too_thin_for_the_core_may_be_hidden_all_the_same() -> None:
    body = np.zeros((400, 400), bool)
    body[40:360, 100:116] = True
    seen = body.copy()
    seen[:, 110:] = False
    found = gather_evidence([body], [seen])[0]
    assert not found.hidden.any() and found.background[100, 113]
    assert found.maybe_hidden[50:350, 110:116].all()


def test_nothing_of_a_whole_person_may_be_hidden() -> None:
    assert not gather_evidence([person()], [person()])[0].maybe_hidden.any()


@pytest.mark.parametrize("shift", [1, 2])
def test_small_errors_of_pose_do_not_count_as_occlusion(shift: int) -> None:
    found = gather_evidence([np.roll(person(), shift, axis=1)], [person()])[0]
    assert found.hidden_share < HIDDEN_SHARE
    assert not found.occluded


def test_nothing_seen_is_all_hidden_and_no_body_is_no_occlusion() -> None:
    nothing = np.zeros((SIZE, SIZE), bool)
    assert gather_evidence([person()], [nothing])[0].hidden_share > 0.99
    assert not gather_evidence([nothing], [person()])[0].occluded
    assert person_size(nothing) == 0.0
    assert person_size(person()) == 80.0


def test_body_cut_by_the_edge_of_the_picture_is_not_hidden_there() -> None:
    body = np.zeros((SIZE, SIZE), bool)
    body[30:, 40:60] = True
    assert gather_evidence([body], [body])[0].hidden_share == 0.0
    assert not gather_evidence([body], [body])[0].occluded


def test_a_pose_that_is_a_little_off_shows_outside_the_mask_and_not_in_the_core() -> None:
    body = person()
    off = np.roll(body, 1, axis=1)
    (fits,), (misses,) = gather_evidence([body], [body]), gather_evidence([off], [body])
    assert fits.outside_share == 0.0
    assert misses.hidden_share == 0.0
    assert misses.outside_share == (off & ~body).sum() / body.sum() > 0.005
