"""Measures `import` on clips of `render_plain_clip.py`, whose truth is known; one line a clip.

python scripts/measure_import.py clips/101 clips/102             # nothing but the .mp4
python scripts/measure_import.py --true clips/101                # true camera and masks
python scripts/measure_import.py --true --points clips/101       # and true key points, in the picture alone

Of clips with a bar, true key points behind it are not given, and `hidden` says how much of what the bar hides of the
person was found, and how much of what was found is so.
"""

from __future__ import annotations

import argparse
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
from occfusion.fitting.pipeline import Fit, fit_body
from occfusion.fitting.quality import PREVIEW, posed, silhouette
from occfusion.human import Body, embedded_body
from occfusion.importing.aligning import aligned_with_masks
from occfusion.importing.hiding import told_apart
from occfusion.importing.sources import Choice, Given, Sources, gather

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
        with tempfile.TemporaryDirectory() as place:
            given = Given(
                keypoints=write_points(truth, SIZE, Path(place)) if arguments.points else None,
                masks=folder / "masks" if arguments.true else None,
            )
            choice = Choice(focal=float(truth["K"][0, 0]) if arguments.true else None)
            sources = gather(folder / "clip.mp4", choice, given)
        frames = sources.shot.numbers
        whole, seen = (
            [cv2.imread(str(folder / kind / f"{k:06d}.png"), 0) > 0 for k in frames]
            for kind in ("whole", "masks")
        )
        of_masks = float(np.mean([iou(m, t) for m, t in zip(sources.masks, seen, strict=True)]))

        def refit(one: Sources, body: Body = body) -> Fit:
            return fit_body(
                body, one.points, one.masks or None, one.intrinsics.K, one.shot.seconds,
                focal_known=one.intrinsics.known, hidden=one.hidden,
            )  # fmt: skip

        sources, fit = told_apart(body, sources, refit(sources), refit)
        fit = aligned_with_masks(body, sources, fit)
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
            f"{told(sources.hidden, whole, truth['bars'][frames])}, "
            f"{seconds:.0f} s ({spent:.0f} s of CPU)",
            flush=True,
        )


if __name__ == "__main__":
    main()
