"""How well a video shows a body, in parts and in words, on embedded people."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from occfusion.geometry.coverage import MANY, UNSEEN, Coverage, Sighting
from occfusion.human import embedded_body
from occfusion.human.coverage import BodyCoverage, body_parts, cover_body, in_words
from occfusion.human.coverage_picture import COLOURS, draw_coverage
from occfusion.synth import SceneSpec
from occfusion.synth.scene import Scene

BODY = embedded_body()


def covered(name: str) -> BodyCoverage:
    scene = Scene(replace(SceneSpec.parse(name), image_size=128, frames=24, cameras=1))
    camera = scene.cameras[0]
    found = cover_body(
        (
            Sighting.through(
                scene.parameters(k).vertices, camera.viewmat, camera.K, next(scene.shots(k)).mask
            )
            for k in range(24)
        ),
        BODY,
    )
    assert found is not None
    return found


@pytest.fixture(scope="module")
def scenes() -> dict[str, BodyCoverage]:
    return {name: covered(name) for name in ("003-clean", "003-clean-front", "003-clean-back")}


def test_who_turns_is_seen_from_many_directions(scenes):
    shares = scenes["003-clean"].shares()
    assert shares["seen_many"] > 0.75 and shares["unseen"] < 0.15
    assert sum(shares.values()) == pytest.approx(1.0)
    assert not any("back" in text for text in scenes["003-clean"].warnings())


def test_who_does_not_turn_hides_the_other_side(scenes):
    front, back = scenes["003-clean-front"], scenes["003-clean-back"]
    assert front.shares("back")["unseen"] > 0.9 and front.shares("chest and belly")["unseen"] < 0.1
    assert back.shares("back")["unseen"] < 0.1 and back.shares("chest and belly")["unseen"] > 0.9
    assert front.shares("chest and belly")["seen_one"] > 0.7
    assert "nobody sees the back" in front.warnings()[0] and "guess" in front.warnings()[0]
    assert "chest" in front.warnings()[1] and "one direction" in front.warnings()[1]
    assert "the chest and belly" in back.warnings()[0]
    assert front.spread() < 40 < scenes["003-clean"].spread()


def test_the_summary_says_the_same_in_numbers(scenes):
    told = scenes["003-clean-front"].json()
    assert told["views"] == 24 and len(told["parts"]) == 12
    assert told["seen_many"] + told["seen_one"] + told["unseen"] == pytest.approx(1.0, abs=1e-3)
    assert told["warnings"] == scenes["003-clean-front"].warnings()


def test_nothing_seen_has_no_spread():
    count = len(BODY.v_template)
    nothing = Coverage(3, np.zeros(count), np.full(count, np.nan), *np.zeros((2, count, 3, 3)))
    blind = BodyCoverage(nothing, body_parts(BODY), np.ones(count))
    assert blind.spread() is None and blind.json()["spread_degrees"] is None
    assert blind.shares() == {"seen_many": 0.0, "seen_one": 0.0, "unseen": 1.0}


def test_parts_lie_where_their_names_say():
    parts, points = body_parts(BODY), BODY.v_template.numpy()
    assert len(set(parts)) == 12
    assert points[parts == "face"][:, 1].min() > points[parts == "back"][:, 1].mean()
    assert (
        points[parts == "front of the left arm"][:, 0].min()
        > 0
        > points[parts == "back of the right arm"][:, 0].max()
    )
    assert points[parts == "chest and belly"][:, 2].mean() > points[parts == "back"][:, 2].mean()
    assert points[parts == "front of the left leg"][:, 1].mean() < points[parts == "back"][:, 1].mean()


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        (["back"], "the back"),
        (["face", "back of the head"], "the head"),
        (["front of the left arm", "back of the left arm"], "the left arm"),
        (["back of the left leg", "back of the right leg", "back"], "the back and the back of both legs"),
        (
            [f"{s} of the {a} leg" for s in ("front", "back") for a in ("left", "right")],
            "both legs",
        ),
    ],
)
def test_parts_in_words(parts, words):
    assert in_words(parts) == words


def test_the_picture_shows_four_sides_in_their_colours(scenes):
    picture = draw_coverage(BODY, scenes["003-clean-front"])
    columns = picture.shape[1] // 4
    views = [picture[30:440, k * columns : (k + 1) * columns].reshape(-1, 3).astype(int) for k in range(4)]

    def reds(pixels) -> float:
        body = pixels.min(axis=1) < 250
        hue = pixels[body] / pixels[body].max(axis=1, keepdims=True)
        wanted = np.array(COLOURS[UNSEEN]) / max(COLOURS[UNSEEN])
        return float((np.abs(hue - wanted).max(axis=1) < 0.1).mean())

    front, _, back, _ = (reds(pixels) for pixels in views)
    assert front < 0.2 and back > 0.7
    assert COLOURS[MANY] != COLOURS[UNSEEN]
