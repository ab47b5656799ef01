"""OcMotion in both forms, against upstream's own rules for vertices, pixels, masks and the choice of frames."""

from __future__ import annotations

import json
import pickle
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from hydra import compose, initialize_config_dir

from data.layout_writers import Source, save_picture
from occfusion.__main__ import main
from occfusion.data.ocmotion.ocmotion_data import OcMotionDataModule
from occfusion.data.ocmotion.ocmotion_protocols import PROTOCOLS, describe_ocmotion
from occfusion.errors import ConfigError, DataError
from occfusion.human import Body, load_body
from occfusion.synth import SceneSpec, write_scene
from upstream import ocmotion as upstream
from upstream.ocmotion import UpstreamSmpl

CONF = Path(__file__).parents[2] / "conf"
SIZE, FRAMES, CAMERAS = 96, 6, 3
EXACT = 1e-5
"""Metres: 0.01 mm."""


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Source:
    spec = SceneSpec(1, "clean", image_size=SIZE, frames=FRAMES, cameras=CAMERAS)
    return Source(write_scene(tmp_path_factory.mktemp("scenes"), spec, progress=False))


@pytest.fixture(scope="module")
def smpl(source: Source, tmp_path_factory: pytest.TempPathFactory) -> UpstreamSmpl:
    return UpstreamSmpl(source, tmp_path_factory.mktemp("body") / "smpl.npz")


@pytest.fixture(scope="module")
def body(smpl: UpstreamSmpl) -> Body:
    return load_body(smpl.path)


