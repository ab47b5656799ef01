from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from occfusion.errors import CheckpointError
from occfusion.files.run_folder import RunFolder
from occfusion.files.table import read_table
from occfusion.report.page import _smoothed, markdown_table, plot_error_vs_time, plot_losses, write_report
from occfusion.report.tables import print_comparison, print_summary

NOTHING = {"psnr": None, "ssim": None, "lpips": None, "mask_iou": None}
METRICS = {
    "dataset": "synthetic", "scene": "101-hard", "variant": "A", "images": 12,
    "regions": {
        "full": {"psnr": 27.123, "ssim": 0.98765, "lpips": 0.0421, "mask_iou": 0.951,
                 "images": 12, "psnr_capped": 2},
        "box": NOTHING, "visible": NOTHING, "hidden": NOTHING,
    },
    "perceptual_metric": "ST-LPIPS (VGG)",
    "train_seconds": {"init": None, "optim": 61.25, "refine": None, "total": 61.25},
    "gaussians": 6890, "peak_memory_mb": 812.4, "left_out": ["stage init"],
}  # fmt: skip


@pytest.fixture
def run_dir(tmp_path):
    folder = tmp_path / "a run"
    (folder / "pictures").mkdir(parents=True)
    (folder / "pictures" / "held_out.png").write_bytes(b"")
    (folder / "metrics.json").write_text(json.dumps(METRICS))
    decision = {"part": "stage init", "used": False, "reason": "variant A | does not need it"}
    (folder / "plan.json").write_text(json.dumps({"decisions": [decision]}))
    (folder / "environment.json").write_text(json.dumps({"threads": 2, "packages": {"torch": "2.13.0"}}))
    (folder / "error_vs_time.csv").write_text(
        "stage,step,train_seconds,wall_seconds,psnr,ssim,lpips,mask_iou,gaussians,peak_memory_mb\n"
        "optim,0,0,1,10.5,0.5,,0.1,6890,300\n"
        "optim,40,2.5,4,20.25,0.9,,0.8,6890,310\n"
    )
    return folder


def test_report_holds_figures_under_their_real_names(run_dir):
    text = write_report(RunFolder(run_dir)).read_text()
    assert "ST-LPIPS (VGG) x1000" in text
    assert not re.search(r"(?<!ST-)LPIPS", text)
    row = next(line for line in text.splitlines() if line.startswith("| full"))
    assert [cell.strip() for cell in row.split("|")[2:-1]] == ["12", "27.12", "0.9877", "42.1", "0.951"]
    hidden = next(line for line in text.splitlines() if line.startswith("| hidden"))
    assert [cell.strip() for cell in hidden.split("|")[2:-1]] == ["-"] * 5
    assert "2 images reached the cap" in text
    assert "61.2 s (optim 61.2)" in text
    assert "variant A \\| does not need it" in text


def test_links_are_relative_and_lead_to_files(run_dir):
    text = write_report(RunFolder(run_dir)).read_text()
    links = re.findall(r"!\[.*?\]\((.*?)\)", text)
    assert sorted(links) == ["error_vs_time.png", "pictures/held_out.png"]
    assert all((run_dir / link).is_file() for link in links)


def test_curve_is_drawn(run_dir, tmp_path):
    plot_error_vs_time(read_table(run_dir / "error_vs_time.csv"), tmp_path / "curve.png", "ST-LPIPS (VGG)")
    picture = cv2.imread(str(tmp_path / "curve.png"))
    # three panels: the perceptual column is empty
    assert picture.shape[1] > 2.5 * picture.shape[0]
    assert np.ptp(picture) == 255


def test_losses_are_drawn_stage_after_stage(run_dir):
    rows = [f"optim,{k},{10 / k},{0.1 / k},,0.01,7" for k in range(1, 161)]
    rows += [f"refine,{k},{1 / k},{0.01 / k},{0.2 if k % 8 == 1 else ''},0.01,7" for k in range(1, 81)]
    (run_dir / "losses.csv").write_text(
        "\n".join(["stage,step,total,rgb,lpips,rate_means,gaussians", *rows]) + "\n"
    )
    text = write_report(RunFolder(run_dir)).read_text()
    assert "![losses](losses.png)" in text and "mean of 50 steps" in text
    picture = cv2.imread(str(run_dir / "losses.png"))
    assert picture.shape[1] > 3 * picture.shape[0]  # a row of three panels
    ink = [np.ptp(panel) for panel in np.array_split(picture, 3, axis=1)]
    assert min(ink) == 255
    steps, values = _smoothed(
        [{"step": str(k), "a": "2" if k > 50 else "1", "b": ""} for k in range(1, 101)], "a", 10
    )
    assert (steps, values) == ([35.5, 85.5], [1.0, 2.0])


def test_a_loss_table_without_rows_is_not_drawn(tmp_path):
    (tmp_path / "losses.csv").write_text("stage,step,total,rgb,gaussians\n")
    for table in ("losses.csv", "none.csv"):
        assert not plot_losses(read_table(tmp_path / table), tmp_path / "losses.png")
    assert not (tmp_path / "losses.png").exists()


def test_a_run_without_curve_plan_or_pictures(tmp_path):
    (tmp_path / "metrics.json").write_text(json.dumps(METRICS | {"perceptual_metric": None}))
    text = write_report(RunFolder(tmp_path)).read_text()
    assert "![" not in text and "perceptual x1000" in text


def test_a_folder_that_is_no_run(tmp_path):
    with pytest.raises(CheckpointError, match=r"metrics\.json"):
        write_report(RunFolder(tmp_path))
    (tmp_path / "metrics.json").write_text("{")
    with pytest.raises(CheckpointError, match="not readable JSON"):
        write_report(RunFolder(tmp_path))


def test_names_in_brackets_are_printed_whole(capsys):
    """A terminal's library takes words in brackets for styles."""
    run = METRICS | {"scene": "clip [final]"}
    print_summary(Path("runs/[final]/E"), run)
    print_comparison([run])
    said = capsys.readouterr().out
    assert "run folder: runs/[final]/E" in said and "occfusion view runs/[final]/E" in said
    assert said.count("clip [final]") == 2


def test_markdown_table_escapes_bars():
    assert markdown_table(["a", "b"], [["x|y", "1"]]).splitlines() == [
        "| a | b |",
        "| --- | ---: |",
        "| x\\|y | 1 |",
    ]
