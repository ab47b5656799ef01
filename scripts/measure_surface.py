"""How far Gaussians lie from the true surface, and how opaque they are, by how well the video shows their place.

python scripts/measure_surface.py RUN [RUN ...]        # prints a CSV

For runs on embedded scenes in ZJU-MoCap's layout. The avatar is put into the rest pose, beside the dressed person
there; places are those of `geometry.coverage`, each Gaussian at its nearest vertex. The true surface is a million
points drawn on it, so distances are too large by half a millimetre at most. Bodies of `hard` scenes have another shape
on disk: their distances hold that as well.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree

from occfusion.geometry.coverage import CLASSES
from occfusion.run.loaded import load_run
from occfusion.run.prepare import observe
from occfusion.synth.dress import dress
from occfusion.synth.subject import make_subject
from occfusion.types import Pose

POINTS = 1_000_000
COLUMNS = ("run", "places", "share", "p50_mm", "p95_mm", "opacity", "faint_share")
FAINT = 0.3
"""Opacity below which a Gaussian is counted as faint."""


@torch.no_grad()
def measure(folder: Path) -> list[dict[str, object]]:
    """Returns a row for each class of places."""
    run = load_run(folder)
    scene = str(run.settings.dataset.scene)
    figure = dress(make_subject(int(scene.split("-")[0])))
    surface = trimesh.Trimesh(figure.rest, figure.faces, process=False)
    points, _ = trimesh.sample.sample_surface(surface, POINTS, seed=0)
    avatar = run.avatar.eval()
    avatar.pose_refiner = avatar.pose_spline = None  # the rest pose is exact
    rest = Pose(run.betas, torch.zeros(3), torch.zeros(69), torch.zeros(3))
    means = avatar.deform(rest).means.double().numpy()
    distance = 1000.0 * cKDTree(points).query(means)[0]
    coverage = observe(run.settings).coverage
    if coverage is None:
        raise SystemExit(f"{folder}: no view shows the body")
    classes = coverage.coverage.classes[avatar.gaussians.vertex_index.numpy()]
    opacity = avatar.gaussians.opacities.double().numpy()
    rows: list[dict[str, object]] = []
    for name, number in CLASSES.items():
        own = classes == number
        if not own.any():
            continue
        p50, p95 = np.percentile(distance[own], [50, 95])
        rows.append(
            {
                "run": f"{scene}/{folder.resolve().name}", "places": name, "share": f"{own.mean():.3f}",
                "p50_mm": f"{p50:.1f}", "p95_mm": f"{p95:.1f}", "opacity": f"{opacity[own].mean():.3f}",
                "faint_share": f"{(opacity[own] < FAINT).mean():.3f}",
            }
        )  # fmt: skip
    return rows


def main() -> None:
    if len(sys.argv) < 2:
        raise SystemExit(__doc__)
    writer = csv.DictWriter(sys.stdout, COLUMNS)
    writer.writeheader()
    for folder in map(Path, sys.argv[1:]):
        writer.writerows(measure(folder))


if __name__ == "__main__":
    main()
