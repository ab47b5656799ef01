"""The training frames before any mask is completed: where the body is, and how much of it an occluder hides."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import NamedTuple, overload

import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.errors import DataError
from occfusion.fields.bits import PackedMasks
from occfusion.geometry.camera import project_vertices
from occfusion.geometry.sampled_mesh import SampledMesh, box_of
from occfusion.human.body import Body
from occfusion.human.posed_mesh import mesh_poser
from occfusion.observation.consistency import ProjectedMesh
from occfusion.observation.evidence import (
    FITTING,
    Evidence,
    are_fitting,
    evidence_of,
    gather_evidence,
    misfit,
)
from occfusion.observation.keypoints import face_vertices, keypoints_3d
from occfusion.types import Camera, Frame, Pose

Mask = NDArray[np.bool_]

LATELY_POSED = 8
"""Bodies that are kept: whoever goes through a video asks for a frame's several times, and for its neighbours'."""
JUDGED = 200
"""Frames that decisions go by, evenly spread."""


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


class ObservedFrames(Sequence[ObservedFrame]):
    """What is known of the training frames; each is looked at when it is asked for, and remembered.

    Decisions go by some of a long video. What a step needs of one of the others is found when it comes to it.

    Args:
        indices: numbers of the frames in the sequence.
        look: looks at the frame of a position.
        sample: positions of the frames that decisions go by.
    """

    def __init__(
        self, indices: Sequence[int], look: Callable[[int], ObservedFrame], sample: Sequence[int]
    ) -> None:
        self.indices, self.sample, self._look = tuple(indices), list(sample), look
        self.positions = {index: position for position, index in enumerate(self.indices)}
        self._found: dict[int, ObservedFrame] = {}

    @classmethod
    def of(cls, frames: Sequence[ObservedFrame]) -> ObservedFrames:
        """Returns frames that were looked at, all of which decisions go by."""
        return cls([frame.index for frame in frames], frames.__getitem__, range(len(frames)))

    def __len__(self) -> int:
        """How many frames are trained on."""
        return len(self.indices)

    @overload
    def __getitem__(self, position: int) -> ObservedFrame: ...
    @overload
    def __getitem__(self, position: slice) -> list[ObservedFrame]: ...
    def __getitem__(self, position: int | slice) -> ObservedFrame | list[ObservedFrame]:
        """Returns what is known of the frame at a position.

        Raises:
            DataError: its body is nowhere in the picture.
        """
        if isinstance(position, slice):
            return [self[k] for k in range(len(self))[position]]
        place = range(len(self))[position]
        if place not in self._found:
            self._found[place] = self._look(place)
        return self._found[place]

    @property
    def judged(self) -> list[ObservedFrame]:
        """The frames that decisions go by, in order."""
        return [self[k] for k in self.sample]

    def changed(self, change: Callable[[ObservedFrame], ObservedFrame]) -> ObservedFrames:
        """Returns the same frames, each of them changed when it is asked for."""
        return ObservedFrames(self.indices, lambda position: change(self[position]), self.sample)


@torch.no_grad()
def observe_frames(read: Callable[[int], Frame], indices: Sequence[int], body: Body) -> ObservedFrames:
    """Returns what masks and poses say of the training frames of one camera.

    Args:
        read: gives the frame at a position.
        indices: numbers of the frames in the sequence.
        body: of their poses.

    Raises:
        DataError: the body of a frame that decisions go by is nowhere in the picture.
    """
    count, face = len(indices), face_vertices(body)
    sample = np.linspace(0, count - 1, min(JUDGED, count)).round().astype(int).tolist()
    bodies, seen = PackedMasks(), PackedMasks()
    views: dict[int, tuple[Pose, Camera]] = {}

    @lru_cache(LATELY_POSED)
    def posed_at(position: int) -> PosedBody:
        return _pose(body, *views[position], face)

    def masks_at(position: int) -> tuple[Mask, Mask]:
        frame = read(position)
        views[position] = frame.pose.to("cpu"), frame.camera.to("cpu")
        return _covered(frame, posed_at(position).projected, body), frame.visible_mask.cpu().numpy()

    for position in sample:
        covered, visible = masks_at(position)
        bodies.put(position, covered)
        seen.put(position, visible)
    sampled = dict(zip(sample, gather_evidence(bodies.values(), seen.values()), strict=True))
    fits = are_fitting((own.hidden_share, own.outside_share) for own in sampled.values())

    @torch.no_grad()
    def look(position: int) -> ObservedFrame:
        evidence = sampled.get(position) or evidence_of(*masks_at(position), fits=fits)
        return ObservedFrame(indices[position], partial(posed_at, position), evidence)

    return ObservedFrames(indices, look, sample)


def _covered(frame: Frame, projected: ProjectedMesh, body: Body) -> Mask:
    """Returns the pixels of a frame that the body covers by more than half, `[H, W]`."""
    (height, width), poser = frame.visible_mask.shape, mesh_poser(body)
    x, y, w, h = box = box_of(projected.pixels, width, height)
    drawn = SampledMesh.draw(projected.pixels, projected.depths, poser.faces, box, closed=poser.closed)
    covered = np.zeros((height, width), np.bool_)
    covered[y : y + h, x : x + w] = drawn.coverage > 0.5
    if not covered.any():
        raise DataError(
            f"frame {frame.name}: the body lies outside the picture or behind the camera; check its "
            f"parameters, or leave the frame out with dataset.train_frames"
        )
    return covered


@torch.no_grad()
def _pose(body: Body, pose: Pose, camera: Camera, face: tuple[int, ...]) -> PosedBody:
    mesh = mesh_poser(body).pose(pose)
    pixels, depths = project_vertices(
        mesh.vertices, camera.viewmat.double().numpy(), camera.K.double().numpy()
    )
    points = keypoints_3d(torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.joints), face).numpy()
    return PosedBody(mesh.vertices, points, ProjectedMesh(pixels, depths))


def misfit_of(observed_frames: ObservedFrames | None) -> tuple[float, int] | None:
    """Returns how much of the body lies outside the mask, and in how many frames; None where these are too few.

    A share, the median of the frames that show a whole person.
    """
    whole = [
        observed_frame.evidence
        for observed_frame in (() if observed_frames is None else observed_frames.judged)
        if not observed_frame.evidence.occluded
    ]
    missed = misfit([own.outside_share for own in whole])
    return None if missed is None else (missed, len(whole))


def poses_fit(observed_frames: ObservedFrames | None) -> bool:
    """Returns whether poses need no mending, as far as the video tells."""
    measured = misfit_of(observed_frames)
    return measured is not None and measured[0] < FITTING
