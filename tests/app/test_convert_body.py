"""`occfusion convert-body`: from the official pickle to a safe file, once."""

from __future__ import annotations

import os
import pickle

import numpy as np
import pytest

from files.test_bodyfile import VERTICES, content, official_pickle
from occfusion.__main__ import main
from occfusion.files.bodyfile import load_body_arrays


@pytest.mark.parametrize("suffix", [".npz", ".safetensors"])
@pytest.mark.parametrize("shapes", [10, 300])
def test_the_official_pickle_becomes_a_safe_file(tmp_path, capsys, suffix, shapes):
    source = official_pickle(tmp_path / "SMPL_NEUTRAL.pkl", content(shapes), 2)
    target = tmp_path / f"smpl{suffix}"
    assert main(["convert-body", str(source), str(target)]) == 0
    said = capsys.readouterr().out
    assert f"{VERTICES} vertices (SMPL has 6890), {shapes} shape components, with pose blend shapes" in said
    before, after = load_body_arrays(source), load_body_arrays(target)
    for key in before.__dataclass_fields__:
        np.testing.assert_allclose(getattr(after, key), getattr(before, key), atol=1e-6)
    if suffix == ".npz":
        with np.load(target, allow_pickle=False) as archive:
            assert "v_template" in archive and archive["v_template"].dtype == np.float32


def test_what_is_there_is_kept(tmp_path, capsys):
    source = official_pickle(tmp_path / "a.pkl", content(), 2)
    target = tmp_path / "b.npz"
    target.write_text("mine")
    assert main(["convert-body", str(source), str(target)]) == 1
    assert "--force" in capsys.readouterr().err and target.read_text() == "mine"
    assert main(["convert-body", str(source), str(target), "--force"]) == 0
    assert main(["convert-body", str(source), str(tmp_path / "b.pkl")]) == 1
    assert "ends in .npz or .safetensors" in capsys.readouterr().err


def test_code_does_not_run_and_nothing_is_written(tmp_path, capsys):
    class Runs:
        def __reduce__(self):
            return os.system, (f"touch {tmp_path / 'ran'}",)

    source, target = tmp_path / "a.pkl", tmp_path / "b.npz"
    source.write_bytes(pickle.dumps({"v_template": Runs()}))
    assert main(["convert-body", str(source), str(target)]) == 1
    assert "not allowed" in capsys.readouterr().err
    assert not target.exists() and not (tmp_path / "ran").exists()
