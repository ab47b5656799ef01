"""What all tests share."""

import gc
import os

import pytest
import torch

# tests work on small tensors, which more threads only slow down, the more so where two processes share the cores;
# thread counts are tested where they matter
torch.set_num_threads(1)
os.environ.setdefault("OMP_NUM_THREADS", "1")  # of the processes that tests start


def pytest_collection_finish(session: pytest.Session) -> None:
    """Leaves the modules of all tests out of searches for garbage, a fifth of a tiny run's time."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True, scope="session")
def unsynchronised_disk() -> None:
    """Waits for no disk, a tenth of a tiny run's time: nobody cuts the power while a test runs."""
    os.fsync = lambda descriptor: None
