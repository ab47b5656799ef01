"""Small arrays that live in a kernel's own frame."""

from __future__ import annotations

from typing import Any

from numba import carray, types
from numba.core import cgutils
from numba.extending import intrinsic

from occfusion.splat.backends.numba_compile import inline


def _local_memory(size: int) -> Any:
    @intrinsic
    def memory(_: Any) -> Any:
        pointer = types.CPointer(types.float32)

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            element = context.get_value_type(types.float32)
            return cgutils.alloca_once(builder, element, size=size)

        return pointer(), generate

    return memory


def local_array(size: int) -> Any:
    """Returns a helper for kernels that returns an uninitialised float32 array `[size]`.

    Nothing else can point to it, which the compiler sees: what is summed there lane by lane stays in registers.
    """
    memory = _local_memory(size)

    @inline
    def array() -> Any:
        return carray(memory(), (size,))

    return array
