"""Every form of picture and mask is read by its rule or refused by name."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest

from occfusion.errors import DataError
from occfusion.files.atomic import write_png
from occfusion.files.images import image_header, image_size, read_mask, read_rgb


@pytest.fixture
def colours() -> np.ndarray:
    rows, columns = np.mgrid[:20, :30]
    return np.stack([rows * 10, columns * 8, 255 - rows * 5], axis=2).astype(np.uint8)


def save(path, image, *options):
    assert cv2.imwrite(str(path), image, list(options))
    return path


def test_png_is_exact_and_in_rgb_order(tmp_path, colours):
    path = save(tmp_path / "a.png", colours[..., ::-1])
    np.testing.assert_array_equal(read_rgb(path), colours)
    assert image_size(path) == (30, 20)


def test_jpeg_is_near(tmp_path, colours):
    path = save(tmp_path / "a.jpg", colours[..., ::-1], cv2.IMWRITE_JPEG_QUALITY, 98)
    assert np.abs(read_rgb(path).astype(int) - colours).mean() < 3
    assert image_header(path).format == "jpeg" and image_size(path) == (30, 20)


def test_grey_is_repeated(tmp_path, colours):
    read = read_rgb(save(tmp_path / "a.png", colours[..., 0]))
    np.testing.assert_array_equal(read, np.repeat(colours[..., :1], 3, axis=2))


def test_alpha_is_blended_onto_black(tmp_path):
    image = np.zeros((1, 3, 4), np.uint8)
    image[0, :, :3], image[0, :, 3] = (10, 100, 200), (0, 128, 255)
    read = read_rgb(save(tmp_path / "a.png", image))
    wanted = [[round(v * a / 255) for v in (200, 100, 10)] for a in (0, 128, 255)]
    np.testing.assert_array_equal(read[0], wanted)


def test_16_bits_are_scaled(tmp_path, colours):
    read = read_rgb(save(tmp_path / "a.png", colours[..., ::-1].astype(np.uint16) * 257))
    np.testing.assert_array_equal(read, colours)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_cut_short_is_refused(tmp_path, suffix):
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    path = save(tmp_path / f"a{suffix}", noise)
    content = path.read_bytes()
    for kept in (0.01, 0.3, 0.7, 0.999):
        path.write_bytes(content[: int(len(content) * kept)])
        with pytest.raises(DataError, match=f"a{suffix}: "):
            read_rgb(path)


def test_damage_inside_is_refused(tmp_path, colours):
    path = save(tmp_path / "a.png", colours)
    content = bytearray(path.read_bytes())
    content[60:120] = bytes(60)
    path.write_bytes(content)
    with pytest.raises(DataError, match="cannot be decoded"):
        read_rgb(path)


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def test_only_the_pictures_own_chunks_reach_the_decoder(tmp_path, colours, monkeypatch):
    """A declared length of 2 GB made the decoder allocate it; a second header could change the size."""
    content = save(tmp_path / "a.png", colours).read_bytes()
    texts = content[:33] + chunk(b"zTXt", b"x" * 1000) + chunk(b"acTL", bytes(8)) + content[33:]
    (tmp_path / "b.png").write_bytes(texts)
    given: list[int] = []
    decode = cv2.imdecode
    monkeypatch.setattr(cv2, "imdecode", lambda data, flags: given.append(len(data)) or decode(data, flags))
    np.testing.assert_array_equal(read_rgb(tmp_path / "b.png"), colours[..., ::-1])
    assert given == [len(content)]
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 60000, 1000, 8, 2, 0, 0, 0))
    long = struct.pack(">I4s", 2**31 - 1, b"tEXt")
    for broken in (content[:33] + header + content[33:], content[:33] + long + content[33:]):
        (tmp_path / "b.png").write_bytes(broken)
        with pytest.raises(DataError, match=r"b\.png: .*damaged"):
            read_rgb(tmp_path / "b.png")
    assert len(given) == 1


def gigapixel_png() -> bytes:
    header = struct.pack(">IIBBBBB", 40000, 40000, 1, 0, 0, 0, 0)
    lines = zlib.compress(bytes(5001 * 40000), 9)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", lines) + chunk(b"IEND", b"")


def test_a_gigapixel_is_refused_before_decoding(tmp_path, monkeypatch):
    (tmp_path / "a.png").write_bytes(gigapixel_png())
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    for read in (read_rgb, read_mask):
        with pytest.raises(DataError, match="40000 x 40000 pixels, more than 64 megapixels"):
            read(tmp_path / "a.png")


def exif_jpeg(content: bytes, orientation: int) -> bytes:
    tiff = b"II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x0112, 3, 1, orientation, 0, 0)
    body = b"Exif\0\0" + tiff
    return content[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + content[2:]


def test_exif_rotation_is_refused_and_upright_is_not(tmp_path, colours):
    content = save(tmp_path / "a.jpg", colours).read_bytes()
    (tmp_path / "a.jpg").write_bytes(exif_jpeg(content, 1))
    assert read_rgb(tmp_path / "a.jpg").shape == (20, 30, 3)
    (tmp_path / "a.jpg").write_bytes(exif_jpeg(content, 6))
    with pytest.raises(DataError, match="EXIF orientation 6"):
        read_rgb(tmp_path / "a.jpg")


def test_cmyk_is_refused(tmp_path, colours):
    content = bytearray(save(tmp_path / "a.jpg", colours).read_bytes())
    frame = content.find(b"\xff\xc0")
    content[frame + 9] = 4  # number of components
    (tmp_path / "a.jpg").write_bytes(content)
    with pytest.raises(DataError, match="CMYK"):
        read_rgb(tmp_path / "a.jpg")


@pytest.mark.parametrize("content", [b"", b"GIF89a...", b"\xff\xd8\xff\xe0", b"\x89PNG\r\n\x1a\n"])
def test_other_formats_are_refused(tmp_path, content):
    (tmp_path / "a.jpg").write_bytes(content)
    for read in (read_rgb, read_mask, image_size):
        with pytest.raises(DataError, match=r"a\.jpg: .*must be PNG or JPEG"):
            read(tmp_path / "a.jpg")


def test_missing_is_named(tmp_path):
    for read in (read_rgb, read_mask, image_size):
        with pytest.raises(DataError, match=r"absent.png"):
            read(tmp_path / "absent.png")


PERSON = np.zeros((8, 8), bool)
PERSON[2:6, 3:5] = True


@pytest.mark.parametrize(
    "stored",
    [
        PERSON.astype(np.uint8),
        PERSON * np.uint8(255),
        PERSON * np.uint8(77),
        PERSON * np.uint16(65535),
        PERSON * np.uint16(3),
        np.repeat(PERSON[..., None] * np.uint8(255), 3, axis=2),
        PERSON[..., None] * np.array([0, 0, 9], np.uint8),
        PERSON * (np.arange(64).reshape(8, 8) % 18 + 1).astype(np.uint8),  # labels
        np.dstack([np.repeat(PERSON[..., None] * np.uint8(255), 3, axis=2), np.full((8, 8), 255, np.uint8)]),
    ],
)
def test_masks_of_every_kind(tmp_path, stored):
    np.testing.assert_array_equal(read_mask(save(tmp_path / "m.png", stored)), PERSON)


def test_soft_masks_are_cut_at_128(tmp_path):
    soft = np.array([[0, 127, 128, 255]], np.uint8)
    np.testing.assert_array_equal(read_mask(save(tmp_path / "m.png", soft)), [[False, False, True, True]])


def test_jpeg_masks_are_soft_masks(tmp_path):
    big = cv2.resize(PERSON * np.uint8(255), (64, 64), interpolation=cv2.INTER_NEAREST)
    read = read_mask(save(tmp_path / "m.jpg", big, cv2.IMWRITE_JPEG_QUALITY, 90))
    assert (read == (big > 0)).mean() > 0.99


@pytest.mark.parametrize("value", [0, 1])
def test_empty_and_full_masks(tmp_path, value):
    read = read_mask(save(tmp_path / "m.png", np.full((4, 4), value * 255, np.uint8)))
    assert (read == bool(value)).all()


def test_ambiguous_masks_are_refused(tmp_path):
    with pytest.raises(DataError, match="up to 180 are neither labels"):
        read_mask(save(tmp_path / "m.png", np.array([[0, 90, 180]], np.uint8)))


def test_written_masks_come_back(tmp_path):
    write_png(tmp_path / "deep" / "m.png", PERSON)
    np.testing.assert_array_equal(read_mask(tmp_path / "deep" / "m.png"), PERSON)
