"""What a run hid lies in its folder, and another run that is given the folder hides the same pixels."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from data.tiny_scene import TinyScene
from occfusion.data.occluders import read_occlusion, write_occlusion
from occfusion.data.silhouette import Silhouette
from occfusion.data.zju.zju_data import ZjuDataModule
from occfusion.errors import DataError

KINDS = ("strip", "box", "moving", "polygons", "files")
SIZE = (64, 64)


@pytest.fixture
def masks(tmp_path) -> Path:
    """Two masks for `files`, one of them of an odd shape."""
    folder = tmp_path / "masks"
    folder.mkdir()
    picture = np.zeros(SIZE, np.uint8)
    picture[20:40] = 255
    cv2.imwrite(str(folder / "0.png"), picture)
    cv2.imwrite(str(folder / "1.png"), cv2.circle(0 * picture, (30, 30), 12, 7, -1))
    return folder


def module(tiny: TinyScene, **settings) -> ZjuDataModule:
    occlusion = {"fraction": 0.7, **settings.pop("occlusion")}
    return ZjuDataModule(tiny.root, tiny.name, tiny.body, image_size=48, occlusion=occlusion, **settings)


@pytest.mark.parametrize("kind", KINDS)
def test_another_run_sees_the_same_pixels(kind, tiny, masks, tmp_path):
    first = module(tiny, occlusion={"kind": kind, "seed": 5, "folder": str(masks)})
    first.store_occlusion(tmp_path / "occlusion")
    again = {"kind": "files", "folder": str(tmp_path / "occlusion"), "fraction": 0.1, "share": 0.9}
    second = module(tiny, occlusion=again, seed=9)
    frames = list(zip(first.train_frames(), second.train_frames(), strict=True))
    assert len(frames) == 6 and sum(bool(frame.occluded.any()) for frame, _ in frames) == 4
    for a, b in frames:
        assert torch.equal(a.occluded, b.occluded) and torch.equal(a.visible_mask, b.visible_mask)
        assert torch.equal(a.rgb, b.rgb)
    second.store_occlusion(tmp_path / "copy")
    content = [
        {p.name: p.read_bytes() for p in (tmp_path / name).iterdir()} for name in ("occlusion", "copy")
    ]
    assert content[0] == content[1]  # and so on for ever


def test_frames_are_found_by_their_number(tiny, tmp_path):
    whole = module(tiny, occlusion={"kind": "polygons"})
    whole.store_occlusion(tmp_path)
    again = {"kind": "files", "folder": str(tmp_path)}
    some = module(tiny, occlusion=again, train_frames=[1, 6, 2])
    assert some.train_indices == (1, 3, 5)
    for frame in some.train_frames():
        assert torch.equal(frame.occluded, whole.train_frame(frame.index).occluded)
    module(tiny, occlusion={"kind": "polygons"}, train_frames=[0, 4, 1]).store_occlusion(tmp_path / "short")
    again = {"kind": "files", "folder": str(tmp_path / "short")}
    with pytest.raises(DataError, match=r"short/manifest.json: does not say .* in frame 4 and 1 more"):
        module(tiny, occlusion=again).setup()


def test_rectangles_take_no_pictures_and_equal_masks_one(tiny, masks, tmp_path):
    module(tiny, occlusion={"kind": "box"}).store_occlusion(tmp_path / "box")
    assert [path.name for path in (tmp_path / "box").iterdir()] == ["manifest.json"]
    module(tiny, occlusion={"kind": "files", "folder": str(masks)}).store_occlusion(tmp_path / "files")
    assert len(list((tmp_path / "files").glob("*.png"))) == 2  # of four occluded frames
    module(tiny, occlusion={"kind": "none"}).store_occlusion(tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_what_is_there_is_not_written_again_and_what_is_lost_is(tiny, tmp_path):
    data = module(tiny, occlusion={"kind": "polygons"})
    data.store_occlusion(tmp_path)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    data.store_occlusion(tmp_path)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == before
    (tmp_path / "000002.png").unlink()
    data.store_occlusion(tmp_path)
    assert (tmp_path / "000002.png").is_file()


def test_another_stored_occlusion_is_another_data_hash(tiny, tmp_path):
    write_occlusion(tmp_path, dict.fromkeys(range(6), (20, 0, 9, 64)), SIZE, {})
    settings = {"kind": "files", "folder": str(tmp_path)}
    before = module(tiny, occlusion=settings).summary()
    assert before["hidden_boxes"] == [[20, 0, 9, 64]] * 6 and before["occluded_frames"] == 6
    write_occlusion(tmp_path, dict.fromkeys(range(6), (20, 0, 10, 64)), SIZE, {})
    assert module(tiny, occlusion=settings).summary()["hash"] != before["hash"]


def test_a_run_folder_itself_is_refused_with_the_right_name(tiny, tmp_path):
    module(tiny, occlusion={"kind": "box"}).store_occlusion(tmp_path / "occlusion")
    with pytest.raises(DataError, match=r"is a run; name its folder .*occlusion"):
        module(tiny, occlusion={"kind": "files", "folder": str(tmp_path)}).setup()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"size": [65, 64]}, r"pictures of size \[65, 64\], but these have \[64, 64\]"),
        ({"frames": [1]}, "has no table 'frames'"),
        ({"frames": {"0": "../000000.png"}}, "frame 0: '../000000.png' is no name of a mask"),
        ({"frames": {"0": "000009.png"}}, "000009.png: file not found"),
        ({"frames": {"0": [1, 2, 3]}}, r"frame 0: \[1, 2, 3\] is no rectangle"),
        ({"frames": {"0": [60, 0, 5, 64]}}, r"is no rectangle \[x, y, width, height\] inside the picture"),
        ({"frames": {"0": [1.5, 0, 5, 64]}}, "is no rectangle"),
    ],
)
def test_damaged_manifests_are_refused_by_name(change, words, tmp_path):
    mask = np.zeros(SIZE, bool)
    mask[3:9, 4:8] = True
    write_occlusion(tmp_path, {0: Silhouette.of(mask), 1: None}, SIZE, {})
    found = read_occlusion(tmp_path, [1, 0], SIZE)
    assert found[0] is None and (found[1].full() == mask).all()
    path = tmp_path / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(DataError, match=words):
        read_occlusion(tmp_path, [0], SIZE)
    path.write_text("{")
    with pytest.raises(DataError, match=r"manifest.json: not JSON"):
        read_occlusion(tmp_path, [0], SIZE)


def test_masks_of_another_size_are_refused(tmp_path):
    mask = np.ones(SIZE, bool)
    write_occlusion(tmp_path, {0: Silhouette.of(mask)}, SIZE, {})
    cv2.imwrite(str(tmp_path / "000000.png"), np.full((32, 64), 255, np.uint8))
    with pytest.raises(DataError, match=r"000000.png: 64 x 32 pixels, but the pictures have 64 x 64"):
        read_occlusion(tmp_path, [0], SIZE)
