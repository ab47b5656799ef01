"""Step-indexed sampling, the stream that reads ahead, the bounded cache, and the protocol."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from itertools import islice

import pytest

from occfusion.data.prepare import held_out_cameras, held_out_range, train_range
from occfusion.data.sampling import AHEAD, StepSampler, StepStream, prefetched
from occfusion.data.views import BoundedCache
from occfusion.errors import ConfigError


def test_each_epoch_visits_every_frame_once_in_its_own_order():
    sampler = StepSampler(7, seed=3)
    epochs = [[sampler.position_at(7 * epoch + k) for k in range(7)] for epoch in range(20)]
    assert all(sorted(epoch) == list(range(7)) for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) > 15


def test_the_order_depends_on_the_seed_and_the_step_alone():
    forwards = [StepSampler(5, 0).position_at(step) for step in range(50)]
    backwards = [StepSampler(5, 0).position_at(step) for step in reversed(range(50))]
    assert forwards == backwards[::-1]
    shared = StepSampler(5, 0)
    assert [shared.position_at(step) for step in reversed(range(50))] == backwards
    assert forwards != [StepSampler(5, 1).position_at(step) for step in range(50)]


@pytest.mark.parametrize("step", [0, 1, 4, 5, 13, 1000])
def test_a_stream_started_late_goes_on_as_the_first_would(step):
    whole = list(islice(StepStream(lambda p: p, StepSampler(5, 2), lambda: 0), step + 12))
    late = list(islice(StepStream(lambda p: p, StepSampler(5, 2), lambda: step), 12))
    assert late == whole[step:]


def test_reading_ahead_is_bounded_and_in_order():
    begun: list[int] = []
    stream = prefetched(lambda k: begun.append(k) or k, iter(range(100)))
    for k in range(10):
        assert next(stream) == k
        assert len(begun) <= k + 1 + AHEAD
    stream.close()
    assert len(begun) < 20


def test_reading_happens_in_another_thread_and_its_error_comes_through():
    threads = list(prefetched(lambda _: threading.current_thread().name, [0, 1]))
    assert all(name.startswith("frames") for name in threads)

    def fail(k: int) -> int:
        if k == 2:
            raise OSError("bad frame")
        return k

    stream = prefetched(fail, range(5))
    assert [next(stream), next(stream)] == [0, 1]
    with pytest.raises(OSError, match="bad frame"):
        next(stream)


def test_what_is_kept_is_made_where_it_is_used_and_the_order_stays():
    kept = {1, 2, 5}
    found = list(prefetched(lambda k: (k, threading.current_thread().name), range(7), kept.__contains__))
    own = threading.current_thread().name
    assert [k for k, _ in found] == list(range(7))
    assert {k for k, name in found if name == own} == kept
    stream = prefetched(lambda k: k, iter(range(100)), lambda _: True)
    assert [next(stream) for _ in range(3)] == [0, 1, 2]  # nothing is made that nobody has asked for
    late = StepStream(lambda p: p, StepSampler(5, 2), lambda: 3, is_kept=lambda p: p % 2 == 0)
    plain = StepStream(lambda p: p, StepSampler(5, 2), lambda: 3)
    assert list(islice(late, 12)) == list(islice(plain, 12))


@dataclass
class Block:
    nbytes: int


def test_the_cache_stays_within_its_bound_and_keeps_what_it_has():
    cache: BoundedCache[Block] = BoundedCache(100)
    made: list[int] = []

    def get(key: int) -> Block:
        return cache.get(key, lambda: made.append(key) or Block(40))

    for _ in range(3):
        for key in range(4):
            get(key)
    assert len(cache) == 2 and made.count(0) == made.count(1) == 1 and made.count(2) == made.count(3) == 3
    few: BoundedCache[Block] = BoundedCache(100, max_items=1)
    assert [few.get(key, lambda: Block(1)).nbytes for key in (0, 1, 0)] == [1, 1, 1] and len(few) == 1


@pytest.mark.parametrize(
    ("frames", "train", "test"),
    [
        (617, range(0, 500, 5), range(0, 500, 30)),  # ZJU-MoCap 377: 100 and 17 frames
        (500, range(0, 500, 5), range(0, 500, 30)),
        (475, range(0, 400, 4), range(0, 400, 24)),
        (100, range(100), range(0, 100, 6)),
        (7, range(7), range(0, 7, 6)),
        (1, range(1), range(1)),
    ],
)
def test_the_papers_frames_cut_to_the_scene(frames, train, test):
    assert train_range(None, frames) == tuple(train)
    assert held_out_range(None, frames) == tuple(test)


def test_given_frames():
    assert train_range([2, None, 3], 10) == (2, 5, 8)
    assert train_range([0, 500, 4], 10) == (0, 4, 8)


@pytest.mark.parametrize(
    "spec", [[0, 5], [0, 5, 0], [-1, 5, 1], [5, 5, 1], [20, 30, 1], "0:5", [0, 1.5, 1], 3]
)
def test_frames_that_cannot_be(spec):
    with pytest.raises(ConfigError, match=r"dataset.train_frames"):
        train_range(spec, 10)


def test_cameras():
    assert held_out_cameras(None, 1, 4) == (0, 2, 3)
    assert held_out_cameras([3, 1], 1, 4) == (3, 1)
    for spec in ([4], [-1], [0, 0], "0", [True]):
        with pytest.raises(ConfigError, match=r"dataset.test_cameras"):
            held_out_cameras(spec, 1, 4)
    for camera in (4, -1, True, None, "0"):
        with pytest.raises(ConfigError, match=r"dataset.train_camera"):
            held_out_cameras(None, camera, 4)


@pytest.mark.parametrize("step", [0, 3, 100])
@pytest.mark.parametrize("processes", [1, 2, 3, 7])
def test_processes_share_one_sequence(step: int, processes: int):
    """Together they see what one process would in as many steps as they are, whenever they begin."""
    alone = list(islice(StepStream(lambda p: p, StepSampler(5, 2), lambda: step * processes), 6 * processes))
    shares = [
        list(islice(StepStream(lambda p: p, StepSampler(5, 2), lambda: step, lambda r=r: (r, processes)), 6))
        for r in range(processes)
    ]
    assert [shares[k % processes][k // processes] for k in range(6 * processes)] == alone
