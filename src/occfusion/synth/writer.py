"""Writes a scene in the layout of ZJU-MoCap as released; whole or not at all.

| path | content |
|---|---|
| `annots.npy` | cameras (`K`, `R`, `T` in millimetres, `D`) and picture paths |
| `Camera_B1/000000.jpg` ... | pictures |
| `mask/<same>.png` | the person as seen, 0 and 1 |
| `new_params/{i}.npy` | `poses`, `Rh`, `Th`, `shapes` |
| `new_vertices/{i}.npy` | body vertices in the world, metres |
| `images_complete/<same>.jpg`, `mask_complete/<same>.png` | without the occluder; only where there is one |
| `body.npz` | the body, SMPL's keys |
| `scene.json` | the settings; written last |
"""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.cpu.threads import usable_cores
from occfusion.errors import DataError
from occfusion.files.lock import only_one
from occfusion.synth.atlas import load_atlas
from occfusion.synth.fullbody import asset_bytes
from occfusion.synth.manifest import is_current, write_manifest
from occfusion.synth.scene import Parameters, Scene, Shot
from occfusion.synth.spec import SceneSpec

PNG_COMPRESSION = 3  # masks are small at any level; higher ones only take longer
BYTES_PER_PIXEL = 0.15  # measured: 0.09 for picture and mask at 512 pixels
BYTES_PER_PICTURE = 3_000
BYTES_PER_FRAME = 90_000  # parameters and vertices
MAX_THREADS = 8


HALF_PIXEL = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])


def write_scene(root: Path | str, spec: SceneSpec, *, progress: bool = True) -> Path:
    """Returns the folder `root/spec.name`, written now unless it holds this very scene already.

    Nothing appears under that name before the scene is complete.

    Args:
        root: folder of scenes; made when missing.
        spec: what to write.
        progress: show a progress bar.

    Raises:
        DataError: the folder holds something else, or the disk is full or refuses.
    """
    root = Path(root)
    target = root / spec.name
    if is_current(target, spec):
        return target
    try:
        root.mkdir(parents=True, exist_ok=True)
        with only_one(
            root / f".{spec.name}.lock", on_wait=lambda: print(f"{target} is being written; waiting")
        ):
            if is_current(target, spec):  # by the process that was waited for
                return target
            _sweep(root, spec.name)
            _check_space(root, spec)
            with _partial(root, spec.name) as folder:
                _write_all(folder, Scene(spec), progress)
                write_manifest(folder, spec)
                _put(folder, target, spec)
    except OSError as error:
        reason = "the disk is full" if error.errno == errno.ENOSPC else str(error.strerror or error)
        raise DataError(f"{target}: cannot be written: {reason}.") from error
    return target


def _write_all(folder: Path, scene: Scene, progress: bool) -> None:
    for part in _parts(scene):
        for camera in scene.cameras:
            (folder / part / camera.name).mkdir(parents=True)
    for part in ("new_params", "new_vertices"):
        (folder / part).mkdir()
    (folder / "body.npz").write_bytes(asset_bytes("free_body.npz"))
    save_object(folder / "annots.npy", camera_annotations(scene))
    frames = range(scene.spec.frames)
    threads = min(usable_cores(), MAX_THREADS, len(frames))
    with _bar(scene.spec, progress) as advance, ThreadPoolExecutor(threads) as pool:
        running = [pool.submit(_write_frame, folder, scene, frame) for frame in frames]
        try:
            for done in as_completed(running):
                done.result()
                advance()
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
        finally:
            load_atlas.cache_clear()  # the person is painted; the finest is 41 MB


def _parts(scene: Scene) -> list[str]:
    return (
        ["", "mask"] if scene.spec.occluders == "none" else ["", "mask", "images_complete", "mask_complete"]
    )


def _write_frame(folder: Path, scene: Scene, frame: int) -> None:
    parameters = scene.parameters(frame)
    save_object(folder / "new_params" / f"{frame}.npy", body_content(parameters))
    np.save(folder / "new_vertices" / f"{frame}.npy", parameters.vertices.astype(np.float32))
    for camera, shot in zip(scene.cameras, scene.shots(frame), strict=True):
        _write_shot(folder, f"{camera.name}/{frame:06d}", shot, scene.jpeg_quality)


