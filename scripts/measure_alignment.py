"""How far joints are off before and after poses are aligned with outlines; nothing is trained.

python scripts/measure_alignment.py WORK 003-clean 003-camera 003-hard 003-wild

A line a scene: root mean square error of 22 joints across and along the first camera's line of sight, in millimetres,
as given and as aligned. Scenes are written to WORK where they are missing: 128 px, 60 frames, a strip before the person
in the first 48.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from numpy.typing import NDArray

from occfusion.human import Body
from occfusion.observation.pose_alignment import aligned_pose
from occfusion.run.prepare import observe
from occfusion.settings.schema import load_settings
from occfusion.synth import SceneSpec
from occfusion.synth.fullbody import bone_transforms, load_model_body, skin
from occfusion.synth.scene import Scene
from occfusion.synth.studio import Y_UP_TO_Z_UP
from occfusion.types import Pose

ROOT = Path(__file__).parents[1]
FRAMES = 60
JOINTS = 22
"""The fingers' joints of the body have no outline worth the name."""


def true_joints(scene: Scene, frame: int) -> NDArray[np.float64]:
    """Returns where the joints truly are, `[22, 3]`, metres."""
    body = load_model_body()
    rest = body.regressor @ (body.template + body.shapedirs @ scene.subject.betas)
    transforms = bone_transforms(scene.take.poses[frame], rest, body.parents)
    return np.asarray((skin(rest, np.eye(24), transforms) + scene.take.transl[frame]) @ Y_UP_TO_Z_UP.T)[
        :JOINTS
    ]


def joints_of(body: Body, pose: Pose) -> NDArray[np.float64]:
    """Returns where a pose has them, `[22, 3]`, metres."""
    found = body(pose.betas, pose.global_orient, pose.body_pose, pose.transl)[1]
    return np.asarray(found.double().numpy()[:JOINTS])


@torch.no_grad()
def line(name: str, work: Path) -> str:
    """Returns the line of a scene."""
    own = [
        f"dataset.scene={name}", f"dataset.root={work}", "dataset.image_size=128", f"dataset.frames={FRAMES}",
        "dataset.cameras=6", "trainer.accelerator=cpu",
    ]  # fmt: skip
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        settings = load_settings(compose("config", own))
    started = time.process_time()
    observed = observe(settings)
    seconds = time.process_time() - started
    if observed.alignment is None:
        return f"{name}: outlines tell too little"
    spline, body, data = observed.alignment.spline(), observed.body, observed.data
    scene = Scene(replace(SceneSpec.parse(name), image_size=16, frames=FRAMES, cameras=1))
    view = data.camera(0).viewmat[:3, :3].double().numpy()
    errors: tuple[list[NDArray[np.float64]], ...] = ([], [])
    for frame in data.train_indices:
        given, wanted = data.pose(frame), true_joints(scene, frame)
        for found, pose in zip(errors, (given, aligned_pose(given, spline, body)), strict=True):
            found.append((joints_of(body, pose) - wanted) @ view.T)
    cells = []
    for found in errors:
        each = 1000.0 * np.stack(found)
        across = float(np.sqrt((each[..., :2] ** 2).sum(axis=-1).mean()))
        cells.append(f"{across:.1f} across, {float(np.sqrt((each[..., 2] ** 2).mean())):.1f} along")
    corrected = (
        "corrected" if observed.registered is not None and observed.registered.corrections else "as given"
    )
    return (
        f"{name}: given {cells[0]}; aligned {cells[1]} mm; amount {observed.alignment.amount:g}; cameras {corrected}; "
        f"observed in {seconds:.0f} s of CPU time"
    )


def main() -> None:
    """Prints a line a scene."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("work", type=Path, help="folder of the written scenes")
    parser.add_argument("scene", nargs="+", help="embedded people, NNN-level")
    given = parser.parse_args()
    for name in given.scene:
        print(line(name, given.work.resolve()), flush=True)


if __name__ == "__main__":
    main()
