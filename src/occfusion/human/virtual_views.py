"""The dressed body in poses of the video, from sides that nobody filmed."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import overload

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from occfusion.geometry.camera import camera_round, project_vertices
from occfusion.geometry.coverage import surface_frames
from occfusion.geometry.distance import nearest_set
from occfusion.geometry.rotation import axis_angle_to_matrix
from occfusion.geometry.zbuffer import NO_FACE, rasterize_mesh
from occfusion.human.body import Body
from occfusion.human.observability import Observability
from occfusion.types import Camera, Pose

Floats = NDArray[np.float64]

VIEWS = 96
"""Virtual views of a video."""
GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
"""Turns from each view to the next: any few that follow each other are spread all round."""
NEAREST = 2.0
"""Distance of a camera from the middle of the body, in distances from there to its farthest place, at least."""
LARGEST = 512
"""Pixels of a side of a view at most: outlines of clothes are not known to less than some millimetres."""
REACH = 0.1
"""Metres that a view shows around the dressed body."""
AWAY = -0.1
"""Cosine of normal and line of sight below which a place faces away from a view."""
SAMPLES = 2
"""Samples of a view along each side of a pixel: an outline between two pixels is grey."""


@dataclass(frozen=True)
class VirtualView:
    """The dressed body in a pose from one side, and how little the video says of it.

    Shares and weights are bytes, 255 for 1: of pictures that are drawn now and then there are many.

    Attributes:
        pose: as the data give it.
        camera: of the picture.
        alpha: share of each pixel that the dressed body covers, `[H, W]`.
        weight: how little the video itself says of the outline from here, at the nearest place, `[H, W]`.
        unseen: how far the place of the body that a pixel shows was never seen, `[H, W]`; 0 outside.
        is_away: vertices that face away from the camera, bool, `[V]`.
    """

    pose: Pose
    camera: Camera
    alpha: Tensor
    weight: Tensor
    unseen: Tensor
    is_away: Tensor

    def to(self, device: torch.device) -> VirtualView:
        """Returns the view with its pictures on `device`."""
        pictures = {name: getattr(self, name).to(device) for name in ("alpha", "weight", "unseen", "is_away")}
        return replace(self, **pictures)


class VirtualViews(Sequence[VirtualView]):
    """Views of a dressed body from all sides: cameras go round its own axis, feet to head.

    A view is drawn when it is first asked for, and kept: a short training, and one that goes on, asks for few.

    Args:
        count: of views.
        frame: pose and camera of the frame of a view's number; the distance of a camera stays, unless it is so near
            that it would cut into the person.
        body: of the poses.
        known: of its surface.
        thickness: how far clothes stand off at each place, `[V]`, metres.
        device: on which the pictures are kept.
    """

    def __init__(
        self,
        count: int,
        frame: Callable[[int], tuple[Pose, Camera]],
        body: Body,
        known: Observability,
        thickness: Floats,
        device: torch.device | str = "cpu",
    ) -> None:
        self._drawn: list[VirtualView | None] = [None] * count
        self._frame, self._body, self._known, self._thickness = frame, body, known, thickness
        self._device = torch.device(device)
        self._faces = body.faces.cpu().numpy()
        self._canonical = surface_frames(body.da_vertices().double().cpu().numpy(), self._faces)

    def __len__(self) -> int:
        return len(self._drawn)

    @overload
    def __getitem__(self, number: int) -> VirtualView: ...

    @overload
    def __getitem__(self, number: slice) -> list[VirtualView]: ...

    def __getitem__(self, number: int | slice) -> VirtualView | list[VirtualView]:
        if isinstance(number, slice):
            return [self[k] for k in range(*number.indices(len(self)))]
        view = self._drawn[number]
        if view is None:
            view = self._drawn[number] = self._draw(number % len(self)).to(self._device)
        return view

    @torch.no_grad()
    def _draw(self, number: int) -> VirtualView:
        pose, camera = self._frame(number)
        there = pose.to(self._body.v_template.device)
        posed, _ = self._body(there.betas, there.global_orient, there.body_pose, there.transl)
        vertices = posed.double().cpu().numpy()
        middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
        nearest = NEAREST * float(np.linalg.norm(vertices - middle, axis=1).max())
        axis = axis_angle_to_matrix(pose.global_orient.cpu())[:, 1]  # bodies are upright along +y
        angle = 2.0 * math.pi * (number * GOLDEN % 1.0)
        beside = camera_round(camera.to("cpu"), torch.from_numpy(middle), axis, angle, nearest=nearest)
        return virtual_view(
            vertices, self._canonical, self._faces, self._known, self._thickness, beside, pose
        )


def virtual_view(
    posed: Floats,
    canonical: Floats,
    faces: NDArray[np.integer],
    known: Observability,
    thickness: Floats,
    camera: Camera,
    pose: Pose,
) -> VirtualView:
    """Returns what a camera would see of a dressed body.

    Args:
        posed: vertices of the body, `[V, 3]`, metres.
        canonical: `surface_frames` of the body in the pose of `known`, `[V, 3, 3]`.
        faces: triangles, `[F, 3]`, corners counter-clockwise from outside.
        known: what the video says of each place.
        thickness: how far clothes stand off at each place, `[V]`, metres.
        camera: its picture is cut to the person, or grows by what it does not show of it.
        pose: of the body.
    """
    frames = surface_frames(posed, faces)
    normals = frames[:, 2]
    dressed = posed + np.maximum(thickness, 0.0)[:, None] * normals
    camera = _around(dressed, camera)
    viewmat, K = (part.double().numpy() for part in (camera.viewmat, camera.K))
    pixels, depths = project_vertices(dressed, viewmat, K)
    seen = rasterize_mesh(pixels * SAMPLES, depths, faces, camera.width * SAMPLES, camera.height * SAMPLES)
    samples = (seen.face != NO_FACE).reshape(camera.height, SAMPLES, camera.width, SAMPLES)
    # one sample of each pixel is enough for what changes slowly; where it misses the body, the nearest that does not
    middle = slice(SAMPLES // 2, None, SAMPLES)
    face, shares = seen.face[middle, middle], seen.barycentrics[middle, middle]
    covered = face != NO_FACE
    corner = faces[np.maximum(face, 0), shares.argmax(axis=2)]
    vertex = corner.ravel()[nearest_set(covered)]
    # across the picture, turned into the canonical pose with each place
    across = np.einsum("vki,vk->vi", canonical, frames @ viewmat[0, :3])
    towards = camera.centre.double().numpy() - dressed
    cosine = (normals * towards).sum(axis=1) / np.linalg.norm(towards, axis=1)
    return VirtualView(
        pose,
        Camera(camera.viewmat.float(), camera.K.float(), camera.width, camera.height),
        _as_bytes(samples.mean(axis=(1, 3))),
        _as_bytes(known.outline_ignorance(across)[vertex]),
        _as_bytes(np.where(covered, known.unseen[vertex], 0.0)),
        torch.from_numpy(cosine < AWAY),
    )


def _around(dressed: Floats, camera: Camera) -> Camera:
    """Returns the camera with the picture that a dressed body `[V, 3]` fills but for `REACH`."""
    viewmat, K = (part.double().numpy() for part in (camera.viewmat, camera.K))
    pixels, depths = project_vertices(dressed, viewmat, K)
    rim = REACH * K[0, 0] / float(np.median(depths))
    least, most = pixels.min(axis=0) - rim, pixels.max(axis=0) + rim
    scale = min(1.0, LARGEST / float((most - least).max()))
    least, most = np.floor(scale * least), np.ceil(scale * most)
    moved = camera.K.double().clone()
    moved[:2] *= scale
    moved[:2, 2] -= torch.from_numpy(least)
    width, height = (most - least).astype(int).tolist()
    return Camera(camera.viewmat, moved, width, height)


def _as_bytes(values: Floats) -> Tensor:
    """Returns values in 0..1 as bytes, 255 for 1."""
    return torch.from_numpy((values.clip(0.0, 1.0) * 255.0 + 0.5).astype(np.uint8))
