"""Work spread over threads comes back in order, whatever happens to it."""

import threading
import time

import pytest
import torch

from occfusion.cpu.workers import AHEAD, threaded_map


@pytest.fixture(autouse=True)
def two_threads():
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    assert torch.get_num_threads() == 2, "given back"
    torch.set_num_threads(threads)


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_order_is_that_of_the_items(workers):
    def late(n: int) -> int:
        time.sleep(0.02 if n % 3 == 0 else 0.0)
        return n * n

    assert list(threaded_map(late, range(10), workers)) == [n * n for n in range(10)]
    assert list(threaded_map(late, [], workers)) == []


def test_several_at_a_time_with_one_thread_of_torch_each():
    both = threading.Barrier(2, timeout=20)

    def meet(_: int) -> int:
        both.wait()  # passes only when two are here
        return torch.get_num_threads()

    assert list(threaded_map(meet, range(4), 2)) == [1, 1, 1, 1]


def test_items_are_taken_as_they_are_needed():
    taken = []

    def items():
        for n in range(100):
            taken.append(n)
            yield n

    results = threaded_map(lambda n: n, items(), 2)
    assert next(results) == 0
    assert len(taken) == 2 * AHEAD + 1
    assert list(results) == list(range(1, 100))


def test_an_item_that_takes_long_holds_nobody_up():
    """The first ends only when all that may be taken ahead of it are done."""
    done = threading.Semaphore(0)

    def work(n: int) -> int:
        if n == 0:
            for _ in range(2 * AHEAD - 1):
                assert done.acquire(timeout=20)
        else:
            done.release()
        return n

    assert list(threaded_map(work, range(12), 2)) == [*range(12)]


def test_an_error_reaches_the_caller():
    def fail(n: int) -> int:
        if n == 3:
            raise ValueError("third")
        return n

    with pytest.raises(ValueError, match="third"):
        list(threaded_map(fail, range(8), 2))
