"""Packed files of Gaussians, value by value: as gsply reads them, and within the steps that the formats have."""

from __future__ import annotations

import numpy as np
import pytest
from test_ply import make

from occfusion.errors import DataError
from occfusion.export.splats import write_splat_glb
from occfusion.files.glb import Glb
from occfusion.files.packed_splats import CHUNK, write_compressed_ply, write_spz
from occfusion.files.ply import SplatTable
from oracles.splat_files import read_by_trimesh

gsply = pytest.importorskip("gsply", reason="gsply reads files of Gaussians independently of us")


def table_of(n, bands):
    drawn = make(n, bands, seed=n + bands)
    small = {
        "sh_rest": 0.2 * drawn.sh_rest,
        "log_scales": drawn.log_scales - 4,
        "sh0": drawn.sh0.clip(-1.5, 1.5),
    }
    return SplatTable(**{**vars(drawn), **small})


def turned_by(read, raw):
    """Angle between rotations, radians."""
    raw = raw / np.linalg.norm(raw, axis=1, keepdims=True)
    return 2 * np.arccos(np.abs((read * raw).sum(axis=1)).clip(0, 1))


def opacity(logits):
    return 1 / (1 + np.exp(-logits))


@pytest.mark.parametrize(("n", "bands"), [(1, 1), (7, 16), (300, 4)])
def test_spz_keeps_values_within_its_steps(tmp_path, n, bands):
    table = table_of(n, bands)
    write_spz(tmp_path / "a.spz", table)
    read = gsply.read_spz(tmp_path / "a.spz")
    assert np.abs(read.means - table.means).max() <= 0.51 / 2**16
    assert np.abs(read.scales - table.log_scales).max() <= 0.51 / 16
    assert turned_by(read.quats, table.raw_quats).max() < 0.006
    assert np.abs(opacity(read.opacities) - opacity(table.opacity_logits)).max() <= 0.51 / 255
    assert np.abs(read.sh0 - table.sh0[:, 0]).max() <= 0.51 / (0.15 * 255)
    if bands > 1:
        assert np.abs(read.shN - table.sh_rest).max() <= 0.51 / 128


@pytest.mark.parametrize(("n", "bands"), [(1, 1), (CHUNK, 4), (3 * CHUNK + 5, 16)])
def test_compressed_ply_keeps_values_within_the_steps_of_their_chunk(tmp_path, n, bands):
    table = table_of(n, bands)
    write_compressed_ply(tmp_path / "a.compressed.ply", table)
    read = gsply.plyread(str(tmp_path / "a.compressed.ply"))
    # the order is another: each Gaussian is found again by its place
    step = np.ptp(table.means, axis=0) / [2047, 1023, 2047] * 0.51 + 1e-6
    row = np.abs(read.means[:, None] - table.means[None]).sum(axis=2).argmin(axis=1)
    assert sorted(row) == list(range(n))
    assert (np.abs(read.means - table.means[row]) <= step).all()
    assert np.abs(read.scales - table.log_scales[row]).max() <= np.ptp(table.log_scales) / 1023
    assert turned_by(read.quats, table.raw_quats[row]).max() < 0.005
    assert np.abs(read.sh0 - table.sh0[row, 0]).max() <= np.ptp(table.sh0) / 255 + 1e-6
    assert np.abs(opacity(read.opacities) - opacity(table.opacity_logits[row])).max() <= 0.51 / 255
    if bands > 1:
        assert np.abs(read.shN - table.sh_rest[row]).max() <= 0.04


@pytest.mark.parametrize("bands", [1, 9])
def test_glb_keeps_every_value(tmp_path, bands):
    table = table_of(5, bands)
    write_splat_glb(tmp_path / "a.glb", table)
    read = read_by_trimesh(tmp_path / "a.glb")
    assert np.array_equal(read["means"], table.means)
    assert np.allclose(read["scales"], np.exp(table.log_scales)) and np.allclose(
        read["o"], opacity(table.opacity_logits)
    )
    assert turned_by(read["quats"], table.raw_quats).max() < 1e-3
    assert np.array_equal(read["sh"], np.concatenate([table.sh0, table.sh_rest], axis=1))


def test_a_chunk_of_equal_values_has_no_extent(tmp_path):
    table = table_of(5, 1)
    arrays = {name: value for name, value in vars(table).items() if name != "about"}
    same = SplatTable(**{name: np.repeat(value[:1], 5, axis=0) for name, value in arrays.items()})
    write_compressed_ply(tmp_path / "a.compressed.ply", same)
    assert np.allclose(gsply.plyread(str(tmp_path / "a.compressed.ply")).means, same.means)


def test_what_does_not_fit_is_refused_and_nothing_is_written(tmp_path):
    table = table_of(3, 1)
    far = SplatTable(**{**vars(table), "means": table.means + 200})
    with pytest.raises(DataError, match="128 m"):
        write_spz(tmp_path / "a.spz", far)
    table.means[1] = np.nan
    for write in (write_spz, write_compressed_ply):
        with pytest.raises(DataError, match="means is not finite"):
            write(tmp_path / "a.spz", table)
    assert not list(tmp_path.iterdir())


def test_arrays_of_a_glb_start_at_whole_words(tmp_path):
    glb = Glb()
    glb.add(np.arange(3, dtype=np.uint8))
    glb.add(np.ones((2, 3), np.float32), bounds=True)
    glb.write(tmp_path / "a.glb")
    content = (tmp_path / "a.glb").read_bytes()
    assert int.from_bytes(content[8:12], "little") == len(content) and len(content) % 4 == 0
    assert content[-24:] == np.ones(6, "<f4").tobytes() and content[-28:-24] == b"\0\1\2\0"
