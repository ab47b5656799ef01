"""The 22 kinds of bad data that must not surprise anyone, in the layouts in which they come; one test a kind.

Kinds of pictures (9) and of masks (12) one by one, bodies (3, 4) and full disks (22) have more tests in
`tests/files`; ZJU-MoCap's own cases are in `test_zju_refusals.py`.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import struct
import warnings
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from data import layout_writers as writers
from data.layout_writers import Source
from files.test_bodyfile import content as body_content
from files.test_bodyfile import official_pickle
from occfusion.data.module import HumanDataModule
from occfusion.data.ocmotion.ocmotion_data import OcMotionDataModule
from occfusion.data.video.video_data import VideoDataModule
from occfusion.data.zju.zju_data import ZjuDataModule
from occfusion.errors import DataError
from occfusion.files.bodyfile import load_body_arrays
from occfusion.human import load_body
from occfusion.synth import SceneSpec, write_scene

SIZE = 96
FAR = np.array([40.0, 0.0, 0.0])
SPEC = SceneSpec(2, "clean", image_size=SIZE, frames=4, cameras=2)
LAYOUTS = ("refined", "humannerf", "w2a", "chomp", "video")


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Source:
    return Source(write_scene(tmp_path_factory.mktemp("bad input"), SPEC, progress=False))


@pytest.fixture(scope="module")
def pristine(source, tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("pristine")
    writers.write_refined(source, root)
    writers.write_humannerf(source, root / "377")
    writers.write_w2a(source, root)
    writers.write_chomp(source, root / "raw")
    writers.write_video(source, root / "mine")
    return root


FOLDERS = {"refined": "my_377", "humannerf": "377", "w2a": "0013_02_w2a", "chomp": "raw", "video": "mine"}


class Copy:
    """A copy of one layout that may be broken."""

    def __init__(self, layout: str, pristine: Path, target: Path, source: Source) -> None:
        self.layout, self.source = layout, source
        self.folder = Path(shutil.copytree(pristine / FOLDERS[layout], target / FOLDERS[layout]))

    def module(self, **settings) -> HumanDataModule:
        root, name, body = self.folder.parent, self.folder.name, settings.pop("body", self.source.body)
        settings = {"train_frames": [0, None, 1], "occlusion": "none", **settings}
        match self.layout:
            case "w2a":
                return OcMotionDataModule(root, "0013_02", body, **settings)
            case "chomp":
                settings = {"person": 1, "numbered_masks": True, "test_cameras": None, **settings}
                return OcMotionDataModule(self.folder, "0013_02", body, **settings)
            case "video":
                return VideoDataModule(root, name, body, **settings)
            case _:
                return ZjuDataModule(root, name, body, **settings)

    def refused(self, *words: str, **settings) -> None:
        with pytest.raises(DataError) as caught:
            self.module(**settings).validate()
        for word in words:
            assert word in str(caught.value), str(caught.value)

    def change(self, kind: str, field: str, change, frame: int | None = None) -> None:
        """Changes `K`, `R`, `T`, `pose` or `transl` of one frame, or of all."""
        {"annots": _annots, "pkl": _pickles, "json": _json, "list": _chomp, "npz": _npz}[kind](
            self.folder, field, change, frame
        )

    def edit(self, field: str, change, frame: int | None = None) -> None:
        kind = {"refined": "annots", "humannerf": "pkl", "w2a": "json", "chomp": "list", "video": "npz"}
        self.change(kind[self.layout], field, change, frame)

    def masks(self) -> list[Path]:
        """Masks of the training camera, frame by frame."""
        where = {"refined": "mask/00", "chomp": "mask/images/0013_02/Camera00"}.get(self.layout, "masks")
        return sorted((self.folder / where).iterdir())

    def pictures(self) -> list[Path]:
        where = {"refined": "images/00", "chomp": "images/0013_02/Camera00"}.get(self.layout, "images")
        return sorted((self.folder / where).iterdir())


def _view(matrix, field, change):
    matrix = np.array(matrix, dtype=float)
    part = (slice(3), slice(3)) if field == "R" else (slice(3), 3)
    matrix[part] = change(matrix[part])
    return matrix


def _annots(folder, field, change, frame):
    if field in ("pose", "transl"):
        key = {"pose": "poses", "transl": "Th"}[field]
        for k in range(4) if frame is None else [frame]:
            path = folder / "smpl_params" / f"{k}.npy"
            values = np.load(path, allow_pickle=True).item()
            values[key] = change(values[key].astype(float))
            writers.save_object(path, values)
        return
    annots = np.load(folder / "annots.npy", allow_pickle=True).item()
    scale = 1000 if field == "T" else 1
    old = annots["cams"][field]
    annots["cams"][field] = [scale * change(np.array(v, dtype=float) / scale) for v in old]
    writers.save_object(folder / "annots.npy", annots)


def _pickles(folder, field, change, frame):
    import pickle

    name = "mesh_infos.pkl" if field in ("pose", "transl") else "cameras.pkl"
    rows = pickle.loads((folder / name).read_bytes())
    for k, row in enumerate(rows.values()):
        if frame in (None, k):
            if field in ("R", "T"):
                row["extrinsics"] = _view(row["extrinsics"], field, change)
            else:
                key = {"K": "intrinsics", "pose": "poses", "transl": "Th"}[field]
                row[key] = change(row[key].astype(float))
    writers.save_pickle(folder / name, rows)


def _json(folder, field, change, frame):
    rows = json.loads((folder / "metadata.json").read_text())
    for k, row in enumerate(rows.values()):
        if frame in (None, k):
            _edit_row(row, field, change, {"K": "cam_intrinsics", "E": "cam_extrinsics", "pose": "poses",
                                           "transl": "trans"})  # fmt: skip
    text = json.dumps(
        {name: {k: np.asarray(v).tolist() for k, v in row.items()} for name, row in rows.items()}
    )
    (folder / "metadata.json").write_text(text)


def _chomp(folder, field, change, frame):
    import pickle

    content = pickle.loads((folder / "annot" / "train.pkl").read_bytes())
    for camera in content[1]:
        for k, row in enumerate(camera):
            if frame in (None, k):
                _edit_row(
                    row["1"], field, change, {"K": "intri", "E": "extri", "pose": "pose", "transl": "trans"}
                )
    writers.save_pickle(folder / "annot" / "train.pkl", content)


def _edit_row(row, field, change, keys):
    if field in ("R", "T"):
        row[keys["E"]] = _view(row[keys["E"]], field, change)
    else:
        row[keys[field]] = change(np.array(row[keys[field]], dtype=float))


def _npz(folder, field, change, frame):
    path = folder / ("poses.npz" if field in ("pose", "transl") else "cameras.npz")
    with np.load(path) as archive:
        values = dict(archive)
    if field in ("R", "T"):
        values["extrinsic"] = _view(values["extrinsic"], field, change)
    elif field == "K":
        values["intrinsic"] = change(values["intrinsic"])
    else:
        key = {"pose": "body_pose", "transl": "transl"}[field]
        for k in range(4) if frame is None else [frame]:
            values[key][k] = change(values[key][k])
    np.savez(path, **values)


@pytest.fixture(params=LAYOUTS)
def scene(request, pristine, tmp_path, source) -> Copy:
    return Copy(request.param, pristine, tmp_path, source)


@pytest.fixture
def video(pristine, tmp_path, source) -> Copy:
    return Copy("video", pristine, tmp_path, source)


TABLES = {
    "refined": ["annots.npy", "smpl_params/1.npy"], "humannerf": ["cameras.pkl", "mesh_infos.pkl"],
    "w2a": ["metadata.json"], "chomp": ["annot/train.pkl"], "video": ["cameras.npz", "poses.npz"],
}  # fmt: skip


def test_00_all_are_sound_before_they_are_broken(scene):
    data = scene.module()
    data.validate()
    assert data.findings == []


def test_01_missing_tables_and_keys(scene):
    for table in TABLES[scene.layout]:
        path = scene.folder / table
        kept = path.read_bytes()
        path.unlink()
        scene.refused(path.name)
        path.write_bytes(kept)
    if scene.layout == "video":
        np.savez(scene.folder / "poses.npz", betas=np.zeros((1, 10)))
        scene.refused("poses.npz", "key 'global_orient' is missing")


def test_02_code_is_refused_by_name_and_not_run(scene, tmp_path):
    class Runs:
        def __reduce__(self):
            return os.system, (f"touch {tmp_path / 'ran'}",)

    for table in TABLES[scene.layout]:
        path = scene.folder / table
        kept = path.read_bytes()
        if path.suffix == ".pkl":
            writers.save_pickle(path, {"frame_000000": Runs()})
        elif path.suffix == ".npy":
            writers.save_object(path, {"cams": Runs(), "ims": [], "poses": Runs()})
        elif path.suffix == ".npz":
            np.savez(path, intrinsic=np.array([Runs()], dtype=object), betas=np.array([Runs()], dtype=object))
        else:
            continue
        words = ("not allowed", ".system") if path.suffix != ".npz" else ()
        scene.refused(path.name, *words)
        path.write_bytes(kept)
    assert not (tmp_path / "ran").exists()


def test_03_official_bodies_need_no_chumpy(tmp_path):
    path = official_pickle(tmp_path / "SMPL_NEUTRAL.pkl", body_content(), 2)
    body = load_body_arrays(path)
    assert body.shapedirs.shape[2] == 10 and body.posedirs is not None
    always = torch.is_warn_always_enabled()
    torch.set_warn_always(True)  # PyTorch warns of read-only arrays once a process
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert load_body(path).num_vertices == len(body.v_template)
    finally:
        torch.set_warn_always(always)


def test_04_bodies_of_300_components_take_ten_betas_and_rows_are_counted(video, tmp_path):
    arrays = load_body_arrays(video.source.folder / "body.npz")
    values = {key: getattr(arrays, key) for key in ("v_template", "posedirs", "weights", "parents", "faces")}
    values["J_regressor"] = arrays.J_regressor
    values["shapedirs"] = np.concatenate([arrays.shapedirs, np.zeros((len(arrays.v_template), 3, 290))], 2)
    values = {key: value for key, value in values.items() if value is not None}
    np.savez(tmp_path / "big.npz", **values)
    video.module(body=load_body(tmp_path / "big.npz")).validate()
    np.savez(tmp_path / "cut.npz", **{**values, "weights": values["weights"][:-1]})
    with pytest.raises(DataError, match=r"'weights' has shape"):
        load_body(tmp_path / "cut.npz")


def test_05_an_absent_body_says_where_to_get_it(tmp_path):
    with pytest.raises(DataError, match=r"smpl.is.tue.mpg.de.*dataset=synthetic"):
        load_body(tmp_path / "SMPL_NEUTRAL.pkl")


def test_06_units_are_checked(scene):
    factor = 0.001 if scene.layout == "refined" else 1000.0
    scene.edit("T", lambda T: T * factor)
    scene.refused("metres")


def test_07_rotations(scene, caplog):
    scene.edit("R", lambda R: R.round(5))
    with caplog.at_level(logging.WARNING):
        scene.module().validate()
    assert "replaced by the nearest rotation" in caplog.text
    scene.edit("R", lambda R: R * [[1], [-1], [1]])
    scene.refused("det = -1")
    scene.edit("R", lambda R: 1.2 * R)
    scene.refused("is not a rotation")


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda K: K * [[0], [1], [1]], "focal"),
        (lambda K: K + np.array([[0, 3, 0], [0, 0, 0], [0, 0, 0]]), "skew"),
        (lambda K: K + np.array([[0, 0, 500], [0, 0, 0], [0, 0, 0]]), "principal point"),
    ],
)
def test_08_intrinsics(scene, change, word):
    scene.edit("K", change)
    scene.refused(word)


def test_09_pictures_of_every_kind(video):
    path = video.pictures()[1]
    picture = cv2.imread(str(path))
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    for accepted in (grey, cv2.cvtColor(picture, cv2.COLOR_BGR2BGRA), picture.astype(np.uint16) * 257):
        cv2.imwrite(str(path), accepted)
        video.module().validate()
        assert video.module().train_frame(1).rgb.shape == (SIZE, SIZE, 3)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(DataError, match=r"image_0002\.png.*cut short"):
        video.module().train_frame(1)


def test_10_a_gigapixel_is_refused_before_it_is_decoded(video):
    header = b"IHDR" + struct.pack(">IIBBBBB", 40_000, 40_000, 8, 2, 0, 0, 0)
    chunk = struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
    end = struct.pack(">I", 0) + b"IEND" + struct.pack(">I", zlib.crc32(b"IEND"))
    video.masks()[1].write_bytes(b"\x89PNG\r\n\x1a\n" + chunk + end)
    video.refused("mask_0002.png", "40000 x 40000", "megapixels")


def test_11_pictures_and_masks_of_different_size(scene):
    cv2.imwrite(str(scene.masks()[1]), np.ones((SIZE // 2, SIZE), np.uint8))
    scene.refused(scene.masks()[1].name, "one size")


def test_12_masks_by_rule(video):
    path = video.masks()[2]
    person = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) > 0
    whole = video.module().train_frame(2).visible_mask.numpy()
    soft = cv2.GaussianBlur(person.astype(np.uint8) * 255, (3, 3), 0)
    soft[person & (soft < 128)] = 200
    soft[~person & (soft >= 128)] = 100
    kinds = [
        person.astype(np.uint8),
        person * np.uint8(255),
        np.repeat(person[..., None] * np.uint8(255), 3, 2),
        soft,
    ]
    for kind in kinds:
        cv2.imwrite(str(path), kind)
        np.testing.assert_array_equal(video.module().train_frame(2).visible_mask.numpy(), whole)
    ambiguous = person.astype(np.uint8) * 120
    ambiguous[0, 0] = 60
    cv2.imwrite(str(path), ambiguous)
    video.refused(path.name, "neither labels")


def test_13_empty_masks_are_left_out_and_all_empty_is_an_error(scene):
    masks = scene.masks()
    cv2.imwrite(str(masks[1]), np.zeros((SIZE, SIZE), np.uint8))
    data = scene.module()
    data.validate()
    assert data.train_indices == (0, 2, 3) and data.summary()["frames_left_out"] == [1]
    assert any("1 training frames show no person" in finding for finding in data.findings)
    for mask in masks:
        cv2.imwrite(str(mask), np.zeros((SIZE, SIZE), np.uint8))
    scene.refused("no person")


def test_14_a_full_mask_is_reported(scene):
    cv2.imwrite(str(scene.masks()[1]), np.ones((SIZE, SIZE), np.uint8))
    data = scene.module()
    data.validate()
    assert any("is it inverted" in finding for finding in data.findings)


def test_15_counts_that_differ_name_what_is_missing(scene):
    if scene.layout in ("refined", "chomp"):  # pictures are named by the table
        scene.pictures()[2].unlink()
        scene.refused((scene.layout == "chomp" and "00002.jpg") or "000002.jpg", "file not found")
        return
    mask, picture = scene.masks()[2], scene.pictures()[2].stem
    kept = mask.read_bytes()
    mask.unlink()
    scene.refused(
        f"{scene.folder / 'masks'}: has nothing for the picture '{picture}' (4 pictures, 3 entries here)"
    )
    mask.write_bytes(kept)
    added = scene.pictures()[3].with_stem(scene.pictures()[3].stem[:-1] + "9")
    shutil.copy(scene.pictures()[3], added)
    if scene.layout == "video":
        scene.refused(f"nothing for the picture '{added.stem}' (5 pictures, 4 entries here)")
    else:
        scene.refused(f"has no '{added.stem}', which {scene.folder / 'images'} has (5 against 4 entries)")


def test_15_rows_of_poses_that_differ_from_the_pictures(video):
    with np.load(video.folder / "poses.npz") as archive:
        values = dict(archive)
    np.savez(video.folder / "poses.npz", **{**values, "transl": values["transl"][:3]})
    video.refused("transl has shape (3, 3), expected (4, 3)")


@pytest.mark.parametrize("frames", [1, 2])
def test_16_one_and_two_frames(frames, source, tmp_path):
    short = Source(source.folder)
    short.frames = frames
    writers.write_video(short, tmp_path / "v")
    data = VideoDataModule(tmp_path, "v", source.body)
    data.validate()
    assert data.train_indices == tuple(range(frames)) and data.frame_at(5).rgb.shape == (SIZE, SIZE, 3)


@pytest.mark.parametrize("field", ["pose", "transl", "T", "K"])
def test_17_nan_names_frame_and_field(scene, field):
    frame = None if field in ("T", "K") and scene.layout in ("refined", "video") else 2
    scene.edit(field, lambda value: value * np.nan, frame)
    names = {
        "refined": {"pose": "2.npy, poses", "transl": "2.npy, Th", "T": "cams.T[0]", "K": "cams.K[0]"},
        "humannerf": {"pose": "frame_000002, poses", "transl": "frame_000002, Th",
                      "T": "frame_000002, extrinsics", "K": "frame_000002, intrinsics"},
        "w2a": {"pose": "00002, poses", "transl": "00002, trans", "T": "00002, extrinsics",
                "K": "00002, intrinsics"},
        "chomp": {"pose": "frame 2, person 1, pose", "transl": "frame 2, person 1, trans",
                  "T": "camera 0, extrinsics", "K": "camera 0, intrinsics"},
        "video": {"pose": "row 2, body_pose", "transl": "row 2, transl", "T": "extrinsics", "K": "intrinsics"},
    }  # fmt: skip
    scene.refused(names[scene.layout][field], "NaN")


def test_18_frames_in_which_the_person_left_the_picture_are_skipped(scene):
    scene.edit("transl", lambda t: t + FAR, 1)
    cv2.imwrite(str(scene.masks()[1]), np.zeros((SIZE, SIZE), np.uint8))
    data = scene.module()
    data.validate()
    assert data.train_indices == (0, 2, 3)
    scene.edit("transl", lambda t: t + FAR)
    scene.refused("outside camera")


def test_19_nothing_occluded_is_counted(scene):
    assert scene.module().summary()["occluded_frames"] == 0


def test_20_everything_occluded(scene):
    scene.refused(
        "hidden completely", occlusion={"kind": "strip", "mid": 512, "width": 1024, "fraction": 1.0}
    )


def test_21_paths(source, tmp_path):
    odd = tmp_path / "data with spaces é 数据"
    writers.write_video(source, odd / "my scene")
    before = {path: path.stat().st_mtime_ns for path in odd.rglob("*")}
    VideoDataModule(odd, "my scene", source.body).validate()
    assert {path: path.stat().st_mtime_ns for path in odd.rglob("*")} == before  # nothing is ever written
    poses = odd / "my scene" / "poses.npz"
    poses.unlink()
    poses.symlink_to(poses)
    with pytest.raises(DataError, match=r"poses\.npz"):
        VideoDataModule(odd, "my scene", source.body).validate()
    loop = odd / "loop"
    loop.symlink_to(loop)
    with pytest.raises(DataError, match="loop: no such folder"):
        VideoDataModule(odd, "loop", source.body).validate()
    raw = writers.write_chomp(source, odd / "raw", name="../..")
    with pytest.raises(DataError, match=r"leads out of"):
        OcMotionDataModule(raw, "..", source.body, layout="chomp").validate()


def test_22_a_full_disk_leaves_the_file_that_was_there(tmp_path, monkeypatch, capsys):
    import errno

    from occfusion.__main__ import main

    source = official_pickle(tmp_path / "a.pkl", body_content(), 2)
    target = tmp_path / "b.npz"
    target.write_bytes(b"previous")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    assert main(["convert-body", str(source), str(target), "--force"]) == 1
    assert "No space left" in capsys.readouterr().err
    assert target.read_bytes() == b"previous" and len(list(tmp_path.iterdir())) == 2
