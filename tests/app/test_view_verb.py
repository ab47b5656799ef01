"""`view`: what is shown of a run, and the page that viser serves, without a browser."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.request import urlopen

import headless
import numpy as np
import pytest
import torch

from occfusion.__main__ import main
from occfusion.errors import CheckpointError, DataError
from occfusion.evaluation.pictures import to_uint8
from occfusion.export.mesh import JOINTS
from occfusion.files.run_folder import RunFolder
from occfusion.geometry.rotation import matrix_to_quaternion
from occfusion.human.rendering import Renderer
from occfusion.run.bodies import make_body, make_data
from occfusion.run.loaded import load_run
from occfusion.run.showing import MotionChoice, make_showing
from occfusion.types import Camera
from occfusion.viewer.figure import Figure
from occfusion.viewer.pictures import camera_of, draw, floor
from occfusion.viewer.room import BACKGROUND, FLOOR_CELL, UNITS, furnish
from occfusion.viewer.seen import TRAINING, Seen

EYE = np.array([0.3, 1.0, 3.0])
STILL = np.zeros((24, 3))


@pytest.fixture(scope="module")
def figure(short_run: Path) -> Figure:
    return Figure(short_run, motion="squat")


def test_gaussians_are_those_of_rendered_pictures(short_run: Path, figure: Figure) -> None:
    showing = make_showing(
        load_run(short_run),
        "turntable",
        MotionChoice("squat"),
        size=(64, 64),
        frames=96,
        renderer=Renderer("auto"),
    )
    shot = next(shot for shot in showing.shots if shot.row == 40)
    upright = showing.painter.performance.upright
    eye = upright[:3, :3] @ shot.camera.centre + upright[:3, 3]
    cloud, splats = showing.painter.cloud(shot), figure.splats(40, STILL, eye.numpy())
    assert np.allclose(splats.means, cloud.means @ upright[:3, :3].T + upright[:3, 3], atol=1e-5)
    assert np.allclose(splats.colors, cloud.colors.clamp(0, 1), atol=1e-4)
    quats, scales = splats.ellipsoids()
    w, x, y, z = quats.T.astype(np.float64)
    first = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1)
    assert np.allclose(
        np.einsum("nij,nj->ni", splats.covariances, first), scales[:, :1] ** 2 * first, atol=1e-7
    )


def test_pictures_for_visitors_are_rendered_pictures(short_run: Path, figure: Figure) -> None:
    showing = make_showing(
        load_run(short_run), "turntable", MotionChoice("squat"), size=(72, 64), frames=96, renderer=Renderer("auto")
    )  # fmt: skip
    shot = next(shot for shot in showing.shots if shot.row == 40)
    drawn, camera = showing.painter.draw(shot), shot.camera
    home = showing.painter.performance.upright @ torch.linalg.inv(camera.viewmat)
    visitor = SimpleNamespace(
        position=home[:3, 3].numpy() * UNITS, wxyz=matrix_to_quaternion(home[:3, :3]).numpy(),
        fov=2 * np.arctan(0.5 * camera.height / float(camera.K[1, 1])), image_width=72, image_height=64,
    )  # fmt: skip
    cloud = figure.cloud(40, STILL, visitor.position / UNITS)
    picture, depth = draw(cloud, figure, camera_of(visitor), Renderer("auto"))
    expected = to_uint8(
        drawn.rgb + (1 - drawn.alpha[..., None]) * torch.from_numpy(floor(camera_of(visitor))) / 255.0
    )
    far = np.abs(picture.astype(int) - expected)  # the footprint is that of the middle of the person
    assert expected.max() > 100 and far.max() < 12 and far.mean() < 0.1
    solid = drawn.alpha.numpy() > 0.95
    assert solid.sum() > 50 and np.abs(depth - UNITS * drawn.depth.numpy())[solid].mean() < 0.02
    assert (depth[drawn.alpha.numpy() < 0.4] > 100).all()
    large = SimpleNamespace(**{**vars(visitor), "image_width": 1920, "image_height": 1080})
    seen = camera_of(large)
    assert (seen.width, seen.height) == (800, 450) and float(seen.K[1, 2]) == 225.0
    assert abs(float(seen.K[1, 1]) / 450 - float(camera.K[1, 1]) / 64) < 1e-4


def test_lines_of_the_floor_are_where_a_camera_sees_them() -> None:
    # from 1.5 m up and 2 m before, looking down by 37 degrees
    turn = torch.tensor([[1.0, 0, 0], [0, -0.8, 0.6], [0, -0.6, -0.8]])
    viewmat = torch.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = turn, -turn @ torch.tensor([0.05, 1.5, 2.0])
    K = torch.tensor([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
    picture = floor(Camera(viewmat, K, 320, 240)).astype(int).sum(axis=2)
    dark = sum(BACKGROUND)
    for x, z, is_line in (
        (0.25, 0.1, True), (-0.5, 0.6, True), (0.1, 0.25, True), (0.6, -0.5, True),
        (0.125, 0.125, False), (-0.375, 0.375, False), (0.63, -0.37, False),
    ):  # fmt: skip
        seen = K @ (turn @ torch.tensor([x, 0.0, z]) + viewmat[:3, 3])
        column, row = (seen[:2] / seen[2] - 0.5).round().int().tolist()
        around = picture[row - 1 : row + 2, column - 1 : column + 2]
        assert around.shape == (3, 3) and (around.max() > dark + 100) == is_line, (x, z)
    behind = floor(Camera(torch.diag(torch.tensor([1.0, -1, -1, 1])) @ viewmat, K, 320, 240))
    assert (behind == BACKGROUND).all() and FLOOR_CELL == 0.25


def test_a_turned_joint_moves_what_hangs_on_it(figure: Figure) -> None:
    turns = STILL.copy()
    turns[JOINTS.index("left_elbow"), 1] = 1.0
    moved = np.linalg.norm(figure.splats(0, turns, EYE).means - figure.splats(0, STILL, EYE).means, axis=1)
    avatar = figure.run.avatar
    strongest = avatar.body.weights[avatar.gaussians.vertex_index].argmax(dim=1).numpy()
    assert moved[strongest == JOINTS.index("left_wrist")].min() > 0.1
    assert (
        moved[np.isin(strongest, [JOINTS.index(name) for name in ("head", "right_elbow", "left_knee")])].max()
        < 1e-3
    )


def test_a_newer_file_is_taken(short_run: Path, tmp_path: Path) -> None:
    shutil.copytree(short_run, tmp_path / "run")
    figure = Figure(tmp_path / "run")
    assert not figure.reload() and "done" in figure.label
    os.utime(RunFolder(tmp_path / "run").stage("optim").avatar, ns=(1, 1))
    assert figure.reload() and not figure.reload()


def test_a_run_without_an_avatar_is_one_message(short_run: Path, tmp_path: Path) -> None:
    shutil.copy(RunFolder(short_run).config, tmp_path / "config.yaml")
    with pytest.raises(CheckpointError, match="holds no avatar yet: let `python train"):
        Figure(tmp_path)


@pytest.fixture
def server() -> Iterator[Any]:
    viser = pytest.importorskip("viser", reason="no viser (extra `view`): its page goes untested here")
    made = viser.ViserServer("127.0.0.1", headless.free_port(), verbose=False)
    furnish(made)
    yield made
    made.stop()


def test_the_page_shows_plays_and_switches(short_run: Path, server: Any) -> None:
    from occfusion.viewer.page import Page

    page = Page(server, {"a run": short_run}, "squat")
    assert urlopen(f"http://127.0.0.1:{server.get_port()}/").status == 200
    page.playing.value = False
    assert page.step() and not page.step()  # nothing is sent twice
    sent = server.scene.get_handle_by_name("/splats")
    expected = page.figure.splats(0, STILL, page._eye)
    assert np.allclose(sent.centers / UNITS, expected.means, atol=1e-5)
    assert (
        np.abs(sent.covariances / UNITS**2 - expected.covariances).max() < 1e-3 * expected.covariances.max()
    )
    page.angles[0].value, page.joint.value = 60.0, "left_shoulder"
    page._turn(0)
    assert page.step() and np.abs(sent.centers / UNITS - expected.means).max() > 0.05
    page._straighten()
    page.look.value, page.with_input.value, page.kind.value = "ellipsoids", True, "error"
    page._due()
    assert page.step() and not sent.visible
    assert len(server.scene.get_handle_by_name("/ellipsoids").batched_positions) == len(expected.means)
    camera, view = server.scene.get_handle_by_name("/camera"), page.figure.run.views("train")[0].camera
    place = page.figure.own.upright @ torch.cat([view.centre, torch.ones(1)])
    assert np.allclose(camera.position, place[:3] * UNITS, atol=1e-3)
    assert camera.image.shape == (view.height, view.width, 3) and 0 < camera.image.mean() < 60
    assert np.array_equal(page.beside.image, camera.image) and "against the truth" in page.said.content
    page.motion.value = "walk"
    page._change_motion()
    assert page.step() and page.frame.max == len(page.figure.performance) - 1


def test_pictures_are_drawn_here_for_each_visitor_or_by_browsers(
    short_run: Path, server: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from occfusion.viewer.page import SERVER, Page

    sent: list[list[Any]] = [[], []]
    visitors = {}
    for number, record in enumerate(sent):
        camera = SimpleNamespace(
            position=np.array([0.0, 11.0, (-1) ** number * 32.0]), wxyz=np.array([0.0, 1 - number, number, 0.0]),
            fov=0.7, image_width=60, image_height=60,
        )  # fmt: skip
        scene = SimpleNamespace(set_background_image=lambda image, to=record, **_: to.append(image))
        visitors[number] = SimpleNamespace(camera=camera, scene=scene)
    monkeypatch.setattr(server, "get_clients", lambda: visitors)
    page = Page(server, {"a run": short_run}, "squat", SERVER)
    page.playing.value = False
    assert page.step() and not page.step()
    assert server.scene.get_handle_by_name("/splats") is None
    front, back = (record[0] for record in sent)
    assert front.shape == (60, 60, 3) and front.max() > 60
    turned = np.abs(front.astype(int) - back[:, ::-1])
    assert turned.mean() > 0.1 and np.abs(front.astype(int) - back).mean() > 0.1
    page.drawn_by.value = "browser"
    page._due()
    assert page.step() and all(record[-1] is None and len(record) == 2 for record in sent)
    assert len(server.scene.get_handle_by_name("/splats").centers) > 1000


def test_without_the_data_the_avatar_is_shown_all_the_same(
    short_run: Path, server: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from occfusion.viewer.page import Page

    page = Page(server, {"a run": short_run}, "squat")
    page.playing.value, page.with_input.value = False, True

    def gone(*_: Any) -> Any:
        raise DataError("/data: is not there")

    monkeypatch.setattr("occfusion.viewer.seen.make_data", gone)
    assert page.step() and server.scene.get_handle_by_name("/splats").visible
    assert not page.with_input.value and "is not there" in page.said.content
    page._due()
    assert page.step() and "is not there" in page.said.content


def test_pictures_of_cameras_are_the_data_and_their_errors(short_run: Path) -> None:
    figure = Figure(short_run, motion="squat")
    seen = Seen(figure.run)
    data = make_data(figure.run.settings, make_body(figure.run.settings.body))
    data.setup()
    assert seen.cameras == (TRAINING, *(f"held out, camera {k}" for k in data.test_cameras))
    for camera, frame in (
        (TRAINING, data.train_frame(3)),
        (seen.cameras[1], data.test_frame(*data.test_views[0])),
    ):
        view = seen.nearest(camera, frame.index + 0.2)
        assert view.frame == frame.index
        drawn = seen.picture(camera, view, "avatar", figure).picture
        # in its own light and world, whatever motion plays
        alone = load_run(short_run).avatar
        assert np.abs(drawn.astype(int) - to_uint8(Renderer("auto").frame(alone, frame).rgb)).max() <= 1
        assert np.array_equal(seen.picture(camera, view, "input", figure).picture, to_uint8(frame.rgb))
        assert frame.truth is not None
        truth = to_uint8(frame.truth.rgb)
        assert np.array_equal(seen.picture(camera, view, "truth", figure).picture, truth)
        error = seen.picture(camera, view, "error", figure)
        expected = 4 * np.abs(drawn / 255.0 - truth / 255.0).mean(axis=2)
        assert np.abs(error.picture[..., 0] / 255.0 - expected.clip(0, 1)).max() < 0.03
        decibels = -10 * np.log10(((drawn / 255.0 - truth / 255.0) ** 2).mean())
        assert abs(float(error.text.split()[-2]) - decibels) < 0.2
    lamp = figure.run.avatar.key_light
    assert (lamp is None) == (figure._light is None)


def test_an_address_of_another_machine_is_one_message(
    short_run: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "viser", object())  # not reached
    assert main(["view", str(short_run), "--host", "192.0.2.1"]) == 1
    assert "--host 192.0.2.1" in capsys.readouterr().err


def test_without_viser_one_message_says_what_to_type(
    short_run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    assert main(["view", str(short_run)]) == 1
    assert "pip install 'occfusion[view]'" in capsys.readouterr().err
