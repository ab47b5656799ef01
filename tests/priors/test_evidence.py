"""What masks and meshes say of occluders, on pictures made by hand."""

import numpy as np
import pytest

from occfusion.observation import evidence
from occfusion.observation.evidence import FRAMES_TO_JUDGE, HIDDEN_SHARE, gather_evidence, misfit, person_size

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


@pytest.mark.parametrize("count", [1, FRAMES_TO_JUDGE + 1])
def test_looking_about_the_person_alone_finds_what_looking_everywhere_does(
    count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = person()
    seen[40:60], seen[:, :48], seen[12:20, 50:] = False, False, False
    pairs = [(person(), person())] * (count - 1) + [(person(), seen)]
    larger = [[np.pad(mask, ((30, 7), (11, 60))) for mask in pair] for pair in pairs]
    ours = gather_evidence(*zip(*larger, strict=True))
    monkeypatch.setattr(evidence, "_window", lambda *_: (slice(None), slice(None)))
    for found, wanted in zip(ours, gather_evidence(*zip(*larger, strict=True)), strict=True):
        for name in ("hidden", "background", "maybe_hidden", "hidden_share", "occluded", "outside_share"):
            np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name), err_msg=name)


def test_of_nothing_nothing_is_said() -> None:
    nothing = np.zeros((6, 8), bool)
    found = gather_evidence([nothing], [nothing])[0]
    assert not found.occluded and not found.maybe_hidden.any() and found.background.all()


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


def sliver() -> np.ndarray:
    seen = person()
    seen[:, 59] = False
    return seen


def test_where_poses_fit_a_sliver_of_a_pixel_may_be_hidden() -> None:
    bodies, visible = [person()] * (FRAMES_TO_JUDGE + 1), [person()] * FRAMES_TO_JUDGE + [sliver()]
    *whole, found = gather_evidence(bodies, visible)
    assert found.maybe_hidden[10:90, 59:61].all()
    assert not (found.maybe_hidden & sliver()).any() and not found.maybe_hidden[:, 70:].any()
    assert not found.occluded and found.background[50, 59]  # complete masks are made as before
    assert not any(own.maybe_hidden.any() for own in whole)


def test_where_poses_fit_less_of_the_body_than_rounding_explains_is_not_hidden() -> None:
    seen = person()
    seen[40:44, 59] = False
    bodies, visible = [person()] * (FRAMES_TO_JUDGE + 1), [person()] * FRAMES_TO_JUDGE + [seen]
    assert not gather_evidence(bodies, visible)[-1].maybe_hidden.any()


@pytest.mark.parametrize("whole", [FRAMES_TO_JUDGE - 2, FRAMES_TO_JUDGE])
def test_where_poses_do_not_fit_or_too_little_tells_a_sliver_is_their_error(whole: int) -> None:
    moved = np.roll(person(), 1, axis=1) if whole == FRAMES_TO_JUDGE else person()
    found = gather_evidence([moved] * (whole + 1), [person()] * whole + [sliver()])[-1]
    assert not found.maybe_hidden.any()


def test_misfit_is_a_median_and_needs_enough_frames() -> None:
    assert misfit([0.5] * (FRAMES_TO_JUDGE - 1)) is None
    assert misfit([0.0] * FRAMES_TO_JUDGE + [0.5]) == 0.0


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
