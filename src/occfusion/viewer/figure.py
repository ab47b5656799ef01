"""What a viewer shows of one run at one moment: Gaussians in a pose, turned joints, in the upright frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from occfusion.files.run_folder import STAGES, RunFolder
from occfusion.geometry.rotation import matrix_to_quaternion
from occfusion.motion import Performance, perform
from occfusion.run.loaded import LoadedRun, load_run
from occfusion.run.showing import SEQUENCE, MotionChoice, find_performance
from occfusion.show.drawing import ESTIMATED, parse_light
from occfusion.synth.rotations import axis_angle_from_quaternion, multiply, quaternion_from_axis_angle
from occfusion.types import Cloud, Pose

NEWEST = "newest"
"""The word for the furthest stage of a run, which may still go on."""


@dataclass(frozen=True)
class Splats:
    """Gaussians to be shown, upright frame, metres.

    Attributes:
        means: `[N, 3]`.
        covariances: `[N, 3, 3]`, with the footprint that they were learned with.
        colors: 0 to 1, as seen from where the camera is, `[N, 3]`.
        opacities: `[N]`.
    """

    means: NDArray[np.float32]
    covariances: NDArray[np.float32]
    colors: NDArray[np.float32]
    opacities: NDArray[np.float32]

    def ellipsoids(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Returns the axes of each as a rotation w, x, y, z `[N, 4]` and standard deviations `[N, 3]`."""
        variances, axes = np.linalg.eigh(self.covariances.astype(np.float64))
        axes *= np.sign(np.linalg.det(axes))[:, None, None]
        quats = matrix_to_quaternion(torch.from_numpy(axes))
        return quats.float().numpy(), np.sqrt(variances.clip(0.0)).astype(np.float32)


class Figure:
    """One run and one of its stages, ready to be posed.

    Args:
        folder: the run.
        stage: `optim`, `refine`, or `NEWEST`.
        motion: what it performs, as for `render`.
    """

    def __init__(self, folder: Path, stage: str = NEWEST, motion: str = SEQUENCE) -> None:
        self.folder = folder
        self._wanted = None if stage == NEWEST else stage
        self._motion = motion
        self._stamp: tuple[tuple[int, int], ...] | None = None
        self.run: LoadedRun
        self.own: Performance
        self.performance: Performance
        self.reload()

    def reload(self) -> bool:
        """Reads the avatar where its files are newer than what is shown; returns whether they were."""
        stamp = _stamp(RunFolder(self.folder))
        if stamp == self._stamp:
            return False
        self.run = load_run(self.folder, self._wanted)
        self._stamp = stamp
        self.own = perform(self.run.clip, self.run.avatar.body, self.run.betas)
        self._light = parse_light(ESTIMATED, self.run.avatar, self.own.upright).vector
        self.play(self._motion)
        return True

    def play(self, motion: str) -> None:
        """Takes another motion: `sequence`, an embedded clip, another run, or a file."""
        self.performance = find_performance(self.run, MotionChoice(motion))
        self._motion = motion
        self.run.avatar.relight(self._lamp(self.performance))

    def _lamp(self, performance: Performance) -> Tensor | None:
        """Returns the lamp in the world of a performance."""
        return None if self._light is None else performance.upright[:3, :3].T @ self._light

    @torch.inference_mode()
    def at_home(self, pose: Pose, eye: Tensor) -> Cloud:
        """Returns the Gaussians in a pose of their own sequence, in its world and its light, whatever plays.

        Args:
            pose: of the sequence.
            eye: where the camera is, `[3]`, metres.
        """
        avatar, shown = self.run.avatar, self.run.avatar.key_light
        avatar.relight(self._lamp(self.own))
        try:
            return avatar(pose, eye)
        finally:
            avatar.relight(shown)

    @property
    def label(self) -> str:
        """What is shown, in a few words."""
        run = self.run
        state = f"step {run.step}, not done" if run.step is not None else "done"
        return f"{run.stage}, {state}, {run.avatar.gaussians.num_gaussians} Gaussians"

    @torch.inference_mode()
    def cloud(self, row: int, turns: NDArray[np.float64], eye: NDArray[np.float64]) -> Cloud:
        """Returns the Gaussians at a moment, upright frame.

        Args:
            row: frame of the motion.
            turns: added to its joints' rotations, axis-angles `[24, 3]`, radians; 0 is the pelvis.
            eye: where the camera is, `[3]`, upright frame, metres.
        """
        avatar, upright = self.run.avatar, self.performance.upright
        pose = self.performance.pose(min(row, len(self.performance) - 1))
        if turns.any():
            whole = torch.cat([pose.global_orient, pose.body_pose]).double().numpy().reshape(-1, 3)
            turned = multiply(quaternion_from_axis_angle(whole), quaternion_from_axis_angle(turns))
            moved = torch.from_numpy(axis_angle_from_quaternion(turned)).float().flatten()
            pose = replace(pose, global_orient=moved[:3], body_pose=moved[3:])
        turn, shift = upright[:3, :3], upright[:3, 3]
        cloud = avatar(pose, (torch.tensor(eye).float() - shift) @ turn)
        return replace(
            cloud, means=cloud.means @ turn.T + shift, covariances=turn @ cloud.covariances @ turn.T
        )

    def splats(self, row: int, turns: NDArray[np.float64], eye: NDArray[np.float64]) -> Splats:
        """Returns the Gaussians at a moment as viewers take them; arguments as in `cloud`."""
        cloud = self.cloud(row, turns, eye)
        footprint = cloud.dilation * self.run.pixel**2
        return Splats(
            cloud.means.numpy(),
            (cloud.covariances + footprint * torch.eye(3)).numpy(),
            cloud.colors.clamp(0.0, 1.0).numpy(),
            cloud.opacities.numpy(),
        )


def _stamp(folder: RunFolder) -> tuple[tuple[int, int], ...]:
    paths = [path for name in STAGES for path in (folder.stage(name).avatar, folder.stage(name).checkpoint)]
    known = [path.stat() for path in paths if path.is_file()]
    return tuple((status.st_mtime_ns, status.st_size) for status in known)
