"""`dataset=synthetic`: writes an embedded scene where it is missing, and reads it as any other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from occfusion.cpu.memory import trim_memory
from occfusion.data.posing import RestBody
from occfusion.data.zju.zju_data import ZjuDataModule
from occfusion.synth import SceneSpec, with_turn, write_scene

FAST_DEV_SIZE = 96
FAST_DEV_FRAMES = 4
FAST_DEV_CAMERAS = 3


def make_synthetic(
    root: str | Path,
    scene: str,
    body: RestBody,
    *,
    image_size: int = 256,
    frames: int = 100,
    cameras: int = 23,
    light: str = "soft",
    turn: int | None = None,
    facing: int | None = None,
    fast_dev_run: bool = False,
    **reading: Any,
) -> ZjuDataModule:
    """Returns the DataModule of an embedded scene, written to disk first when it is not there yet.

    Args:
        root: folder of the written scenes; each size and length has a folder of its own there.
        scene: `NNN-level[-words]`, for example `001-clean`, `101-hard-boxes`, `103-clean-front`.
        body: the embedded body.
        image_size: width and height in pixels of the written pictures.
        frames: moments of the written scene.
        cameras: of the ring around the person.
        light: `soft` or `directional`.
        turn: degrees that the person turns, to and fro; 360: all round; None: as the name of the scene says.
        facing: which side the first camera sees, degrees: 0 the front, 180 the back; None: as the name says.
        fast_dev_run: a tiny scene, for a trial of the code alone.
        **reading: how it is read, as `ZjuDataModule` has it. The scene is the same for every `seed`.

    Raises:
        ConfigError: a scene name, size or light that does not exist.
    """
    spec = with_turn(SceneSpec.parse(scene), turn, facing)
    spec = replace(spec, image_size=image_size, frames=frames, cameras=cameras, light=light)
    if fast_dev_run:
        spec = replace(spec, image_size=FAST_DEV_SIZE, frames=FAST_DEV_FRAMES, cameras=FAST_DEV_CAMERAS)
    folder = Path(root) / f"{spec.image_size}px-{spec.frames}x{spec.cameras}-{spec.light}"
    write_scene(folder, spec)
    trim_memory()  # of the threads that drew
    return ZjuDataModule(folder, spec.name, body, image_size=image_size, **reading)
