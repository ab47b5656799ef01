"""The words of the system: plain records that pass between the layers.

Conventions (`docs/reference/conventions.md`): metres; OpenCV camera axes (x right, y down, z forward);
`viewmat` maps world to camera; pixel centres lie at +0.5; quaternions are w, x, y, z.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

Box = tuple[int, int, int, int]
"""A pixel rectangle `(x, y, width, height)`; x and y are its first column and row."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    Attributes:
        viewmat: world to camera, `[4, 4]`, translation in metres.
        K: intrinsics in pixels, `[3, 3]`.
        width: image width in pixels.
        height: image height in pixels.
    """

    viewmat: Tensor
    K: Tensor
    width: int
    height: int

    @property
    def centre(self) -> Tensor:
        """Returns the camera centre in world coordinates, `[3]`, metres."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def depths(self, points: Tensor) -> Tensor:
        """Returns how far points `[N, 3]` lie before the camera along its axis, `[N]`, metres."""
        return points @ self.viewmat[2, :3].to(points) + self.viewmat[2, 3].to(points)

    def resized(self, width: int, height: int) -> Camera:
        """Returns the camera of the same picture resampled to `width` x `height`."""
        sx, sy = width / self.width, height / self.height
        K = self.K.clone()
        K[0] *= sx
        K[1] *= sy
        return replace(self, K=K, width=width, height=height)

    def to(self, device: torch.device | str) -> Camera:
        """Returns the camera with its tensors on `device`."""
        return replace(self, viewmat=self.viewmat.to(device), K=self.K.to(device))


@dataclass(frozen=True)
class Pose:
    """Body parameters of one frame in the conventions of smplx (rotation about the pelvis).

    Attributes:
        betas: shape coefficients, `[B]`.
        global_orient: root rotation as axis-angle, `[3]`, radians.
        body_pose: the other 23 joints as axis-angles, `[69]`, radians.
        transl: translation, `[3]`, metres.
        frame_index: number of the frame in the sequence that an avatar learns from, which corrections of that frame
            go by, with a share between two frames; None for any other pose.
    """

    betas: Tensor
    global_orient: Tensor
    body_pose: Tensor
    transl: Tensor
    frame_index: float | None = None

    def to(self, device: torch.device | str) -> Pose:
        """Returns the pose with its tensors on `device`."""
        parts = (self.betas, self.global_orient, self.body_pose, self.transl)
        betas, global_orient, body_pose, transl = (part.to(device) for part in parts)
        return Pose(betas, global_orient, body_pose, transl, self.frame_index)


@dataclass(frozen=True)
class Truth:
    """What the camera would have seen without the occluder; for evaluation only.

    Attributes:
        rgb: `[H, W, 3]`, 0..1; background removed (black outside `mask`).
        mask: the complete person, bool `[H, W]`.
        depth: of the person's true surface, `[H, W]`, metres along the optical axis; infinite where there is none.
            None where no data tell.
    """

    rgb: Tensor
    mask: Tensor
    depth: Tensor | None = None


@dataclass(frozen=True)
class Frame:
    """One picture of the person with all that is known about it.

    Attributes:
        index: position of the moment in the sequence (the same for all cameras).
        camera_index: which camera took it.
        name: what errors and tables call it, e.g. `"Camera_B1/000010"`.
        rgb: the observation, `[H, W, 3]`, 0..1; black where the person is not seen.
        visible_mask: the paper's M, bool `[H, W]`.
        occluded: pixels where an occluder, or another person who touches this one, hides what is behind it,
            bool `[H, W]`, or None when that is not known. Evaluation only: no method of the paper is given it.
        complete_mask: the paper's M-hat, bool `[H, W]`; None until a stage has made it.
        truth: the unoccluded person, None where it is not known: what other people hide never is.
        camera: the camera, at the size of `rgb`.
        pose: the body parameters as the data set gives them.
    """

    index: int
    camera_index: int
    name: str
    rgb: Tensor
    visible_mask: Tensor
    occluded: Tensor | None
    complete_mask: Tensor | None
    truth: Truth | None
    camera: Camera
    pose: Pose


@dataclass(frozen=True)
class Cloud:
    """Posed Gaussians in world coordinates, ready to be rasterised.

    Attributes:
        means: centres, `[N, 3]`, metres.
        covariances: `[N, 3, 3]`, square metres.
        opacities: `[N]`, 0..1.
        colors: `[N, 3]`, 0..1, already evaluated for the viewing direction.
        dilation: of the pictures that they were learned from, square pixels (`splat.Limits`).
    """

    means: Tensor
    covariances: Tensor
    opacities: Tensor
    colors: Tensor
    dilation: float


@dataclass(frozen=True)
class Rendering:
    """What the rasteriser returns.

    Attributes:
        rgb: `[H, W, 3]`, blended over the background.
        alpha: the paper's occupancy map A, `[H, W]`, 0..1.
        depth: expected depth, `[H, W]`, metres; 0 where alpha is 0.
        radii: half extents in pixels of each splat, `[N, 2]`; 0 where it was culled.
    """

    rgb: Tensor
    alpha: Tensor
    depth: Tensor
    radii: Tensor
