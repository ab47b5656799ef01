from __future__ import annotations

import io
import struct

import numpy as np
import pytest
import trimesh

from occfusion.errors import DataError
from occfusion.files.ply import SplatTable, write_ply
from oracles.splat_files import read_raw_ply


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
    for name, value in read_raw_ply(tmp_path / "a.ply").items():
        assert np.array_equal(getattr(table, name), value), name


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
