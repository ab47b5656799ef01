from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from occfusion.synth.atlas import LAYERS, fill, halvings, load_atlas
from occfusion.synth.dress import dress
from occfusion.synth.fullbody import SKIN, load_full_body
from occfusion.synth.light import KEY_DIRECTION, Lighting, light_vertices
from occfusion.synth.noise import value_noise
from occfusion.synth.paint import paint
from occfusion.synth.subject import make_subject

EVERYBODY = (*range(12), *range(100, 106))


@pytest.mark.parametrize("number", [0, 1, 101, 999])
def test_a_number_is_always_the_same_person(number: int) -> None:
    one, other = (dataclasses.asdict(make_subject(number)) for _ in range(2))
    for key, value in one.items():
        np.testing.assert_array_equal(value, other[key])


def test_people_differ() -> None:
    people = [make_subject(n) for n in EVERYBODY]
    for trait in ("pattern", "bottom", "hair_style", "neckline", "has_belt"):
        assert len({getattr(p, trait) for p in people}) > 1, trait
    assert len({tuple(p.skin.round(2)) for p in people}) > 6
    assert len({tuple(p.betas.round(3)) for p in people}) == len(people)
    for group in (people[:12], people[12:]):
        assert any(p.bottom == "skirt" for p in group)
        assert any(p.bottom == "loose" for p in group)


def test_heights_are_those_of_grown_people() -> None:
    body = load_full_body()
    own = body.vertex_group == SKIN
    heights = [np.ptp((body.template + body.shapedirs @ make_subject(n).betas)[own, 1]) for n in range(60)]
    assert 1.48 < min(heights) < 1.62
    assert 1.80 < max(heights) < 1.98


def test_negative_numbers_are_refused() -> None:
    with pytest.raises(ValueError, match="start at 0"):
        make_subject(-1)


def test_clothes_stand_off_and_skin_stays() -> None:
    subject = make_subject(1)
    figure, body = dress(subject), load_full_body()
    assert 0.003 < figure.cloth[figure.cloth > 0.001].mean() < 0.02
    bare = (figure.cloth == 0) & (figure.hanging == 0)
    shaped = body.template + body.shapedirs @ subject.betas
    rest = {tuple(p): r for p, r in zip(body.template.round(9), shaped, strict=True)}
    face = bare & (figure.template[:, 2] > 0.09) & (np.abs(figure.template[:, 1] - 0.65) < 0.04)
    assert face.sum() > 100
    for template, point in zip(figure.template[face].round(9), figure.rest[face], strict=True):
        np.testing.assert_allclose(point, rest[tuple(template)], atol=1e-9)
    assert np.isfinite(figure.rest).all()
    assert figure.faces.max() < len(figure.rest)


def test_a_skirt_leaves_the_body_s_outline() -> None:
    figure = dress(make_subject(3))
    assert (figure.hanging > 0.5).sum() > 100
    assert not (dress(make_subject(2)).hanging > 0).any()


def test_texture_is_complete() -> None:
    texture = paint(make_subject(2), 4.0)
    assert texture.shape == (LAYERS, 256, 256, 3)
    assert np.isfinite(texture).all() and texture.min() >= 0 and texture.max() <= 1
    assert texture[0].std() > 0.1


def test_coarse_textures_are_fine_ones_averaged() -> None:
    fine, coarse = (paint(make_subject(0), texel) for texel in (4.0, 8.0))
    averaged = fine.reshape(LAYERS, 128, 2, 128, 2, 3).mean((2, 4))
    painted = np.zeros(LAYERS * 128 * 128, bool)
    painted[load_atlas(128).texels] = True
    assert np.abs(averaged - coarse)[painted.reshape(LAYERS, 128, 128)].mean() < 0.03


def test_filling_leaves_no_hole() -> None:
    atlas = load_atlas(256)
    filled = fill(atlas, np.full((len(atlas.texels), 3), 0.5), 1)
    assert filled.shape == (LAYERS, 128, 128, 3)
    np.testing.assert_allclose(filled, 0.5, atol=1e-5)  # one colour in, no black between the islands


def test_resolution_follows_the_picture() -> None:
    assert [halvings(t) for t in (0.1, 1.0, 1.9, 2.0, 7.0, 1e9)] == [0, 0, 0, 1, 2, 4]


def test_value_noise_is_smooth_bounded_and_seeded() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (4000, 3))
    noise = value_noise(points, 0.1, 3)
    assert np.abs(noise).max() <= 1.0 and noise.std() > 0.2
    near = value_noise(points + 1e-6, 0.1, 3)
    assert np.abs(noise - near).max() < 1e-3
    assert np.abs(noise - value_noise(points, 0.1, 4)).max() > 0.5


def test_light_without_shadows_is_lambert_s() -> None:
    figure = dress(make_subject(1))
    light = light_vertices(figure.rest, figure.faces, Lighting(0.78, shadows=False))
    assert light.min() == pytest.approx(0.78)
    assert 0.97 < light.max() <= 1.0
    turned = light_vertices(figure.rest * [-1, -1, 1], figure.faces, Lighting(0.78, shadows=False))
    assert np.abs(light - turned).max() > 0.1  # the lamp stays where it is


def test_shadows_only_take_light_away() -> None:
    figure = dress(make_subject(1))
    turned = figure.rest @ np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
    plain = light_vertices(turned, figure.faces, Lighting(0.6, shadows=False))
    shaded = light_vertices(turned, figure.faces, Lighting(0.6, shadows=True))
    assert (shaded <= plain + 1e-9).all()
    assert (plain - shaded).mean() > 0.01
    assert np.linalg.norm(KEY_DIRECTION) == pytest.approx(1.0)
