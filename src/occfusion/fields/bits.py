"""Fields of records that keep a mask in little memory, for records of every frame of a video."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]


class Bits:
    """A field of a dataclass that takes a mask `[H, W]`, keeps it packed, and gives a mask made anew."""

    def __set_name__(self, owner: type, name: str) -> None:
        """Notes under which name it is kept."""
        self._name = f"_{name}_packed"

    def __get__(self, record: Any, owner: type | None = None) -> Mask:
        """Returns the mask."""
        if record is None:
            raise AttributeError("no default")  # what a dataclass asks a field for
        return unpacked(record.__dict__[self._name])

    def __set__(self, record: Any, mask: Mask) -> None:
        """Keeps a mask."""
        record.__dict__[self._name] = packed(mask)


Packed = tuple[bytes, tuple[int, ...]]

FASTEST = 1
"""Of zlib's levels. A mask of 256 px takes 8192 bytes as bits, about 560 packed, and 15 microseconds to unpack."""


def packed(mask: Mask) -> Packed:
    """Returns the bits of a mask, compressed, and its shape."""
    return zlib.compress(np.packbits(mask).tobytes(), FASTEST), mask.shape


def unpacked(kept: Packed) -> Mask:
    """Returns the mask that was packed."""
    compressed, shape = kept
    return mask_of_bits(np.frombuffer(zlib.decompress(compressed), np.uint8), shape)


def mask_of_bits(bits: NDArray[np.uint8], shape: tuple[int, ...]) -> Mask:
    """Returns the mask of a shape whose bits `np.packbits` gave."""
    return np.unpackbits(bits, count=int(np.prod(shape))).view(np.bool_).reshape(shape)


class PackedMasks(Mapping[int, Mask]):
    """Masks by the numbers of frames, kept packed; each is made anew when it is asked for."""

    def __init__(self) -> None:
        self._kept: dict[int, Packed] = {}

    def __getitem__(self, frame: int) -> Mask:
        """Returns the mask of a frame, bool `[H, W]`."""
        return unpacked(self._kept[frame])

    def __contains__(self, frame: object) -> bool:
        """Returns whether a frame has a mask; makes none."""
        return frame in self._kept

    def __iter__(self) -> Iterator[int]:
        """Yields the numbers of the frames."""
        return iter(self._kept)

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._kept)

    def put(self, frame: int, mask: Mask) -> None:
        """Keeps the mask of a frame."""
        self._kept[frame] = packed(mask)
