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
