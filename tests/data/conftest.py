"""One written scene for tests that only read it."""

from __future__ import annotations

import pytest

from data.tiny_scene import TinyScene, write_tiny_scene


@pytest.fixture(scope="session")
def tiny(tmp_path_factory) -> TinyScene:
    return write_tiny_scene(tmp_path_factory.mktemp("scenes"))
