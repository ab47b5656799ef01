"""What is freed goes back to the system."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest

PROGRAM = """
import sys
from contextlib import nullcontext
import torch
from occfusion.cpu.memory import large_blocks_apart

def resident():
    with open("/proc/self/status") as lines:
        return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1000

torch.ones(5_000_000)  # 20 MB, freed: the C library takes blocks of up to that from the heap from now on
with large_blocks_apart() if sys.argv[1] == "apart" else nullcontext():
    before, kept, blocks = resident(), [], []
    for _ in range(20):
        blocks.append(torch.ones(3_000_000))
        kept.append(torch.ones(20_000))
    del blocks
    print(resident() - before)
"""


def left_behind(how: str, **environment: str) -> float:
    """Returns what stays of 240 MB in blocks of 12, between small ones that are kept, when they are freed, MB."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), **environment}
    command = [sys.executable, "-c", PROGRAM, how]
    return float(subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
def test_large_blocks_leave_no_holes() -> None:
    assert left_behind("together") > 150
    assert left_behind("apart") < 20
    assert left_behind("apart", MALLOC_MMAP_THRESHOLD_=str(32 << 20)) > 150  # what the user says goes
