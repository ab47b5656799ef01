"""People whom the completion of colours is learned from: marks on one side, and what the network makes of these."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree

from occfusion.geometry.normals import vertex_normals
from occfusion.human.body import embedded_body
from occfusion.inpaint.completion import ColorCompleter, CompletionSettings
from occfusion.prior_training import completion_people
from occfusion.prior_training.completion_examples import watched
from occfusion.prior_training.completion_people import VALIDATION, mixed_subject, vertex_colours
from occfusion.synth.fullbody import load_model_body
from occfusion.synth.regions import ARM_STARTS
from occfusion.synth.subject import make_subject

SHARES = ("OTHER_PATTERN", "NO_TOP", "MARKED", "HAIRY", "MARKED_BEHIND")


def painted(monkeypatch, subject, seed, **shares):
    """Returns the colours of a person of whom `shares` alone are not 0."""
    for name in SHARES:
        monkeypatch.setattr(completion_people, name, shares.get(name, 0.0))
    return vertex_colours(subject, np.random.default_rng(seed))


def plain(number):
    return replace(make_subject(number), pattern="plain")


@pytest.mark.parametrize(("behind", "sign"), [(0.0, 1.0), (1.0, -1.0)])
@pytest.mark.parametrize("shares", [{"MARKED": 1.0}, {"MARKED": 1.0, "NO_TOP": 1.0}])
def test_marks_are_on_one_side_of_the_trunk(monkeypatch, behind, sign, shares):
    places, sizes = load_model_body().template, []
    for seed in range(12):
        subject = mixed_subject(np.random.default_rng(seed))
        with_marks = painted(monkeypatch, subject, seed, MARKED_BEHIND=behind, **shares)
        without = painted(monkeypatch, subject, seed, **{**shares, "MARKED": 0.0})
        marked = places[np.abs(with_marks - without).max(axis=1) > 0.02]
        assert (sign * marked[:, 2] > -0.02).all() and (np.abs(marked[:, 0]) < ARM_STARTS + 0.02).all(), seed
        sizes.append(len(marked))
    assert np.median(sizes) > 20, sizes


def test_a_bare_trunk_is_of_skin_and_hairy_in_front_alone(monkeypatch):
    places = load_model_body().template
    trunk = (np.abs(places[:, 0]) < 0.12) & (places[:, 1] > 0.1) & (places[:, 1] < 0.35)  # below long hair
    for number in (2, 10, 24):
        subject = plain(number)
        bare, hairy = (painted(monkeypatch, subject, 3, NO_TOP=1.0, HAIRY=share) for share in (0.0, 1.0))
        back = trunk & (places[:, 2] < -0.03)
        away = np.abs(bare[back] - subject.skin).mean()
        assert away < 0.08 < np.abs(vertex_colours(subject, None)[back] - subject.skin).mean(), number
        np.testing.assert_array_equal(hairy[places[:, 2] < -0.02], bare[places[:, 2] < -0.02])
        assert np.abs(hairy - bare).max() > 0.1


def copied(found, plain_colors, marked):
    """Returns what is found on the back of the contrast of what is in front of it, and that contrast, squared."""
    model = load_model_body()
    places, normals = model.template, vertex_normals(model.template, model.faces)
    trunk = (np.abs(places[:, 0]) < 0.17) & (places[:, 1] > 0.06) & (places[:, 1] < 0.45)
    front, back = (np.flatnonzero(trunk & (sign * normals[:, 2] > 0.3)) for sign in (1.0, -1.0))
    opposite = front[KDTree(places[front, :2]).query(places[back, :2])[1]]
    contrast = (marked - plain_colors)[opposite]
    return (contrast * (found - plain_colors)[back]).sum(), np.square(contrast).sum()


@pytest.mark.parametrize("shares", [{"MARKED": 1.0}, {"NO_TOP": 1.0, "HAIRY": 1.0}], ids=["print", "hair"])
def test_what_is_in_front_alone_is_not_copied_to_the_back(monkeypatch, shares):
    """People it has not learned from, seen from before; of all their marks' contrast, 0 none and 1 all.

    Weights that knew of no such marks copied 0.41 of prints and 0.49 of hair.
    """
    completer, found_of = ColorCompleter(embedded_body(), CompletionSettings()), []
    for number in VALIDATION:
        subject = plain(number)
        marked = painted(monkeypatch, subject, number, **shares)
        without = painted(monkeypatch, subject, number, **{**shares, "MARKED": 0.0, "HAIRY": 0.0})
        shown = watched(marked, subject.betas, np.random.default_rng(number), facing=0.0)
        found = completer.complete(shown.colors.float(), shown.seen.float()).colors
        assert torch.isfinite(found).all()
        found_of.append(copied(found.double().numpy(), without, marked))
    copies, contrasts = np.sum(found_of, axis=0)
    assert copies / contrasts < 0.25, (copies / contrasts, found_of)
