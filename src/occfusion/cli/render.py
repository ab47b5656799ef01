"""`python -m occfusion render RUN --path turntable --output FILE`: pictures of a trained avatar."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from pathlib import Path

import torch

from occfusion.errors import ConfigError
from occfusion.evaluation.pictures import Image, to_uint8
from occfusion.files.video import write_frames
from occfusion.geometry.camera import orbit_camera
from occfusion.human.rendering import Renderer
from occfusion.run.loaded import load_run

PATHS = ("turntable", "canonical")
DISTANCE = 3.2
"""Metres from the camera to the person: all of a tall person fits a 45 degree view."""
FIELD_OF_VIEW = math.radians(45)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of the verb."""
    parser.add_argument("run", type=Path, help="a run folder")
    parser.add_argument(
        "--path",
        choices=PATHS,
        default="turntable",
        help="turntable: the first training pose, upright; canonical: the Da pose",
    )
    parser.add_argument(
        "--output", type=Path, required=True, help="a .mp4 file, or a folder for numbered .png files"
    )
    parser.add_argument("--frames", type=int, default=72, help="pictures in one turn")
    parser.add_argument("--size", type=int, default=512, help="pixels of each side")
    parser.add_argument("--white", action="store_true", help="white background instead of black")


def run(arguments: argparse.Namespace) -> int:
    """Renders and writes; returns the exit code."""
    if arguments.frames < 1 or not 16 <= arguments.size <= 4096:
        raise ConfigError("--frames must be at least 1, and --size between 16 and 4096")
    write_frames(arguments.output, _pictures(arguments), fps=24)
    print(arguments.output)
    return 0


@torch.no_grad()
def _pictures(arguments: argparse.Namespace) -> Iterator[Image]:
    loaded = load_run(arguments.run)
    avatar, renderer = loaded.avatar, Renderer("auto")
    background = torch.ones(3) if arguments.white else None
    pose = loaded.upright_pose if arguments.path == "turntable" else None
    reference = avatar.canonical(torch.zeros(3)) if pose is None else avatar(pose, torch.zeros(3))
    low, high = reference.means.amin(dim=0), reference.means.amax(dim=0)
    for k in range(arguments.frames):
        angle = 2 * math.pi * k / arguments.frames
        camera = orbit_camera((low + high) / 2, angle, DISTANCE, FIELD_OF_VIEW, arguments.size)
        cloud = avatar.canonical(camera.centre) if pose is None else avatar(pose, camera.centre)
        yield to_uint8(renderer.draw(cloud, camera, background=background).rgb)
