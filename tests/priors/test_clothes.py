"""How far clothes reach beyond the body, on upright tubes whose clothes are known."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from occfusion.geometry.mesh_spread import spread_over_mesh
from occfusion.geometry.zbuffer import NO_FACE, rasterize_mesh
from occfusion.human.body import embedded_body
from occfusion.observation.clothes import (
    BETWEEN,
    LEAST_LOOKS,
    MARGIN,
    face_of,
    fit_thickness,
    measure_reach,
    reach_in_picture,
)
from occfusion.observation.consistency import ProjectedMesh
from occfusion.observation.evidence import Evidence
from occfusion.observation.frames import ObservedFrame, PosedBody
from occfusion.observation.keypoints import HEAD, face_vertices
from occfusion.synth.scene import Scene
from occfusion.synth.spec import SceneSpec
from occfusion.types import Camera

SIZE, FOCAL, DISTANCE, RADIUS, HALF = 240, 300.0, 3.0, 0.1, 0.4  # a pixel is a centimetre
SECTORS, RINGS = 32, 9
BODY = embedded_body()
CAMERA = Camera(
    torch.eye(4),
    torch.tensor([[FOCAL, 0.0, SIZE / 2], [0.0, FOCAL, SIZE / 2], [0.0, 0.0, 1.0]]),
    SIZE,
    SIZE,
)
SIDES = np.arange(SECTORS) % (SECTORS // 2) == 0  # of a ring: its normals lie in the picture


def tubes(*middles: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Upright tubes before the camera, one beside another; corners counter-clockwise from outside."""
    angle = 2.0 * np.pi * np.arange(SECTORS) / SECTORS
    x, z = RADIUS * np.cos(angle), DISTANCE + RADIUS * np.sin(angle)
    points, faces = [], []
    for number, middle in enumerate(middles):
        for y in np.linspace(-HALF, HALF, RINGS):
            points.append(np.column_stack([middle + x, np.full(SECTORS, y), z]))
        for ring in range(RINGS - 1):
            first = (number * RINGS + ring) * SECTORS
            for k in range(SECTORS):
                a, b = first + k, first + (k + 1) % SECTORS
                faces += [(a, a + SECTORS, b), (b, a + SECTORS, b + SECTORS)]
    return np.concatenate(points), np.array(faces)


def shown(left: float, right: float) -> NDArray[np.bool_]:
    """Pixels of a person from `left` to `right`, metres beside the axis, higher than the tubes."""
    beside = (np.arange(SIZE) + 0.5 - SIZE / 2) * DISTANCE / FOCAL
    return (np.abs(beside) < HALF + 0.05)[:, None] & (beside >= left) & (beside < right)


def reach(visible: NDArray[np.bool_], background: NDArray[np.bool_], *middles: float) -> NDArray[np.float64]:
    """The reach of each ring but the outermost, `[tubes, rings, sectors]`."""
    vertices, faces = tubes(*middles)
    found = reach_in_picture(vertices, faces, CAMERA, visible, background, 0.004)
    return found.reshape(len(middles), RINGS, SECTORS)[:, 1:-1]


@pytest.mark.parametrize("loose", [0.0, 0.03, 0.06, 0.15])
def test_a_skirt_is_as_wide_as_it_is_seen(loose: float) -> None:
    visible = shown(-RADIUS - loose, RADIUS + loose)
    (found,) = reach(visible, ~visible, 0.0)
    assert np.abs(found[:, SIDES] - loose).max() < 0.012  # a pixel
    towards = 3 * SECTORS // 4
    assert np.isnan(found[:, towards]).all()  # whose normal points at the camera


