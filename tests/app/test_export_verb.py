"""`export` as a user types it: files drawn from what readers that are not ours find in them, and by a real browser."""

from __future__ import annotations

import base64
import json
import re
import struct
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import headless
import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from occfusion.__main__ import main
from occfusion.cli import export
from occfusion.errors import DataError
from occfusion.evaluation.pictures import to_uint8
from occfusion.export.splats import turned_harmonics
from occfusion.geometry.camera import project_vertices
from occfusion.geometry.rotation import axis_angle_to_matrix
from occfusion.geometry.zbuffer import rasterize_mesh
from occfusion.human.rendering import Renderer
from occfusion.run.loaded import load_run
from occfusion.run.showing import MotionChoice, Showing, make_showing
from occfusion.splat import Limits, rasterize
from occfusion.splat.harmonics import evaluate
from oracles.splat_files import read_by_gsply, read_by_trimesh

SIZE = 128


@pytest.fixture
def run(short_run: Path) -> Path:
    return short_run


@cache
def shown(run: Path, motion: str, frames: int, light: str = "estimated") -> Showing:
    choice = MotionChoice(motion)
    return make_showing(
        load_run(run),
        "turntable",
        choice,
        light=light,
        size=(SIZE, SIZE),
        frames=frames,
        renderer=Renderer("auto"),
    )


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(max(np.mean((a / 255.0 - b / 255.0) ** 2), 1e-12)))


@pytest.mark.parametrize(
    ("suffix", "read", "least"),
    [
        (".ply", read_by_gsply, 70),
        (".compressed.ply", read_by_gsply, 45),
        (".spz", read_by_gsply, 45),
        (".glb", read_by_trimesh, 70),
    ],
)
def test_posed_gaussians_read_by_another_reader_show_the_same_picture(
    suffix: str,
    read: Callable[[Path], dict[str, np.ndarray]],
    least: float,
    run: Path,
    tmp_path: Path,
) -> None:
    path = tmp_path / f"posed{suffix}"
    words = ["--motion", "squat", "--pose", "40", "--light", "120,30"]
    assert main(["export", str(run), "--output", str(path), *words]) == 0
    found = {k: torch.tensor(np.ascontiguousarray(v)).float() for k, v in read(path).items()}
    assert all(bool(value.isfinite().all()) for value in found.values())
    assert float(found["o"].min()) > 1 / 256
    showing = shown(run, "squat", 96, "120,30")
    shot = next(shot for shot in showing.shots if shot.row == 40)
    view = shot.camera.viewmat @ torch.linalg.inv(showing.painter.performance.upright)
    cloud = showing.painter.cloud(shot)
    drawn = rasterize(
        found["means"], found["quats"], found["scales"], found["o"], found["sh"], view, shot.camera.K, SIZE, SIZE,
        sh_degree=round(found["sh"].shape[1] ** 0.5) - 1, limits=Limits(dilation=cloud.dilation),
    )  # fmt: skip
    assert psnr(to_uint8(drawn.rgb), to_uint8(showing.painter.draw(shot).rgb)) > least


def test_a_viewer_with_its_own_footprint_shows_the_same_picture(run: Path, tmp_path: Path) -> None:
    """Viewers add 0.3 square pixels, whatever the size; `--for-viewers` bakes in what that lacks of ours."""
    loaded = load_run(run)
    side = 8 * loaded.views("train")[0].camera.width
    showing = make_showing(
        loaded, "held-out", MotionChoice("sequence"), size=(side, side), frames=1, renderer=Renderer("auto")
    )
    (shot,) = showing.shots
    ours = showing.painter.cloud(shot)
    assert ours.dilation > 1.0  # of eight times the size: there is something to bake in
    view = shot.camera.viewmat @ torch.linalg.inv(showing.painter.performance.upright)
    found = {}
    for name, words in {"plain": [], "baked": ["--for-viewers", str(side)]}.items():
        path = tmp_path / f"{name}.ply"
        assert main(["export", str(run), "--output", str(path), "--pose", str(shot.row), *words]) == 0
        read = {k: torch.tensor(np.ascontiguousarray(v)).float() for k, v in read_by_gsply(path).items()}
        drawn = rasterize(
            read["means"], read["quats"], read["scales"], read["o"], read["sh"], view, shot.camera.K, side, side,
            sh_degree=round(read["sh"].shape[1] ** 0.5) - 1, limits=Limits(dilation=0.3),
        )  # fmt: skip
        found[name] = psnr(to_uint8(drawn.rgb), to_uint8(showing.painter.draw(shot).rgb))
    assert found["baked"] > 45 and found["plain"] < found["baked"] - 6, found


