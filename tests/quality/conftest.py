"""One thread: these pictures are so small that handing work out costs more than the work."""

from __future__ import annotations

import pytest
import torch

from occfusion.perceptual import PerceptualMetric, load_perceptual


@pytest.fixture(autouse=True)
def _one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def stlpips() -> PerceptualMetric:
    return load_perceptual("stlpips")
