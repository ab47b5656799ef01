"""Measures where the 33 landmarks lie on the body: prints the table of `occfusion/fitting/anchors.py`.

python scripts/render_plain_clip.py 2 --output clips/002        # subjects below 100 only, for each
python scripts/calibrate_landmarks.py clips/*
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch

from occfusion.fitting.anchors import ANCHORS
from occfusion.fitting.batch import BodyBatch, rotations_of
from occfusion.footage.clip import open_clip, read_clip
from occfusion.footage.landmarks import MIRRORED, NAMES
from occfusion.footage.people import follow
from occfusion.human import embedded_body

ROUNDS = 12


def main() -> None:
    body = embedded_body()
    batch = BodyBatch(body, np.zeros(1, dtype=np.int64))
    rows: dict[int, list[np.ndarray]] = {k: [] for k in range(33)}
    for folder in map(Path, sys.argv[1:]):
        truth = np.load(folder / "truth.npz")
        shot = read_clip(open_clip(folder / "clip.mp4"))
        points = follow(shot.pictures, shot.numbers).keypoints()
        poses, K = torch.tensor(truth["poses"]).float(), truth["K"]
        turns, places = batch.transforms(
            torch.tensor(truth["betas"]).float(), rotations_of(poses[:, :3], poses[:, 3:]),
            torch.tensor(truth["transl"]).float(),
        )  # fmt: skip
        assert np.abs(places.numpy() - truth["joints"]).max() < 1e-3
        for k, (joint, frame, *_) in enumerate(ANCHORS):
            place, turn = places[:, joint].numpy(), turns[:, frame].numpy()
            ray = (points.pixels[:, k] - K[:2, 2]) / K[0, 0]
            sure = points.confidence[:, k] > 0.5
            # (p + R o)_xy - ray (p + R o)_z = 0, metres across the ray
            A = turn[:, :2] - ray[:, :, None] * turn[:, 2:3]
            b = -(place[:, :2] - ray * place[:, 2:3])
            if MIRRORED[k] < k:  # of the right side: mirror the unknown
                A = A * np.array([-1.0, 1.0, 1.0])
            rows[min(k, int(MIRRORED[k]))].append(np.concatenate([A[sure], b[sure][..., None]], axis=2))
    for k in range(33):
        if MIRRORED[k] < k:
            continue
        data = np.concatenate(rows[k])
        A, b = data[..., :3], data[..., 3]
        offset, weight = np.zeros(3), np.ones(len(A))
        for _ in range(ROUNDS):
            root = np.sqrt(weight)[:, None]
            left, right = (A * root[..., None]).reshape(-1, 3), (b * root).reshape(-1)
            offset = np.linalg.solve(left.T @ left + 1e-3 * len(A) * np.eye(3) * 0.05, left.T @ right)
            gap = np.linalg.norm(b - A @ offset, axis=1)
            weight = 1 / (1 + (gap / 0.04) ** 2) ** 2
        print(f"{NAMES[k]:20s} {np.round(offset, 3)}  spread {np.median(gap) / 1.18:.3f}  n={len(A)}")


if __name__ == "__main__":
    main()
