"""What it costs to open a large scene: only what is used is read, in files and megabytes."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np

from data.tiny_scene import write_tiny_scene
from occfusion.data.zju.zju_data import ZjuDataModule
from occfusion.files import images

FRAMES, CAMERAS = 100, 23
MEGABYTES = 300.0


def resident_megabytes() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def test_a_hundred_frames_of_23_cameras(tmp_path, monkeypatch):
    small = write_tiny_scene(tmp_path / "small", cameras=CAMERAS, frames=2)
    target = tmp_path / "CoreView_999"
    (target / "new_params").mkdir(parents=True)
    rows = []
    for frame in range(FRAMES):
        names = [f"Camera_B{camera + 1}/{frame:06d}.png" for camera in range(CAMERAS)]
        for camera, name in enumerate(names):
            for folder, source in (
                ("", small.picture(frame % 2, camera)),
                ("mask", small.mask(frame % 2, camera)),
            ):
                link = target / folder / name
                link.parent.mkdir(parents=True, exist_ok=True)
                os.link(source, link)
        shutil.copy(small.folder / "new_params" / f"{frame % 2}.npy", target / "new_params" / f"{frame}.npy")
        rows.append({"ims": names, "kpts2d": np.zeros((CAMERAS, 25, 3))})  # as released; not used here
    annots = small.annots()
    np.save(target / "annots.npy", {"cams": annots["cams"], "ims": rows}, allow_pickle=True)
    decoded, original = [], images._decode
    monkeypatch.setattr(
        images, "_decode", lambda path, *a, **k: decoded.append(path) or original(path, *a, **k)
    )
    before = resident_megabytes()
    data = ZjuDataModule(tmp_path, target.name, small.body, image_size=64, train_frames=[0, None, 1])
    data.setup()
    data.frame_at(0)
    assert (
        FRAMES <= len(decoded) <= FRAMES + 10
    )  # of 4600: masks of the training camera, and the frame asked for
    assert resident_megabytes() - before < MEGABYTES
    assert len(data.train_indices) == FRAMES and len(data.test_cameras) == CAMERAS - 1
