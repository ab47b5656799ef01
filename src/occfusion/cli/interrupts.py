"""Ctrl-C at a moment when Python cannot raise what it means."""

from __future__ import annotations

import _thread
import contextlib
import sys
import threading
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

AGAIN_SECONDS = 0.05
"""By then the destructor is left, and another one is seldom reached."""


def keep_interrupts() -> None:
    """Lets no interruption be lost that falls into a destructor or a library's callback.

    Python prints such a `KeyboardInterrupt` with its traceback and goes on as though nobody had pressed a key. From now
    on the main thread is interrupted again a moment later, without a word.
    """
    if sys.unraisablehook is not _unraisable:
        global _before
        _before = sys.unraisablehook
        sys.unraisablehook = _unraisable


_before = sys.__unraisablehook__


def _unraisable(error: UnraisableHookArgs) -> None:
    if not issubclass(error.exc_type, KeyboardInterrupt):
        _before(error)
        return
    again = threading.Timer(AGAIN_SECONDS, _thread.interrupt_main)
    again.daemon = True  # a process that has come to its end is not held by it
    with contextlib.suppress(RuntimeError):  # the interpreter ends, and nothing is left to interrupt
        again.start()
