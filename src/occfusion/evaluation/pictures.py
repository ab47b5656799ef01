"""Pictures for people: truth, rendering and error side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from occfusion.files.atomic import write_json, write_png
from occfusion.types import Frame, Rendering

ERROR_GAIN = 4.0
"""Error maps show four times the absolute difference: a level of 64 of 255 is white."""
CAPTION_HEIGHT = 20
Image = NDArray[np.uint8]


def to_uint8(rgb: Tensor) -> Image:
    """Returns a `[H, W, 3]` picture in 0..1 as 8-bit values."""
    return (rgb.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()


def error_map(a: Tensor, b: Tensor) -> Tensor:
    """Returns the amplified mean absolute difference as a grey picture, `[H, W, 3]`."""
    grey = (a - b).abs().mean(dim=-1, keepdim=True) * ERROR_GAIN
    return grey.clamp(0, 1).expand(-1, -1, 3)


def captioned(image: Image, text: str) -> Image:
    """Returns the picture with a line of text above it."""
    bar = np.full((CAPTION_HEIGHT, image.shape[1], 3), 255, np.uint8)
    cv2.putText(bar, text, (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
    return np.concatenate([bar, image])


def write_comparison(path: Path, frames: Sequence[Frame], render: Callable[[Frame], Rendering]) -> None:
    """Writes one row a frame: observation, rendering, truth and error (the last two where truth is known).

    A `.json` beside the picture says where in it each part lies, `{"views": [{"name", "frame", "camera",
    "parts": {"input": [x, y, width, height], "rendering", "truth", "error"}}]}`, for whoever puts parts of
    several runs side by side.
    """
    rows, views, top = [], [], 0
    with torch.inference_mode():
        for frame in frames:
            ours = render(frame).rgb
            columns = [("input", f"input {frame.name}", frame.rgb), ("rendering", "rendering", ours)]
            if frame.truth is not None:
                truth = frame.truth.rgb
                difference = error_map(ours, truth.to(ours))
                columns += [("truth", "truth", truth), ("error", f"error x{ERROR_GAIN:g}", difference)]
            rows.append(np.concatenate([captioned(to_uint8(c), t) for _, t, c in columns], axis=1))
            height, width = frame.rgb.shape[:2]
            parts = {
                name: [k * width, top + CAPTION_HEIGHT, width, height]
                for k, (name, _, _) in enumerate(columns)
            }
            views.append(
                {"name": frame.name, "frame": frame.index, "camera": frame.camera_index, "parts": parts}
            )
            top += rows[-1].shape[0]
    if rows:
        widest = max(row.shape[1] for row in rows)  # rows without truth are shorter
        margins = [((0, 0), (0, widest - row.shape[1]), (0, 0)) for row in rows]
        padded = [np.pad(row, m, constant_values=255) for row, m in zip(rows, margins, strict=True)]
        write_png(path, np.concatenate(padded))
        write_json(path.with_suffix(".json"), {"views": views})