def posed_by_the_rules_of_gltf(path: Path, animation: str, seconds: float) -> np.ndarray:
    """Vertices of a skinned mesh at a moment, as "3.7.3 Skins" and "3.11 Animations" of glTF 2.0 say."""
    content = path.read_bytes()
    (length,) = struct.unpack("<I", content[12:16])
    said, binary = json.loads(content[20 : 20 + length]), content[28 + length :]
    kinds = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
    columns = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}

    def array(index: int) -> np.ndarray:
        accessor = said["accessors"][index]
        start = said["bufferViews"][accessor["bufferView"]]["byteOffset"]
        count = accessor["count"] * columns[accessor["type"]]
        found = np.frombuffer(binary, kinds[accessor["componentType"]], count, start)
        return found.reshape(accessor["count"], -1).astype(np.float64)

    nodes, skin = said["nodes"], said["skins"][0]
    (clip,) = [each for each in said["animations"] if each["name"] == animation]
    for channel in clip["channels"]:
        sampler, target = clip["samplers"][channel["sampler"]], channel["target"]
        times, values = array(sampler["input"])[:, 0], array(sampler["output"])
        nodes[target["node"]][target["path"]] = values[np.abs(times - seconds).argmin()]
    world = {}

    def place(node: int, above: np.ndarray) -> None:
        local = np.eye(4)
        local[:3, :3] = Rotation.from_quat(nodes[node].get("rotation", [0, 0, 0, 1])).as_matrix()
        local[:3, 3] = nodes[node].get("translation", [0, 0, 0])
        world[node] = above @ local
        for child in nodes[node].get("children", []):
            place(child, world[node])

    for root in said["scenes"][said["scene"]]["nodes"]:
        place(root, np.eye(4))
    inverse = array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
    bones = np.stack([world[joint] @ back for joint, back in zip(skin["joints"], inverse, strict=True)])
    attributes = said["meshes"][0]["primitives"][0]["attributes"]
    points = np.c_[array(attributes["POSITION"]), np.ones(len(array(attributes["POSITION"])))]
    joints, weights = array(attributes["JOINTS_0"]).astype(int), array(attributes["WEIGHTS_0"])
    return np.einsum("vk,vkij,vj->vi", weights, bones[joints], points)[:, :3]


def test_meshes_read_by_another_reader_stand_as_the_avatar_does(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("occfusion.export.surface.SIZE", 256)
    posed, skinned = tmp_path / "posed.obj", tmp_path / "skinned.glb"
    assert main(["export", str(run), "--output", str(posed), "--motion", "squat", "--pose", "40"]) == 0
    assert main(["export", str(run), "--output", str(skinned), "--motion", "squat", "--surface"]) == 0
    mesh = trimesh.load(posed, process=False)
    showing = shown(run, "squat", 96, "even")
    upright = showing.painter.performance.upright
    shot = next(shot for shot in showing.shots if shot.row == 40)
    view = (shot.camera.viewmat @ torch.linalg.inv(upright)).numpy()

    def agreement(vertices: np.ndarray) -> tuple[float, float]:
        pixels, depths = project_vertices(vertices, view, shot.camera.K.numpy())
        seen = rasterize_mesh(pixels, depths, np.asarray(mesh.faces), SIZE, SIZE)
        colors = np.asarray(mesh.visual.vertex_colors)[mesh.faces[seen.face]][..., :3]
        drawn = (colors * seen.barycentrics[..., None]).sum(axis=2)
        ours = showing.painter.draw(shot)
        both = (seen.face >= 0) & (ours.alpha.numpy() > 0.5)
        either = (seen.face >= 0) | (ours.alpha.numpy() > 0.5)
        return both.sum() / either.sum(), psnr(drawn[both], to_uint8(ours.rgb)[both])

    overlap, decibels = agreement(np.asarray(mesh.vertices))
    assert overlap > 0.9 and decibels > 20
    fps = showing.painter.performance.clip.fps
    assert fps is not None
    moved = posed_by_the_rules_of_gltf(skinned, "squat", 40 / fps)
    far = np.linalg.norm(moved - mesh.vertices, axis=1)
    assert far.mean() < 1e-4 and far.max() < 0.02  # four bones a vertex, not all
    assert agreement(posed_by_the_rules_of_gltf(skinned, "squat", 0.0))[0] < 0.8
    (read,) = trimesh.load(skinned).geometry.values()
    assert len(read.faces) == len(mesh.faces) and read.is_watertight == mesh.is_watertight


def test_harmonics_turn_with_what_wears_them() -> None:
    generator = torch.Generator().manual_seed(1)
    sh = 0.1 * torch.randn(5, 16, 3, generator=generator, dtype=torch.float64)
    turn = axis_angle_to_matrix(torch.randn(5, 3, generator=generator, dtype=torch.float64))
    seen = torch.nn.functional.normalize(torch.randn(5, 3, generator=generator, dtype=torch.float64), dim=1)
    before = evaluate(sh, torch.einsum("nji,nj->ni", turn, seen), 3)
    assert torch.allclose(evaluate(turned_harmonics(sh, turn), seen, 3), before, atol=1e-9)


def test_bad_words_are_one_message(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(run), "--output", str(tmp_path / "a.fbx")]) == 1
    assert "formats are .ply" in capsys.readouterr().err
    assert main(["export", str(run), "--output", str(tmp_path / "a.ply"), "--pose", "99999"]) == 1
    assert "the motion has the frames 0 to" in capsys.readouterr().err
    assert main(["export", str(run), "--output", str(tmp_path / "a.ply"), "--surface"]) == 1
    assert "--surface is for a .glb" in capsys.readouterr().err
    assert not list(tmp_path.glob("a.*"))


