"""What all tests share."""

import gc
import os

# tests work on small arrays, which more threads only slow down, where two processes share the cores a hundred times;
# NumPy's library of linear algebra reads this once, and so do the processes that tests start. Thread counts are tested
# where they matter
os.environ.setdefault("OMP_NUM_THREADS", "1")
# nor do they train on a GPU, whose sums depend on the order of its threads, but where a user names one
os.environ.setdefault("CUDA_VISIBLE_DEVICES", "")

import pytest
import torch

torch.set_num_threads(1)


def pytest_collection_finish(session: pytest.Session) -> None:
    """Leaves the modules of all tests out of searches for garbage, a fifth of a tiny run's time."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True, scope="session")
def unsynchronised_disk() -> None:
    """Waits for no disk, a tenth of a tiny run's time: nobody cuts the power while a test runs."""
    os.fsync = lambda descriptor: None


@pytest.fixture(autouse=True)
def one_thread() -> None:
    """Gives each test one thread, whatever the one before has left: products of matrices round by their number."""
    torch.set_num_threads(1)
