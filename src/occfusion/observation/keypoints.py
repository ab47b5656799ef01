"""The 18 key points of COCO / OpenPose on a body with SMPL's joints, and which of them the camera sees (paper §4.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from occfusion.human.body import Body
from occfusion.types import Camera

NAMES = (
    "nose", "neck", "r_shoulder", "r_elbow", "r_wrist", "l_shoulder", "l_elbow", "l_wrist", "r_hip", "r_knee",
    "r_ankle", "l_hip", "l_knee", "l_ankle", "r_eye", "l_eye", "r_ear", "l_ear",
)  # fmt: skip
NUM_KEYPOINTS = len(NAMES)
MIRRORED = (0, 1, 5, 6, 7, 2, 3, 4, 11, 12, 13, 8, 9, 10, 15, 14, 17, 16)
"""Which key point each becomes when the picture is mirrored."""

LIMBS = (
    (1, 2), (1, 5), (2, 3), (3, 4), (5, 6), (6, 7), (1, 8), (8, 9), (9, 10), (1, 11), (11, 12), (12, 13),
    (1, 0), (0, 14), (14, 16), (0, 15), (15, 17),
)  # fmt: skip
"""Pairs of key points that OpenPose joins, in the order in which it colours them."""

_BODY_JOINTS = {2: 17, 3: 19, 4: 21, 5: 16, 6: 18, 7: 20, 8: 2, 9: 5, 10: 8, 11: 1, 12: 4, 13: 7}
HEAD = 15
_SHOULDERS = (16, 17)
_FACE = (0, 14, 15, 16, 17)

SELF_OCCLUSION = 0.3
"""The paper's sigma, metres: a joint farther than this behind the surface is left out."""


@dataclass(frozen=True)
class Keypoints:
    """The key points as one camera sees them.

    Attributes:
        pixels: `[18, 2]`, pixels of the camera's picture; may lie outside it.
        depths: depth along the optical axis, `[18]`, metres.
        shown: whether a point is in front of the camera and passes the z-buffer test, bool `[18]`.
    """

    pixels: NDArray[np.float64]
    depths: NDArray[np.float64]
    shown: NDArray[np.bool_]


def face_vertices(body: Body) -> tuple[int, ...]:
    """Returns the vertices that stand for nose, right eye, left eye, right ear, left ear.

    Found on the template by where they are (it faces +z with +y up, as SMPL does), so that any body serves: the
    nose is the foremost vertex of the head, eyes lie above and beside it, ears are what stands out sideways.
    """
    points, on_head = body.v_template, body.weights[:, HEAD] > 0.5
    candidates = torch.nonzero(on_head)[:, 0]
    head = points[candidates]
    joint = body.joint_template[HEAD]
    top = float(head[:, 1].max())
    face = (head[:, 1] > joint[1]) & (head[:, 1] < 0.5 * (joint[1] + top) + 0.03)
    foremost = torch.where(face, head[:, 2], torch.full_like(head[:, 2], -torch.inf)).argmax()
    nose = head[foremost]
    height = top - float(joint[1])
    found = [int(candidates[foremost])]
    for x, y, z in (
        (-0.16, 0.18, -0.10), (0.16, 0.18, -0.10), (-0.40, 0.08, -0.55), (0.40, 0.08, -0.55),
    ):  # fmt: skip
        # in head heights from the nose; the wearer's right is at negative x
        wanted = torch.stack([joint[0] + x * height, nose[1] + y * height, nose[2] + z * height])
        found.append(int(candidates[(head - wanted).square().sum(1).argmin()]))
    return tuple(found)


def keypoints_3d(vertices: Tensor, joints: Tensor, face: tuple[int, ...]) -> Tensor:
    """Returns the key points of a posed body, `[18, 3]`, in the frame of its vertices.

    Args:
        vertices: `[V, 3]`.
        joints: `[24, 3]`.
        face: the five vertices of `face_vertices`.
    """
    out = vertices.new_empty(NUM_KEYPOINTS, 3)
    out[list(_BODY_JOINTS)] = joints[list(_BODY_JOINTS.values())]
    out[1] = 0.5 * (joints[_SHOULDERS[0]] + joints[_SHOULDERS[1]])
    out[list(_FACE)] = vertices[list(face)]
    return out


def see_keypoints(
    points: Tensor, camera: Camera, surface_depth: NDArray[np.float32], sigma: float = SELF_OCCLUSION
) -> Keypoints:
    """Returns where a camera sees the key points, without those that the body itself hides (paper §4.1).

    Args:
        points: key points in the world, `[18, 3]`, metres.
        camera: whose picture it is.
        surface_depth: the z-buffer of the body mesh in that picture, `[H, W]`, metres; infinite where it is not.
        sigma: how far behind the surface a point may lie, metres; infinite keeps all.
    """
    viewmat = camera.viewmat.double().cpu()
    local = (points.double().cpu() @ viewmat[:3, :3].T + viewmat[:3, 3]).numpy()
    K = camera.K.double().cpu().numpy()
    depths = local[:, 2]
    ahead = depths > 0.01
    pixels = (local[:, :2] / np.where(ahead, depths, 1.0)[:, None]) @ K[:2, :2].T + K[:2, 2]
    height, width = surface_depth.shape
    inside = ahead & (pixels >= 0).all(1) & (pixels[:, 0] < width) & (pixels[:, 1] < height)
    column = np.where(inside, pixels[:, 0], 0.0).astype(int)
    row = np.where(inside, pixels[:, 1], 0.0).astype(int)
    surface = np.where(inside, surface_depth[row, column], np.inf)
    return Keypoints(pixels, depths, ahead & ~(depths - surface > sigma))