@pytest.fixture(scope="module")
def pristine(source: Source, smpl: UpstreamSmpl, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("ocmotion")
    upstream.write_cut(source, smpl, root)
    upstream.write_raw(source, smpl, root / "raw")
    return root


@pytest.fixture
def cut(pristine: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(pristine / "0013_02_w2a", tmp_path / "0013_02_w2a"))


@pytest.fixture
def raw(pristine: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(pristine / "raw", tmp_path / "raw"))


def module(root: Path, body: Body, scene: str = "0013_02", **settings) -> OcMotionDataModule:
    return OcMotionDataModule(root, scene, body, **{"train_frames": [0, None, 1], **settings})


def posed(data: OcMotionDataModule, body: Body, frame: int) -> np.ndarray:
    pose = data.pose(frame)
    return body(pose.betas, pose.global_orient, pose.body_pose, pose.transl)[0].double().numpy()


def pixels(data: OcMotionDataModule, points: np.ndarray, camera: int = 0) -> np.ndarray:
    lens = data.camera(camera)
    return upstream.project(points, lens.K.double().numpy(), lens.viewmat.double().numpy())


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def taken(data: OcMotionDataModule) -> str:
    data.setup()
    return "\n".join(data.taken.lines())


# --- Wild2Avatar's cut -------------------------------------------------------------------------------


def test_the_cut_is_read_as_occfusion_reads_it(cut, body, smpl):
    data = module(cut.parent, body, image_size=SIZE)
    data.validate()
    assert not data.findings and data.scene_name == "0013_02_w2a"
    names = sorted(path.stem for path in (cut / "images").iterdir())  # upstream's order
    assert [frame.name for frame in data.train_frames()] == names == [f"{256 + k:05d}" for k in range(FRAMES)]
    for frame, name in zip(data.train_frames(), names, strict=True):
        vertices, K, view = upstream.occfusion_vertices(cut, smpl, name)
        assert np.abs(posed(data, body, frame.index) - vertices).max() < EXACT
        # at the stored size pixel centres are whole numbers for OpenCV, and at +0.5 here
        np.testing.assert_allclose(
            pixels(data, vertices) - 0.5, 2 * upstream.project(vertices, K, view), atol=2e-3
        )
        assert overlap(frame.visible_mask.numpy(), upstream.occfusion_mask(cut, name)) == 1.0


def test_occnerfs_cameras_see_the_same(cut, body, smpl):
    """`trans` is in its extrinsics, and the body turns about the pelvis."""
    cameras, meshes = (pickle.loads((cut / name).read_bytes()) for name in ("cameras.pkl", "mesh_infos.pkl"))
    data = module(cut.parent, body)
    data.setup()
    for frame, name in enumerate(sorted(path.stem for path in (cut / "images").iterdir())):
        row, view = meshes[name], cameras[name]["extrinsics"]
        upright = smpl(row["poses"], row["betas"])[0]
        turned = (upright - row["Th"]) @ cv2.Rodrigues(row["Rh"].astype(float))[0].T + row["Th"]
        lens = data.camera(0).viewmat.double().numpy()
        seen = posed(data, body, frame) @ lens[:3, :3].T + lens[:3, 3]
        np.testing.assert_allclose(seen, turned @ view[:3, :3].T + view[:3, 3], atol=EXACT)


def test_the_paper_trains_on_every_second_frame_at_half_of_the_stored_size(source, smpl, body, tmp_path):
    folder = upstream.write_cut(source, smpl, tmp_path, spare=0)
    data = OcMotionDataModule(tmp_path, "0013_02", body)
    assert data.image_size is None
    data.setup()
    names = sorted(path.stem for path in (folder / "images").iterdir())[::2]
    frames = list(data.train_frames())
    assert [frame.name for frame in frames] == names and data.image_size == SIZE // 2
    for frame, name in zip(frames, names, strict=True):
        picture = source.picture(int(name) - 256)
        assert frame.rgb.shape[:2] == (int(picture.shape[0] * 0.5), int(picture.shape[1] * 0.5))
        vertices, K, view = upstream.occfusion_vertices(folder, smpl, name)
        # the half-size pixel j is the stored pixels 2j and 2j + 1
        np.testing.assert_allclose(
            pixels(data, vertices), upstream.project(vertices, K, view) + 0.25, atol=1e-3
        )
        nearest = cv2.resize(upstream.occfusion_mask(folder, name).astype(np.uint8), (SIZE // 2, SIZE // 2),
                             interpolation=cv2.INTER_NEAREST) > 0  # fmt: skip
        mask = frame.visible_mask.numpy()
        edges = [
            cv2.morphologyEx(m.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
            for m in (mask, nearest)
        ]
        assert not (
            (mask != nearest) & ~(edges[0] | edges[1])
        ).any()  # the edge is cut by another rule: by area here
    said = taken(data)
    assert "frames [0, 100, 2] and half of the stored size (dataset.protocol=paper)" in said
    assert data.summary()["protocol"]["name"] == "paper" and data.summary()["protocol"]["differs"]
    by_hand = OcMotionDataModule(tmp_path, "0013_02", body, image_size=40, train_frames=[0, None, 1])
    assert "dataset.protocol" not in taken(by_hand) and by_hand.train_frame(0).rgb.shape[:2] == (40, 40)


def test_rows_without_pictures_are_counted_and_left_out(cut, body):
    said = taken(module(cut.parent, body))
    assert (
        "pictures: images/, all 6; 6 of the 12 rows of metadata.json have no picture and are left out" in said
    )
    assert "body: metadata.json: SMPL(poses, betas) + trans" in said and "the camera stands still" in said
    assert "centres: 0 (OpenCV)" in said and "every value but 0" in said
    assert (
        "all_cameras.pkl (all cameras of the sequence: of those beyond the first the cut has no pictures)"
        in said
    )
    assert "not looked at: metadata_0.json" in said and "dataset.layout=humannerf" in said
    save_picture(cut / "masks" / "00999.png", np.zeros((SIZE, SIZE), np.uint8))
    assert "1 files of masks/ belong to no picture and are left out" in taken(module(cut.parent, body))


def test_pictures_without_a_row_are_named(cut, body):
    for number in (500, 501):
        shutil.copy(cut / "images" / "00256.png", cut / "images" / f"{number:05d}.png")
    with pytest.raises(DataError, match=r"metadata\.json: has no '00500' and 1 more, which .*images has"):
        module(cut.parent, body).setup()


def test_stray_files_are_no_pictures(cut, body):
    for name in ("out.mp4", ".DS_Store", "Thumbs.db"):
        (cut / "images" / name).write_bytes(b"stray")
    data = module(cut.parent, body)
    data.validate()
    assert len(data.train_indices) == FRAMES


def test_the_order_of_pictures_is_that_of_their_numbers(cut, body):
    rows = json.loads((cut / "metadata.json").read_text())
    renamed = {f"{256 + k:05d}": str(97 + k) for k in range(FRAMES)}  # 97 to 102
    for folder in ("images", "masks"):
        for old, new in renamed.items():
            (cut / folder / f"{old}.png").rename(cut / folder / f"{new}.png")
    (cut / "metadata.json").write_text(
        json.dumps({renamed.get(name, name): row for name, row in rows.items()})
    )
    data = module(cut.parent, body)
    data.setup()
    assert [frame.name for frame in data.train_frames()] == [str(97 + k) for k in range(FRAMES)]


def test_every_mask_value_but_0_is_the_person(cut, body):
    for path in (cut / "masks").iterdir():
        soft = cv2.GaussianBlur(cv2.imread(str(path)), (5, 5), 0)
        assert set(np.unique(soft)) - {0, 255}
        cv2.imwrite(str(path), soft)
    data = module(cut.parent, body, image_size=SIZE)
    data.setup()
    for frame in data.train_frames():
        assert overlap(frame.visible_mask.numpy(), upstream.occfusion_mask(cut, frame.name)) == 1.0


def test_another_body_is_refused_in_millimetres(cut, body, smpl, tmp_path):
    taller = {**smpl.values, "v_template": smpl.values["v_template"] * 1.02}
    np.savez(tmp_path / "taller.npz", **taller)
    with pytest.raises(
        DataError,
        match=r"mesh_infos\.pkl, 00256, tpose_joints: joint \d+ is [\d.]+ mm .*more than 2 mm are.*--body",
    ):
        module(cut.parent, load_body(tmp_path / "taller.npz")).validate()
    version = {**smpl.values, "v_template": smpl.values["v_template"] * 1.0005}
    np.savez(tmp_path / "version.npz", **version)
    data = module(cut.parent, load_body(tmp_path / "version.npz"))
    data.validate()
    (remark,) = data.findings
    assert "mesh_infos.pkl, 00256, tpose_joints: joint" in remark and "another version or sex" in remark
    (cut / "mesh_infos.pkl").unlink()
    module(cut.parent, load_body(tmp_path / "taller.npz")).setup()  # nothing in the folder tells


def test_another_rotation_in_mesh_infos_is_told(cut, body):
    path = cut / "mesh_infos.pkl"
    meshes = pickle.loads(path.read_bytes())
    meshes["00258"]["Rh"] = meshes["00258"]["Rh"] + np.float32(0.1)
    upstream.dump(path, meshes)
    data = module(cut.parent, body)
    data.validate()
    assert any("Rh is another rotation than poses[:3]" in f and "first 00258" in f for f in data.findings)


def test_rows_that_cannot_be_meant(cut, body):
    path = cut / "metadata.json"
    whole = json.loads(path.read_text())
    rows = json.loads(path.read_text())
    del rows["00258"]["trans"]
    path.write_text(json.dumps(rows))
    with pytest.raises(DataError, match=r"00258: has no 'trans', which 5 of 6 frames have"):
        module(cut.parent, body).setup()
    path.write_text(json.dumps({**whole, "00258.png": whole["00258"]}))
    with pytest.raises(DataError, match=r"two rows for the picture '00258'"):
        module(cut.parent, body).setup()


def test_check_says_what_it_took_of_the_cut(cut, smpl, capsys, tmp_path):
    overlay = str(tmp_path / "overlay.png")
    assert main(["check", str(cut), "--body", str(smpl.path), "--overlay", overlay, "--strict"]) == 0
    said = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "OcMotion as Wild2Avatar cut it (w2a)" in said and "ready to train" in said


# --- protocols ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "frames", "divisor"),
    [("paper", (0, 100, 2), 2), ("wild2avatar", (0, 100, 1), 2), ("occnerf", (0, None, 1), 4)],
)
def test_protocols(name, frames, divisor, cut, body):
    """OccFusion: 50 of 100 frames, half size; Wild2Avatar: 100; OccNeRF: `resize_img_scale: 0.25`, every picture."""
    assert (PROTOCOLS[name].frames, PROTOCOLS[name].divisor) == (frames, divisor)
    data = OcMotionDataModule(cut.parent, "0013_02", body, protocol=name)
    data.setup()
    assert data.image_size == SIZE // divisor
    assert data.train_indices == tuple(range(FRAMES))[slice(*frames)]
    words = describe_ocmotion(name)
    assert "@" in words["source"] and len(words["differs"]) > 40


def test_the_papers_protocol_is_the_default(cut, body):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        dataset = compose("config", ["dataset=ocmotion"]).dataset
    assert dataset.protocol == "paper" and dataset.image_size is None and dataset.train_frames is None
    assert PROTOCOLS["paper"].sequences == (
        "0011_02_1",
        "0011_02_2",
        "0013_02",
        "0038_04",
        "0039_02",
        "0041_00",
    )
    with pytest.raises(
        ConfigError, match=r"protocol='zju': for OcMotion choose one of paper, wild2avatar, occnerf"
    ):
        OcMotionDataModule(cut.parent, "0013_02", body, protocol="zju")
    with pytest.raises(ConfigError, match=r"image_size=3"):
        OcMotionDataModule(cut.parent, "0013_02", body, image_size=3)


# --- as released -------------------------------------------------------------------------------------

FORMS = {
    "text": {},
    "number": {"key": 0},
    "two digits": {"key": "00"},
    "backslashes": {"separator": "\\"},
    "rows of one": {"as_rows": True},
    "flat": {"flat": True},
    "flat, backslashes": {"flat": True, "separator": "\\", "key": 0, "as_rows": True},
}


@pytest.mark.parametrize("form", FORMS)
def test_the_raw_release_is_read_as_its_own_program_reads_it(form, source, smpl, body, tmp_path):
    upstream.write_raw(source, smpl, tmp_path, **FORMS[form])
    data = module(tmp_path, body, "0013", image_size=SIZE, train_camera=1, test_cameras=None)
    data.validate()
    assert not data.findings and data.test_cameras == (0, 2)
    for frame in range(FRAMES):
        row = upstream.person(source, smpl, frame, 1)
        vertices = smpl(row["pose"], row["betas"])[0] + row["trans"]
        assert np.abs(posed(data, body, frame) - vertices).max() < EXACT
        wanted = upstream.project(vertices, row["intri"], row["extri"])
        np.testing.assert_allclose(pixels(data, vertices, 1) - 0.5, wanted, atol=2e-3)
        read = data.train_frame(frame)
        assert overlap(read.visible_mask.numpy(), source.mask(frame, 1) > 0) == 1.0
        assert read.name == f"images/0013/Camera01/{frame:06d}"
    said = taken(data)
    key = FORMS[form].get("key", "0")
    assert f"SMPL(pose, betas) + trans of person 0 (key {key!r})" in said
    assert ("lists of frames, grouped by sequence" in said) == ("flat" in form)
    assert ("mask_path, smpl_joints_3d" in said) == bool(FORMS[form].get("as_rows"))


def test_one_camera_of_a_sequence_by_its_name(raw, source, body, smpl):
    data = module(raw, body, "0013_02", image_size=SIZE)
    data.validate()
    assert data.summary()["cameras"] == 1 and data.summary()["train_camera"] == "images/0013/Camera02"
    row = upstream.person(source, smpl, 3, 2)
    vertices = smpl(row["pose"], row["betas"])[0] + row["trans"]
    assert np.abs(posed(data, body, 3) - vertices).max() < EXACT
    np.testing.assert_allclose(
        pixels(data, vertices) - 0.5, upstream.project(vertices, row["intri"], row["extri"]), atol=2e-3
    )
    assert "cameras Camera00, Camera01 (dataset.scene=0013 takes all)" in taken(data)
    with pytest.raises(
        ConfigError, match=r"0013 has no camera 5; its pictures lie in images/0013/Camera00, "
    ):
        module(raw, body, "0013_05").setup()
    with pytest.raises(
        ConfigError, match=r"0013_02_1 is a clip .* dataset\.scene=0013_02 and dataset\.train_frames"
    ):
        module(raw, body, "0013_02_1").setup()
    with pytest.raises(ConfigError, match=r"have 0001, 0013; one camera alone is called as 0001_02"):
        module(raw, body, "0099_02").setup()


def test_frames_without_the_person_are_normal_and_counted(raw, body):
    def empty(cameras):
        del cameras[2][1]["0"]  # nobody in the picture
        cameras[2][4]["0"] = {}
        cameras[2][3]["7"] = cameras[2][3].pop("0")  # somebody else
        cameras[1][0].pop("0")

    upstream.change_raw(raw, empty)
    data = module(raw, body, "0013_02", image_size=SIZE)
    said = taken(data)
    assert [frame.name[-6:] for frame in data.train_frames()] == ["000000", "000002", "000005"]
    assert "3 of the 6 moments of annot/train.pkl" in said
    assert "3 left out that do not show person 0 (2 of them show nobody)" in said
    assert "people 7 (dataset.person)" in said
    every = module(raw, body, "0013", image_size=SIZE, person=0)
    assert "4 left out that do not show person 0 in every camera (0 of them show nobody)" in taken(every)
    data.validate()
    assert any("people 7 are annotated beside person 0" in finding for finding in data.findings)


def test_moments_are_paired_by_number(raw, body, smpl, source):
    def shuffled(cameras):
        del cameras[0][2]  # one camera lost a picture, and another is not in order
        cameras[1].reverse()

    upstream.change_raw(raw, shuffled)
    data = module(raw, body, "0013", image_size=SIZE, train_camera=1, test_cameras=[0])
    said = taken(data)
    assert "5 of the 6 moments" in said and "paired by the numbers in their names; 1 left out" in said
    assert [frame.name[-6:] for frame in data.train_frames()] == [f"{k:06d}" for k in (0, 1, 3, 4, 5)]
    for place, frame in enumerate((0, 1, 3, 4, 5)):
        assert data.test_frame(place, 0).name.endswith(f"Camera00/{frame:06d}")
        row = upstream.person(source, smpl, frame, 0)
        assert (
            np.abs(posed(data, body, place) - smpl(row["pose"], row["betas"])[0] - row["trans"]).max() < EXACT
        )


def test_names_without_numbers_are_paired_by_place(raw, body):
    for camera in range(CAMERAS):
        for frame, letter in enumerate("abcdef"):
            for place, suffix in (("", "jpg"), ("mask", "png")):
                folder = raw / place / "images" / "0013" / f"Camera{camera:02d}"
                (folder / f"{frame:06d}.{suffix}").rename(folder / f"{letter}.{suffix}")

    def rename(cameras):
        for rows in cameras:
            for row, letter in zip(rows, "abcdef", strict=True):
                row["img_path"] = row["img_path"][:-10] + f"{letter}.jpg"
        cameras[2].pop()

    upstream.change_raw(raw, rename)
    data = module(raw, body, "0013")
    assert "5 of the 6 moments of annot/train.pkl, by their place in the lists; 1 left out" in taken(data)


def test_one_person_under_two_numbers_is_told(raw, body):
    def renumber(cameras):
        for rows in cameras:
            for row in rows[3:]:
                row["4"] = row.pop("0")

    upstream.change_raw(raw, renumber)
    data = module(raw, body, "0013_02")
    data.validate()
    assert any(
        "person 4 begins in frame 3" in f and "one person under two numbers" in f for f in data.findings
    )


def test_another_person_under_the_same_number_in_another_camera(raw, body):
    def elsewhere(cameras):
        for row in cameras[1]:
            row["0"]["trans"] = row["0"]["trans"] + np.float32(1)

    upstream.change_raw(raw, elsewhere)
    data = module(raw, body, "0013", test_cameras=[])
    data.validate()
    assert any(
        "person 0 of camera images/0013/Camera01 is more than 0.3 m" in f and "dataset.scene=0013_00" in f
        for f in data.findings
    )


def test_a_person_twice_in_a_frame(raw, body):
    upstream.change_raw(raw, lambda cameras: cameras[2][2].update({"00": cameras[2][2]["0"]}))
    with pytest.raises(DataError, match=r"camera 0, frame 2: has person 0 twice, the second time as '00'"):
        module(raw, body, "0013_02").setup()


def test_pictures_of_another_size_than_annotated(raw, body):
    def doubled(cameras):
        for row in cameras[2]:
            row["h_w"] = (SIZE, 2 * SIZE)

    upstream.change_raw(raw, doubled)
    with pytest.raises(
        DataError, match=r"has 96 x 96 pixels, but .* was annotated in 192 x 96 \(h_w is height"
    ):
        module(raw, body, "0013_02").setup()


def test_masks_are_the_users_to_make(source, smpl, body, tmp_path):
    upstream.write_raw(source, smpl, tmp_path, masks=None)
    with pytest.raises(
        DataError, match=r"OcMotion comes without person masks: .*images/0013/Camera02/000000\.png"
    ):
        module(tmp_path, body, "0013_02").setup()
    for frame in range(FRAMES):  # the picture's path without the folder of all pictures does as well
        mask = source.mask(frame, 2) * np.uint8(255)
        save_picture(tmp_path / "mask" / "0013" / "Camera02" / f"{frame:06d}.png", mask)
    data = module(tmp_path, body, "0013_02", image_size=SIZE)
    data.validate()
    assert overlap(data.train_frame(2).visible_mask.numpy(), source.mask(2, 2) > 0) == 1.0


def test_limbs_far_from_the_annotated_key_points_are_a_doubt(raw, body):
    def moved(by):
        def change(cameras):
            for row in cameras[2]:
                row["0"]["lsp_joints_2d"] = row["0"]["lsp_joints_2d"] + np.float32([by, 0, 0])

        return change

    upstream.change_raw(raw, moved(2))
    data = module(raw, body, "0013_02", image_size=SIZE)
    data.validate()
    assert not data.findings
    upstream.change_raw(raw, moved(10))
    data = module(raw, body, "0013_02", image_size=SIZE)
    data.validate()
    assert any("are 12 pixels from the annotated key points (median of 48" in f for f in data.findings), (
        data.findings
    )

    def unknown(cameras):
        for row in cameras[2]:
            row["0"]["lsp_joints_2d"] = np.zeros((14, 3))

    upstream.change_raw(raw, unknown)
    data = module(raw, body, "0013_02", image_size=SIZE)
    data.validate()
    assert not data.findings
