"""Draws what the simplification of the pose does for a challenging one (paper §4.1).

    python scripts/draw_simplified_pose.py [OUTPUT.png]

Left to right: the body as its depth, all 18 key points, and those that the z-buffer test leaves.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch

from occfusion.files.atomic import write_png
from occfusion.human.body import embedded_body
from occfusion.observation.bodyview import project, view_body
from occfusion.observation.crop import Square
from occfusion.observation.keypoints import face_vertices, keypoints_3d, see_keypoints
from occfusion.priors.sd15.canvas import draw_keypoints
from occfusion.types import Camera

SIZE = 320
TURNS = (0.0, 90.0, 200.0)  # degrees about the vertical


def main(output: Path) -> None:
    """Writes the picture."""
    body = embedded_body()
    pose = torch.zeros(24, 3)
    pose[1], pose[4] = torch.tensor([-1.3, 0.0, 0.15]), torch.tensor([1.2, 0.0, 0.0])  # a knee lifted
    pose[16], pose[17] = (
        torch.tensor([0.0, -0.9, -0.5]),
        torch.tensor([0.7, 0.0, 0.9]),
    )  # an arm before, one behind
    pose[18], pose[19] = torch.tensor([0.0, -0.7, 0.0]), torch.tensor([0.0, 0.9, 0.0])
    rows = []
    for turn in TURNS:
        orient = torch.tensor([0.0, np.deg2rad(turn), 0.0], dtype=torch.float32)
        vertices, joints = body(torch.zeros(10), orient, pose[1:].flatten(), torch.zeros(3))
        points = keypoints_3d(vertices, joints, face_vertices(body))
        viewmat = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
        viewmat[2, 3] = 3.0
        K = torch.tensor([[1000.0, 0.0, 512.0], [0.0, 1000.0, 512.0], [0.0, 0.0, 1.0]])
        camera = Camera(viewmat, K, 1024, 1024)
        corners = vertices.double().numpy()
        pixels, _ = project(corners, viewmat.double().numpy(), K.double().numpy())
        window = Square.around(pixels).camera(camera, SIZE)
        view = view_body(
            *project(corners, viewmat.double().numpy(), window.K.double().numpy()),
            body.faces.numpy(),
            SIZE,
            SIZE,
        )
        grey = np.where(np.isfinite(view.depth), 110.0 - 100.0 * view.relative_depth, 0.0).clip(0, 255)
        canvases = [
            draw_keypoints(see_keypoints(points, window, view.depth, sigma), SIZE, SIZE)
            for sigma in (np.inf, 0.3)
        ]
        rows.append(np.hstack([np.repeat(grey[..., None], 3, axis=2).astype(np.uint8), *canvases]))
    write_png(output, np.vstack(rows))


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("docs/pictures/simplified_pose.png"))
