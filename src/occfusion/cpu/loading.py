"""Loading libraries, of which a start mostly consists."""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Iterator


@contextlib.contextmanager
def loading() -> Iterator[None]:
    """Lets modules be imported without a search for garbage, of which they leave none.

    The searches take a quarter of the time that `import torch` takes, and as long again when the program ends. What is
    there afterwards is not searched again.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if was_on:
            gc.enable()
