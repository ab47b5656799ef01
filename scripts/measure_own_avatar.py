"""Measures an avatar of an imported clip beside one of the same clip with true poses and camera.

    python scripts/render_plain_clip.py 101 --output clips/101
    python scripts/measure_own_avatar.py clips/101 --output runs/own speed=fast dataset.image_size=256

Both are trained by the command that `import` prints, with the words behind it; pictures and masks are the import's.
Held-out frames of the clip's own camera are evaluated by the runs themselves, poses being inputs. For other cameras
the person is rendered anew from around, over black; the fit's world is laid on the true one by one rotation and shift
of all joints of the clip, and by one for each frame. `posed`: what was learned apart from where the fit has the body:
the avatar is put into the true poses, its joints on the true ones by a shift, and its size is the person's, which one
camera does not tell. PSNR is over the person's box, 10 % larger.
"""

from __future__ import annotations

import argparse
import json
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import render_plain_clip as plain
import torch
from scipy.spatial.transform import Rotation

from occfusion.fitting.batch import height_at_rest
from occfusion.human import embedded_body
from occfusion.human.rendering import Renderer
from occfusion.run.loaded import load_run
from occfusion.synth.scene import Scene
from occfusion.synth.spec import SceneSpec
from occfusion.types import Camera, Pose

AROUND, EVERY, MARGIN = (60, 120, 180, 240, 300), 5, 0.1
"""Degrees about the upright axis of other cameras; each so-manyth held-out frame; of the box."""


def rigid(ours: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Returns the rotation and shift `[4, 4]` that lays points `[N, 3]` on others best."""
    out = np.eye(4)
    turn, _ = Rotation.align_vectors(truth - truth.mean(axis=0), ours - ours.mean(axis=0))
    out[:3, :3] = turn.as_matrix()
    out[:3, 3] = truth.mean(axis=0) - out[:3, :3] @ ours.mean(axis=0)
    return out


def imported(clip: Path, folder: Path) -> list[str]:
    """Imports a clip unless that is done; returns the words of the training command."""
    log = folder.with_suffix(".txt")
    if not log.exists():
        words = [sys.executable, "-m", "occfusion", "import", str(clip), "--output", str(folder)]
        done = subprocess.run(words, capture_output=True, text=True, check=True)
        log.write_text(done.stdout)
    text = log.read_text()
    return shlex.split(text[text.index("python train.py") :].replace("\\\n", " "))[1:]


def with_truth(folder: Path, truth: dict[str, np.ndarray], output: Path) -> None:
    """Copies an import, with true poses and the true camera in place of its own."""
    if output.exists():
        return
    shutil.copytree(folder, output)
    frames = json.loads((folder / "import.json").read_text())["numbers"]
    camera = dict(np.load(folder / "cameras.npz"))
    np.savez(output / "cameras.npz", **{**camera, "intrinsic": truth["K"]})
    poses = truth["poses"][frames]
    np.savez(
        output / "poses.npz", betas=truth["betas"], global_orient=poses[:, :3], body_pose=poses[:, 3:],
        transl=truth["transl"][frames],
    )  # fmt: skip


def trained(words: list[str], name: str, run: Path, more: list[str]) -> dict[str, float]:
    """Trains unless that is done; returns what the run says of the held-out frames."""
    if not (run / "metrics.json").exists():
        words = [f"dataset.scene={name}" if w.startswith("dataset.scene=") else w for w in words]
        subprocess.run([sys.executable, *words, f"output_dir={run}", *more], check=True)
    found = json.loads((run / "metrics.json").read_text())["regions"]
    return {key: found[key]["psnr"] for key in ("full", "box")}


def joints_of(folder: Path) -> tuple[dict[str, torch.Tensor], np.ndarray]:
    """Returns the poses of a folder, and their joints `[N, 24, 3]`."""
    rows = {key: torch.tensor(value).float() for key, value in np.load(folder / "poses.npz").items()}
    body, names = embedded_body(), ("global_orient", "body_pose", "transl")
    each = zip(*(rows[name] for name in names), strict=True)
    with torch.no_grad():
        return rows, np.stack([body(rows["betas"], *row)[1].double().numpy() for row in each])


def views_around(view: np.ndarray) -> list[np.ndarray]:
    """Returns world to camera of cameras turned about the world's upright axis."""
    out = []
    for degrees in AROUND:
        turn = np.eye(4)
        turn[:3, :3] = cv2.Rodrigues(np.array([0.0, 0.0, np.radians(degrees)]))[0]
        out.append(view @ turn)
    return out


@torch.no_grad()
def from_around(
    run: Path, folder: Path, scene: Scene, truth: dict[str, np.ndarray], frames: list[int], side: int
) -> dict[str, float]:
    """Returns the mean PSNR from other cameras: worlds laid on each other once, in each frame, and posed truly."""
    K, view = plain.camera()
    rows, joints = joints_of(folder)
    numbers = json.loads((folder / "import.json").read_text())["numbers"]
    wanted = truth["joints"][numbers]
    once = rigid(joints.reshape(-1, 3), wanted.reshape(-1, 3))
    loaded, renderer = load_run(run), Renderer("auto")
    width, height = side, round(side * plain.HEIGHT / plain.WIDTH)
    small = np.diag([width / plain.WIDTH, height / plain.HEIGHT, 1.0]) @ K
    out: dict[str, list[float]] = {"once": [], "each frame": [], "posed": []}
    size = size_of(truth["betas"]) / size_of(rows["betas"])
    black = np.zeros((plain.HEIGHT, plain.WIDTH, 3), np.float32)
    for frame in frames:
        pose = Pose(
            rows["betas"], rows["global_orient"][frame], rows["body_pose"][frame], rows["transl"][frame],
            float(frame),
        )  # fmt: skip
        for around in views_around(view):
            picture, mask = plain.shot(scene, numbers[frame], K, around, black)
            picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA) / 255.0
            box = box_of(cv2.resize(mask.astype(np.uint8), (width, height)) > 0)
            for key, shown, onto in (
                ("once", pose, once),
                ("each frame", pose, rigid(joints[frame], wanted[frame])),
                ("posed", *posed_truly(rows["betas"], truth["poses"][numbers[frame]], wanted[frame], size)),
            ):
                seen = around @ np.linalg.inv(view) @ onto
                # in a world that is larger the camera is farther
                seen[:3] /= np.cbrt(np.linalg.det(seen[:3, :3]))
                camera = Camera(torch.tensor(seen).float(), torch.tensor(small).float(), width, height)
                drawn = renderer.draw(loaded.avatar(shown, camera.centre), camera).rgb.clamp(0, 1).numpy()
                out[key].append(-10 * np.log10(((drawn - picture)[box] ** 2).mean()))
    return {key: float(np.mean(values)) for key, values in out.items()}


