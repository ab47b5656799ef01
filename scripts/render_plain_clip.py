"""Renders an embedded person as a plain video over a rendered background, with the truth beside it.

    python scripts/render_plain_clip.py 101 --output clips/101            # 100 frames, 1280 x 720
    python scripts/render_plain_clip.py 101 --bar 0.5 --output clips/101b # half hidden in 80 % of the frames
    python scripts/render_plain_clip.py 2 --mixed --output clips/002m     # poses that no recording has
    python scripts/render_plain_clip.py 101 --pan 12 --output clips/101p  # the camera turns to and fro

Writes `clip.mp4`, and `truth.npz`: `joints` N x 24 x 3 (camera, metres), `K`, `betas`, `poses`, `transl` (camera),
`bars` N x 2, the columns of the bar;
`masks/` the visible person, `whole/` the whole one.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from occfusion.files.atomic import atomic_write, write_png
from occfusion.files.video import write_frames
from occfusion.synth.disturb import person_mask
from occfusion.synth.fullbody import bone_transforms, load_model_body
from occfusion.synth.motion import smooth_noise
from occfusion.synth.rotations import (
    axis_angle_from_quaternion,
    matrix_from_axis_angle,
    multiply,
    quaternion_from_axis_angle,
)
from occfusion.synth.scene import Scene
from occfusion.synth.shading import draw, lay_over
from occfusion.synth.spec import SceneSpec
from occfusion.synth.studio import Y_UP_TO_Z_UP

WIDTH, HEIGHT, FPS = 1280, 720, 10.0
FOCAL = 1024.0
AWAY, LENS, AIM = 3.3, 1.35, 0.95  # metres
ARMS, LEGS = [13, 14, 16, 17, 18, 19, 20, 21], [1, 2, 4, 5, 7, 8]
DISTURBED = [1, 2, 3, 4, 5, 6, 9, 12, 15, 16, 17, 18, 19, 20, 21]
KNEES = [3 * 4, 3 * 5]
PAN_FRAMES = 50  # of a camera's turn to and fro


def mix(poses: np.ndarray, rng: np.random.Generator) -> None:
    """Moves arms and legs as at other times of a take, and disturbs joints: poses `[T, 72]`, in place."""
    count = len(poses)
    for joints in (ARMS, LEGS):
        poses[:, _numbers(joints)] = np.roll(poses, int(rng.integers(count)), 0)[:, _numbers(joints)]
    noise = smooth_noise(rng, count, 3 * len(DISTURBED), 8.0)
    poses[:, _numbers(DISTURBED)] += rng.uniform(0.1, 0.35) * noise
    poses[:, KNEES] = np.abs(poses[:, KNEES])


def _numbers(joints: list[int]) -> list[int]:
    return [3 * joint + axis for joint in joints for axis in range(3)]


def camera() -> tuple[np.ndarray, np.ndarray]:
    """Returns K `[3, 3]` and world to camera `[4, 4]`."""
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1.0]])
    centre = np.array([0.0, -AWAY, LENS])
    forward = np.array([0.0, 0.0, AIM]) - centre
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    view = np.eye(4)
    view[:3, :3], view[:3, 3] = R, -R @ centre
    return K, view


def background(seed: int) -> np.ndarray:
    """Returns a room, `[HEIGHT, WIDTH, 3]`, 0..255: a papered wall with pictures and shelves, a wooden floor."""
    rng = np.random.default_rng([991, seed])
    out = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    edge = int(0.74 * HEIGHT)
    out[:edge] = rng.uniform(110, 190, 3)
    out[edge:] = rng.uniform(70, 130, 3) * [1.1, 0.9, 0.7]
    for size, amount in ((160, 25), (40, 12), (9, 9), (3, 6)):
        coarse = rng.normal(0, amount, (HEIGHT // size + 2, WIDTH // size + 2, 1)).astype(np.float32)
        out += cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)[..., None]
    for _ in range(9):
        w, h = rng.integers(60, 220), rng.integers(50, 240)
        x, y = rng.integers(0, WIDTH - w), rng.integers(0, edge - 20)
        out[y : min(y + h, edge), x : x + w] *= rng.uniform(0.4, 1.5, 3)
        cv2.rectangle(
            out, (int(x), int(y)), (int(x + w), int(min(y + h, edge))), tuple(rng.uniform(20, 90, 3)), 3
        )
    for k in range(14):
        x = k * WIDTH // 14
        cv2.line(out, (x, edge), (int((x - WIDTH / 2) * 2 + WIDTH / 2), HEIGHT), (50, 40, 30), 2)
    out = cv2.GaussianBlur(out, (0, 0), 0.8) + rng.normal(0, 2.0, out.shape)
    return np.clip(out, 0, 255).astype(np.float32)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("subject", type=int)
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument(
        "--bar", type=float, default=0.0, help="share of the person's width behind a fixed bar"
    )
    parser.add_argument("--mixed", action="store_true", help="poses that no recording has")
    parser.add_argument("--pan", type=float, default=0.0, help="degrees by which the camera turns to and fro")
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    scene = Scene(SceneSpec(arguments.subject, "hard", frames=arguments.frames, cameras=1, image_size=720))
    if arguments.mixed:
        mix(scene.take.poses, np.random.default_rng([7, arguments.subject]))
    K, view = camera()
    room, at_rest = background(arguments.subject), joints_at_rest(scene)
    still, room_ahead = view, room
    joints, poses, transl, pictures, bars = [], [], [], [], []
    for frame in range(arguments.frames):
        if arguments.pan:
            view, room = panned(still, room_ahead, K, arguments.pan * np.sin(2 * np.pi * frame / PAN_FRAMES))
        pose, places = in_camera(scene, frame, at_rest, view)
        joints.append(places)
        poses.append(pose)
        transl.append(joints[-1][0] - at_rest[0])
        picture, mask = shot(scene, frame, K, view, room)
        write_png(arguments.output / "whole" / f"{frame:06d}.png", mask)
        bars.append((0, 0))
        if arguments.bar and frame < 0.8 * arguments.frames:
            columns = np.flatnonzero(mask.any(axis=0))
            wide = arguments.bar * (columns[-1] - columns[0])
            x0 = int((columns[-1] + columns[0]) / 2 - wide / 2)
            bars[-1] = (x0, x0 + int(wide))
            picture[:, slice(*bars[-1])] = room[:, :1] * 0.6
            mask[:, slice(*bars[-1])] = False
        write_png(arguments.output / "masks" / f"{frame:06d}.png", mask)
        pictures.append(np.clip(picture, 0, 255).astype(np.uint8))
    write_frames(arguments.output / "clip.mp4", pictures, FPS)
    with atomic_write(arguments.output / "truth.npz") as stream:
        np.savez(
            stream, joints=np.stack(joints), K=K, betas=scene.subject.betas, poses=np.stack(poses),
            transl=np.stack(transl), bars=np.array(bars),
        )  # fmt: skip


def panned(
    view: np.ndarray, room: np.ndarray, K: np.ndarray, degrees: float
) -> tuple[np.ndarray, np.ndarray]:
    """Returns world to camera, and the room, of a camera turned about its own upright axis."""
    turn = cv2.Rodrigues(np.array([0.0, np.radians(degrees), 0.0]))[0]
    out = view.copy()
    out[:3] = turn @ view[:3]
    flags = {"flags": cv2.INTER_LINEAR, "borderMode": cv2.BORDER_REFLECT}
    return out, np.asarray(cv2.warpPerspective(room, K @ turn @ np.linalg.inv(K), (WIDTH, HEIGHT), **flags))


def joints_at_rest(scene: Scene) -> np.ndarray:
    """Returns the joints of a scene's person at rest, `[24, 3]`, metres."""
    body = load_model_body()
    return np.asarray(body.regressor @ (body.template + body.shapedirs @ scene.subject.betas))