@pytest.mark.parametrize(
    ("name", "words", "message"),
    [
        ("a.ply", ["--light", "45,30"], "--light: "),
        ("a.spz", ["--motion", "walk"], "neither motion nor lamp"),
        ("a.html", ["--light", "45,30"], "is in even light"),
        ("a.html", ["--pose", "3"], "all frames of the motion"),
        ("a.obj", ["--for-viewers", "512"], "files of Gaussians"),
        ("a.glb", ["--surface", "--light", "even"], "is in even light"),
        ("a.html", ["--surface"], "plays Gaussians"),
        ("a.html", ["--fps", "0"], "--fps 0: must be positive"),
        ("a.ply", ["--pose", "1", "--motion-fps", "nan"], "--motion-fps nan: must be positive"),
    ],
)
def test_options_without_effect_are_refused(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, words: list[str], message: str
) -> None:
    assert main(["export", str(run), "--output", str(tmp_path / name), *words]) == 1
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_files_say_which_light_they_have(run: Path, tmp_path: Path) -> None:
    lamp = ["--motion", "squat", "--pose", "4", "--light", "45,30"]
    for name, words, text in (
        ("a.ply", lamp, "comment frame 4 of squat, a lamp 45 degrees"),
        ("a.compressed.ply", lamp, "comment frame 4 of squat, a lamp 45 degrees"),
        ("a.glb", lamp, '"about": "frame 4 of squat, a lamp 45 degrees'),
        ("b.ply", [], "comment canonical pose, even light"),
    ):
        assert main(["export", str(run), "--output", str(tmp_path / name), *words]) == 0
        assert text in (tmp_path / name).read_bytes()[:60_000].decode("latin-1")


def test_the_page_says_who_it_shows_and_in_which_light(run: Path, tmp_path: Path) -> None:
    assert main(["export", str(run), "--output", str(tmp_path / "a.html")]) == 0
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert "<title>001-clean</title>" in text
    (record,) = re.findall(r'id="record">(.*?)</script>', text)
    assert "even light" in json.loads(record)["about"]["text"]


def test_a_folder_of_poses_is_whole_or_not_there(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "poses"
    out.mkdir()
    (out / "0007.ply").write_bytes(b"of an earlier call")
    (out / "notes.ply").write_bytes(b"of the user")
    words = ["export", str(run), "--output", str(out), "--motion", "squat"]
    whole = export.posed_table

    def fails_at_the_third(*arguments: Any) -> Any:
        calls.append(None)
        if len(calls) == 3:
            raise DataError("the disk refuses")
        return whole(*arguments)

    calls: list[None] = []
    monkeypatch.setattr(export, "posed_table", fails_at_the_third)
    assert main([*words, "--fps", "3"]) == 1
    assert "the disk refuses" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["0007.ply", "notes.ply", "poses"]
    assert main([*words, "--fps", "1"]) == 0
    names = sorted(path.name for path in out.iterdir())
    count = len(names) - 1
    assert 1 < count < 7 and names == [*(f"{row:04d}.ply" for row in range(count)), "notes.ply"]
    assert read_by_gsply(out / "0001.ply")["means"].shape[1] == 3


@pytest.mark.slow
@pytest.mark.skipif(headless.find_browser() is None, reason="no Chromium: exported pages go unseen here")
def test_the_page_shows_five_poses_as_we_do_and_a_wrong_bone_shows(run: Path, tmp_path: Path) -> None:
    pytest.importorskip("websockets", reason="speaks to the browser")
    path = tmp_path / "avatar.html"
    assert main(["export", str(run), "--output", str(path), "--motion", "squat"]) == 0
    assert path.stat().st_size < 6e6
    assert "http://" not in path.read_text().split("<script type", 1)[0]
    showing = shown(run, "squat", 5, "even")
    upright = showing.painter.performance.upright
    with headless.opened(path, tmp_path / "profile", headless.SELDOM) as page:
        page.wait_for("!!window.occfusion || window.occfusionError", 90)
        assert page.evaluate("String(window.occfusionError)") == "undefined"

        def drawn(row: int, shot: Any) -> np.ndarray:
            view = (shot.camera.viewmat @ torch.linalg.inv(upright)).flatten().tolist()
            K = shot.camera.K
            pinhole = [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])]
            url = page.evaluate(f"occfusion.draw(0, {row}, {view}, {pinhole}, {SIZE}, {SIZE}, {shot.scale})")
            return cv2.imdecode(np.frombuffer(base64.b64decode(url.split(",")[1]), np.uint8), 1)[..., ::-1]

        for shot in showing.shots:
            assert shot.row is not None
            ours = to_uint8(showing.painter.draw(shot).rgb)
            assert ours.max() > 60
            assert psnr(drawn(shot.row, shot), ours) > 38
        # the matrices of another moment are wrong ones: the figure must tell
        middle = showing.shots[2]
        assert psnr(drawn(0, middle), to_uint8(showing.painter.draw(middle).rgb)) < 35
