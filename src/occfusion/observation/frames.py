"""The training frames before any mask is completed: where the body is, and how much of it an occluder hides."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.errors import DataError
from occfusion.fields.bits import PackedMasks
from occfusion.geometry.camera import project_vertices
from occfusion.geometry.sampled_mesh import SampledMesh, box_of
from occfusion.human.body import Body
from occfusion.observation.consistency import ProjectedMesh
from occfusion.observation.evidence import FITTING, Evidence, gather_evidence, misfit
from occfusion.observation.keypoints import face_vertices, keypoints_3d
from occfusion.types import Camera, Frame, Pose

Mask = NDArray[np.bool_]

LATELY_POSED = 8
"""Bodies that are kept: whoever goes through a video asks for a frame's several times, and for its neighbours'."""


@dataclass(frozen=True)
class Observation:
    """A frame as a prior sees it.

    Attributes:
        name: what errors call it.
        rgb: the person as far as seen, black elsewhere, float32 `[H, W, 3]`, 0..1.
        visible: the paper's M, bool `[H, W]`.
        background: pixels known to show no person, bool `[H, W]`.
        camera: the camera.
        vertices: the body mesh in the world, `[V, 3]`, metres.
        keypoints: its key points in the world, `[18, 3]`, metres.
        faces: its triangles, `[F, 3]`.
    """

    name: str
    rgb: NDArray[np.float32]
    visible: Mask
    background: Mask
    camera: Camera
    vertices: NDArray[np.float64]
    keypoints: NDArray[np.float64]
    faces: NDArray[np.int64]


class PosedBody(NamedTuple):
    """A frame's body.

    Attributes:
        vertices: the body mesh in the world, `[V, 3]`, metres.
        keypoints: `[18, 3]`, metres.
        projected: the mesh in the picture.
    """

    vertices: NDArray[np.float64]
    keypoints: NDArray[np.float64]
    projected: ProjectedMesh


@dataclass(frozen=True)
class ObservedFrame:
    """What is known of a training frame.

    Its body is posed when it is asked for: kept, those of a long video would take half a megabyte a frame.

    Attributes:
        index: number of the frame in the sequence.
        posed: gives the frame's body.
        evidence: what is hidden.
    """

    index: int
    posed: Callable[[], PosedBody]
    evidence: Evidence

    @property
    def vertices(self) -> NDArray[np.float64]:
        """The body mesh in the world, `[V, 3]`, metres."""
        return self.posed().vertices

    @property
    def keypoints(self) -> NDArray[np.float64]:
        """Key points in the world, `[18, 3]`, metres."""
        return self.posed().keypoints

    @property
    def projected(self) -> ProjectedMesh:
        """The mesh in the picture."""
        return self.posed().projected

    def observation(self, frame: Frame, body: Body) -> Observation:
        """Returns the frame as a prior sees it."""
        posed = self.posed()
        return Observation(
            name=frame.name,
            rgb=frame.rgb.cpu().numpy(),
            visible=frame.visible_mask.cpu().numpy(),
            background=self.evidence.background,
            camera=frame.camera.to("cpu"),
            vertices=posed.vertices,
            keypoints=posed.keypoints,
            faces=body.faces.cpu().numpy(),
        )


@torch.no_grad()
def observe_frames(frames: Iterable[Frame], body: Body) -> list[ObservedFrame]:
    """Returns what masks and poses say of the training frames of one camera.

    Raises:
        DataError: the body of a frame is nowhere in the picture.
    """
    face, faces = face_vertices(body), body.faces.cpu().numpy()
    bodies, seen = PackedMasks(), PackedMasks()
    known: list[tuple[int, Callable[[], PosedBody]]] = []
    views: list[tuple[Pose, Camera]] = []

    @lru_cache(LATELY_POSED)
    def posed_at(position: int) -> PosedBody:
        return _pose(body, *views[position], face)

    for frame in frames:
        camera = frame.camera.to("cpu")
        posed = partial(posed_at, len(views))
        views.append((frame.pose.to("cpu"), camera))
        pixels, depths = (projected := posed().projected).pixels, projected.depths
        x, y, w, h = box = box_of(pixels, camera.width, camera.height)
        covered = np.zeros((camera.height, camera.width), np.bool_)
        covered[y : y + h, x : x + w] = SampledMesh.draw(pixels, depths, faces, box).coverage > 0.5
        if not covered.any():
            raise DataError(
                f"frame {frame.name}: the body lies outside the picture or behind the camera; check its "
                f"parameters, or leave the frame out with dataset.train_frames"
            )
        bodies.put(len(known), covered)
        seen.put(len(known), frame.visible_mask.cpu().numpy())
        known.append((frame.index, posed))
    evidence = gather_evidence(bodies.values(), seen.values())
    return [ObservedFrame(index, posed, found) for (index, posed), found in zip(known, evidence, strict=True)]


@torch.no_grad()
def _pose(body: Body, pose: Pose, camera: Camera, face: tuple[int, ...]) -> PosedBody:
    own = pose.to(body.v_template.device)
    vertices, joints = (
        part.double().cpu() for part in body(own.betas, own.global_orient, own.body_pose, own.transl)
    )
    pixels, depths = project_vertices(
        vertices.numpy(), camera.viewmat.double().numpy(), camera.K.double().numpy()
    )
    points = keypoints_3d(vertices, joints, face).numpy()
    return PosedBody(vertices.numpy(), points, ProjectedMesh(pixels, depths))


def misfit_of(observed_frames: Sequence[ObservedFrame] | None) -> tuple[float, int] | None:
    """Returns how much of the body lies outside the mask, and in how many frames; None where these are too few.

    A share, the median of the frames that show a whole person.
    """
    whole = [
        observed_frame.evidence
        for observed_frame in observed_frames or ()
        if not observed_frame.evidence.occluded
    ]
    missed = misfit([own.outside_share for own in whole])
    return None if missed is None else (missed, len(whole))


def poses_fit(observed_frames: Sequence[ObservedFrame] | None) -> bool:
    """Returns whether poses need no mending, as far as the video tells."""
    measured = misfit_of(observed_frames)
    return measured is not None and measured[0] < FITTING
