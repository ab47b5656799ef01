"""Small arrays that live in a kernel's own frame."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import carray, from_dtype, types
from numba.core import cgutils
from numba.extending import intrinsic

from occfusion.cpu.compilation import inline


def _local_memory(size: int, element: Any) -> Any:
    @intrinsic
    def memory(_: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return cgutils.alloca_once(builder, context.get_value_type(element), size=size)

        return types.CPointer(element)(), generate

    return memory


def local_array(shape: tuple[int, ...], dtype: Any) -> Any:
    """Returns a helper for kernels that returns an uninitialised array of this shape and type, of a few kB at most.

    Nothing else can point to it, which the compiler sees: loops over it become vector code without a check for
    overlaps, and what is summed there lane by lane stays in registers.
    """
    memory = _local_memory(math.prod(shape), from_dtype(np.dtype(dtype)))

    @inline
    def array() -> Any:
        return carray(memory(), shape)

    return array
