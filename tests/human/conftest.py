from __future__ import annotations

import pytest
import torch

from occfusion.files.bodyfile import BodyArrays
from occfusion.human import Body, embedded_body
from oracles.people import make_arrays


@pytest.fixture(scope="session")
def arrays() -> BodyArrays:
    return make_arrays()


@pytest.fixture
def body(arrays: BodyArrays) -> Body:
    return Body(arrays, torch.float64)


@pytest.fixture(scope="session")
def free_body() -> Body:
    return embedded_body()
