"""Masks kept as bits: what is put in comes out, whatever the shape, in little memory."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from occfusion.fields.bits import Bits, PackedMasks, packed, unpacked


@dataclass(frozen=True)
class Record:
    mask: Bits = Bits()  # noqa: RUF009
    share: float


@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (8, 8), (0, 4), (37, 41)])
def test_a_field_gives_what_it_was_given(shape: tuple[int, int]) -> None:
    mask = np.random.default_rng(0).random(shape) < 0.4
    record = Record(mask, 0.25)
    assert np.array_equal(record.mask, mask) and record.mask.dtype == np.bool_ and record.share == 0.25
    changed = replace(record, share=0.5)
    assert np.array_equal(changed.mask, mask) and changed.share == 0.5
    # what comes out is made anew: writing into it changes no record
    if mask.size:
        record.mask[0, 0] ^= True
        assert np.array_equal(record.mask, mask)


def test_a_field_has_no_default() -> None:
    with pytest.raises(TypeError):
        Record(share=1.0)  # type: ignore[call-arg]


def test_masks_by_frames() -> None:
    masks = {frame: np.random.default_rng(frame).random((64, 48)) < 0.3 for frame in (3, 1, 7)}
    kept = PackedMasks()
    for frame, mask in masks.items():
        kept.put(frame, mask)
    kept.put(9, ~masks[3])
    assert list(kept) == [3, 1, 7, 9] and len(kept) == 4 and 1 in kept and 2 not in kept
    assert kept.get(2) is None
    for frame, mask in masks.items():
        assert np.array_equal(kept[frame], mask)
    assert np.array_equal(kept[9], ~masks[3])
    # views of the values can be gone through again and again
    values = kept.values()
    assert [int(mask.sum()) for mask in values] == [int(mask.sum()) for mask in values]


def test_a_mask_with_an_outline_takes_a_tenth_of_its_bits() -> None:
    rows, columns = np.mgrid[:256, :256]
    disk = (rows - 128) ** 2 + (columns - 100) ** 2 < 90**2
    for mask in (disk, ~disk):
        kept, shape = packed(mask)
        assert len(kept) * 10 < mask.size / 8
        assert np.array_equal(unpacked((kept, shape)), mask)
