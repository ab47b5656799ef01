"""Damaged tables through everything before the first step of training, and through `occfusion check`."""

from __future__ import annotations

import argparse
from contextlib import suppress

import numpy as np
import pytest

from data.mutations import mutated_value
from data.test_bad_input import Copy
from data.test_bad_input import pristine as pristine
from data.test_bad_input import source as source
from data.test_fuzz import TABLES
from occfusion.cli.check import _inspect
from occfusion.data.checking.fit import draw_overlay
from occfusion.errors import OccfusionError

MANY = 40


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("table", TABLES)
def test_damaged_tables_are_refused_or_trained_on(table, pristine, source, tmp_path, monkeypatch):
    layout, file, load, save = TABLES[table]
    scene = Copy(layout, pristine, tmp_path, source)
    path = scene.folder / file
    content, rng = load(path), np.random.default_rng([2, *table.encode()])
    arguments = argparse.Namespace(
        body=source.folder / "body.npz",
        camera=0,
        masks=None,
        person=None,
        scene="0013_02",
        numbered_masks=False,
        layout="auto",
    )
    monkeypatch.chdir(tmp_path)
    scene.module().frame_at(0)  # else every refusal would be for another reason
    refused = 0
    for _ in range(MANY):
        try:
            save(path, mutated_value(content, rng, json_only=table == "metadata"))
        except (TypeError, ValueError):  # this format cannot hold such a value
            continue
        try:
            data = scene.module()
            data.validate()
            data.summary()
            data.frame_at(0)
        except OccfusionError:
            refused += 1
        with suppress(OccfusionError):
            findings, look = _inspect(scene.folder, arguments)
            assert findings
            if look is not None:
                draw_overlay(look)
    assert 0 < refused < MANY
    assert not (tmp_path / "RAN").exists()
