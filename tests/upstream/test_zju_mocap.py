"""ZJU-MoCap's releases as their makers wrote them: which fit, which rule, which pixels are the person."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from data.layout_writers import Source, save_object
from occfusion.__main__ import main
from occfusion.data.zju.zju_data import ZjuDataModule
from occfusion.data.zju.zju_layout import ZjuScene
from occfusion.errors import ConfigError, DataError
from occfusion.files.images import read_mask
from occfusion.human import Body, embedded_body, load_body
from occfusion.human.body import without_pose_blend_shapes
from occfusion.run.prepare import make_body
from occfusion.settings.schema import BodySettings
from occfusion.synth import SceneSpec, write_scene
from upstream import zju_mocap as upstream
from upstream.zju_mocap import SmplBody

SIZE, FRAMES, CAMERAS = 96, 3, 2
EXACT = 1e-5
"""Metres: 0.01 mm."""


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Source:
    spec = SceneSpec(1, "clean", image_size=SIZE, frames=FRAMES, cameras=CAMERAS)
    return Source(write_scene(tmp_path_factory.mktemp("scenes"), spec, progress=False))


@pytest.fixture(scope="module")
def smpl(source: Source, tmp_path_factory: pytest.TempPathFactory) -> SmplBody:
    return SmplBody(source, tmp_path_factory.mktemp("body") / "smpl.npz")


@pytest.fixture(scope="module")
def body(smpl: SmplBody) -> Body:
    return load_body(smpl.path)


def module(folder: Path, body: Body, **settings) -> ZjuDataModule:
    settings = {"image_size": SIZE, "occlusion": "none", "train_frames": [0, FRAMES, 1],
                "test_frames": [0, FRAMES, 2], **settings}  # fmt: skip
    return ZjuDataModule(folder.parent, folder.name, body, **settings)


def stored(folder: Path, name: str, frame: int) -> dict:
    return np.load(folder / name / f"{frame}.npy", allow_pickle=True).item()


def vertex_error(data: ZjuDataModule, body: Body, wanted: list[np.ndarray]) -> float:
    worst = 0.0
    for frame, vertices in enumerate(wanted):
        pose = data.pose(frame)
        posed = body(pose.betas, pose.global_orient, pose.body_pose, pose.transl)[0].double().numpy()
        worst = max(worst, float(np.linalg.norm(posed - vertices, axis=1).max()))
    return worst


def iou(first: np.ndarray, second: np.ndarray) -> float:
    return float((first & second).sum() / (first | second).sum())


def test_the_newer_fit_by_its_rule(source, smpl, body, tmp_path):
    folder = upstream.write_original(source, tmp_path, smpl)
    data = module(folder, body)
    data.validate()
    wanted = [smpl.vertices(stored(folder, "new_params", f), new_params=True) for f in range(FRAMES)]
    assert vertex_error(data, body, wanted) < EXACT
    taken = data.taken
    assert "new_params/{i}.npy, the newer fit" in taken.body
    assert "gives the vertices of new_vertices/ with pose blend shapes, off by 0.00" in taken.body
    assert "params/, the older fit, made without pose blend shapes (dataset.fit=params)" in taken.others
    assert "mask_cihp/ (dataset.masks=mask_cihp)" in taken.others
    assert taken.pictures == f"the {FRAMES} moments of annots.npy" and taken.centres == "0 (OpenCV)"
    assert taken.layout == "original ZJU-MoCap" and "2, which stand still" in taken.cameras
    assert not any("blend shapes" in finding for finding in data.findings)


def test_projection_is_upstreams(source, smpl, body, tmp_path):
    """`K (R x + T / 1000)`, whose whole numbers are the middles of pixels: 0.5 less than ours."""
    folder = upstream.write_original(source, tmp_path, smpl)
    data, cams = module(folder, body), upstream.cameras_of(source, lists=False)
    points = smpl.vertices(stored(folder, "new_params", 1), new_params=True)
    for camera in range(CAMERAS):
        seen = (points @ cams["R"][camera].T + cams["T"][camera].T / 1000.0) @ cams["K"][camera].T
        ours = data.camera(camera)
        viewmat, K = ours.viewmat.double().numpy(), ours.K.double().numpy()
        pixels = (points @ viewmat[:3, :3].T + viewmat[:3, 3]) @ K.T
        np.testing.assert_allclose(pixels[:, :2] / pixels[:, 2:] - 0.5, seen[:, :2] / seen[:, 2:], atol=1e-3)


def test_the_older_fit_on_request_and_by_its_rule(source, smpl, body, tmp_path):
    folder = upstream.write_original(source, tmp_path, smpl)
    wanted = [smpl.vertices(stored(folder, "params", f), new_params=False) for f in range(FRAMES)]
    plain = without_pose_blend_shapes(body)
    data = module(folder, plain, fit="params")
    assert vertex_error(data, plain, wanted) < EXACT
    assert "params/{i}.npy, the older fit" in data.taken.body and "off by 0.00" in data.taken.body
    # posed by the other rule: said, with its millimetres, and how to have it right
    wrong = module(folder, body, fit="params")
    wrong.validate()
    off = 1000 * vertex_error(wrong, body, wanted)
    (remark,) = [finding for finding in wrong.findings if "pose blend shapes" in finding]
    assert f"off by {off:.3g} mm at most" in remark and "body.pose_blend_shapes=false" in remark and off > 1
    assert f"off by {off:.3g} mm at most" in wrong.taken.body


def test_the_setting_leaves_the_blend_shapes_out(smpl, body):
    """In the run and wherever its body is made again; the arrays of the file stay as they are."""
    plain = make_body(BodySettings("smpl", str(smpl.path), pose_blend_shapes=False))
    assert plain.posedirs is None and plain.digest() != body.digest()
    assert plain.digest() == without_pose_blend_shapes(body).digest() and body.posedirs is not None
    assert make_body(BodySettings("smpl", str(smpl.path))).digest() == body.digest()


def test_the_newer_fit_with_a_body_told_to_leave_its_blend_shapes_out(source, smpl, body, tmp_path):
    folder = upstream.write_original(source, tmp_path, smpl)
    refusal = (
        r"new_vertices: the body file gives other vertices.* mm are allowed.*body.pose_blend_shapes=true"
    )
    with pytest.raises(DataError, match=refusal):
        module(folder, without_pose_blend_shapes(body)).setup()
    shutil.rmtree(folder / "new_vertices")
    data = module(folder, without_pose_blend_shapes(body))
    assert "posed without pose blend shapes, which the body does not have" in data.taken.body


def test_313_and_315_have_the_newer_fit_too(source, smpl, body, tmp_path):
    folder = upstream.write_stamped(source, tmp_path, smpl)
    data = module(folder, body)
    data.validate()
    wanted = [smpl.vertices(stored(folder, "new_params", f + 1), new_params=True) for f in range(FRAMES)]
    assert vertex_error(data, body, wanted) < EXACT
    assert "the first 1" in data.taken.body and "time stamps" in data.taken.layout
    assert f"{FRAMES + 1} moments" in data.taken.pictures
    assert f"1 of them have no body in new_params/: {FRAMES + 1}" in data.taken.pictures
    with pytest.raises(DataError, match=rf"new_params.{FRAMES + 1}\.npy: file not found"):
        module(folder, body, train_frames=[0, FRAMES + 1, 1]).validate()


def test_old_releases_have_the_older_fit_alone(source, smpl, body, tmp_path):
    folder = upstream.write_stamped(source, tmp_path, smpl, 315, ("params",))
    plain = without_pose_blend_shapes(body)
    wanted = [smpl.vertices(stored(folder, "params", f + 1), new_params=False) for f in range(FRAMES)]
    assert vertex_error(module(folder, plain), plain, wanted) < EXACT
    shutil.rmtree(folder / "vertices")  # as many copies: the folder's name tells, and the rules are compared
    data = module(folder, body)
    data.validate()
    off = 1000 * vertex_error(data, body, wanted)
    (remark,) = [finding for finding in data.findings if "pose blend shapes" in finding]
    assert f"off by {off:.3g} mm at most" in remark and "Neural Body" in remark and "no vertices/" in remark
    assert not any("blend shapes" in finding for finding in validated(module(folder, plain)))


def validated(data: ZjuDataModule) -> list[str]:
    data.validate()
    return data.findings


def test_a_folder_made_with_blend_shapes_is_known_by_its_vertices(source, smpl, body, tmp_path):
    """Neural Body's script for EasyMocap's results writes `params/` too, and that program blends today."""
    folder = upstream.write_original(source, tmp_path, smpl)
    for name in ("params", "vertices"):
        shutil.rmtree(folder / name)
        (folder / f"new_{name}").rename(folder / name)
    data = module(folder, body)
    assert not any("blend shapes" in finding for finding in validated(data))
    assert "gives the vertices of vertices/ with pose blend shapes, off by 0.00" in data.taken.body


def test_another_body_is_refused_with_its_millimetres(source, smpl, body, tmp_path):
    folder = upstream.write_original(source, tmp_path, smpl)
    values = dict(smpl.values)
    values["v_template"] = values["v_template"] * 1.02
    np.savez(tmp_path / "other.npz", **values)
    with pytest.raises(DataError, match=r"with pose blend shapes [\d.]+ mm at most .*body\.path"):
        module(folder, load_body(tmp_path / "other.npz")).setup()
    few = without_pose_blend_shapes(body)
    shutil.rmtree(folder / "new_vertices")
    (folder / "new_vertices").mkdir()
    np.save(folder / "new_vertices" / "0.npy", np.zeros((100, 3), np.float32))
    assert "not compared with new_vertices/, which has 100 vertices" in module(folder, few).taken.body
    np.save(folder / "new_vertices" / "0.npy", np.zeros((100, 4), np.float32))
    with pytest.raises(DataError, match=r"new_vertices.0\.npy has shape"):
        module(folder, few).setup()


def test_the_refined_release(source, smpl, body, tmp_path):
    folder = upstream.write_refined(source, tmp_path, smpl)
    data = module(folder, body)
    data.validate()
    wanted = [smpl.vertices(stored(folder, "smpl_params", f), new_params=True) for f in range(FRAMES)]
    assert vertex_error(data, body, wanted) < EXACT
    assert data.taken.layout == "refined ZJU-MoCap" and "smpl_vertices/ with pose blend" in data.taken.body
    assert "schp/ (dataset.masks=schp)" in data.taken.others
    with pytest.raises(DataError, match=r"no folder params \(dataset.fit=params\); it has smpl_params"):
        module(folder, body, fit="params").setup()
    with pytest.raises(ConfigError, match=r"dataset.fit='old': choose auto, smpl_params, new_params, params"):
        module(folder, body, fit="old").setup()


def test_masks_of_the_original_release(source, smpl, body, tmp_path):
    folder = upstream.write_original(source, tmp_path, smpl)
    for frame in range(FRAMES):
        name = f"Camera_B1/{frame:06d}.png"
        one, other = (
            cv2.imread(str(folder / part / name), cv2.IMREAD_UNCHANGED) for part in ("mask", "mask_cihp")
        )
        for masks, wanted in (
            ("mask", one != 0), ("mask_cihp", other != 0), ("mask+mask_cihp", (one != 0) | (other != 0)),
        ):  # fmt: skip
            seen = module(folder, body, masks=masks).train_frame(frame).visible_mask.numpy()
            assert iou(seen, wanted) == 1.0
    assert iou(seen, source.mask(FRAMES - 1) > 0) == 1.0  # neither of the two is the whole person
    taken = module(folder, body, masks="mask+mask_cihp").taken
    assert taken.masks == "mask/ or mask_cihp/: every value or colour but 0 is the person"


def test_soft_masks_of_the_refined_release_count_every_value(source, smpl, body, tmp_path):
    folder = upstream.write_refined(source, tmp_path, smpl)
    data = module(folder, body)
    for frame in range(FRAMES):
        path = folder / "mask" / "00" / f"{frame:06d}.png"
        wanted = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) != 0
        assert iou(data.train_frame(frame).visible_mask.numpy(), wanted) == 1.0
        assert iou(read_mask(path), wanted) < 0.95  # elsewhere soft edges are cut in the middle


@pytest.mark.parametrize("camera", [0, 1])
def test_painted_labels(source, smpl, body, tmp_path, camera):
    """The places of a palette (camera 0) or colours (camera 1): all but black."""
    folder = upstream.write_refined(source, tmp_path, smpl)
    data = module(folder, body, masks="schp", train_camera=camera)
    data.validate()
    for frame in range(FRAMES):
        wanted = upstream.parser_labels(source.mask(frame, camera)) != 0
        assert iou(data.train_frame(frame).visible_mask.numpy(), wanted) == 1.0


def test_a_palette_is_read_by_its_places(tmp_path):
    places = np.zeros((8, 8), np.uint8)
    places[2:5, 1:7] = np.arange(1, 19).reshape(3, 6)
    content = upstream.palette_png(places)
    path = tmp_path / "m.png"
    path.write_bytes(content)
    np.testing.assert_array_equal(read_mask(path), places > 0)
    colours = upstream.voc_palette()[places]
    assert colours.max() == 192  # what once was neither labels nor soft
    assert cv2.imwrite(str(path), colours[..., ::-1])
    np.testing.assert_array_equal(read_mask(path), places > 0)


def test_pictures_are_no_painted_labels(tmp_path):
    noise = np.random.default_rng(0).integers(0, 200, (32, 32, 3), dtype=np.uint8)
    assert cv2.imwrite(str(tmp_path / "m.png"), noise)
    for any_value in (False, True):
        with pytest.raises(DataError, match="neither labels"):
            read_mask(tmp_path / "m.png", any_value=any_value)


def test_jpeg_masks_are_not_trusted_near_zero(source, tmp_path):
    mask = cv2.resize(source.mask(0) * np.uint8(255), (256, 256), interpolation=cv2.INTER_NEAREST)
    assert cv2.imwrite(str(tmp_path / "m.jpg"), mask, [cv2.IMWRITE_JPEG_QUALITY, 80])
    assert iou(read_mask(tmp_path / "m.jpg", any_value=True), mask > 0) > 0.98


def test_distorted_masks_as_opencv_undistorts_them(source, smpl, body, tmp_path):
    folder = upstream.write_refined(source, tmp_path, smpl)
    annots = np.load(folder / "annots.npy", allow_pickle=True).item()
    D = np.array([[-0.2], [0.05], [0.002], [-0.001], [0.01]])
    annots["cams"]["D"] = [D] * CAMERAS
    save_object(folder / "annots.npy", annots)
    data = module(folder, body)
    for frame in range(FRAMES):
        mask = cv2.imread(str(folder / "mask" / "00" / f"{frame:06d}.png"), cv2.IMREAD_UNCHANGED) != 0
        wanted = cv2.undistort(mask.astype(np.uint8), annots["cams"]["K"][0], D) != 0
        assert iou(data.train_frame(frame).visible_mask.numpy(), wanted) > 0.9995


def test_cameras_without_pictures_are_named(source, smpl, body, tmp_path):
    folder = upstream.write_original(source, tmp_path, smpl)
    shutil.rmtree(folder / "Camera_B2")
    data = module(folder, body, test_cameras=[])
    data.validate()
    assert "there are no pictures of 1: Camera_B2" in data.taken.cameras
    with pytest.raises(DataError, match=r"Camera_B2.000000\.jpg: file not found"):
        module(folder, body).validate()


def test_check_says_the_same(source, smpl, body, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = upstream.write_original(source, tmp_path, smpl)
    assert main(["check", str(folder), "--body", str(smpl.path)]) == 0
    assert "gives the vertices of new_vertices/ with pose blend" in " ".join(words(capsys))
    values = dict(smpl.values, shapedirs=np.zeros_like(smpl.values["shapedirs"]))
    np.savez(tmp_path / "other.npz", **values)
    assert main(["check", str(folder), "--body", str(tmp_path / "other.npz")]) == 1
    assert "the body file gives other vertices" in " ".join(words(capsys))
    assert main(["check", str(folder)]) == 0  # the embedded body stands in, and nobody takes it for SMPL
    assert "other vertices" not in " ".join(words(capsys))


def words(capsys: pytest.CaptureFixture[str]) -> list[str]:
    """The third column of a table that wraps its cells."""
    rows = [line.split("│") for line in capsys.readouterr().out.splitlines() if line.startswith("│")]
    return " ".join(row[3] for row in rows).split()


def test_embedded_scenes_are_said_to_be_such(source):
    data = module(source.folder, embedded_body())
    assert data.taken.layout == "an embedded scene in the layout of original ZJU-MoCap"
    assert "gives the vertices of new_vertices/, off by 0.000" in data.taken.body


def test_looking_alone_reads_no_body(source, smpl, body, tmp_path):
    """A reader on its own, as `check` makes it, opens `annots.npy` and says what it would take."""
    folder = upstream.write_original(source, tmp_path, smpl)
    for frame in range(FRAMES):
        (folder / "new_params" / f"{frame}.npy").write_bytes(b"")
    scene = ZjuScene(folder, lambda betas: np.zeros(3))
    assert scene.fit_name == "new_params" and replace(scene.taken) == scene.taken
