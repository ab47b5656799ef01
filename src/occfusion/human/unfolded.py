"""The body's surface as two pictures: its front and its back in the canonical pose, one behind the other.

A pixel of the front and the same pixel of the back are places of the body that lie behind each other. So a network
that works on pictures sees at once what a place has opposite it, and, mirrored, on the other side of the body.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from occfusion.geometry.distance import nearest_set
from occfusion.geometry.normals import vertex_normals
from occfusion.geometry.zbuffer import NO_FACE, rasterize_mesh
from occfusion.human.body import Body

MARGIN = 0.04
"""Share of a picture that is left free on each side."""


class UnfoldedBody:
    """The mean-shape body in the canonical pose, drawn in parallel from before and from behind.

    Both pictures have the person's left at the same columns: the back is seen as if through the front.

    Args:
        body: the body.
        size: pixels a side of a picture, S.

    Attributes:
        mask: where a picture shows the body, bool `[2, S, S]`: front, back.
        depth: how far before the body's middle a pixel's place lies, in body heights, `[2, S, S]`; 0 outside.
        grid: left to right and top to bottom, -1..1 of the body's height about its middle, `[2, S, S]`.
    """

    def __init__(self, body: Body, size: int) -> None:
        points = body.da_vertices().detach().double().cpu().numpy()
        faces = body.faces.cpu().numpy()
        low, high = points.min(axis=0), points.max(axis=0)
        middle, extent = 0.5 * (low + high), float((high - low)[:2].max())
        scale = size * (1.0 - 2.0 * MARGIN) / extent
        pixels = np.stack([points[:, 0] - middle[0], middle[1] - points[:, 1]], axis=1) * scale + 0.5 * size
        self.size = size
        self._pixels = torch.from_numpy(pixels)
        sides = []
        for sign in (1.0, -1.0):  # the corners' order does not matter to the z-buffer
            seen = rasterize_mesh(pixels, 1.0 + extent - sign * (points[:, 2] - middle[2]), faces, size, size)
            sides.append(seen)
        face = np.stack([seen.face for seen in sides])
        self.mask = torch.from_numpy(face != NO_FACE)
        self._corners = torch.from_numpy(faces[np.where(face == NO_FACE, 0, face)].astype(np.int64))
        weights = np.stack([seen.barycentrics for seen in sides]).astype(np.float32)
        self._weights = torch.from_numpy(weights) * self.mask[..., None]
        height = float(high[1] - low[1])
        depth = torch.from_numpy(((points[:, 2] - middle[2]) / height).astype(np.float32))
        self.depth = self.unfold(depth[:, None])[:, 0]
        across = (torch.arange(size, dtype=torch.float32) + 0.5 - 0.5 * size) / (0.5 * size)
        self.grid = torch.stack([across.expand(size, size), across[:, None].expand(size, size)])
        self._side = torch.from_numpy((vertex_normals(points, faces)[:, 2] < 0).astype(np.int64))
        self._nearest = torch.from_numpy(np.stack([nearest_set(mask) for mask in face != NO_FACE]))

    def unfold(self, values: Tensor) -> Tensor:
        """Returns what vertices have, `[V, C]`, as pictures `[2, C, S, S]`; 0 outside of the body."""
        drawn = (values[self._corners] * self._weights[..., None].to(values)).sum(dim=3)
        return drawn.permute(0, 3, 1, 2)

    def fold(self, pictures: Tensor) -> Tensor:
        """Returns what pictures `[2, C, S, S]` have at each vertex, `[V, C]`: of the side that it faces, bilinear.

        Pixels outside of the body count as the nearest one on it.
        """
        count = pictures.shape[1]
        flat = pictures.reshape(2, count, -1)
        whole = torch.stack(
            [side[:, nearest.reshape(-1)] for side, nearest in zip(flat, self._nearest, strict=True)]
        )
        whole = whole.reshape(pictures.shape)
        places = (self._pixels / self.size * 2.0 - 1.0).to(pictures)[None, None].expand(2, 1, -1, 2)
        taken = F.grid_sample(whole, places, mode="bilinear", padding_mode="border", align_corners=False)[
            :, :, 0
        ]
        index = self._side.to(pictures.device)[None, :].expand(count, -1)
        return torch.where(index == 0, taken[0], taken[1]).T.contiguous()
