"""Measures `import` on clips of `render_plain_clip.py`, whose truth is known; one line a clip.

python scripts/measure_import.py clips/101 clips/102             # nothing but the .mp4
python scripts/measure_import.py --true clips/101                # true camera and masks
python scripts/measure_import.py --true --points clips/101       # and true key points, in the picture alone
python scripts/measure_import.py clips/101 --output data         # into data/101, or what is there from before

Words that are not known go to `import`. Of clips with a bar, true key points behind it are not given, and `hidden` says
how much of what the bar hides of the person was found, and how much of what was found is so.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from occfusion.files.atomic import write_json
from occfusion.fitting.anchors import landmark_places
from occfusion.fitting.batch import BodyBatch, rotations_of
from occfusion.fitting.quality import PREVIEW, posed, silhouette
from occfusion.fitting.solver import Solution
from occfusion.human import embedded_body
from occfusion.importing.folder import OCCLUDER, PERSON

SIZE = (1280, 720)
"""Of the clips of `render_plain_clip.py`."""


def aligned(ours: np.ndarray, truth: np.ndarray) -> float:
    """Returns the mean distance of joints after the best rotation and translation, millimetres."""
    a, b = ours - ours.mean(axis=0), truth - truth.mean(axis=0)
    return float(np.linalg.norm(Rotation.align_vectors(b, a)[0].apply(a) - b, axis=1).mean() * 1000)


def write_points(truth: dict[str, np.ndarray], size: tuple[int, int], place: Path) -> Path:
    """Writes where the landmarks of the true bodies are in the pictures as MediaPipe's files; none behind a bar."""
    batch = BodyBatch(embedded_body(), np.zeros(1, dtype=np.int64))
    betas, poses, transl = (
        torch.tensor(truth[key], dtype=torch.float32) for key in ("betas", "poses", "transl")
    )
    rotations = rotations_of(poses[:, :3], poses[:, 3:])
    marks = landmark_places(*batch.transforms(betas, rotations, transl)).double().numpy()
    pixels = marks @ truth["K"].T
    pixels = pixels[..., :2] / pixels[..., 2:]
    for frame, (start, stop) in enumerate(truth["bars"]):
        sure = ~((pixels[frame, :, 0] >= start) & (pixels[frame, :, 0] < stop))
        points = [
            {"x": x / size[0], "y": y / size[1], "z": 0.0, "visibility": float(seen)}
            for (x, y), seen in zip(pixels[frame].tolist(), sure.tolist(), strict=True)
        ]
        write_json(place / f"{frame:06d}.json", {"landmarks": [points]})
    return place


def told(found: list[np.ndarray] | None, whole: list[np.ndarray], bars: np.ndarray) -> str:
    """Returns how well what hides the person was told from background, in words."""
    hit = hid = said = right = 0
    for k, (body, (start, stop)) in enumerate(zip(whole, bars, strict=True)):
        cover = np.zeros(body.shape, dtype=bool)
        cover[:, start:stop] = True
        hid += int((body & cover).sum())
        if found is not None:
            hit += int((body & cover & found[k]).sum())
            said += int(found[k].sum())
            right += int((found[k] & cover).sum())
    of_hidden = f"{hit / hid:.2f} of what is hidden found" if hid else "nothing is hidden"
    return f"{of_hidden}, " + (f"{right / said:.2f} of what was found is so" if said else "nothing found")


def iou(one: np.ndarray, other: np.ndarray) -> float:
    return float((one & other).sum() / max((one | other).sum(), 1))


def imported(clip: Path, output: Path, truth: dict[str, np.ndarray], words: list[str], points: bool) -> str:
    """Imports a clip unless that is done; returns the time that it took, in words."""
    if output.exists():
        return "imported before"
    begun, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryDirectory() as place:
        if points:
            words = [*words, "--keypoints", str(write_points(truth, SIZE, Path(place)))]
        command = [sys.executable, "-m", "occfusion", "import", str(clip), "--output", str(output), *words]
        done = subprocess.run(command, capture_output=True, text=True)
    if not output.exists():
        sys.exit(done.stderr)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return f"{time.perf_counter() - begun:.0f} s ({spent:.0f} s of CPU)"


def solution_of(folder: Path) -> Solution:
    """Returns the bodies of an import."""
    with np.load(folder / "poses.npz") as rows, np.load(folder / "cameras.npz") as camera:
        parts = (rows[key] for key in ("betas", "global_orient", "body_pose", "transl"))
        return Solution(*parts, camera["intrinsic"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument(
        "--true", action="store_true", help="true camera and masks; key points are still the model's"
    )
    parser.add_argument("--points", action="store_true", help="true key points in the picture, without depth")
    parser.add_argument("--output", type=Path, help="where imports are kept, and taken from")
    arguments, more = parser.parse_known_args()
    body = embedded_body()
    faces = body.faces.numpy()
    for folder in arguments.folders:
        with np.load(folder / "truth.npz") as stored:
            truth = dict(stored)
        words = [*more]
        if arguments.true:
            words += ["--masks", str(folder / "masks"), "--focal", str(float(truth["K"][0, 0]))]
        with tempfile.TemporaryDirectory() as place:
            output = (arguments.output or Path(place)) / folder.name
            took = imported(folder / "clip.mp4", output, truth, words, arguments.points)
            report = json.loads((output / "import.json").read_text())
            frames, solution = report["numbers"], solution_of(output)
            values = [cv2.imread(str(output / "masks" / f"{k:06d}.png"), 0) for k in range(len(frames))]
        is_numbered = max(int(value.max()) for value in values) == OCCLUDER
        masks = [value == PERSON if is_numbered else value > 0 for value in values]
        hidden = [value == OCCLUDER for value in values] if is_numbered else None
        whole, seen = (
            [cv2.imread(str(folder / kind / f"{k:06d}.png"), 0) > 0 for k in frames]
            for kind in ("whole", "masks")
        )
        of_masks = float(np.mean([iou(m, t) for m, t in zip(masks, seen, strict=True)]))
        errors, overlaps = [], []
        for k, (vertices, joints) in enumerate(posed(body, solution)):
            errors.append(aligned(joints, truth["joints"][frames[k]]))
            shown = silhouette(vertices, solution.K, faces, whole[k].shape)
            area = cv2.INTER_AREA
            small = cv2.resize(whole[k].astype(np.uint8) * 255, shown.shape[::-1], interpolation=area) > 127
            overlaps.append(iou(shown, small))
        mended = report.get("mended_by_colour", {"said": "poses are not mended"})["said"]
        print(
            f"{folder.name}: joints {np.mean(errors):.1f} mm (worst frame {np.max(errors):.0f}), reprojection "
            f"{report['median_reprojection_percent_of_height']:.2f} %, body against true mask "
            f"{np.mean(overlaps):.3f} (at {PREVIEW} px), mask {of_masks:.3f}, frames {len(frames)}, "
            f"trusted {report['trusted']}, doubtful {len(report['doubtful_frames'])}, swapped "
            f"{len(report['left_and_right_exchanged'])}, focal {solution.K[0, 0]:.0f}, "
            f"{told(hidden, whole, truth['bars'][frames])}, {mended}, {took}",
            flush=True,
        )


if __name__ == "__main__":
    main()
