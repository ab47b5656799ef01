"""Trains the correction of landmarks in space, `occfusion/footage/lift.py`, on rendered embedded people.

    python scripts/train_landmark_lift.py runs/lift          # 80 people of 100 frames: 30 minutes on one core

People are rendered as `render_plain_clip.py` does, each before a camera of its own. From number 32 on, arms and legs
move as at other times of the take, and joints are disturbed, so that poses are not those of two recordings alone.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import render_plain_clip as plain
import torch

from occfusion.errors import DataError
from occfusion.files.atomic import atomic_write
from occfusion.fitting.anchors import landmark_places
from occfusion.fitting.batch import BodyBatch, rotations_of
from occfusion.footage.landmarks import COUNT, MIRRORED
from occfusion.footage.lift import ASSET, HIPS, MOST, WORLD_SCALE, from_hips, inputs
from occfusion.footage.people import follow
from occfusion.human import embedded_body
from occfusion.synth.scene import Scene
from occfusion.synth.spec import SceneSpec

SUBJECTS, MIXED_FROM, FRAMES = range(20, 100), 32, 100
HIDDEN, EPOCHS, BATCH, RATE = 128, 60, 128, 2e-3
ROLL, NOISE = 0.15, 0.01  # radians; metres, and shares of the person's size


def person(subject: int) -> dict[str, np.ndarray]:
    """Returns landmarks and their true places, in the camera, of a person's frames."""
    rng = np.random.default_rng([7, subject])
    plain.AWAY, plain.LENS, plain.AIM = rng.uniform(2.6, 4.5), rng.uniform(0.7, 1.9), rng.uniform(0.85, 1.05)
    plain.FOCAL = plain.AWAY / 3.3 * 1024 * rng.uniform(0.8, 1.05)
    scene = Scene(SceneSpec(subject, "hard", frames=FRAMES, cameras=1, image_size=720))
    if subject >= MIXED_FROM:
        plain.mix(scene.take.poses, rng)
    K, view = plain.camera()
    room, at_rest = plain.background(subject), plain.joints_at_rest(scene)
    rows, pictures = [], []
    for frame in range(FRAMES):
        pose, joints = plain.in_camera(scene, frame, at_rest, view)
        rows.append(np.concatenate([pose, joints[0] - at_rest[0]]))
        picture, _ = plain.shot(scene, frame, K, view, room)
        jpeg = cv2.imencode(
            ".jpg", np.clip(picture, 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 80]
        )[1]
        pictures.append(np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_COLOR)))
    points = follow(pictures, range(FRAMES)).keypoints()
    table = torch.tensor(np.stack(rows), dtype=torch.float32)
    batch = BodyBatch(embedded_body(), np.zeros(1, dtype=np.int64))
    betas = torch.tensor(scene.subject.betas, dtype=torch.float32)
    chain = batch.transforms(betas, rotations_of(table[:, :3], table[:, 3:72]), table[:, 72:])
    seen = points.presence > 0
    return {
        "world": points.world[seen], "pixels": points.pixels[seen], "confidence": points.confidence[seen],
        "truth": landmark_places(*chain).double().numpy()[seen],
    }  # fmt: skip


