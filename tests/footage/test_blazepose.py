"""Anchors, regions and heat maps against slow, independent reckonings; the models on a rendered person."""

from __future__ import annotations

import numpy as np
import pytest

from occfusion.footage.blazepose import DETECTOR_SIDE, Region, _Look, anchors, decode, merged, refined
from occfusion.footage.landmarks import ARMS, COUNT, INDEX, LEGS, MIRRORED, NAMES


def test_anchors_are_those_of_the_graph():
    """SsdAnchorsCalculator's loops: layers of one stride together, two anchors a layer, cell by cell."""
    expected, strides, layer = [], [8, 16, 32, 32, 32], 0
    while layer < len(strides):
        last = layer
        while last < len(strides) and strides[last] == strides[layer]:
            last += 1
        cells = DETECTOR_SIDE // strides[layer]
        for y in range(cells):
            for x in range(cells):
                expected += [((x + 0.5) / cells, (y + 0.5) / cells)] * (2 * (last - layer))
        layer = last
    assert len(expected) == 2254
    np.testing.assert_allclose(anchors(), expected)


def test_boxes_are_decoded_about_their_anchor_and_merged_by_person():
    raw, logits = np.zeros((2254, 12)), np.full(2254, -9.0)
    for k in (100, 101, 2000):
        raw[k, :4], logits[k] = (2.24, 0, 22.4, 44.8), 3.0 if k == 100 else 2.0
        raw[k, 4:6] = (0, 11.2)
    boxes, scores = decode(raw, logits)
    np.testing.assert_allclose(boxes[0, :2], anchors()[100] + [0.01, 0])
    np.testing.assert_allclose(boxes[0, 2:4], [0.1, 0.2])
    np.testing.assert_allclose(boxes[0, 4:6], anchors()[100] + [0, 0.05])
    people = merged(boxes, scores)
    assert len(people) == 2 and people[0][1] == pytest.approx(1 / (1 + np.exp(-3)))


def test_a_region_turns_with_the_body():
    upright = Region.spanned(np.array([50.0, 60.0]), np.array([50.0, 20.0]))
    assert upright.turn == pytest.approx(0) and upright.side == pytest.approx(100)
    lying = Region.spanned(np.array([50.0, 60.0]), np.array([90.0, 60.0]))
    assert abs(lying.turn) == pytest.approx(np.pi / 2)
    # the upper end of the body is up in the cut-out of the region
    inverse = np.linalg.inv(np.vstack([lying.to_picture(256), [0, 0, 1]]))
    x, y, _ = inverse @ [90.0, 60.0, 1.0]
    assert x == pytest.approx(128) and y < 128


def test_heat_refines_where_it_is_sure():
    points = np.full((39, 2), 100.0)
    heat = np.full((64, 64, 39), -9.0, np.float32)
    heat[26, 24, 3] = 6.0
    out = refined(points, heat)
    np.testing.assert_allclose(out[0], 100.0)
    np.testing.assert_allclose(out[3], [24 * 4, 26 * 4], atol=0.2)


def test_sides_are_exchanged_in_pairs():
    assert (MIRRORED[MIRRORED] == np.arange(33)).all()
    assert MIRRORED[INDEX["left_knee"]] == INDEX["right_knee"] and MIRRORED[0] == 0 and len(NAMES) == 33


def look(rng: np.random.Generator) -> _Look:
    return _Look(
        0.9, rng.uniform(0, 256, (39, 2)), rng.uniform(0.5, 1.0, COUNT), rng.normal(0, 0.4, (COUNT, 3)),
        np.zeros((4, 4), np.float32),
    )  # fmt: skip


@pytest.mark.parametrize("parts", [(), (ARMS,), (LEGS,), (ARMS, LEGS)])
def test_a_look_that_takes_left_for_right_is_put_right_before_the_mean_of_two(parts):
    """As the model did with a filmed person before a real room: arms and legs of the mean lay in the middle."""
    rng = np.random.default_rng(0)
    seen = look(rng)
    order = np.arange(COUNT)
    for part in parts:
        order[part] = MIRRORED[part]
    noise = rng.normal(0, 2.0, (39, 2))
    places = np.concatenate([seen.places[order], seen.places[COUNT:]]) + noise
    other = _Look(0.8, places, seen.chance[order], seen.world[order], seen.mask)
    put_right = other.with_sides_of(seen)
    assert np.abs(put_right.places - seen.places).max() < 10.0
    np.testing.assert_array_equal(put_right.world, seen.world)
    np.testing.assert_array_equal(put_right.chance, seen.chance)


def test_a_rendered_person_is_found_with_landmarks_on_the_joints():
    pytest.importorskip("ai_edge_litert")
    from occfusion.footage.mattes import person_masks
    from occfusion.footage.people import follow
    from occfusion.synth.scene import Scene
    from occfusion.synth.spec import SceneSpec

    scene = Scene(SceneSpec(3, "clean", frames=2, cameras=1, image_size=384, turn=30))
    shots = [next(iter(scene.shots(frame))) for frame in range(2)]
    pictures = [np.clip(shot.image.astype(np.int16) + 40, 0, 255).astype(np.uint8) for shot in shots]
    track = follow(pictures, [0, 1])
    points = track.keypoints()
    camera = scene.cameras[0]
    for frame in range(2):
        body = scene.parameters(frame)
        joints = _joints(scene, body)
        local = joints @ camera.R.T + camera.T
        pixels = (local @ camera.K.T)[:, :2] / local[:, 2:]
        chosen = [INDEX["left_knee"], INDEX["right_knee"], INDEX["left_ankle"], INDEX["right_ankle"]]
        apart = np.linalg.norm(points.pixels[frame][chosen] - pixels[[4, 5, 7, 8]], axis=1)
        assert np.median(apart) < 0.04 * np.ptp(pixels[:, 1])
    masks = person_masks(pictures, track.sightings)
    for mask, shot in zip(masks, shots, strict=True):
        assert (mask & shot.mask).sum() / (mask | shot.mask).sum() > 0.85


def _joints(scene, parameters):
    from occfusion.synth.fullbody import load_model_body

    return load_model_body().regressor @ parameters.vertices
