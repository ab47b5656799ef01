"""What the first bytes of a PNG or JPEG say, read before anything is decoded."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}
"""Colour type to channels; 3 is a palette, which decodes to colours."""

_PNG_ESSENTIAL = frozenset((b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND"))

_PNG_COLOUR, _PALETTE = 25, 3
"""Where the colour type stands in a file, and its value for a palette."""

_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers that carry the size; the three others in their range are tables."""

_STANDALONE = frozenset(range(0xD0, 0xD9)) | {0x01}
_EXIF_ORIENTATION = 0x0112


@dataclass(frozen=True)
class ImageHeader:
    """A picture's declared form.

    Attributes:
        width: columns.
        height: rows.
        channels: 1 grey, 2 grey with alpha, 3 colour, 4 colour with alpha (PNG) or CMYK (JPEG).
        bits: bits per channel.
        format: `"png"` or `"jpeg"`.
        orientation: the EXIF orientation, 1 when upright or not given.
        complete: whether the file has its end marker.
    """

    width: int
    height: int
    channels: int
    bits: int
    format: str
    orientation: int
    complete: bool


def parse_header(content: bytes) -> ImageHeader:
    """Returns the header of a picture; of a file's beginning too, `complete` is then False.

    Raises:
        ValueError: neither PNG nor JPEG, or the size lies beyond `content`; says which.
    """
    if content.startswith(_PNG_SIGNATURE):
        return _parse_png(content)
    if content.startswith(b"\xff\xd8"):
        return _parse_jpeg(content)
    raise ValueError("neither a PNG nor a JPEG" if content else "the file is empty")


def _parse_png(content: bytes) -> ImageHeader:
    if len(content) < 26 or content[12:16] != b"IHDR":
        raise ValueError("a PNG without its header")
    width, height, bits, colour = struct.unpack(">IIBB", content[16:26])
    if colour not in _PNG_CHANNELS or width == 0 or height == 0:
        raise ValueError("a PNG with a damaged header")
    return ImageHeader(
        width, height, _PNG_CHANNELS[colour], bits, "png", _png_orientation(content), b"IEND" in content[-64:]
    )


def essential_png(content: bytes, *, palette: bool = True) -> bytes:
    """Returns a PNG with only the chunks that make its picture.

    A decoder would otherwise believe the declared length of every chunk (gigabytes, in a file of a few
    bytes), a second header, animations, and compressed texts.

    Args:
        content: the file.
        palette: False makes the places in a palette grey values.

    Raises:
        ValueError: the file ends before its end marker, or has two headers.
    """
    kept, at, colours = [_PNG_SIGNATURE], len(_PNG_SIGNATURE), _PNG_ESSENTIAL
    while at + 12 <= len(content):
        length, kind = struct.unpack(">I4s", content[at : at + 8])
        end = at + 12 + length  # length, kind, content, checksum
        if end > len(content):
            break
        if (kind == b"IHDR") != (at == len(_PNG_SIGNATURE)):
            raise ValueError("a PNG with a damaged header")
        if kind == b"IHDR" and not palette and content[_PNG_COLOUR] == _PALETTE:
            colours = _PNG_ESSENTIAL - {b"PLTE", b"tRNS"}
            header = content[at + 4 : _PNG_COLOUR] + b"\0" + content[_PNG_COLOUR + 1 : end - 4]
            kept.append(content[at : at + 4] + header + struct.pack(">I", zlib.crc32(header)))
        elif kind in colours:
            kept.append(content[at:end])
        if kind == b"IEND":
            return b"".join(kept)
        at = end
    raise ValueError("the picture is cut short or damaged")


def _png_orientation(content: bytes) -> int:
    at = content.find(b"eXIf", 0, 4096)
    return _tiff_orientation(content[at + 4 : at + 4 + 4096]) if at > 0 else 1


def _parse_jpeg(content: bytes) -> ImageHeader:
    at, orientation = 2, 1
    while at + 4 <= len(content):
        if content[at] != 0xFF:
            raise ValueError("a JPEG with a damaged header")
        marker = content[at + 1]
        if marker == 0xFF or marker in _STANDALONE:  # fill bytes and markers without content
            at += 1 if marker == 0xFF else 2
            continue
        (length,) = struct.unpack(">H", content[at + 2 : at + 4])
        body = content[at + 4 : at + 2 + length]
        if marker == 0xE1 and body.startswith(b"Exif\0\0"):
            orientation = _tiff_orientation(body[6:])
        if marker in _JPEG_FRAMES:
            if len(body) < 6:
                break
            bits, height, width, channels = struct.unpack(">BHHB", body[:6])
            if width == 0 or height == 0:
                raise ValueError("a JPEG with a damaged header")
            # entropy-coded bytes 0xFF are stuffed: after the header this pair can only be the end marker
            complete = content.rfind(b"\xff\xd9") > at
            return ImageHeader(width, height, channels, bits, "jpeg", orientation, complete)
        at += 2 + length
    raise ValueError("a JPEG whose size could not be found")


def _tiff_orientation(block: bytes) -> int:
    """Returns the orientation entry of an EXIF block, 1 when there is none."""
    order = {b"II": "<", b"MM": ">"}.get(block[:2])
    if order is None or len(block) < 8:
        return 1
    (start,) = struct.unpack(order + "I", block[4:8])
    if start + 2 > len(block):
        return 1
    (entries,) = struct.unpack(order + "H", block[start : start + 2])
    for index in range(entries):
        entry = block[start + 2 + 12 * index : start + 14 + 12 * index]
        if len(entry) < 12:
            break
        tag, kind, _count, value = struct.unpack(order + "HHIH", entry[:10])
        if tag == _EXIF_ORIENTATION and kind == 3:
            return int(value)
    return 1
