"""What a finished run hid is hidden again by a run that is given its folder."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

Train = Callable[..., tuple[Path, dict[str, Any]]]
SHORT = (
    "trainer.max_steps=2",
    "evaluation.held_out=false",
    "evaluation.curve=false",
    "evaluation.pictures=false",
)


def scene(folder: Path) -> dict[str, Any]:
    return dict(json.loads((folder / "plan.json").read_text())["scene"])


def test_the_run_folder_alone_brings_the_occlusion_back(train: Train) -> None:
    first, before = train(
        "dataset.occlusion.kind=polygons", "dataset.occlusion.seed=3", *SHORT, folder="first"
    )
    stored = first / "occlusion"
    assert len(list(stored.glob("*.png"))) == 8  # of ten frames
    again = (
        "dataset.occlusion.kind=files",
        f"dataset.occlusion.folder={stored}",
        "dataset.occlusion.fraction=0.2",
    )
    second, after = train(*again, *SHORT, folder="second")
    for key in ("hidden_boxes", "visible_share", "occluded_frames"):
        assert scene(first)[key] == scene(second)[key]
    assert len(set(scene(first)["visible_share"].values())) > 5
    assert before["regions"] == after["regions"]  # the same training on the same pixels, figure by figure
    copies = [
        {path.name: path.read_bytes() for path in (run / "occlusion").iterdir()} for run in (first, second)
    ]
    assert copies[0] == copies[1]
    none, _ = train("dataset.occlusion.kind=none", *SHORT, folder="none")
    assert not (none / "occlusion").exists()