def size_of(betas: np.ndarray | torch.Tensor) -> float:
    """Returns the height at rest of a body of that shape, metres."""
    return float(height_at_rest(embedded_body(), torch.as_tensor(betas).float()))


def posed_truly(
    betas: torch.Tensor, pose: np.ndarray, wanted: np.ndarray, size: float
) -> tuple[Pose, np.ndarray]:
    """Returns a body of that shape in a pose `[72]`, and what lays it on true joints: a shift, after a scale."""
    turns = torch.tensor(pose).float()
    shown = Pose(betas, turns[:3], turns[3:], torch.zeros(3), 0.0)
    _, joints = embedded_body()(betas, shown.global_orient, shown.body_pose, shown.transl)
    onto = np.diag([size, size, size, 1.0])
    onto[:3, 3] = wanted.mean(axis=0) - size * joints.double().numpy().mean(axis=0)
    return shown, onto


def box_of(mask: np.ndarray) -> tuple[slice, slice]:
    """Returns the box about a mask, larger by `MARGIN`."""
    parts = []
    for axis in (1, 0):
        where = np.flatnonzero(mask.any(axis=axis))
        more = round(MARGIN * (where[-1] - where[0]))
        parts.append(slice(max(0, where[0] - more), where[-1] + 1 + more))
    return parts[0], parts[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", help="of render_plain_clip.py")
    parser.add_argument(
        "--output", type=Path, required=True, help="for data and runs; what is there is not done again"
    )
    arguments, more = parser.parse_known_args()
    folders, more = [f for f in arguments.folders if f.is_dir()], [
        *(str(f) for f in arguments.folders if not f.is_dir()), *more
    ]  # fmt: skip
    side = next((int(w.split("=")[1]) for w in more if w.startswith("dataset.image_size=")), 512)
    for folder in folders:
        truth = dict(np.load(folder / "truth.npz"))
        fitted = arguments.output / "data" / folder.name
        fitted.parent.mkdir(parents=True, exist_ok=True)
        words = imported(folder / "clip.mp4", fitted)
        exact = fitted.with_name(f"{folder.name}-true")
        with_truth(fitted, truth, exact)
        scene = Scene(
            SceneSpec(int(folder.name), "hard", frames=len(truth["poses"]), cameras=1, image_size=720)
        )
        count = len(json.loads((fitted / "import.json").read_text())["numbers"])
        frames = list(range(max(1, round(0.8 * count)), count, EVERY))
        for data in (fitted, exact):
            run = arguments.output / "runs" / data.name
            own = trained(words, data.name, run, more)
            others = from_around(run, data, scene, truth, frames, side)
            print(
                f"{data.name}: own camera, held-out frames {own['full']:.2f} dB, in the box {own['box']:.2f}; other "
                f"cameras {others['once']:.2f} dB, laid on each other frame by frame {others['each frame']:.2f}, posed "
                f"as the person was {others['posed']:.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
