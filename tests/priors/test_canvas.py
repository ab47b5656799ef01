"""The canvas of a skeleton: where it has which colour, and what is left out."""

import numpy as np
import pytest
import torch

from made_up_person import FRONT, made_up_observation
from occfusion.geometry.camera import project_vertices
from occfusion.observation.bodyview import view_body
from occfusion.observation.keypoints import LIMBS, MIRRORED, NAMES, see_keypoints
from occfusion.priors.sd15.canvas import COLORS, LIMB_BRIGHTNESS, draw_canvas, draw_keypoints

ALL = np.ones(18, bool)
PIXELS = FRONT * (400.0, 440.0) + (256.0, 30.0)
WRISTS = (NAMES.index("r_wrist"), NAMES.index("l_wrist"))


def at(canvas: np.ndarray, point: np.ndarray) -> tuple[int, ...]:
    x, y = np.floor(point).astype(int)
    return tuple(int(value) for value in canvas[y, x])


def area(canvas: np.ndarray) -> int:
    return int(canvas.any(axis=-1).sum())


def only(*names: str) -> np.ndarray:
    return np.isin(NAMES, names)


def test_canvas_is_rgb_on_black() -> None:
    canvas = draw_canvas(PIXELS, ALL, 520, 512)
    assert canvas.shape == (512, 520, 3) and canvas.dtype == np.uint8
    assert not canvas[:, :100].any() and not canvas[:20].any()


def test_each_joint_has_its_colour_at_its_place() -> None:
    canvas = draw_canvas(PIXELS, ALL, 512, 512)
    for k in range(18):
        assert at(canvas, PIXELS[k]) == COLORS[k], NAMES[k]


def test_limbs_have_the_colours_of_openpose_dimmed() -> None:
    for k, (start, end) in enumerate(LIMBS):
        two = np.zeros(18, bool)
        two[[start, end]] = True
        points = PIXELS.copy()
        points[start], points[end] = (100.0, 100.0), (200.0, 300.0)
        canvas = draw_canvas(points, two, 512, 512)
        assert at(canvas, np.array([150.0, 200.0])) == tuple(int(LIMB_BRIGHTNESS * c) for c in COLORS[k])


def test_sizes_at_the_size_of_controlnets_training() -> None:
    joint = draw_canvas(np.full((18, 2), 100.0), only("neck"), 512, 512)
    assert area(joint) == pytest.approx(np.pi * 4.0**2, rel=0.35)
    points = PIXELS.copy()
    points[2], points[3] = (100.0, 100.5), (300.0, 100.5)
    limb = draw_canvas(points, only("r_shoulder", "r_elbow"), 512, 512)
    assert limb[:, 200].any(axis=-1).sum() == pytest.approx(8, abs=1)
    assert limb.any(axis=(0, 2)).nonzero()[0][[0, -1]] == pytest.approx([96, 304], abs=1)


@pytest.mark.parametrize("factor", [0.25, 0.5, 2.0])
def test_thickness_grows_with_the_canvas(factor: float) -> None:
    large = draw_canvas(PIXELS, ALL, 512, 512)
    scaled = draw_canvas(PIXELS * factor, ALL, round(512 * factor), round(512 * factor))
    share = area(scaled) / scaled[..., 0].size
    # cv2 fills each pixel that an outline touches, which counts more the thinner a limb is
    assert share == pytest.approx(area(large) / large[..., 0].size, rel=0.1 / min(factor, 1.0))


def test_dropped_joint_takes_its_limbs_with_it() -> None:
    canvas = draw_canvas(PIXELS, ALL & ~only("r_elbow"), 512, 512)
    upper, lower = 0.5 * (PIXELS[2] + PIXELS[3]), 0.5 * (PIXELS[3] + PIXELS[4])
    for point in (PIXELS[3], upper, lower):
        assert at(canvas, point) == (0, 0, 0)
    assert at(canvas, PIXELS[2]) == COLORS[2] and at(canvas, PIXELS[4]) == COLORS[4]


def test_limb_needs_both_ends() -> None:
    one = area(draw_canvas(PIXELS, only("l_knee"), 512, 512))
    far = area(draw_canvas(PIXELS, only("l_knee", "r_wrist"), 512, 512))
    limb = area(draw_canvas(PIXELS, only("l_knee", "l_ankle"), 512, 512))
    assert far == pytest.approx(2 * one, abs=4)  # by where a disc lies between pixels
    assert limb > 4 * one
    assert area(draw_canvas(PIXELS, ~ALL, 512, 512)) == 0


def test_mirrored_body_mirrors_the_canvas_up_to_colours() -> None:
    tilted = PIXELS + np.linspace(0.0, 40.0, 18)[:, None]
    mirrored = tilted[list(MIRRORED)] * (-1.0, 1.0) + (512.0, 0.0)
    shown = ALL & ~only("r_knee", "l_ear")
    straight = draw_canvas(tilted, shown, 512, 512).any(axis=-1)
    other = draw_canvas(mirrored, shown[list(MIRRORED)], 512, 512).any(axis=-1)
    # outlines may differ by the pixel that a centre on the edge falls to
    assert (straight ^ other[:, ::-1]).sum() < 0.1 * straight.sum()


def test_points_outside_are_cut_off() -> None:
    points = PIXELS.copy()
    points[WRISTS[0]], points[WRISTS[1]] = (-300.0, 200.0), (1e9, -1e9)
    canvas = draw_canvas(points, ALL, 512, 512)
    assert at(canvas, np.array([1.0, 200.0 - (200.0 - PIXELS[3][1]) * 301 / (300 + PIXELS[3][0])])) != (
        0,
        0,
        0,
    )


def test_a_shown_point_must_be_finite() -> None:
    points = PIXELS.copy()
    points[4] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        draw_canvas(points, ALL, 64, 64)
    draw_canvas(points, ALL & ~only("r_wrist"), 64, 64)
    with pytest.raises(ValueError, match="18 key points"):
        draw_canvas(points[:17], ALL, 64, 64)


def test_joint_behind_the_body_is_not_drawn() -> None:
    frame = made_up_observation()
    camera = frame.camera
    projected = project_vertices(frame.vertices, camera.viewmat.numpy(), camera.K.numpy())
    depth = view_body(*projected, frame.faces, camera.width, camera.height).depth
    points = frame.keypoints.copy()
    points[WRISTS[0]] = (0.0, 0.2, points[0, 2] + 0.6)
    seen = see_keypoints(torch.from_numpy(points), camera, depth)
    canvas = draw_keypoints(seen, camera.width, camera.height)
    assert list(np.nonzero(~seen.shown)[0]) == [WRISTS[0]]
    colors = {tuple(int(v) for v in color) for color in canvas.reshape(-1, 3)}
    assert COLORS[WRISTS[1]] in colors and COLORS[WRISTS[0]] not in colors
