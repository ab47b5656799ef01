from __future__ import annotations

import io
import struct

import numpy as np
import pytest
import trimesh

from occfusion.errors import DataError
from occfusion.files.ply import SplatTable, read_ply, write_ply


def make(n=5, bands=4, seed=0):
    rng = np.random.default_rng(seed)

    def draw(*shape):
        return rng.normal(size=shape).astype(np.float32)

    return SplatTable(draw(n, 3), draw(n, 4), draw(n, 3), draw(n), draw(n, 1, 3), draw(n, bands - 1, 3))


@pytest.mark.parametrize("bands", [1, 4, 9, 16])
@pytest.mark.parametrize("n", [0, 1, 7])
def test_round_trip(tmp_path, n, bands):
    table = make(n, bands)
    write_ply(tmp_path / "a.ply", table)
    again = read_ply(tmp_path / "a.ply")
    for name in vars(table):
        assert np.array_equal(getattr(table, name), getattr(again, name)), name


def test_layout_byte_by_byte(tmp_path):
    table = make(3, 16)
    write_ply(tmp_path / "a.ply", table)
    header, numbers = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 3"]
    names = [line.removeprefix("property float ") for line in lines[3:]]
    assert len(names) == 62 and len(numbers) == 3 * 62 * 4
    row = dict(zip(names, struct.unpack("<62f", numbers[62 * 4 : 2 * 62 * 4]), strict=True))
    assert [row["x"], row["nx"]] == [table.means[1, 0], 0.0]
    assert [row[f"f_dc_{c}"] for c in range(3)] == table.sh0[1, 0].tolist()
    # 15 coefficients of red, then 15 of green, then 15 of blue
    for k in range(15):
        for c in range(3):
            assert row[f"f_rest_{15 * c + k}"] == table.sh_rest[1, k, c]
    assert [row[f"rot_{k}"] for k in range(4)] == table.raw_quats[1].tolist()
    assert [row[f"scale_{k}"] for k in range(3)] == table.log_scales[1].tolist()
    assert row["opacity"] == table.opacity_logits[1]


def test_another_reader_finds_the_points(tmp_path):
    table = make(6)
    write_ply(tmp_path / "a.ply", table)
    cloud = trimesh.load(io.BytesIO((tmp_path / "a.ply").read_bytes()), file_type="ply")
    assert np.allclose(cloud.vertices, table.means)


@pytest.mark.parametrize("name", ["means", "log_scales", "sh_rest", "opacity_logits"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_refused_and_the_old_file_stays(tmp_path, name, value):
    path = tmp_path / "a.ply"
    write_ply(path, make())
    before = path.read_bytes()
    table = make()
    getattr(table, name)[2] = value
    with pytest.raises(DataError, match=rf"{name} is not finite in 1 rows, the first is row 2"):
        write_ply(path, table)
    assert path.read_bytes() == before


def test_shapes_that_do_not_fit_are_refused(tmp_path):
    table = make()
    with pytest.raises(DataError, match="raw_quats"):
        write_ply(tmp_path / "a.ply", SplatTable(**{**vars(table), "raw_quats": table.raw_quats[:4]}))


def test_properties_in_any_order_and_comments(tmp_path):
    table = make(2, 1)
    write_ply(tmp_path / "a.ply", table)
    header, numbers = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")
    lines = header.decode().splitlines()
    columns = np.frombuffer(numbers, "<f4").reshape(2, -1)[:, ::-1]
    lines = [*lines[:2], "comment made by hand", lines[2], *lines[:2:-1], "end_header", ""]
    (tmp_path / "b.ply").write_bytes("\n".join(lines).encode() + columns.tobytes())
    assert np.array_equal(read_ply(tmp_path / "b.ply").raw_quats, table.raw_quats)


def nan_inside(content):
    return content[:-4] + struct.pack("<f", float("nan"))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda c: b"", "not a .ply"),
        (lambda c: b"\x89PNG" + c, "not a .ply"),
        (lambda c: c[:-1], "cut off"),
        (lambda c: c + b"\0", "cut off"),
        (lambda c: c.replace(b"vertex 5", b"vertex 99999999999"), "cut off"),
        (lambda c: c.replace(b"vertex 5", b"vertex -5"), "one element"),
        (lambda c: c.replace(b"binary_little_endian", b"ascii"), "binary little-endian"),
        (lambda c: c.replace(b"float opacity", b"float opaque"), "opacity"),
        (lambda c: c.replace(b"float f_rest_8", b"float f_best_8"), "layout"),
        (lambda c: c.replace(b"float scale_1", b"float scale_0"), "distinct"),
        (lambda c: c.replace(b"property float x", b"property list x"), "distinct float"),
        (nan_inside, "not finite"),
    ],
)
def test_bad_files(tmp_path, spoil, message):
    path = tmp_path / "a.ply"
    write_ply(path, make())
    path.write_bytes(spoil(path.read_bytes()))
    with pytest.raises(DataError, match=message):
        read_ply(path)


def test_missing_file(tmp_path):
    with pytest.raises(DataError, match="cannot be read"):
        read_ply(tmp_path / "none.ply")
