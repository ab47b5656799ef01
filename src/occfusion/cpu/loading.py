"""Loading libraries, of which a start mostly consists."""

from __future__ import annotations

import contextlib
import gc
import importlib
import importlib.util
import os
import sys
from collections.abc import Iterator
from importlib.abc import MetaPathFinder
from types import ModuleType

OPENCV_THREADS = "OPENCV_FOR_THREADS_NUM"
"""Of the environment: threads of OpenCV, which reads it when it is loaded."""
TRACING = "torch._meta_registrations"
"""What `import torch` loads for programs that trace or compile models: a quarter of its time."""
TABLES = (TRACING, "torch._prims", "torch._decomp", "torch._refs")
"""That, and what it loads."""
COMPILED_BLAS = "scipy.linalg.cython_blas"
"""What numba loads, SciPy's linear algebra with it, for kernels that take covariances."""
COMPILES = "gsplat"
"""The one package with which drawing may trace something."""
CHECKED = ("2.13",)
"""Versions of torch that can be imported so; others are loaded whole."""


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


@contextlib.contextmanager
def loading_to_draw() -> Iterator[None]:
    """As `loading`, without what drawing an avatar does not need: a quarter of the time until the first picture.

    Whoever imports another part of torch afterwards, as Lightning does, gets what was left out of it first; kernels of
    numba cannot call `np.cov` in such a process. For one thread; what is loaded already stays as it is.
    """
    with loading():
        if is_torch_checked():
            with _stood_in_for(TRACING, ModuleType(TRACING), of="torch"):
                import torch  # noqa: F401
            if TRACING not in sys.modules:
                sys.meta_path.insert(0, _TablesFirst())
        with _stood_in_for(COMPILED_BLAS, None, of="numba.np.arraymath"):
            importlib.import_module("numba.np.arraymath")
        yield


class _TablesFirst(MetaPathFinder):
    """Finds nothing, but has torch's tables for tracing loaded before the first part of it that asks for them.

    Drawing imports no other part. Those that trace import each other in a circle which the tables have to begin.
    """

    def find_spec(self, fullname: str, path: object, target: object = None) -> None:
        """Loads the tables, once, where a part of torch is asked for that they do not load themselves."""
        if fullname.startswith("torch.") and self in sys.meta_path:
            sys.meta_path.remove(self)
            if not fullname.startswith(TABLES):
                importlib.import_module(TRACING)


def is_torch_checked() -> bool:
    """Returns whether torch can do without its tables for tracing: by its version, and by who else may ask for them."""
    from importlib.metadata import PackageNotFoundError, version  # which torch loads as well

    try:
        release = ".".join(version("torch").split(".")[:2])
    except PackageNotFoundError:  # built by hand
        return False
    return release in CHECKED and importlib.util.find_spec(COMPILES) is None


@contextlib.contextmanager
def _stood_in_for(name: str, module: ModuleType | None, *, of: str) -> Iterator[None]:
    """Puts something in a module's place while `of` is imported, if neither is there; None: as if it were missing."""
    if name in sys.modules or of in sys.modules:
        yield
        return
    sys.modules[name] = module  # type: ignore[assignment]  # None is how Python is told that there is none
    try:
        yield
    finally:
        del sys.modules[name]
        package, _, attribute = name.rpartition(".")
        if package in sys.modules:
            vars(sys.modules[package]).pop(attribute, None)
