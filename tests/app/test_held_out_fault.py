"""A bad held-out file that only decoding shows is told when it is measured; mending it costs no training."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import pytest

from app.conftest import SCENE, run_tiny
from occfusion.errors import DataError
from occfusion.files.run_folder import RunFolder
from occfusion.run import optim

OPTIONS = ("stage=optim", "optim.steps=2", "evaluation.curve=false", "evaluation.pictures=false")


def test_mending_it_does_not_cost_the_run(
    scene_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(scene_root / SCENE, tmp_path / SCENE)
    (mask,) = sorted((tmp_path / SCENE / "mask").glob("*/000009.png"))[1:2]
    picture, whole = cv2.imread(str(mask), cv2.IMREAD_UNCHANGED), mask.read_bytes()
    middle = len(whole) // 2
    mask.write_bytes(
        whole[:middle] + bytes(255 - byte for byte in whole[middle : middle + 4]) + whole[middle + 4 :]
    )
    folder = RunFolder(tmp_path / "run")
    with pytest.raises(DataError, match=rf"{mask.parent.name}/000009\.png"):
        run_tiny(tmp_path, folder.path, *OPTIONS)
    assert folder.stage("optim").has_avatar and not folder.metrics.is_file()

    def trained_again(*_: object) -> None:
        raise AssertionError("the run was lost")

    monkeypatch.setattr(optim, "_train", trained_again)
    cv2.imwrite(str(mask), picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    assert mask.stat().st_size != len(whole), "another file, as one from another source would be"
    _, metrics = run_tiny(tmp_path, folder.path, *OPTIONS)
    assert metrics["images"] == 4
