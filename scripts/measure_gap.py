"""Where the error of somebody who does not turn lies, beside the same person turning.

python scripts/measure_gap.py FACING TURNING [FACING TURNING ...]        # runs of the same subjects; prints a CSV

Both avatars are drawn on the held-out cameras of FACING. Pixels are told apart by its coverage: places that no frame
shows, that one direction shows, that many show, and all outside of the person. Each row gives the PSNR with the pixels
of one part taken from the avatar of who turned, as if they were known as well as those; and the part's share of the
squared error, its own and that of who turned, both in units of FACING's whole error.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import numpy as np
import torch

from occfusion.geometry.coverage import CLASSES
from occfusion.human.coverage import class_of_pixels
from occfusion.run.loaded import load_run
from occfusion.run.prepare import observe

COLUMNS = ("scene", "part", "psnr", "share", "share_turning")
PARTS: dict[str, tuple[str, ...]] = {
    "none": (),
    "unseen": ("unseen",),
    "seen_one": ("seen_one",),
    "seen_many": ("seen_many",),
    "outside": ("outside",),
    "unseen, seen_one": ("unseen", "seen_one"),
    "unseen, outside": ("unseen", "outside"),
    "all": ("unseen", "seen_one", "seen_many", "outside"),
}


@torch.no_grad()
def measure(facing: Path, turning: Path) -> list[dict[str, str]]:
    """Returns a row for each part."""
    run, other = load_run(facing), load_run(turning)
    observed = observe(run.settings)
    renderer, coverage = observed.renderer, observed.coverage
    if coverage is None:
        raise SystemExit(f"{facing}: no view shows the body")
    found: dict[str, list[tuple[float, float, float]]] = {name: [] for name in PARTS}
    for frame in observed.data.test_dataloader():
        classes = class_of_pixels(frame, run.avatar.body, coverage)
        if frame.truth is None or classes is None:
            continue
        truth, is_person = frame.truth.rgb.numpy(), frame.truth.mask.numpy().astype(bool)
        own, known = (
            np.square(renderer.frame(each.avatar.eval(), frame).rgb.numpy() - truth).mean(axis=2)
            for each in (run, other)
        )
        pixels = {name: is_person & (classes == number) for name, number in CLASSES.items()} | {
            "outside": ~is_person
        }
        for name in found:
            part = np.any([pixels[each] for each in PARTS[name]], axis=0) & np.ones_like(is_person)
            left = np.where(part, known, own).mean()
            found[name].append(
                (-10.0 * np.log10(left), own[part].sum() / own.sum(), known[part].sum() / own.sum())
            )
    rows = []
    for name, figures in found.items():
        psnr, share, share_turning = np.mean(figures, axis=0)
        rows.append(
            {
                "scene": str(run.settings.dataset.scene), "part": name, "psnr": f"{psnr:.2f}",
                "share": f"{share:.3f}", "share_turning": f"{share_turning:.3f}",
            }
        )  # fmt: skip
    return rows


def main() -> None:
    folders = [Path(argument) for argument in sys.argv[1:]]
    if not folders or len(folders) % 2:
        raise SystemExit(__doc__)
    writer = csv.DictWriter(sys.stdout, COLUMNS)
    writer.writeheader()
    for facing, turning in zip(folders[::2], folders[1::2], strict=True):
        writer.writerows(measure(facing, turning))


if __name__ == "__main__":
    main()
