"""A picture of a body from four sides, coloured by how well a video shows it."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.geometry.coverage import MANY, ONE, UNSEEN
from occfusion.geometry.normals import vertex_normals
from occfusion.geometry.zbuffer import NO_FACE, rasterize_mesh
from occfusion.human.body import Body
from occfusion.human.coverage import BodyCoverage

HEIGHT = 480
"""Rows of the picture."""
MARGIN = 24
COLOURS = {MANY: (70, 170, 90), ONE: (235, 180, 60), UNSEEN: (200, 60, 60)}
"""RGB of the classes of places: green, yellow, red."""
WORDS = {MANY: "from many directions", ONE: "from one", UNSEEN: "not seen"}
SIDES = {"front": 0.0, "left": 90.0, "back": 180.0, "right": 270.0}
"""Side of the body that is looked at, and by how many degrees the camera goes round it."""
FAR = 10.0  # metres: any depth before the camera will do, as nothing shrinks with it


@torch.no_grad()
def draw_coverage(body: Body, coverage: BodyCoverage) -> NDArray[np.uint8]:
    """Returns the body in its canonical pose from four sides, `[H, W, 3]`: seen from many directions, one, none."""
    points = body.da_vertices().double().cpu().numpy()
    faces = body.faces.cpu().numpy()
    points = points - 0.5 * (points.min(axis=0) + points.max(axis=0))
    scale = (HEIGHT - 2 * MARGIN) / float(np.ptp(points[:, 1]))
    colours = np.array([COLOURS[k] for k in (UNSEEN, ONE, MANY)], float)[coverage.coverage.classes]
    normals = vertex_normals(points, faces)
    widest = float(np.linalg.norm(points[:, [0, 2]], axis=1).max())
    width = int(np.ceil(2 * widest * scale)) + MARGIN
    columns = []
    for name, degrees in SIDES.items():
        angle = np.radians(degrees)
        across = np.array([np.cos(angle), 0.0, -np.sin(angle)])
        towards = np.array([np.sin(angle), 0.0, np.cos(angle)])
        pixels = np.column_stack([0.5 * width + scale * points @ across, 0.5 * HEIGHT - scale * points[:, 1]])
        seen = rasterize_mesh(pixels, FAR - points @ towards, faces, width, HEIGHT)
        shade = 0.45 + 0.55 * np.clip(normals @ towards, 0.0, 1.0)
        shows = seen.face != NO_FACE
        lit = (colours * shade[:, None])[faces[seen.face[shows]]]  # [pixels of the body, 3 corners, 3]
        picture = np.full((HEIGHT, width, 3), 255, dtype=np.uint8)
        picture[shows] = np.einsum("pck,pc->pk", lit, seen.barycentrics[shows]).round().astype(np.uint8)
        _write(picture, name, (8, 18), 0.5)
        columns.append(picture)
    sheet = np.concatenate(columns, axis=1)
    left = 8
    for k in (MANY, ONE, UNSEEN):
        cv2.rectangle(sheet, (left, HEIGHT - 18), (left + 12, HEIGHT - 6), COLOURS[k], -1)
        _write(sheet, WORDS[k], (left + 18, HEIGHT - 7), 0.45)
        left += 40 + 8 * len(WORDS[k])
    return sheet


def _write(picture: NDArray[np.uint8], text: str, place: tuple[int, int], size: float) -> None:
    cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, (0, 0, 0), 1, cv2.LINE_AA)
