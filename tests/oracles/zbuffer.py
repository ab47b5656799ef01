"""A z-buffer by ray casting: one ray a pixel against every triangle, in float64."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def cast_rays(
    points: NDArray[np.float64], faces: NDArray[np.int64], K: NDArray[np.float64], width: int, height: int
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Returns depth, face, barycentrics and how near each pixel is to a tie.

    The ray through a pixel centre is `t * K^-1 (x, y, 1)`, so that t is the depth. Corner weights solve
    `[p_i p_j p_k] w = ray`; they are positive inside the triangle, and `t = 1 / sum(w)`.
    The last array is the smaller of the smallest weight of the seen triangle (relative) and
    the relative depth distance to the next surface: where it is tiny, rounding may decide.
    """
    depth = np.full((height, width), np.inf)
    face = np.full((height, width), -1)
    weights = np.zeros((height, width, 3))
    margin = np.full((height, width), np.inf)
    for row in range(height):
        for column in range(width):
            ray = np.linalg.solve(K, np.array([column + 0.5, row + 0.5, 1.0]))
            hits = []
            for f, corners in enumerate(faces):
                try:
                    w = np.linalg.solve(points[corners].T, ray)
                except np.linalg.LinAlgError:
                    continue
                t = 1.0 / w.sum()
                share = w * t
                margin[row, column] = min(margin[row, column], np.abs(share).min())
                if (w >= 0).all():
                    hits.append((t, f, share))
            hits.sort(key=lambda hit: (hit[0], hit[1]))
            if hits:
                depth[row, column], face[row, column], weights[row, column] = hits[0]
                if len(hits) > 1:
                    margin[row, column] = min(margin[row, column], hits[1][0] / hits[0][0] - 1.0)
    return depth, face, weights, margin
