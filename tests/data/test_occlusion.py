"""What is hidden: the strip against counting pixels, settings, and the other kinds."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from occfusion.data.occlusion import KINDS, OcclusionSettings, plan, strip_columns
from occfusion.data.silhouette import Silhouette, bounding_box
from occfusion.data.zju.zju_data import ZjuDataModule
from occfusion.errors import ConfigError, DataError


def people(count: int = 10, size: int = 128) -> list[np.ndarray]:
    """A blob that wanders from left to right and changes its width."""
    rows, columns = np.mgrid[:size, :size] / size
    masks = []
    for k in range(count):
        x, w = 0.4 + 0.02 * k, 0.08 + 0.01 * (k % 3)
        masks.append(((columns - x) / w) ** 2 + ((rows - 0.5) / 0.35) ** 2 < 1)
    return masks


def silhouettes(masks) -> list[Silhouette]:
    return [Silhouette.of(mask) for mask in masks]


def hidden_share(mask, box) -> float:
    x, y, w, h = box
    return mask[y : y + h, x : x + w].sum() / mask.sum()


def test_the_strip_is_at_the_median_column_and_hides_half():
    masks = people()
    boxes = plan(OcclusionSettings("strip"), silhouettes(masks), "001-clean")
    assert boxes[8:] == (None, None) and len(set(boxes[:8])) == 1
    x, y, w, h = boxes[0]
    assert (y, h) == (0, 128) and w % 2 == 0
    columns = np.sort(np.concatenate([np.nonzero(mask)[1] for mask in masks]))
    assert abs(x + w // 2 - columns[len(columns) // 2]) <= 1
    shares = {
        half: abs(np.mean([hidden_share(m, (x + w // 2 - half, 0, 2 * half, 128)) for m in masks[:8]]) - 0.5)
        for half in range(1, 40)
    }
    assert w // 2 == min(shares, key=shares.get)


def test_the_strip_does_not_depend_on_the_size():
    coarse = plan(OcclusionSettings("strip"), silhouettes(people(size=128)), "x")[0]
    fine = plan(OcclusionSettings("strip"), silhouettes(people(size=512)), "x")[0]
    assert abs(4 * coarse[0] - fine[0]) <= 4 and abs(4 * coarse[2] - fine[2]) <= 8


@pytest.mark.parametrize(
    ("scene", "size", "columns"),
    [
        ("CoreView_377", 1024, (425, 495)),
        ("my_387", 1024, (423, 473)),
        ("394", 1024, (386, 450)),
        ("CoreView_386", 512, (188, 228)),
    ],
)
def test_the_papers_strips(scene, size, columns):
    x, y, w, h = plan(OcclusionSettings("strip"), silhouettes(people(size=size)), scene)[0]
    assert (x, x + w, y, h) == (*columns, 0, size)


def test_no_other_scene_is_taken_for_one_of_the_paper():
    auto = plan(OcclusionSettings("strip"), silhouettes(people()), "377-clean")[0]
    assert auto == plan(OcclusionSettings("strip"), silhouettes(people()), "001-clean")[0]


def test_given_columns_win():
    boxes = plan(OcclusionSettings("strip", mid=512, width=65), silhouettes(people(size=512)), "CoreView_377")
    assert boxes[0] == ((512 - 32) // 2, 0, 32, 512)
    assert strip_columns(10, 70, 1024) == (0, 45)  # cut at the picture's edge


@pytest.mark.parametrize("frames", [1, 2, 3, 100])
def test_the_first_four_fifths_are_occluded(frames):
    boxes = plan(OcclusionSettings("strip"), silhouettes(people(frames, 64)), "x")
    occluded = [box is not None for box in boxes]
    assert sum(occluded) == round(0.8 * frames) and occluded == sorted(occluded, reverse=True)


def test_box_is_centred_on_each_person_and_hides_its_share():
    masks = people()
    boxes = plan(OcclusionSettings("box", fraction=1.0, share=0.3), silhouettes(masks), "x")
    for mask, box in zip(masks, boxes, strict=True):
        px, py, pw, ph = bounding_box(mask)
        assert abs(2 * box[0] + box[2] - 2 * px - pw) <= 1 and abs(2 * box[1] + box[3] - 2 * py - ph) <= 1
        assert abs(box[2] * box[3] / (pw * ph) - 0.3) < 0.05


def test_moving_bar_crosses_the_range_and_comes_back():
    masks = people(21)
    boxes = plan(OcclusionSettings("moving", fraction=1.0, width=64, sweeps=2.0), silhouettes(masks), "x")
    middles = [box[0] + box[2] / 2 for box in boxes]
    left = min(bounding_box(m)[0] for m in masks)
    right = max(sum(bounding_box(m)[::2]) for m in masks)
    assert abs(middles[0] - left) <= 2 and abs(middles[-1] - left) <= 2 and abs(middles[10] - right) <= 2
    assert (np.diff(middles[:11]) > 0).all() and (np.diff(middles[10:]) < 0).all()


def test_none_hides_nothing():
    assert plan(OcclusionSettings("none"), silhouettes(people()), "CoreView_377") == (None,) * 10


def test_empty_masks():
    empty = silhouettes([np.zeros((8, 8), bool)] * 3)
    for kind in ("strip", "moving"):
        with pytest.raises(DataError, match="person"):
            plan(OcclusionSettings(kind), empty, "x")
    assert plan(OcclusionSettings("box"), empty, "x") == (None, None, None)


@given(
    st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32 - 1),
    st.tuples(*[st.integers(0, 45)] * 4),
)  # fmt: skip
def test_silhouettes_keep_the_mask(height, width, seed, hidden):
    mask = np.random.default_rng(seed).random((height, width)) < 0.2
    kept = Silhouette.of(mask)
    np.testing.assert_array_equal(kept.columns(), mask.sum(axis=0))
    x, y, w, h = hidden
    outside = mask.copy()
    outside[y : y + h, x : x + w] = False
    wanted = outside.sum() / mask.sum() if mask.any() else 1.0
    assert kept.share_outside(hidden) == pytest.approx(wanted)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "files"])
def test_a_bare_name_and_a_mapping_are_the_same(kind):
    assert OcclusionSettings.parse(kind) == OcclusionSettings.parse({"kind": kind})
    assert OcclusionSettings.parse(None) == OcclusionSettings("none")


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("stripe", "none, strip, box, moving"),
        ({"kind": "strip", "widht": 3}, "occlusion.widht: unknown; did you mean width"),
        ({"kind": "strip", "fraction": 1.2}, "fraction=1.2: must be 0 to 1"),
        ({"kind": "strip", "fraction": "half"}, "fraction='half'"),
        ({"kind": "strip", "mid": -1}, "mid=-1"),
        ({"kind": "strip", "width": float("nan")}, "width=nan"),
        ({"kind": "strip", "share": True}, "share=True"),
        (["strip"], "mapping"),
    ],
)
def test_bad_settings(value, message):
    with pytest.raises(ConfigError, match=message):
        OcclusionSettings.parse(value)


def masked_share(mask, hidden: Silhouette) -> float:
    return (mask & hidden.full()).sum() / mask.sum()


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
def test_polygons_hide_their_share_of_each_person(share):
    masks = people(size=256)
    settings = OcclusionSettings("polygons", fraction=1.0, share=share)
    hidden = plan(settings, silhouettes(masks), "x")
    for mask, polygon in zip(masks, hidden, strict=True):
        assert abs(masked_share(mask, polygon) - share) < 0.02
        assert Silhouette.of(mask).share_outside(polygon) == pytest.approx(1 - masked_share(mask, polygon))
    assert len({polygon.bits.tobytes() for polygon in hidden}) == len(masks)


def test_polygons_follow_their_seed_alone():
    def bits(seed):
        hidden = plan(OcclusionSettings("polygons", seed=seed), silhouettes(people()), "x")
        return [None if part is None else part.bits.tobytes() for part in hidden]

    assert bits(3) == bits(3) != bits(4)
    assert bits(3)[8:] == [None, None]


def test_masks_from_files(tmp_path):
    masks = people()
    for k in range(3):
        picture = np.zeros((128, 128), np.uint8)
        picture[:, 40 * k : 40 * k + 30] = 255
        cv2.imwrite(str(tmp_path / f"hide_{k + 8}.png"), picture)  # 8, 9, 10: by number, not by letter
    settings = OcclusionSettings("files", fraction=1.0, folder=str(tmp_path))
    hidden = plan(settings, silhouettes(masks), "x")
    assert [part.box for part in hidden[:4]] == [(40 * (k % 3), 0, 30, 128) for k in range(4)]
    with pytest.raises(DataError, match=r"128 x 128 pixels, but the pictures have 64 x 64"):
        plan(settings, silhouettes(people(size=64)), "x")
    with pytest.raises(DataError, match=r"absent: no such folder; dataset\.occlusion\.folder must"):
        plan(OcclusionSettings("files", folder=str(tmp_path / "absent")), silhouettes(masks), "x")


def test_files_need_a_folder_and_seeds_are_whole():
    with pytest.raises(ConfigError, match=r"needs dataset\.occlusion\.folder"):
        OcclusionSettings("files")
    with pytest.raises(ConfigError, match=r"seed=0.5"):
        OcclusionSettings("polygons", seed=0.5)


@pytest.mark.parametrize("kind", ["polygons", "files"])
def test_a_mask_hides_pixels_of_the_frames_and_enters_the_hash(tiny, tmp_path, kind):
    def module(**occlusion):
        settings = {"kind": kind, "fraction": 1.0, "folder": str(tmp_path), **occlusion}
        return ZjuDataModule(tiny.root, tiny.name, tiny.body, image_size=64, occlusion=settings)

    picture = np.zeros((64, 64), np.uint8)
    picture[20:40] = 255
    cv2.imwrite(str(tmp_path / "0.png"), picture)
    data, clean = module(), ZjuDataModule(tiny.root, tiny.name, tiny.body, image_size=64, occlusion="none")
    data.validate()
    for frame, whole in zip(data.train_frames(), clean.train_frames(), strict=True):
        assert 0 < frame.visible_mask.sum() < whole.visible_mask.sum()
        assert not (frame.visible_mask & frame.occluded).any()
        assert (frame.truth.mask == whole.visible_mask).all()
        if kind == "files":
            assert (frame.occluded.numpy() == (picture > 0)).all()
    before = data.summary()
    other = ZjuDataModule(tiny.root, tiny.name, tiny.body, image_size=64, occlusion=data.occlusion, seed=9)
    assert other.summary()["hidden_boxes"] == before["hidden_boxes"]  # whatever the seed of training
    assert before["hash"] == module().summary()["hash"] and all(before["hidden_boxes"])
    picture[40:45] = 255
    cv2.imwrite(str(tmp_path / "0.png"), picture)
    assert (module().summary()["hash"] != before["hash"]) == (kind == "files")
    assert module(seed=1).summary()["hash"] != before["hash"]