def test_what_lies_between_two_legs_is_shared() -> None:
    gap, visible = 0.12, shown(-0.26, 0.26)
    found = reach(visible, ~visible, -RADIUS - gap / 2, RADIUS + gap / 2)
    for inner in (found[0, :, 0], found[1, :, SECTORS // 2]):
        assert np.abs(inner - BETWEEN * gap).max() < 0.012
    for outer in (found[0, :, SECTORS // 2], found[1, :, 0]):
        assert np.abs(outer).max() < 0.012
    bare = shown(-0.26, -gap / 2) | shown(gap / 2, 0.26)
    assert np.nanmax(reach(bare, ~bare, -RADIUS - gap / 2, RADIUS + gap / 2)) < 0.02


def test_an_end_that_may_be_hidden_tells_nothing() -> None:
    visible = shown(-RADIUS - 0.06, RADIUS + 0.03)  # something stands before the right of it
    (found,) = reach(visible, ~visible & ~shown(RADIUS + 0.03, 1.2), 0.0)
    assert np.isnan(found[:, 0]).all()
    assert np.abs(found[:, SECTORS // 2] - 0.06).max() < 0.012


def test_a_normal_through_another_part_of_the_body_tells_nothing() -> None:
    """It comes out at that one's far side, and what is seen there is not this one's."""
    visible = shown(-0.35, 0.35)
    found = reach(visible, ~visible, -RADIUS, RADIUS)
    assert np.isnan(found[0, :, 0]).all()
    assert np.isfinite(found[0, :, SECTORS // 2]).all()


@pytest.mark.parametrize("moved", [(1.2, 0.0, 0.0), (0.0, 0.0, -DISTANCE), (0.0, 0.0, -9.0)])
def test_a_body_at_the_edge_or_behind_the_camera_tells_nothing(moved: tuple[float, ...]) -> None:
    vertices, faces = tubes(0.0)
    everything = np.ones((SIZE, SIZE), np.bool_)
    found = reach_in_picture(vertices + np.array(moved), faces, CAMERA, everything, ~everything, 0.004)
    assert np.isnan(found).all()


def observed(visible: NDArray[np.bool_]) -> ObservedFrame:
    vertices, _ = tubes(0.0)
    pixels = FOCAL * vertices[:, :2] / vertices[:, 2:] + SIZE / 2
    posed = PosedBody(vertices, np.zeros((18, 3)), ProjectedMesh(pixels, vertices[:, 2]))
    nothing = np.zeros_like(visible)
    return ObservedFrame(0, lambda: posed, Evidence(nothing, ~visible, nothing, 0.0, False, 0.0))


def test_the_median_of_the_frames_less_a_margin() -> None:
    visible = [shown(-RADIUS - loose, RADIUS + loose) for loose in (0.0, 0.1, 0.1, 0.12, 0.28)]
    frames = [SimpleNamespace(visible_mask=torch.from_numpy(each), camera=CAMERA) for each in visible]
    body = cast(Any, SimpleNamespace(faces=torch.from_numpy(tubes(0.0)[1])))

    def measured(count: int) -> NDArray[np.float64]:
        everywhere = measure_reach(
            [observed(each) for each in visible], lambda k: cast(Any, frames[k]), body, range(count)
        )
        return everywhere.reshape(RINGS, SECTORS)[1:-1]

    found = measured(5)
    assert np.abs(found[:, SIDES] - (0.1 - MARGIN * DISTANCE / FOCAL)).max() < 0.012
    assert found.min() > 0.02  # what no frame tells has what neighbours have
    assert not measured(LEAST_LOOKS - 1).any()


def posed(
    vertices: NDArray[np.float64], visible: NDArray[np.bool_], known: NDArray[np.bool_]
) -> ObservedFrame:
    pixels = FOCAL * vertices[:, :2] / vertices[:, 2:] + SIZE / 2
    body = PosedBody(vertices, np.zeros((18, 3)), ProjectedMesh(pixels, vertices[:, 2]))
    nothing = np.zeros_like(visible)
    return ObservedFrame(0, lambda: body, Evidence(nothing, known & ~visible, nothing, 0.0, False, 0.0))


def fitted(
    thickness: float,
    lean: float,
    known: NDArray[np.bool_] | None = None,
    bare: NDArray[np.bool_] | None = None,
) -> NDArray[np.float64]:
    """What is found of a tube that leans in the picture and wears clothes of a thickness, `[rings, sectors]`.

    In each frame its edge falls elsewhere in its pixels.
    """
    vertices, faces = tubes(0.0)
    known = np.ones((SIZE, SIZE), np.bool_) if known is None else known
    c, s = np.cos(lean), np.sin(lean)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    straight = vertices - (0.0, 0.0, DISTANCE)
    looks, frames = [], []
    for shift in (0.0, 0.0023, 0.0041, 0.0068):
        worn = straight * ((RADIUS + thickness) / RADIUS, 1.0, (RADIUS + thickness) / RADIUS)
        body, dressed = (each @ turn.T + (shift, 0.0, DISTANCE) for each in (straight, worn))
        pixels = FOCAL * dressed[:, :2] / dressed[:, 2:] + SIZE / 2
        shown = rasterize_mesh(pixels, dressed[:, 2], faces, SIZE, SIZE).face != NO_FACE
        looks.append(posed(body, shown & known, known))
        frames.append(SimpleNamespace(visible_mask=torch.from_numpy(shown & known), camera=CAMERA))
    mesh = cast(Any, SimpleNamespace(faces=torch.from_numpy(faces), num_vertices=len(vertices)))
    found = fit_thickness(looks, lambda k: cast(Any, frames[k]), mesh, range(len(looks)), bare)
    return found.reshape(RINGS, SECTORS)


@pytest.mark.parametrize("lean", [0.0, 0.3, np.pi / 4, 1.2])
@pytest.mark.parametrize("thickness", [0.0, 0.013, 0.04])
def test_tight_clothes_to_a_fraction_of_a_pixel_however_the_outline_runs(
    lean: float, thickness: float
) -> None:
    """A pixel is a centimetre. The ends of the tube are open and are left out."""
    found = fitted(thickness, lean)[2:-2, SIDES]
    assert np.abs(found - thickness).max() < 0.004


def test_a_body_that_is_wider_than_the_person_wears_nothing() -> None:
    assert not fitted(-0.03, 0.2).any()


def test_clothes_that_an_occluder_may_hide_are_those_of_neighbours() -> None:
    known = np.ones((SIZE, SIZE), np.bool_)
    known[SIZE // 2 - 8 : SIZE // 2 + 8] = False  # a strip across the middle
    found = fitted(0.03, 0.0, known)[2:-2, SIDES]
    assert np.abs(found - 0.03).max() < 0.008
    assert not fitted(0.03, 0.0, np.zeros_like(known)).any()


@pytest.mark.parametrize("moved", [(9.0, 0.0, 0.0), (0.0, 0.0, -9.0), (0.0, 0.0, 0.15 - DISTANCE)])
def test_a_body_that_has_no_outline_wears_nothing(moved: tuple[float, ...]) -> None:
    """Beside the picture, behind the camera, and filling the picture."""
    vertices, faces = tubes(0.0)
    everything = np.ones((SIZE, SIZE), np.bool_)
    frame = cast(Any, SimpleNamespace(visible_mask=torch.from_numpy(everything), camera=CAMERA))
    mesh = cast(Any, SimpleNamespace(faces=torch.from_numpy(faces), num_vertices=len(vertices)))
    looks = [posed(vertices + np.array(moved), everything, everything)]
    assert not fit_thickness(looks, lambda _: frame, mesh, range(1)).any()


def test_a_bare_place_is_bare_unless_outlines_show_otherwise() -> None:
    bare = np.zeros((RINGS, SECTORS), np.bool_)
    bare[3:6, 20:29] = True  # towards the camera
    found = fitted(0.03, 0.0, bare=bare.ravel())
    assert found[4, 24] < 0.012 and found[2:-2, SIDES].min() > 0.022
    bare[:, SIDES] = True
    assert fitted(0.03, 0.0, bare=bare.ravel())[2:-2, SIDES].min() > 0.022


def test_the_face_is_from_chin_to_brow() -> None:
    points, face = BODY.v_template.double().numpy(), face_of(BODY)
    head = (BODY.weights[:, HEAD] > 0.5).numpy()
    nose, right_eye, left_eye, *ears = face_vertices(BODY)
    assert face[[nose, right_eye, left_eye]].all() and not face[ears].any()
    assert not face[~head].any()
    top, chin = points[head, 1].max(), points[face, 1].min()
    assert points[face, 1].max() < top - 0.05 and points[nose, 1] - 0.08 < chin
    assert np.median(points[face, 2]) > np.quantile(points[head, 2], 0.6)
    assert points[face, 0].mean() == pytest.approx(points[head, 0].mean(), abs=0.005)


def test_what_is_spread_over_a_mesh() -> None:
    _, faces = tubes(0.0)
    count = RINGS * SECTORS
    weight = np.zeros(count)
    weight[::7] = 1.0
    assert np.allclose(spread_over_mesh(3.0 * weight, weight, faces), 3.0)
    assert np.allclose(spread_over_mesh(np.zeros(count), np.zeros(count), faces, (0.2, 0.5)), 0.2)
    upper = np.where(np.arange(count) < count // 2, 1.0, 0.0)
    found = spread_over_mesh(upper, np.ones(count), faces).reshape(RINGS, SECTORS).mean(axis=1)
    assert (np.diff(found) <= 1e-12).all() and 0.0 < found[-1] < found[0] < 1.0


@pytest.mark.parametrize(
    ("name", "least", "most"), [("003-clean-front", 0.05, 0.25), ("011-clean-front", 0.0, 0.03)]
)
def test_a_dressed_person_wears_a_skirt_or_none(name: str, least: float, most: float) -> None:
    """The quarter of the thighs that clothes reach farthest from: between the legs, and beside them."""
    scene = Scene(replace(SceneSpec.parse(name), image_size=128, frames=24, cameras=1))
    camera = scene.cameras[0]
    view = Camera(torch.from_numpy(camera.viewmat), torch.from_numpy(camera.K), 128, 128)
    template = BODY.da_vertices().numpy()
    thighs = (template[:, 1] > -0.4) & (template[:, 1] < -0.2)
    found = []
    for k in range(0, 24, 3):
        mask = next(scene.shots(k)).mask
        vertices = scene.parameters(k).vertices
        found.append(reach_in_picture(vertices, BODY.faces.numpy(), view, mask, ~mask, 0.01)[thighs])
    each = np.stack(found)
    told = each[:, np.isfinite(each).sum(axis=0) >= LEAST_LOOKS]
    assert least <= np.percentile(np.nanmedian(told, axis=0), 75) <= most
