"""Ctrl-C at a moment when Python cannot raise what it means."""

from __future__ import annotations

import _thread
import contextlib
import signal
import sys
import threading
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sys import UnraisableHookArgs
    from types import FrameType

AGAIN_SECONDS = 0.05
"""By then the destructor is left, and another one is seldom reached."""

_before = sys.__unraisablehook__
_is_pressed = False


def keep_interrupts() -> None:
    """Lets no interruption be lost that falls into a destructor or a library's callback, and notes all from now on.

    Python prints such a `KeyboardInterrupt` with its traceback and goes on as though nobody had pressed a key. From now
    on the main thread is interrupted again a moment later, without a word.
    """
    global _before, _is_pressed
    _is_pressed = False
    if sys.unraisablehook is not _unraisable:
        _before = sys.unraisablehook
        sys.unraisablehook = _unraisable
    is_main = threading.current_thread() is threading.main_thread()
    if is_main and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _press)


def is_interrupted() -> bool:
    """Returns whether Ctrl-C was pressed since `keep_interrupts`, whatever became of it.

    OmegaConf's clean-up fails where it is interrupted itself, its own error takes the place of the interruption, and
    Hydra goes on where it only wanted to know whether there are many jobs.
    """
    return _is_pressed


def _press(number: int, frame: FrameType | None) -> None:
    global _is_pressed
    _is_pressed = True
    signal.default_int_handler(number, frame)


def _unraisable(error: UnraisableHookArgs) -> None:
    if not issubclass(error.exc_type, KeyboardInterrupt):
        # what an interruption left half-made lacks an attribute when it goes, and is nobody's fault
        if not (_is_pressed and issubclass(error.exc_type, AttributeError)):
            _before(error)
        return
    again = threading.Timer(AGAIN_SECONDS, _thread.interrupt_main)
    again.daemon = True  # a process that has come to its end is not held by it
    with contextlib.suppress(RuntimeError):  # the interpreter ends, and nothing is left to interrupt
        again.start()
