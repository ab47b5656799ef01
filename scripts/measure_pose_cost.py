"""Measures what errors of fitted poses cost in pictures, whatever an avatar learns: the true person, posed by the fit.

    python scripts/render_plain_clip.py 3 --output clips/3
    python -m occfusion import clips/3/clip.mp4 --output data/3
    python scripts/measure_pose_cost.py clips/3 data/3

The rendered person of a clip, with the clip's own clothes, shape and light, takes poses between the true ones and
those of the fit, and is drawn beside the truth in the clip's camera and five others. The fit's world is laid on the
true one by one rotation and shift of the clip, or of each frame. No avatar can be nearer in such views than this
person is, but by chance: its look is the truth.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
import render_plain_clip as plain
from measure_own_avatar import box_of, joints_of, rigid, views_around
from scipy.spatial.transform import Rotation, Slerp

from occfusion.synth.fullbody import bone_transforms, load_model_body
from occfusion.synth.scene import Scene
from occfusion.synth.spec import SceneSpec
from occfusion.synth.studio import Y_UP_TO_Z_UP

SIDE = 192
"""Pixels of the pictures' longer side."""
SHARES = (0.25, 0.5, 0.75, 1.0)
"""Of the way from the true pose to the fit's."""


def between(one: np.ndarray, other: np.ndarray, share: float) -> np.ndarray:
    """Returns axis-angles `[24, 3]` so far along the way from one pose to another, joint by joint."""
    rows = [
        Slerp([0, 1], Rotation.from_rotvec([a, b]))(share).as_rotvec()
        for a, b in zip(one, other, strict=True)
    ]
    return np.stack(rows)


class Puppet:
    """The person of a clip, in any pose: poses and places are of the clip's camera."""

    def __init__(self, subject: int, frames: int) -> None:
        self.scene = Scene(SceneSpec(subject, "hard", frames=frames, cameras=1, image_size=720))
        self.K, self.view = plain.camera()
        self.parents, self.at_rest = load_model_body().parents, plain.joints_at_rest(self.scene)
        self.turn = self.view[:3, :3] @ Y_UP_TO_Z_UP
        self.black = np.zeros((plain.HEIGHT, plain.WIDTH, 3), np.float32)

    def joints(self, pose: np.ndarray, pelvis: np.ndarray) -> np.ndarray:
        """Returns the joints `[24, 3]` in the camera of a pose `[24, 3]` whose pelvis is there."""
        moves = bone_transforms(pose.reshape(72), self.at_rest, self.parents)
        places = (moves[:, :3, :3] @ self.at_rest[:, :, None])[..., 0] + moves[:, :3, 3]
        return places - places[0] + pelvis

    def seen(
        self, frame: int, pose: np.ndarray, pelvis: np.ndarray, views: list[np.ndarray]
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Returns picture and mask from each view."""
        root = Rotation.from_matrix(self.turn.T @ Rotation.from_rotvec(pose[0]).as_matrix()).as_rotvec()
        take = self.scene.take
        take.poses[frame] = np.concatenate([root, pose[1:].reshape(69)])
        take.transl[frame] = self.turn.T @ (pelvis - self.view[:3, 3]) - self.at_rest[0]
        out = []
        for view in views:
            picture, mask = plain.shot(self.scene, frame, self.K, view, self.black)
            size = (SIDE, round(SIDE * plain.HEIGHT / plain.WIDTH))
            small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA) / 255.0
            out.append((small, cv2.resize(mask.astype(np.uint8), size) > 0))
        return out


def turned(pose: np.ndarray, joints: np.ndarray, by: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns a pose and its pelvis after a rotation and shift `[4, 4]` of the world."""
    out = pose.copy()
    out[0] = (Rotation.from_matrix(by[:3, :3]) * Rotation.from_rotvec(pose[0])).as_rotvec()
    return out, by[:3, :3] @ joints[0] + by[:3, 3]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "clip", type=Path, help="folder of render_plain_clip.py, named by the subject's number"
    )
    parser.add_argument("fit", type=Path, help="folder that import wrote of it")
    parser.add_argument("--every", type=int, default=20, help="each so-manyth frame")
    arguments = parser.parse_args()
    truth = dict(np.load(arguments.clip / "truth.npz"))
    puppet = Puppet(int(arguments.clip.name), len(truth["poses"]))
    rows, fitted = joints_of(arguments.fit)
    numbers = json.loads((arguments.fit / "import.json").read_text())["numbers"]
    wanted = truth["joints"][numbers]
    once = rigid(fitted.reshape(-1, 3), wanted.reshape(-1, 3))
    views = [puppet.view, *views_around(puppet.view)]
    errors: dict[str, list[list[float]]] = {}
    for row in range(0, len(numbers), arguments.every):
        frame = numbers[row]
        true_pose = truth["poses"][frame].reshape(24, 3)
        exact = puppet.seen(frame, true_pose, wanted[row, 0], views)
        fit = np.concatenate([rows["global_orient"][row].numpy(), rows["body_pose"][row].numpy()]).reshape(
            24, 3
        )
        cases = {
            "as fitted": (fit.astype(np.float64), fitted[row, 0]),
            "one rotation and shift": turned(fit, fitted[row], once),
        }
        own, _ = turned(fit, fitted[row], rigid(fitted[row], wanted[row]))
        for share in SHARES:
            pose = between(true_pose, own, share)
            by = rigid(puppet.joints(pose, wanted[row, 0]), wanted[row])
            cases[f"frame by frame, {share:.0%} of the error"] = turned(
                pose, puppet.joints(pose, wanted[row, 0]), by
            )
        for name, (pose, pelvis) in cases.items():
            off = 1000 * np.linalg.norm(puppet.joints(pose, pelvis) - wanted[row], axis=1).mean()
            worth = [
                -10 * np.log10(((drawn - picture)[box_of(mask)] ** 2).mean())
                for (drawn, _), (picture, mask) in zip(
                    puppet.seen(frame, pose, pelvis, views), exact, strict=True
                )
            ]
            errors.setdefault(name, []).append([off, worth[0], float(np.mean(worth[1:]))])
    for name, values in errors.items():
        off, own_camera, others = np.mean(values, axis=0)
        print(f"{name}: joints {off:.0f} mm off, own camera {own_camera:.1f} dB, others {others:.1f} dB")


if __name__ == "__main__":
    main()
