"""The animated `.glb` in a reader that skins and that we did not write: three.js in a real browser."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import headless
import numpy as np
import pytest
import torch

from occfusion.__main__ import main
from occfusion.evaluation.pictures import to_uint8
from occfusion.export.mesh import BONES_PER_VERTEX, JOINTS
from occfusion.export.surface import find_surface
from occfusion.geometry.camera import project_vertices
from occfusion.geometry.zbuffer import rasterize_mesh
from occfusion.human.rendering import Renderer
from occfusion.run.loaded import load_run
from occfusion.run.showing import MotionChoice, make_showing
from oracles.gltf_by_three import GltfByThree

SIZE = 128
ROWS = (0, 24, 40, 63, 95)


@pytest.mark.slow  # a browser: ten seconds
@pytest.mark.skipif(
    headless.find_browser() is None, reason="no Chromium: skinned meshes go unread by three here"
)
def test_three_moves_and_colours_the_mesh_as_we_do_and_a_wrong_bone_shows(
    short_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("websockets", reason="speaks to the browser")
    monkeypatch.setattr("occfusion.export.surface.SIZE", 256)
    path = tmp_path / "skinned.glb"
    assert main(["export", str(short_run), "--output", str(path), "--motion", "squat", "--surface"]) == 0
    run = load_run(short_run)
    surface = find_surface(run.avatar, run.betas, Renderer("auto"))
    strongest = surface.weights.topk(BONES_PER_VERTEX, dim=1)
    four = torch.zeros_like(surface.weights).scatter(
        1, strongest.indices, strongest.values / strongest.values.sum(dim=1, keepdim=True)
    )
    showing = make_showing(
        run, "turntable", MotionChoice("squat"), light="even", size=(SIZE, SIZE), frames=96, renderer=Renderer("auto")
    )  # fmt: skip
    performance = showing.painter.performance
    fps = performance.clip.fps
    assert fps is not None

    def far(a: np.ndarray, b: torch.Tensor) -> np.ndarray:
        found: np.ndarray = np.linalg.norm(a - b.numpy(), axis=1)
        return found

    with headless.opened("about:blank", tmp_path / "profile") as page:
        file = GltfByThree(page, path)
        assert file.about["meshes"] == 1 and file.about["bones"] == list(JOINTS)
        assert [each["name"] for each in file.about["motions"]] == ["squat", "walk"]
        assert abs(file.about["motions"][0]["duration"] - (len(performance) - 1) / fps) < 1e-4
        for row in ROWS:
            ours = replace(surface, weights=four).posed(run.avatar, performance, row)
            whole = surface.posed(run.avatar, performance, row)  # with all bones
            found = file.posed("squat", row / fps)
            assert far(found, ours).max() < 1e-4, row
            assert far(found, whole).mean() < 1e-4 and far(found, whole).max() < 0.02, row
        # the matrices of another moment, and one bone alone, are wrong ones: the figure must tell
        bone = JOINTS.index("left_elbow")
        wrong = far(file.posed("squat", ROWS[-1] / fps, bone, 0.1), ours)
        assert wrong.max() > 0.02 and wrong[(surface.weights[:, :16].sum(dim=1) > 0.999).numpy()].max() < 1e-4

        middle = replace(surface, weights=four).posed(run.avatar, performance, 40)
        assert far(file.posed("squat", 0.0), middle).max() > 0.1
        shot = next(shot for shot in showing.shots if shot.row == 40)
        view = (shot.camera.viewmat @ torch.linalg.inv(performance.upright)).numpy()
        K = shot.camera.K.numpy()
        vertices = file.posed("squat", 40 / fps)
        picture = file.drawn(view, K, SIZE, SIZE)
    pixels, depths = project_vertices(vertices, view, K)
    seen = rasterize_mesh(pixels, depths, surface.faces, SIZE, SIZE)
    colors = 255 * surface.colors.numpy()[surface.faces[seen.face]]
    drawn = (colors * seen.barycentrics[..., None]).sum(axis=2)
    both = (seen.face >= 0) & (picture.max(axis=2) > 0)
    assert both.sum() / ((seen.face >= 0) | (picture.max(axis=2) > 0)).sum() > 0.98
    assert np.abs(picture[both] - drawn[both]).mean() < 2.0  # of 255: three mixes colours in linear light
    avatar = showing.painter.draw(shot)
    both = (picture.max(axis=2) > 0) & (avatar.alpha.numpy() > 0.5)
    squared = np.mean((picture[both] / 255.0 - to_uint8(avatar.rgb)[both] / 255.0) ** 2)
    assert -10 * np.log10(squared) > 20
