"""Measures imports of filmed clips against what the other cameras of the same moment saw.

    pip download --no-deps pose2sim==0.10.49
    python -m zipfile -e pose2sim-0.10.49-py3-none-any.whl clips
    python scripts/measure_filmed.py clips/Pose2Sim --output data/filmed

The package Pose2Sim (BSD-3-Clause) holds a man on a treadmill, filmed by four calibrated cameras. Each clip is imported
alone, from nothing but its pictures. The truth is triangulated: landmarks of all four cameras, without the one that
fits worst while it is more than `FAR` off. Frames in which a bone has another length than usual are left out.
Twelve landmarks of arms and legs are compared in each frame, after rotation and shift.

The calibration file is read as `Pose2Sim/calibration.py` does (`read_qca`, `calib_qca_fun`; perfanalytics/pose2sim
0.10.49): sixty-fourths of pixels, millimetres, and cameras that look along -z.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.fitting.anchors import landmark_places
from occfusion.fitting.batch import BodyBatch, height_at_rest, rotations_of
from occfusion.footage.clip import open_clip, read_clip
from occfusion.footage.landmarks import COUNT, INDEX, KeyPoints
from occfusion.footage.people import follow
from occfusion.human import embedded_body

Floats = NDArray[np.float64]

PARTS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
MARKS = [INDEX[f"{side}_{part}"] for part in PARTS for side in ("left", "right")]
BONES = [(0, 2), (2, 4), (1, 3), (3, 5), (6, 8), (8, 10), (7, 9), (9, 11), (0, 1), (6, 7)]  # places in MARKS
SURE, FAR, LENGTH = 0.5, 25.0, 0.25
"""Confidence of a landmark that is used; pixels of the film; share by which a bone's length may differ."""


@dataclass(frozen=True)
class Rig:
    """A calibrated camera: intrinsics `[3, 3]`, distortion, world to camera `[3, 4]`, metres."""

    K: Floats
    distortion: Floats
    view: Floats


def cameras(path: Path) -> list[Rig]:
    """Returns the cameras of a Qualisys file."""
    out = []
    for camera in ElementTree.parse(path).getroot().findall("cameras/camera"):
        inner, placed = camera.find("intrinsic"), camera.find("transform")
        assert inner is not None and placed is not None

        def value(key: str, of: ElementTree.Element = inner) -> float:
            return float(of.attrib[key]) / 64.0

        K = np.diag([value("focalLengthU"), value("focalLengthV"), 1.0])
        K[:2, 2] = value("centerPointU"), value("centerPointV")
        names = ("radialDistortion1", "radialDistortion2", "tangentalDistortion1", "tangentalDistortion2")
        centre = np.array([float(placed.attrib[axis]) for axis in "xyz"]) / 1000.0
        turn = np.array([[float(placed.attrib[f"r{a}{b}"]) for b in (1, 2, 3)] for a in (1, 2, 3)])
        turn = np.diag([1.0, -1.0, -1.0]) @ turn
        out.append(Rig(K, np.array([value(name) for name in names]), np.column_stack([turn, -turn @ centre])))
    return out


def triangulated(rigs: Sequence[Rig], seen: Sequence[KeyPoints]) -> Floats:
    """Returns the landmarks of each frame in the world, `[N, 12, 3]`; NaN where cameras do not agree.

    Args:
        rigs: cameras.
        seen: landmarks by camera, pixels of the film.
    """
    count = len(seen[0])
    flat = [
        cv2.undistortPoints(points.pixels.reshape(-1, 1, 2) - 0.5, rig.K, rig.distortion).reshape(
            count, COUNT, 2
        )
        for rig, points in zip(rigs, seen, strict=True)
    ]
    out = np.full((count, len(MARKS), 3), np.nan)
    for frame in range(count):
        for place, mark in enumerate(MARKS):
            used = [k for k, points in enumerate(seen) if points.confidence[frame, mark] > SURE]
            while len(used) >= 2:
                rows = [
                    flat[k][frame, mark, axis] * rigs[k].view[2] - rigs[k].view[axis]
                    for k in used
                    for axis in (0, 1)
                ]
                x = np.linalg.svd(np.array(rows))[2][-1]
                off = {k: _off(rigs[k], x[:3] / x[3], flat[k][frame, mark]) for k in used}
                worst = max(off, key=lambda k: off[k])
                if off[worst] <= FAR:
                    out[frame, place] = x[:3] / x[3]
                    break
                used.remove(worst)
    lengths = np.stack([np.linalg.norm(out[:, a] - out[:, b], axis=1) for a, b in BONES], axis=1)
    strange = np.abs(lengths / np.nanmedian(lengths, axis=0) - 1.0) > LENGTH
    out[strange.any(axis=1)] = np.nan
    return out


