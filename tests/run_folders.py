"""Run folders as training leaves them, written in a moment."""

import csv
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

STPIPS = "ST-LPIPS (VGG)"
PAPER = {"psnr": 22.54, "ssim": 0.9457, "lpips": 54.88, "minutes": 2}


def write_run(
    folder: Path, *, variant: str = "A", seed: int = 0, scene: str = "001-clean", psnr: float = 25.0,
    images: int = 10, curve: tuple[tuple[float, float], ...] = ((0, 15.0), (10, 20.0), (30, 24.0)),
    init_seconds: float | None = None, metric: str | None = STPIPS, **settings: Any,
) -> Path:  # fmt: skip
    (folder / "pictures").mkdir(parents=True)
    config = {
        "dataset": {"name": "zju", "scene": scene}, "variant": {"name": variant, "paper": PAPER}, "seed": seed,
        "output_dir": str(folder), **settings,
    }  # fmt: skip
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    full = {
        "psnr": psnr,
        "ssim": 0.95,
        "lpips": 0.05,
        "mask_iou": 0.9,
        "images": images,
        "lpips_images": images,
    }
    nothing = dict.fromkeys(("psnr", "ssim", "lpips", "mask_iou"))
    metrics = {
        "dataset": "zju", "scene": scene, "variant": variant, "images": images,
        "regions": {"full": full, "box": full, "visible": full, "hidden": nothing,
                    "seen_many": nothing, "seen_one": nothing, "unseen": nothing}, "perceptual_metric": metric,
        "train_seconds": {"init": init_seconds, "optim": curve[-1][0], "refine": None,
                          "total": curve[-1][0] + (init_seconds or 0)},
        "gaussians": 6890, "peak_memory_mb": 500.0, "left_out": ["stage refine"],
    }  # fmt: skip
    (folder / "metrics.json").write_text(json.dumps(metrics))
    decision = {"part": "stage refine", "used": False, "reason": f"variant {variant} <does> not need it"}
    (folder / "plan.json").write_text(json.dumps({"decisions": [decision]}))
    with (folder / "error_vs_time.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(
            [
                "stage",
                "step",
                "train_seconds",
                "wall_seconds",
                "psnr",
                "ssim",
                "lpips",
                "mask_iou",
                "gaussians",
                "mb",
            ]
        )
        for seconds, value in curve:
            writer.writerow(["optim", 1, seconds, seconds, value, 0.9, "", 0.8, 6890, 1])
    write_pictures(folder, level=60 + 10 * seed)
    return folder


def write_pictures(folder: Path, level: int, views: tuple[str, ...] = ("c1/000000", "c2/000004")) -> None:
    parts = ("input", "rendering", "truth", "error")
    whole = np.zeros((len(views) * 60, 160, 3), np.uint8)
    described = []
    for row, view in enumerate(views):
        boxes = {part: [40 * k, row * 60 + 20, 40, 40] for k, part in enumerate(parts)}
        for part, (x, y, _, _) in boxes.items():
            whole[y + 12 : y + 30, x + 15 : x + 25] = level if part in ("rendering", "error") else 200
        described.append({"name": view, "frame": 0, "camera": 1, "parts": boxes})
    cv2.imwrite(str(folder / "pictures" / "held_out.png"), whole)
    (folder / "pictures" / "held_out.json").write_text(json.dumps({"views": described}))