def in_camera(
    scene: Scene, frame: int, at_rest: np.ndarray, view: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the pose `[72]` and the joints `[24, 3]` of a frame as the camera sees them."""
    pose, turn = scene.take.poses[frame], view[:3, :3] @ Y_UP_TO_Z_UP
    moves = bone_transforms(pose, at_rest, load_model_body().parents)
    world = (moves[:, :3, :3] @ at_rest[:, :, None])[..., 0] + moves[:, :3, 3] + scene.take.transl[frame]
    root = multiply(quaternion_of(turn), quaternion_from_axis_angle(pose[:3]))
    return np.concatenate([axis_angle_from_quaternion(root), pose[3:]]), world @ turn.T + view[:3, 3]


def quaternion_of(matrix: np.ndarray) -> np.ndarray:
    vector = cv2.Rodrigues(matrix)[0].reshape(3)
    assert np.allclose(matrix_from_axis_angle(vector), matrix)
    return quaternion_from_axis_angle(vector)


def shot(
    scene: Scene, frame: int, K: np.ndarray, view: np.ndarray, room: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the picture and the mask of the person."""
    window = draw(scene.mesh(frame), view, K, WIDTH)
    picture = np.zeros((WIDTH, WIDTH, 3), np.float32)
    picture[:HEIGHT] = room
    coverage = np.zeros((WIDTH, WIDTH), np.float32)
    if window is not None:
        nothing = np.full(window.depth.shape, np.inf, np.float32)
        lay_over(picture, coverage, window.x, window.y, window.depth, window.colour, nothing, window.colour)
    return picture[:HEIGHT], person_mask(coverage[:HEIGHT])


if __name__ == "__main__":
    main()