def example(data: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the network's inputs and how far the landmarks are off, in a person of the model's size."""
    world, truth = from_hips(data["world"]), from_hips(data["truth"])
    extents = [np.linalg.norm(part, axis=2).mean(axis=1) for part in (world, truth)]
    return inputs(world, data["pixels"], data["confidence"]), np.median(
        extents[0] / extents[1]
    ) * truth - world


def varied(x: torch.Tensor, y: torch.Tensor, chance: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns examples mirrored, rolled about the view and with noise, each by chance."""
    count = len(x)
    world = x[:, : 3 * COUNT].reshape(-1, COUNT, 3) / WORLD_SCALE
    pixels, sure = x[:, 3 * COUNT : 5 * COUNT].reshape(-1, COUNT, 2), x[:, 5 * COUNT :]
    flipped = torch.rand(count, generator=chance) < 0.5
    order = torch.tensor(MIRRORED)
    sides = [torch.where(flipped[:, None, None], _mirror(part, order), part) for part in (world, pixels, y)]
    angle = ROLL * torch.randn(count, generator=chance)
    c, s = angle.cos(), angle.sin()
    turn = torch.stack([torch.stack([c, s], 1), torch.stack([-s, c], 1)], 1)
    world, pixels, y = (torch.cat([part[..., :2] @ turn, part[..., 2:]], dim=-1) for part in sides)
    noise = NOISE * torch.randn(world.shape, generator=chance)
    pixels = pixels + NOISE * torch.randn(pixels.shape, generator=chance)
    sure = torch.where(flipped[:, None], sure[:, order], sure)
    sure = (sure + 0.05 * torch.randn(sure.shape, generator=chance)).clamp(0, 1)
    parts = (WORLD_SCALE * (world + noise), pixels, sure)
    return torch.cat([part.reshape(count, -1) for part in parts], dim=1), y - noise


def _mirror(part: torch.Tensor, order: torch.Tensor) -> torch.Tensor:
    out = part[:, order].clone()
    out[..., 0] *= -1
    return out


def train(examples: list[tuple[np.ndarray, np.ndarray]]) -> torch.nn.Sequential:
    """Returns the network: the mean distance of the landmarks, in metres, is what it makes small."""
    torch.manual_seed(0)
    chance = torch.Generator().manual_seed(0)
    x, y = (torch.tensor(np.concatenate([e[k] for e in examples]), dtype=torch.float32) for k in range(2))
    wide = [x.shape[1], HIDDEN, HIDDEN]
    layers: list[torch.nn.Module] = []
    for width in wide[1:]:
        layers += [torch.nn.Linear(wide[len(layers) // 3], width), torch.nn.SiLU(), torch.nn.Dropout(0.1)]
    net = torch.nn.Sequential(*layers, torch.nn.Linear(HIDDEN, 3 * COUNT))
    torch.nn.init.zeros_(net[-1].weight)
    optimizer = torch.optim.AdamW(net.parameters(), RATE, weight_decay=1e-3)
    rounds = len(x) // BATCH
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, EPOCHS * rounds)
    for _ in range(EPOCHS):
        for rows in torch.randperm(len(x), generator=chance).split(BATCH)[:rounds]:
            seen, off = varied(x[rows], y[rows], chance)
            loss = (predicted(net, seen) - off).norm(dim=-1).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    return net.eval()


def predicted(net: torch.nn.Sequential, x: torch.Tensor) -> torch.Tensor:
    return MOST * torch.tanh(net(x).reshape(-1, COUNT, 3))


def error(net: torch.nn.Sequential, examples: list[tuple[np.ndarray, np.ndarray]]) -> str:
    x, y = (torch.tensor(np.concatenate([e[k] for e in examples]), dtype=torch.float32) for k in range(2))
    with torch.no_grad():
        after = (predicted(net, x) - y).norm(dim=-1)
    free = [k for k in range(COUNT) if k not in HIPS]
    return f"{1000 * y.norm(dim=-1)[:, free].mean():.0f} mm before, {1000 * after[:, free].mean():.0f} after"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path, help="folder for the rendered people's landmarks")
    parser.add_argument("--output", type=Path, default=Path("src/occfusion/assets") / ASSET)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    arguments.data.mkdir(parents=True, exist_ok=True)
    examples = {}
    for subject in SUBJECTS:
        file = arguments.data / f"{subject:03d}.npz"
        if not file.exists():
            try:
                np.savez(file, **person(subject))
            except DataError as problem:
                print(f"{subject}: left out, {problem}")
                continue
        examples[subject] = example(dict(np.load(file)))
    known = [e for s, e in examples.items() if s % 5]
    print(f"people left out: {error(train(known), [e for s, e in examples.items() if s % 5 == 0])}")
    mixed = [e for s, e in examples.items() if s >= MIXED_FROM]
    plain_ = [e for s, e in examples.items() if s < MIXED_FROM]
    print(f"trained on mixed motions, measured on plain ones: {error(train(mixed), plain_)}")
    net = train(list(examples.values()))
    content = {}
    for k, layer in enumerate(layer for layer in net if isinstance(layer, torch.nn.Linear)):
        content[f"weight{k}"] = layer.weight.detach().numpy().astype(np.float16)
        content[f"bias{k}"] = layer.bias.detach().numpy().astype(np.float16)
    with atomic_write(arguments.output) as stream:
        np.savez_compressed(stream, **content)
    print(f"{arguments.output}: {arguments.output.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