def _write_shot(folder: Path, name: str, shot: Shot, quality: int) -> None:
    _save_jpeg(folder / f"{name}.jpg", shot.image, quality)
    _save_mask(folder / "mask" / f"{name}.png", shot.mask)
    if shot.image_complete is not None and shot.mask_complete is not None:
        _save_jpeg(folder / "images_complete" / f"{name}.jpg", shot.image_complete, quality)
        _save_mask(folder / "mask_complete" / f"{name}.png", shot.mask_complete)


def body_content(parameters: Parameters) -> dict[str, Any]:
    """Returns what a file of `new_params` holds."""
    return {
        "poses": parameters.poses[None].astype(np.float32),
        "Rh": parameters.Rh[None].astype(np.float32),
        "Th": parameters.Th[None].astype(np.float32),
        "shapes": parameters.shapes[None].astype(np.float32),
    }


def camera_annotations(scene: Scene) -> dict[str, Any]:
    """Returns what `annots.npy` holds: the calibration and the names of the pictures."""
    cameras = scene.disk_cameras
    return {
        "cams": {
            # as calibrated by OpenCV, which puts the centre of the first pixel at 0, not at 0.5
            "K": [c.K - HALF_PIXEL for c in cameras],
            "R": [c.R for c in cameras],
            "T": [1000.0 * c.T[:, None] for c in cameras],  # millimetres, as released
            "D": [np.zeros((5, 1)) for _ in cameras],
        },
        "ims": [{"ims": [f"{c.name}/{i:06d}.jpg" for c in cameras]} for i in range(scene.spec.frames)],
    }


def save_object(path: Path, content: dict[str, Any]) -> None:
    """Writes a dict as the data set does: a pickled object array. It is only ever read with an allow-list."""
    box = np.empty((), dtype=object)
    box[()] = content
    np.save(path, box, allow_pickle=True)


def _save_jpeg(path: Path, image: NDArray[np.uint8], quality: int) -> None:
    _save_encoded(path, ".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])


def _save_mask(path: Path, mask: NDArray[np.bool_]) -> None:
    _save_encoded(path, ".png", mask.astype(np.uint8), [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION])


def _save_encoded(path: Path, suffix: str, image: NDArray[np.uint8], options: list[int]) -> None:
    done, encoded = cv2.imencode(suffix, np.ascontiguousarray(image), options)
    if not done:
        raise DataError(f"{path}: the picture could not be encoded.")
    path.write_bytes(encoded.tobytes())


def _check_space(root: Path, spec: SceneSpec) -> None:
    pictures = spec.frames * spec.cameras * (1 if spec.occluders == "none" else 2)
    needed = (
        pictures * (spec.image_size**2 * BYTES_PER_PIXEL + BYTES_PER_PICTURE) + spec.frames * BYTES_PER_FRAME
    )
    free = shutil.disk_usage(root).free
    if free < needed:
        raise DataError(
            f"{root}: {free / 1e6:.0f} MB are free, the scene {spec.name} needs about {needed / 1e6:.0f} MB; "
            "make room, or ask for fewer frames or smaller pictures."
        )


@contextmanager
def _partial(root: Path, name: str) -> Iterator[Path]:
    """Yields a folder beside the target that is gone afterwards, whatever happens."""
    folder = Path(tempfile.mkdtemp(prefix=f".{name}.{os.getpid()}.", suffix=".partial", dir=root))
    folder.chmod(0o755)  # mkdtemp makes it private
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _sweep(root: Path, name: str) -> None:
    """Removes what a killed process left behind."""
    for left in root.glob(f".{name}.*.partial"):
        owner = left.name[len(name) + 2 :].split(".")[0]
        if owner.isdigit() and not _is_alive(int(owner)):
            shutil.rmtree(left, ignore_errors=True)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _put(folder: Path, target: Path, spec: SceneSpec) -> None:
    """Gives the finished folder its name; another process may have been faster with the same scene."""
    if is_current(target, spec):
        return
    if target.exists():  # of an earlier version of the generator, or empty
        outdated = folder.with_name(folder.name.replace(".partial", ".old.partial"))
        target.rename(outdated)
        shutil.rmtree(outdated, ignore_errors=True)
    try:
        folder.rename(target)
    except OSError:
        if not is_current(target, spec):
            raise


@contextmanager
def _bar(spec: SceneSpec, shown: bool) -> Iterator[Callable[[], None]]:
    if not shown:
        yield lambda: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("frames"),
        TimeRemainingColumn(),
    )  # fmt: skip
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(
            f"writing {spec.name}, {spec.image_size} px, {spec.cameras} cameras", total=spec.frames
        )
        yield lambda: bar.advance(task)