def _off(rig: Rig, point: Floats, place: Floats) -> float:
    seen = rig.view[:, :3] @ point + rig.view[:, 3]
    return float(np.linalg.norm(seen[:2] / seen[2] - place) * rig.K[0, 0])


def landmarks_of(folder: Path) -> tuple[Floats, float]:
    """Returns where the body of an import has the landmarks, `[N, 12, 3]`, and its height."""
    content, body = np.load(folder / "poses.npz"), embedded_body()
    betas, orient, pose, transl = (
        torch.tensor(content[key]).float() for key in ("betas", "global_orient", "body_pose", "transl")
    )
    batch = BodyBatch(body, np.zeros(1, dtype=np.int64))
    turns, places = batch.transforms(betas, rotations_of(orient, pose), transl)
    marks = landmark_places(turns, places).detach().double().numpy()
    return marks[:, MARKS], float(height_at_rest(body, betas))


def laid_on(ours: Floats, truth: Floats) -> tuple[Floats, float]:
    """Returns points `[N, 3]` after rotation and shift onto others, and how much larger these are."""
    a, b = ours - ours.mean(axis=0), truth - truth.mean(axis=0)
    u, spread, v = np.linalg.svd(a.T @ b)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    return a @ (u * signs) @ v + truth.mean(axis=0), float((spread * signs).sum() / (a**2).sum())


def seen_by(film: Path) -> tuple[KeyPoints, list[int]]:
    """Returns the landmarks of a clip in pixels of the film, and the frames."""
    shot = read_clip(open_clip(film), every=2, frames=None, start=0, stop=None, side=1280)
    points = follow(shot.pictures, shot.numbers).keypoints()
    return KeyPoints(points.pixels / shot.scale, points.confidence, None, points.presence), shot.numbers


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("package", type=Path, help="the folder Pose2Sim of the package")
    parser.add_argument(
        "--output", type=Path, required=True, help="for imports; what is there is not made again"
    )
    arguments, words = parser.parse_known_args()
    demo = arguments.package / "Demo_SinglePerson"
    films = sorted((demo / "videos").glob("cam*.mp4"))
    seen = [seen_by(film) for film in films]
    truth = triangulated(cameras(demo / "calibration" / "Calib.qca.txt"), [points for points, _ in seen])
    rows = []
    for film, (_, frames) in zip(films, seen, strict=True):
        folder = arguments.output / film.stem
        if not folder.exists():
            command = [
                sys.executable,
                "-m",
                "occfusion",
                "import",
                str(film),
                "--output",
                str(folder),
                *words,
            ]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        report = json.loads((folder / "import.json").read_text())
        marks, height = landmarks_of(folder)
        wanted = truth[[frames.index(number) for number in report["numbers"]]]
        errors, sizes = [], []
        for ours, theirs in zip(marks, wanted, strict=True):
            told = np.isfinite(theirs).all(axis=1)
            if told.sum() >= 8:
                moved, size = laid_on(ours[told], theirs[told])
                errors.append(1000.0 * np.linalg.norm(moved - theirs[told], axis=1).mean())
                sizes.append(size)
        rows.append(float(np.mean(errors)))
        found = report["median_reprojection_percent_of_height"], report["median_mask_iou"]
        print(
            f"{film.stem}: {len(errors)} frames, joints {rows[-1]:.1f} mm (worst frame {max(errors):.0f}), "
            f"reprojection {found[0]:.2f} %, IoU {found[1]:.3f}, height {height:.2f} m, "
            f"to be {np.median(sizes):.3f} times as large, trusted {report['trusted']}",
            flush=True,
        )
    print(f"mean {np.mean(rows):.1f} mm")


if __name__ == "__main__":
    main()
