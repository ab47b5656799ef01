"""Large blocks of memory are kept out of the heap where that is asked for."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest

PROGRAM = """
import ctypes
import torch
from occfusion.cpu.memory import large_blocks_apart

def is_apart(numbers):
    # the word before a block of glibc's: its size, and in the second bit whether it was mapped by itself
    block = torch.ones(numbers)
    return bool(ctypes.c_size_t.from_address(block.data_ptr() - 8).value & 2)

torch.ones(5_000_000)  # 20 MB, freed: the C library takes blocks of up to that from the heap from now on
told = [is_apart(3_000_000)]
with large_blocks_apart():
    told += [is_apart(3_000_000), is_apart(100_000)]
print(*told, is_apart(3_000_000))
"""


def told(**environment: str) -> str:
    """Returns whether 12 MB lie apart before, 12 MB and 0.4 MB meanwhile, and 12 MB afterwards."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), **environment}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
def test_large_blocks_are_apart_meanwhile() -> None:
    assert told() == "False True False False"
    assert told(MALLOC_MMAP_THRESHOLD_=str(32 << 20)) == "False False False False", "what the user says goes"
