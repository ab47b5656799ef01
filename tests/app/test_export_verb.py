"""`export` as a user types it: files drawn from what readers that are not ours find in them, and by a real browser."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import cv2
import headless
import numpy as np
import pytest
import torch

from occfusion.__main__ import main
from occfusion.evaluation.pictures import to_uint8
from occfusion.export.splats import turned_harmonics
from occfusion.geometry.rotation import axis_angle_to_matrix
from occfusion.human.rendering import Renderer
from occfusion.run.loaded import load_run
from occfusion.run.showing import MotionChoice, Showing, make_showing
from occfusion.splat import Limits, rasterize
from occfusion.splat.harmonics import evaluate

SIZE = 128


@pytest.fixture
def run(short_run: Path) -> Path:
    return short_run


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


def read_by_gsply(path: Path) -> dict[str, torch.Tensor]:
    gsply = pytest.importorskip("gsply", reason="gsply reads .ply files independently of us")
    data = gsply.plyread(str(path))
    higher = np.zeros((len(data.means), 0, 3), np.float32) if data.shN is None else data.shN
    sh = np.concatenate([data.sh0.reshape(-1, 1, 3), higher], axis=1)
    names = {"means": data.means, "quats": data.quats, "scales": np.exp(data.scales), "sh": sh}
    opacities = 1 / (1 + np.exp(-data.opacities.reshape(-1).astype(np.float64)))
    return {
        k: torch.from_numpy(np.ascontiguousarray(v)).float() for k, v in {**names, "o": opacities}.items()
    }


def test_a_posed_ply_read_by_another_reader_shows_the_same_picture(run: Path, tmp_path: Path) -> None:
    path = tmp_path / "posed.ply"
    words = ["--motion", "squat", "--pose", "40", "--light", "120,30"]
    assert main(["export", str(run), "--output", str(path), *words]) == 0
    read = read_by_gsply(path)
    assert all(bool(value.isfinite().all()) for value in read.values()) and float(read["o"].min()) > 1 / 256
    showing = shown(run, "squat", 96, "120,30")
    shot = next(shot for shot in showing.shots if shot.row == 40)
    view = shot.camera.viewmat @ torch.linalg.inv(showing.painter.performance.upright)
    cloud = showing.painter.cloud(shot)
    drawn = rasterize(
        read["means"], read["quats"], read["scales"], read["o"], read["sh"], view, shot.camera.K, SIZE, SIZE,
        sh_degree=round(read["sh"].shape[1] ** 0.5) - 1, limits=Limits(dilation=cloud.dilation),
    )  # fmt: skip
    assert psnr(to_uint8(drawn.rgb), to_uint8(showing.painter.draw(shot).rgb)) > 45


def test_harmonics_turn_with_what_wears_them() -> None:
    generator = torch.Generator().manual_seed(1)
    sh = 0.1 * torch.randn(5, 16, 3, generator=generator, dtype=torch.float64)
    turn = axis_angle_to_matrix(torch.randn(5, 3, generator=generator, dtype=torch.float64))
    seen = torch.nn.functional.normalize(torch.randn(5, 3, generator=generator, dtype=torch.float64), dim=1)
    before = evaluate(sh, torch.einsum("nji,nj->ni", turn, seen), 3)
    assert torch.allclose(evaluate(turned_harmonics(sh, turn), seen, 3), before, atol=1e-9)


def test_bad_words_are_one_message(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(run), "--output", str(tmp_path / "a.obj")]) == 1
    assert "formats are .ply" in capsys.readouterr().err
    assert main(["export", str(run), "--output", str(tmp_path / "a.ply"), "--pose", "99999"]) == 1
    assert "the motion has the frames 0 to" in capsys.readouterr().err
    assert not list(tmp_path.glob("a.*"))


@pytest.mark.slow
@pytest.mark.skipif(headless.find_browser() is None, reason="no Chromium on this machine")
def test_the_page_shows_five_poses_as_we_do_and_a_wrong_bone_shows(run: Path, tmp_path: Path) -> None:
    pytest.importorskip("websockets", reason="speaks to the browser")
    path = tmp_path / "avatar.html"
    assert main(["export", str(run), "--output", str(path), "--motion", "squat"]) == 0
    assert path.stat().st_size < 6e6
    assert "http://" not in path.read_text().split("<script type", 1)[0]
    showing = shown(run, "squat", 5, "even")
    upright = showing.painter.performance.upright
    with headless.opened(path, tmp_path / "profile") as page:
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
