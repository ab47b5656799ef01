"""A picture that shows at a glance whether body, mask and picture belong together."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.data import checks, overlap
from occfusion.data.inspection import Look, posed_bodies
from occfusion.data.scene import Array
from occfusion.errors import DataError
from occfusion.files.images import read_rgb

HEIGHT = 480
"""Rows of each column of the overlay."""

COLUMNS = 4
MASK_COLOUR, BODY_COLOUR, JOINT_COLOUR = (40, 220, 60), (240, 60, 40), (255, 230, 40)


def draw_overlay(look: Look) -> NDArray[np.uint8] | None:
    """Returns a few training pictures with the mask's edge (green), the body's (red) and its joints (yellow).

    None where no frame has picture, mask, camera and parameters.
    """
    posed = posed_bodies(look)
    if look.camera not in look.sound or not posed:
        return None
    frames = list(posed)
    chosen = sorted({frames[int(k)] for k in np.linspace(0, len(frames) - 1, COLUMNS).round()})
    columns = [column for frame in chosen if (column := _column(look, frame, *posed[frame])) is not None]
    return np.concatenate(columns, axis=1) if columns else None


def _column(look: Look, frame: int, vertices: Array, joints: Array) -> NDArray[np.uint8] | None:
    camera = look.view(frame)
    try:
        picture = read_rgb(look.scene.files(frame, look.camera).rgb)
    except DataError:  # reported where the files are checked
        return None
    mask = look.people[frame].seen.full()
    scale = HEIGHT / picture.shape[0]
    size = (max(round(picture.shape[1] * scale), 1), HEIGHT)
    canvas = np.array(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    _edge(canvas, mask, MASK_COLOUR)
    _edge(canvas, overlap.body_outline(vertices, camera, picture.shape), BODY_COLOUR)
    pixels, depth = checks.project(joints, camera)
    for x, y in pixels[depth > 0] * scale:
        if abs(x) < 2 * size[0] and abs(y) < 2 * HEIGHT:
            cv2.circle(canvas, (round(x), round(y)), 2, JOINT_COLOUR, -1)
    name = look.scene.files(frame, look.camera).name
    cv2.putText(canvas, name[-40:], (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 255), 1, cv2.LINE_AA)
    return canvas


def _edge(canvas: NDArray[np.uint8], mask: NDArray[np.bool_], colour: tuple[int, int, int]) -> None:
    size = (canvas.shape[1], canvas.shape[0])
    scaled = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    edges, _ = cv2.findContours(scaled, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(canvas, edges, -1, colour, 1)
