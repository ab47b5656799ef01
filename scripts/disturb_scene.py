"""Puts one kind of input error into a copy of a scene in ZJU-MoCap's layout, by a stated amount.

python scripts/disturb_scene.py scenes/103-clean off/103-clean pose=0.05 shift=1

Pictures, masks and calibration change for the training camera alone, body parameters for all: other cameras show the
truth. Errors wander over frames as an estimator's do (a Gaussian of `WANDERS` frames); they have nothing in common with
those of the embedded levels.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter, gaussian_filter1d
from scipy.spatial.transform import Rotation

from occfusion.files.arrays import load_npy
from occfusion.files.images import read_mask, read_rgb
from occfusion.synth.writer import save_object

ERRORS = {
    "pose": "radians: of each angle of each joint",
    "place": "metres: along each axis",
    "shape": "standard deviations: of each shape component but the first, which is size",
    "focal": "share by which the training camera's focal length is too long",
    "shift": "pixels by which the training camera's picture is displaced",
    "mask": "pixels by which the edge of its masks is off",
    "light": "share by which exposure and colour of its pictures wander",
    "blur": "pixels: standard deviation of its lens",
    "noise": "grey values: standard deviation of its sensor",
}
WANDERS = 3.0
BUMPS = 3.0  # pixels: how far along an edge its error stays the same
CAMERA = "Camera_B1"
Floats = NDArray[np.float64]


def wandering(rng: np.random.Generator, *shape: int, over: float = WANDERS) -> Floats:
    """Returns noise of variance one, smooth along the first axis."""
    noise = gaussian_filter1d(rng.standard_normal(shape), over, axis=0, mode="wrap")
    return np.asarray(noise / noise.std())


def replace_object(path: Path, content: dict[str, Any]) -> None:
    """Writes a file anew in a copy that is made of links, so that the scene it is a copy of stays as it is."""
    path.unlink()
    save_object(path, content)


def disturb_bodies(folder: Path, amounts: Mapping[str, float], rng: np.random.Generator) -> None:
    files = sorted((folder / "new_params").glob("*.npy"), key=lambda file: int(file.stem))
    turns = amounts.get("pose", 0.0) * wandering(rng, len(files), 24, 3)
    steps = amounts.get("place", 0.0) * wandering(rng, len(files), 3)
    shape = amounts.get("shape", 0.0) * rng.standard_normal(10)
    shape[0] = 0.0
    for file, turn, step in zip(files, turns, steps, strict=True):
        own = load_npy(file)
        poses = np.asarray(own["poses"], np.float64).reshape(24, 3).copy()
        root = Rotation.from_rotvec(turn[0]) * Rotation.from_rotvec(np.ravel(own["Rh"]))
        poses[1:] = (Rotation.from_rotvec(turn[1:]) * Rotation.from_rotvec(poses[1:])).as_rotvec()
        replace_object(file, {
            "poses": poses.reshape(1, 72).astype(np.float32),
            "Rh": root.as_rotvec()[None].astype(np.float32),
            "Th": np.asarray(own["Th"] + step, np.float32),
            "shapes": np.asarray(own["shapes"] + shape, np.float32),
        })  # fmt: skip
    shutil.rmtree(folder / "new_vertices")  # of the bodies as they were


def disturb_camera(folder: Path, amounts: Mapping[str, float]) -> None:
    annots = load_npy(folder / "annots.npy")
    K = np.array(annots["cams"]["K"][0], np.float64)
    K[[0, 1], [0, 1]] *= 1.0 + amounts.get("focal", 0.0)
    K[:2, 2] += amounts.get("shift", 0.0) * np.sqrt(0.5)
    annots["cams"]["K"][0] = K
    replace_object(folder / "annots.npy", annots)


def disturb_pictures(folder: Path, amounts: Mapping[str, float], rng: np.random.Generator) -> None:
    files = sorted((folder / CAMERA).glob("*.jpg"))
    gains = 1.0 + amounts.get("light", 0.0) * wandering(rng, len(files), 3)
    for file, gain in zip(files, gains, strict=True):
        picture = read_rgb(file).astype(np.float64) * gain
        if blur := amounts.get("blur", 0.0):
            picture = gaussian_filter(picture, (blur, blur, 0.0))
        picture += amounts.get("noise", 0.0) * rng.standard_normal(picture.shape)
        file.unlink()
        cv2.imwrite(str(file), np.clip(picture.round(), 0, 255).astype(np.uint8)[..., ::-1],
                    [cv2.IMWRITE_JPEG_QUALITY, 97])  # fmt: skip


def disturb_masks(folder: Path, amount: float, rng: np.random.Generator) -> None:
    files = sorted((folder / "mask" / CAMERA).glob("*.png"))
    first = read_mask(files[0])
    bumps = gaussian_filter(rng.standard_normal((len(files), *first.shape)), (WANDERS, BUMPS, BUMPS))
    for file, bump in zip(files, amount * bumps / bumps.std(), strict=True):
        mask = read_mask(file)
        inside = np.asarray(distance_transform_edt(mask)) - np.asarray(distance_transform_edt(~mask))
        file.unlink()
        cv2.imwrite(str(file), (inside + bump > 0).astype(np.uint8))


def disturb(source: Path, target: Path, amounts: Mapping[str, float], seed: int = 0) -> None:
    """Writes a copy of a scene with these errors; files that stay the same are links.

    Args:
        source: folder of the scene.
        target: to be made.
        amounts: of errors, by the names of `ERRORS`.
        seed: of the errors.

    Raises:
        FileExistsError: the target is there.
        KeyError: no such error.
    """
    for name in amounts:
        ERRORS[name]
    shutil.copytree(source, target, copy_function=_link)
    (target / "scene.json").unlink()  # it is not that scene any more
    rng = np.random.default_rng(seed)
    if {"pose", "place", "shape"} & amounts.keys():
        disturb_bodies(target, amounts, rng)
    if {"focal", "shift"} & amounts.keys():
        disturb_camera(target, amounts)
    if {"light", "blur", "noise"} & amounts.keys():
        disturb_pictures(target, amounts, rng)
    if "mask" in amounts:
        disturb_masks(target, amounts["mask"], rng)


def _link(source: str, target: str) -> None:
    Path(target).hardlink_to(source)


def main() -> None:
    errors = "\n".join(f"  {name:6} {text}" for name, text in ERRORS.items())
    parser = argparse.ArgumentParser(
        description=f"{__doc__}\nerrors:\n{errors}", formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("source", type=Path)
    parser.add_argument("target", type=Path)
    parser.add_argument("errors", nargs="+", metavar="ERROR=AMOUNT")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    pairs = (error.partition("=") for error in arguments.errors)
    disturb(
        arguments.source, arguments.target, {name: float(amount) for name, _, amount in pairs}, arguments.seed
    )


if __name__ == "__main__":
    main()
