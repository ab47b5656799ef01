"""Reading pictures and masks; every unusual form is handled by a stated rule or refused by name.

| form | picture | mask |
|---|---|---|
| grey | repeated in three channels | as it is |
| with alpha | blended onto black | alpha ignored |
| 16 bits | divided by 257 and rounded | divided by 257 when over 255, else labels |
| colours, palette | as they are | labels: colours other than black, places in the palette other than 0 |
| CMYK, EXIF rotation other than upright, neither PNG nor JPEG | refused | refused |
| cut short | refused | refused |
| array, `.npy` | refused | true and false, whole numbers from 0 to 65535, or a share of the person from 0 to 1 |

Arrays are numbers only: nothing in such a file is executed. InstantAvatar's preparation of PeopleSnapshot writes masks
so. Shares, which are floating-point numbers, count as a soft mask of 255 steps.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.errors import DataError
from occfusion.files.arrays import load_npy, npy_form
from occfusion.files.imageheader import ImageHeader, essential_png, parse_header
from occfusion.files.unpickle import read_bytes

MAX_MEGAPIXELS = 64.0
"""Pictures that declare more are not decoded; a 1-gigapixel PNG can be a file of a few kilobytes."""

MAX_FILE_BYTES = 512 << 20

_HEAD_BYTES = (4096, 1 << 18)
"""How much is read to find a size: nearly always the first; large EXIF blocks need the second."""

_TAIL_BYTES = 64
"""How much is read to find the end marker; some cameras write more behind it, then all is read."""

MAX_LABEL = 40
"""Largest value read as a label: parsing sets have 20 (CIHP) to 33 classes."""

_SOFT = 128
"""From here up a soft mask counts as person."""

_GREY = 40
"""Colours whose channels differ by less are grey: a white mask that was a JPEG once is not quite white."""

_TO_8_BITS = 257
"""65535 / 255."""

MASK_ARRAY = ".npy"
"""Suffix of masks that are kept as arrays."""

_ARRAY_KINDS, _LARGEST = "biuf", 65535


def image_header(path: Path | str) -> ImageHeader:
    """Returns the declared form of a picture, reading only its beginning.

    Raises:
        DataError: missing, or neither PNG nor JPEG.
    """
    path = Path(path)
    try:
        with path.open("rb") as stream:
            for amount in _HEAD_BYTES:
                stream.seek(0)
                try:
                    return parse_header(stream.read(amount))
                except ValueError as error:
                    reason = error
    except FileNotFoundError:
        raise DataError(f"{path}: picture not found.") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror or error}).") from error
    raise DataError(f"{path}: {reason}; pictures and masks must be PNG or JPEG files.")


def image_size(path: Path | str) -> tuple[int, int]:
    """Returns (width, height) in pixels, without decoding."""
    if _is_array(path):
        return _array_size(path)
    header = image_header(path)
    return header.width, header.height


def sound_size(path: Path | str) -> tuple[int, int]:
    """Returns (width, height) in pixels of a file that can be read, as far as its beginning and its end say.

    Raises:
        DataError: missing, cut short, too large, or of a form the table above refuses.
    """
    path = Path(path)
    if _is_array(path):
        return _array_size(path)
    header = image_header(path)
    if not header.complete and _ends(path, header):
        header = replace(header, complete=True)
    _refuse(path, header)
    return header.width, header.height


def _ends(path: Path, header: ImageHeader) -> bool:
    """Returns whether a file has its end marker, where its beginning did not reach so far."""
    with path.open("rb") as stream:
        stream.seek(-min(_TAIL_BYTES, path.stat().st_size), os.SEEK_END)
        if (b"IEND" if header.format == "png" else b"\xff\xd9") in stream.read():
            return True
    return header.format == "jpeg" and parse_header(read_bytes(path, MAX_FILE_BYTES)).complete


def _refuse(path: Path, header: ImageHeader) -> None:
    _refuse_large(path, header.width, header.height)
    if header.orientation != 1:
        raise DataError(
            f"{path}: EXIF orientation {header.orientation}; the calibration cannot tell whether it means "
            "the stored or the turned picture. Turn the pixels and remove the entry."
        )
    if header.format == "jpeg" and header.channels == 4:
        raise DataError(f"{path}: CMYK colours; convert it to RGB.")
    if not header.complete:
        raise DataError(f"{path}: the picture is cut short; get the file again.")


def _refuse_large(path: Path | str, width: int, height: int) -> None:
    if width * height > MAX_MEGAPIXELS * 1e6:
        raise DataError(
            f"{path}: declares {width} x {height} pixels, more than {MAX_MEGAPIXELS:g} megapixels; scale it down first."
        )


def read_rgb(path: Path | str) -> NDArray[np.uint8]:
    """Returns the picture, uint8 `[H, W, 3]`, in RGB order.

    Raises:
        DataError: missing, damaged, cut short, too large, or of a form the table above refuses.
    """
    image = _to_8_bits(_decode(Path(path)))
    if image.ndim == 2:
        return np.repeat(image[..., None], 3, axis=2)
    if image.shape[2] == 4:
        alpha = image[..., 3:].astype(np.uint16)
        image = ((image[..., :3] * alpha + 127) // 255).astype(np.uint8)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))


def read_mask(path: Path | str, *, any_value: bool = False) -> NDArray[np.bool_]:
    """Returns where the person is, bool `[H, W]`.

    Rule: a PNG with a few colours holds the labels of a parser, painted: every colour but black is the person.
    Otherwise, on the largest of the colour channels: values up to `MAX_LABEL` are labels, and so is a single
    value besides 0: non-zero is the person. With values up to 255 in between, the mask is soft (edges
    blurred, or stored as JPEG): 128 and more is the person, or all but 0 where `any_value` says so.

    Args:
        path: the file.
        any_value: every value but 0 is the person in a PNG, however faint; a JPEG is not to be trusted near 0.

    Raises:
        DataError: as `read_rgb`; or several values besides 0 of which the largest is between labels
            and a soft mask, which could mean either.
    """
    array = _is_array(path)
    image = _read_array(path) if array else _decode(Path(path))
    painted, exact = False, array or image_header(path).format == "png"
    if image.ndim == 3:
        image = image[..., :3]
        first, second, third = (image[..., channel] for channel in range(3))
        brightest = np.maximum(np.maximum(first, second), third)
        spread = brightest - np.minimum(np.minimum(first, second), third)
        painted = exact and int(spread.max(initial=0)) > _GREY
        if painted and (person := _painted_labels(image, path)) is not None:
            return person
        image = brightest
    if image.dtype == np.uint16 and image.max(initial=0) < 256:
        image = image.astype(np.uint8)  # labels written with 16 bits
    image = _to_8_bits(image)
    largest = int(image.max(initial=0))
    if largest <= MAX_LABEL:
        return np.asarray(image > 0)
    values = np.flatnonzero(np.bincount(image.reshape(-1), minlength=256))
    if len(values[values > 0]) == 1 or (any_value and exact and not painted):
        return np.asarray(image > 0)
    if largest >= 250:  # JPEG does not quite reach 255
        return np.asarray(image >= _SOFT)
    raise DataError(
        f"{path}: mask values up to {largest} are neither labels (up to {MAX_LABEL}) nor a soft mask (up to "
        "255). Write 0 for background and 255 for the person."
    )


def _painted_labels(image: NDArray[Any], path: Path | str) -> NDArray[np.bool_] | None:
    """Returns where a picture `[H, W, 3]` of painted labels has one, None where it has too many colours for that.

    The places in a palette are the labels; of two that are both black, one is somebody.
    """
    flat = image.reshape(-1, 3).astype(np.int64)
    if len(np.unique(flat @ (1 << 32, 1 << 16, 1))) > MAX_LABEL + 1:
        return None
    person = image.any(axis=2)
    places = _decode(Path(path), as_stored=True)
    if places.ndim == 2 and not (person & (places == 0)).any():
        return np.asarray(places > 0)
    return np.asarray(person)


def read_numbers(path: Path | str) -> NDArray[np.uint16]:
    """Returns the values of a mask that numbers several people, uint16 `[H, W]`, 0 being nobody.

    Grey values as they are stored, with 1 to 16 bits; of a palette, the places in it and not its colours.

    Raises:
        DataError: as `read_rgb`; or the file is a JPEG, which changes values, or its channels differ.
    """
    path = Path(path)
    if _is_array(path):
        return _read_array(path).astype(np.uint16)
    image = _decode(path, as_stored=True)
    if image_header(path).format == "jpeg":
        raise DataError(f"{path}: a JPEG cannot number people, it changes values; write the masks as PNG.")
    if image.ndim == 3:
        if (image[..., :3] != image[..., :1]).any():
            raise DataError(
                f"{path}: colours do not number people; write grey or palette PNG files whose values are the ids."
            )
        image = image[..., 0]
    return image.astype(np.uint16)


def _decode(path: Path, *, as_stored: bool = False) -> NDArray[Any]:
    """Returns the picture as OpenCV decodes it: grey, BGR or BGRA, 8 or 16 bits.

    With `as_stored`, grey values of less than 8 bits are not spread over 0..255, and palettes are not looked up.
    """
    content = read_bytes(path, MAX_FILE_BYTES)
    try:
        header = parse_header(content)
    except ValueError as error:
        raise DataError(f"{path}: {error}; pictures and masks must be PNG or JPEG files.") from None
    _refuse(path, header)
    try:
        if header.format == "png":
            content = essential_png(content, palette=not as_stored)
        image = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except ValueError as error:
        raise DataError(f"{path}: {error}; get the file again.") from None
    except cv2.error as error:
        raise DataError(f"{path}: cannot be decoded ({error.err}); get the file again.") from error
    if image is None or image.shape[:2] != (header.height, header.width):
        raise DataError(f"{path}: cannot be decoded; the file is damaged, get it again.")
    if image.dtype not in (np.uint8, np.uint16):
        raise DataError(f"{path}: {image.dtype} pixels; use 8 or 16 bits.")
    if as_stored and header.bits < 8:
        image = image // (255 // ((1 << header.bits) - 1))
    return np.asarray(image)


def _to_8_bits(image: NDArray[Any]) -> NDArray[np.uint8]:
    if image.dtype == np.uint16:
        return ((image.astype(np.uint32) + _TO_8_BITS // 2) // _TO_8_BITS).astype(np.uint8)
    return image


def _is_array(path: Path | str) -> bool:
    return Path(path).suffix.lower() == MASK_ARRAY


def _array_size(path: Path | str) -> tuple[int, int]:
    """Returns (width, height) of a mask that is an array, reading only the beginning of the file.

    Raises:
        DataError: missing, damaged, or no picture of numbers.
    """
    shape, dtype = npy_form(path)
    plane = shape[:2] if len(shape) == 3 and shape[2] == 1 else shape
    if len(plane) != 2 or 0 in plane or dtype.kind not in _ARRAY_KINDS:
        raise DataError(
            f"{path}: holds {dtype} of shape {shape}; a mask is [height, width], true and false or numbers."
        )
    return plane[1], plane[0]


def _read_array(path: Path | str) -> NDArray[Any]:
    """Returns the values of a mask that is an array, uint8 or uint16 `[H, W]`.

    Raises:
        DataError: missing, damaged, too large, no picture of numbers, or values that no mask has.
    """
    width, height = _array_size(path)
    _refuse_large(path, width, height)
    values = np.asarray(load_npy(path)).reshape(height, width)
    if values.dtype.kind == "b":
        return values.astype(np.uint8)
    if not np.isfinite(values).all() or values.min() < 0 or values.max() > _LARGEST:
        raise DataError(f"{path}: a mask has no values below 0, above {_LARGEST}, infinite or NaN.")
    if values.dtype.kind == "f" and (values != np.round(values)).any():
        if values.max() > 1:
            raise DataError(
                f"{path}: fractions up to {float(values.max()):g}; write 0 to 1 as the share of the person."
            )
        values = np.round(values * 255)
    return values.astype(np.uint8 if values.max() < 256 else np.uint16)
