"""Loading libraries, of which a start mostly consists."""

from __future__ import annotations

import contextlib
import gc
import os
from collections.abc import Iterator

OPENCV_THREADS = "OPENCV_FOR_THREADS_NUM"
"""Of the environment: threads of OpenCV, which reads it when it is loaded."""


@contextlib.contextmanager
def loading() -> Iterator[None]:
    """Lets modules be imported without a search for garbage, of which they leave none.

    The searches take a quarter of the time that `import torch` takes, and as long again when the program ends. What is
    there afterwards is not searched again. OpenCV gets one thread: pictures are the size of a person, and its second
    waits for work at the cost of a third of a look at an outline.
    """
    os.environ.setdefault(OPENCV_THREADS, "1")
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if was_on:
            gc.enable()
