"""What a mask says of a pose: where its outline lies beside the posed body's, and which turns would move it there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.files.bodyfile import NUM_JOINTS
from occfusion.geometry.camera import project_vertices
from occfusion.geometry.outlines import outline_offsets
from occfusion.geometry.sampled_mesh import SampledMesh, box_of
from occfusion.geometry.zbuffer import nearest_faces
from occfusion.human.body import Body
from occfusion.human.posed_mesh import mesh_poser
from occfusion.observation.evidence import person_size
from occfusion.types import Camera, Frame, Pose

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

POSE_COLUMNS = 3 * NUM_JOINTS + 3
"""Turns of all joints, then the place."""
REACH = 0.04
"""Of the person's size: farther edges are not this outline's. The first look reaches twice as far."""
LARGEST = 512
"""Pixels, the longer side of masks that are looked at. There, outlines are known to hundredths of a pixel, and bodies
fit them to tenths."""
LEAST_POINTS = 300
"""Of an outline, that are looked at; of a longer one some, no fewer. Its pixels err as their neighbours do, and all of
them would be believed too much: poses come out worse (docs/experiments/074-fewer-points-better-poses.md)."""
ROOM = 8
"""Pixels beyond the reach about the body: what a blurred edge there is made of."""
OCCLUDER = 0.02
"""Of the person's size: half the width from which on what is missing of the body is hidden rather than misplaced. A leg
is 0.07 wide, an arm 0.05."""


@dataclass(frozen=True)
class Witness:
    """Points of the outline of one frame, `[N]` each.

    Attributes:
        offsets: from the body's outline to the mask's along the normal, pixels.
        turns: pixels along the normal that a unit of each turn and of the place gives, `[N, 75]`.
        shape: the same of each shape component, `[N, B]`.
        picture: the same of a shift of the picture in x and y, pixels, and of a scale about its principal point,
            `[N, 3]`.
        per_metre: pixels of a metre along the normal.
        vertices: of the body, at the points.
        size: of the person in the picture, pixels.
        focal: length, pixels.
    """

    offsets: Floats
    turns: Floats
    shape: Floats
    picture: Floats
    per_metre: Floats
    vertices: NDArray[np.int64]
    size: float
    focal: float

    def only(self, points: slice | NDArray[np.bool_]) -> Witness:
        """Returns some of the points."""
        names = ("offsets", "turns", "shape", "picture", "per_metre", "vertices")
        return replace(self, **{name: getattr(self, name)[points].copy() for name in names})


@dataclass(frozen=True)
class Look:
    """What the alignment needs of a training frame.

    Attributes:
        index: number of the frame in the sequence.
        pose: as given.
        camera: at the size of the mask.
        seen: the visible person, `[H, W]`.
        pixel: sides of the frame's pixels that one of the mask has.
        points: of its outline that are looked at, at least; None: all.
    """

    index: int
    pose: Pose
    camera: Camera
    seen: Mask
    pixel: float = 1.0
    points: int | None = LEAST_POINTS

    @classmethod
    def at(cls, frame: Frame) -> Look:
        """Returns it of a frame; of a large one at a smaller size."""
        return cls.of(frame.index, frame.pose, frame.camera, frame.visible_mask.cpu().numpy())

    @classmethod
    def of(cls, index: int, pose: Pose, camera: Camera, seen: Mask) -> Look:
        """Returns it of a pose and a mask; of a large one at a smaller size."""
        pixel = max(seen.shape) / LARGEST
        if pixel <= 1.0:
            return cls(index, pose, camera, seen)
        width, height = (max(1, round(side / pixel)) for side in (camera.width, camera.height))
        share = cv2.resize(seen.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
        return cls(index, pose, camera.resized(width, height), np.asarray(share) > 0.5, pixel)


@torch.no_grad()
def observe_outline(
    body: Body, look: Look, correction: tuple[Floats, Floats], reach: float
) -> Witness | None:
    """Returns what the mask of a frame says of its pose; None where no outline of it is found.

    Args:
        body: of the pose.
        look: at the frame.
        correction: turns multiplied from the right, axis-angles `[24, 3]`, and a shift `[3]`, metres.
        reach: farthest offset that is looked for, of the person's size.
    """
    poser = mesh_poser(body)
    mesh = poser.pose(look.pose, *correction)
    viewmat, K = (part.double().cpu().numpy() for part in (look.camera.viewmat, look.camera.K))
    pixels, depth = project_vertices(mesh.vertices, viewmat, K)
    height, width = look.seen.shape
    x, y, w, h = box = box_of(pixels, width, height)
    drawn = SampledMesh.draw(pixels, depth, poser.faces, box, closed=poser.closed)
    covered = drawn.coverage
    size = person_size(covered > 0.5)
    if size < 8.0:
        return None
    farthest = max(reach * size, 3.0)
    # what lies farther from the body says nothing of its outline
    room = math.ceil(farthest) + ROOM
    left, top = max(0, x - room), max(0, y - room)
    seen = look.seen[top : y + h + room, left : x + w + room]
    coverage = np.zeros(seen.shape, np.float32)
    coverage[y - top : y - top + h, x - left : x - left + w] = covered
    found = outline_offsets(coverage, seen, farthest, look.points)
    ends = found.points + found.normals * (found.offsets[:, None] + 1.5)
    column, row = np.clip(ends.astype(int), 0, [seen.shape[1] - 1, seen.shape[0] - 1]).T
    kept = ~_hidden(coverage > 0.5, seen, size)[row, column]
    if kept.sum() < 10:
        return None
    vertices = poser.faces[drawn.face_at(found.pixels[kept] - [y - top, x - left]), 0]
    normals, points = found.normals[kept], found.points[kept] + [left, top]
    per_metre = K[0, 0] / depth[vertices]
    # the derivative of a projected point by its place in the world, along the normal
    inwards = ((points - K[:2, 2]) * normals).sum(axis=1) / K[0, 0]
    moves = per_metre[:, None] * (normals @ viewmat[:2, :3] - inwards[:, None] * viewmat[2, :3])
    by_turns, by_shape = poser.derivatives(mesh, vertices, moves)
    return Witness(
        offsets=found.offsets[kept],
        turns=np.concatenate([by_turns, moves], axis=1),
        shape=by_shape,
        picture=np.column_stack([normals, inwards * K[0, 0]]),
        per_metre=per_metre,
        vertices=vertices,
        size=size,
        focal=float(K[0, 0]),
    )


@torch.no_grad()
def misfits(
    body: Body, look: Look, corrections: Sequence[tuple[Floats, Floats]], places: NDArray[np.bool_]
) -> Floats:
    """Returns how far the body and the mask of a frame differ under corrections of the pose, of the body's pixels.

    What is hidden under the first of them is left out of all, and where it has the body decides what a pixel belongs
    to.

    Args:
        body: of the pose.
        look: at the frame.
        corrections: turns `[24, 3]` and shift `[3]` each.
        places: vertices of the body that pixels have to be nearest to, `[V]`.
    """
    found, area = [], 1
    counted = np.zeros_like(look.seen)
    poser = mesh_poser(body)
    viewmat, K = (part.double().cpu().numpy() for part in (look.camera.viewmat, look.camera.K))
    for number, correction in enumerate(corrections):
        pixels, depth = project_vertices(poser.pose(look.pose, *correction).vertices, viewmat, K)
        height, width = look.seen.shape
        face = nearest_faces(pixels, depth, poser.faces, width, height, closed=poser.closed).face
        covered = face >= 0
        if number == 0:
            area = max(1, int(covered.sum()))
            counted = ~_hidden(covered, look.seen, person_size(covered))
            counted &= places[poser.faces[:, 0]][_spread(face.astype(np.int64), covered)]
        found.append(float(((covered ^ look.seen) & counted).sum()) / area)
    return np.array(found)


def _spread(values: NDArray[np.int64], where: Mask) -> NDArray[np.int64]:
    """Returns values of the nearest pixel that has one, `[H, W]`; 0 where none has."""
    if not where.any():
        return np.zeros_like(values)
    _, label = cv2.distanceTransformWithLabels(
        (~where).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.zeros(int(label.max()) + 1, values.dtype)
    of_label[label[where]] = values[where]
    return np.asarray(of_label[label])


def _hidden(body: Mask, seen: Mask, size: float) -> Mask:
    """Returns where something stands before the body, or what a segmenter has left out: not merely beside the pose."""
    radius = max(1, round(OCCLUDER * size))
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    core = cv2.morphologyEx((body & ~seen).astype(np.uint8), cv2.MORPH_OPEN, disk)
    return cv2.dilate(np.asarray(core), disk).astype(bool)
