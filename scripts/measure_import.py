"""Measures `import` on clips of `render_plain_clip.py`, whose truth is known; one line a clip.

python scripts/measure_import.py clips/101 clips/102             # nothing but the .mp4
python scripts/measure_import.py --true clips/101                # true camera and masks
python scripts/measure_import.py --true --points clips/101       # and true key points, in the picture alone
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import cv2
import numpy as np
import torch

from occfusion.fitting.anchors import landmark_places
from occfusion.fitting.batch import BodyBatch, rotations_of
from occfusion.fitting.pipeline import fit_body
from occfusion.fitting.quality import PREVIEW, posed, silhouette
from occfusion.footage.landmarks import KeyPoints
from occfusion.human import embedded_body
from occfusion.importing.sources import Choice, gather


def aligned(ours: np.ndarray, truth: np.ndarray) -> float:
    """Returns the mean distance of joints after the best rotation and translation, millimetres."""
    a, b = ours - ours.mean(axis=0), truth - truth.mean(axis=0)
    u, _, v = np.linalg.svd(a.T @ b)
    turn = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ v))]) @ v
    return float(np.linalg.norm(a @ turn - b, axis=1).mean() * 1000)


def true_points(truth: dict[str, np.ndarray], frames: list[int]) -> KeyPoints:
    """Returns where the landmarks of the true bodies are in the pictures."""
    batch = BodyBatch(embedded_body(), np.zeros(1, dtype=np.int64))
    betas, poses, transl = (
        torch.tensor(truth[key], dtype=torch.float32) for key in ("betas", "poses", "transl")
    )
    rotations = rotations_of(poses[frames, :3], poses[frames, 3:])
    marks = landmark_places(*batch.transforms(betas, rotations, transl[frames])).double().numpy()
    pixels = marks @ truth["K"].T
    return KeyPoints(pixels[..., :2] / pixels[..., 2:], np.ones(marks.shape[:2]), None, np.ones(len(frames)))


def iou(one: np.ndarray, other: np.ndarray) -> float:
    return float((one & other).sum() / max((one | other).sum(), 1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument(
        "--true", action="store_true", help="true camera and masks; key points are still the model's"
    )
    parser.add_argument("--points", action="store_true", help="true key points in the picture, without depth")
    arguments = parser.parse_args()
    body = embedded_body()
    faces = body.faces.numpy()
    for folder in arguments.folders:
        truth, begun, cpu = np.load(folder / "truth.npz"), time.perf_counter(), time.process_time()
        sources = gather(folder / "clip.mp4", Choice())
        frames = sources.shot.numbers
        whole, seen = (
            [cv2.imread(str(folder / kind / f"{k:06d}.png"), 0) > 0 for k in frames]
            for kind in ("whole", "masks")
        )
        of_masks = float(np.mean([iou(m, t) for m, t in zip(sources.masks, seen, strict=True)]))
        masks, K = (seen, truth["K"]) if arguments.true else (sources.masks, sources.intrinsics.K)
        points = true_points(truth, frames) if arguments.points else sources.points
        fit = fit_body(body, points, masks, K, sources.shot.seconds, focal_known=arguments.true)
        seconds, spent = time.perf_counter() - begun, time.process_time() - cpu
        errors, overlaps = [], []
        for k, (vertices, joints) in enumerate(posed(body, fit.solution)):
            errors.append(aligned(joints, truth["joints"][frames[k]]))
            shown = silhouette(vertices, fit.solution.K, faces, whole[k].shape)
            small = (
                cv2.resize(whole[k].astype(np.uint8) * 255, shown.shape[::-1], interpolation=cv2.INTER_AREA)
                > 127
            )
            overlaps.append(iou(shown, small))
        figures = fit.quality.summary()
        print(
            f"{folder.name}: joints {np.mean(errors):.1f} mm (worst frame {np.max(errors):.0f}), reprojection "
            f"{figures['median_reprojection_percent_of_height']:.2f} %, body against true mask "
            f"{np.mean(overlaps):.3f} (at {PREVIEW} px), mask {of_masks:.3f}, frames {len(frames)}, "
            f"trusted {fit.quality.trusted}, doubtful "
            f"{len(fit.quality.doubtful)}, swapped {len(fit.swapped)}, focal {fit.solution.K[0, 0]:.0f}, "
            f"{seconds:.0f} s ({spent:.0f} s of CPU)",
            flush=True,
        )


if __name__ == "__main__":
    main()
