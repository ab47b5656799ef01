"""Damaged files of every kind: a named error or a sound result; no code, no crash, no hang, no memory."""

from __future__ import annotations

import json
import pickle
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from data import layout_writers as writers
from data.layout_writers import Source
from data.mutations import GADGETS, mutated_bytes, mutated_value
from data.tiny_scene import TinyBody
from files.test_bodyfile import content as body_content
from files.test_bodyfile import official_pickle
from occfusion.data.opening import open_folder
from occfusion.data.posing import Poser
from occfusion.errors import OccfusionError
from occfusion.files.bodyfile import load_body_arrays
from occfusion.files.images import image_size, read_mask, read_numbers, read_rgb
from occfusion.synth import SceneSpec, write_scene
from peak_memory import PeakMemory

SECONDS = 5.0
"""Of this process, so that other work on the machine does not count."""
MEGABYTES = 400
FEW = 12
MANY = 160
"""Mutations of each kind in `make test` and in the slow run, of each of 19 kinds: 228 and 3040."""

POSER = Poser(TinyBody(4), stands_in=True)


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Source:
    spec = SceneSpec(1, "clean", image_size=48, frames=2, cameras=2)
    return Source(write_scene(tmp_path_factory.mktemp("fuzz"), spec, progress=False))


@pytest.fixture(scope="module")
def folders(source, tmp_path_factory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("layouts")
    return {
        "refined": writers.write_refined(source, root),
        "humannerf": writers.write_humannerf(source, root / "377"),
        "w2a": writers.write_w2a(source, root),
        "chomp": writers.write_chomp(source, root / "raw"),
        "video": writers.write_video(source, root / "mine"),
    }


def read_all(folder: Path) -> None:
    """Everything that is read of a folder before pictures are."""
    _, scene = open_folder(folder, POSER, sequence="0013_02")
    for camera in range(len(scene.cameras)):
        scene.calibration(camera)
    for frame in range(scene.num_frames):
        POSER.pose(scene.parameters(frame))
        for camera in range(len(scene.cameras)):
            files = scene.files(frame, camera)
            assert all(folder.resolve() in (path.parent / "x").resolve().parents for path in files.all())


def read_picture(path: Path) -> None:
    """Every way of reading it; each refusal must name the file, and one that matters is handed on."""
    refusals: dict[Callable, OccfusionError] = {}
    for read in (image_size, read_rgb, read_mask, read_numbers):
        try:
            read(path)
        except OccfusionError as error:
            refusals[read] = error
    assert all(str(path) in str(error) for error in refusals.values()), refusals
    for read in (image_size, read_rgb) if path.suffix == ".jpg" else refusals:  # a colour picture is no mask
        if read in refusals:
            raise refusals[read]


def save_npz(path: Path, content: dict[str, Any]) -> None:
    np.savez(path, **content)


def with_arrays(path: Path) -> dict[str, Any]:
    with np.load(path) as archive:
        return dict(archive)


TABLES: dict[str, tuple[str, str, Callable, Callable]] = {
    "annots": ("refined", "annots.npy", lambda p: np.load(p, allow_pickle=True).item(), writers.save_object),
    "params": ("refined", "smpl_params/1.npy", lambda p: np.load(p, allow_pickle=True).item(), writers.save_object),
    "cameras": ("humannerf", "cameras.pkl", lambda p: pickle.loads(p.read_bytes()), writers.save_pickle),
    "meshes": ("humannerf", "mesh_infos.pkl", lambda p: pickle.loads(p.read_bytes()), writers.save_pickle),
    "metadata": ("w2a", "metadata.json", lambda p: json.loads(p.read_text()),
                 lambda p, c: p.write_text(json.dumps(c))),
    "chomp": ("chomp", "annot/train.pkl", lambda p: pickle.loads(p.read_bytes()), writers.save_pickle),
    "video": ("video", "poses.npz", with_arrays, save_npz),
    "video camera": ("video", "cameras.npz", with_arrays, save_npz),
}  # fmt: skip
PICTURES = {"jpg": "images/00/000000.jpg", "png": "mask/00/000000.png"}
KINDS = [
    *(f"{name}, values" for name in TABLES),
    *(f"{name}, bytes" for name in TABLES),
    *PICTURES,
    "body.pkl",
]


def attempt(read: Callable[[], Any], what: str, place: Path) -> bool:
    """Whether it was read; a refusal must be one of ours and name the file."""
    started, message = time.process_time(), None
    try:
        read()
    except OccfusionError as error:
        message = str(error)
    took = time.process_time() - started
    assert took < SECONDS, f"{what}: {took:.1f} s"
    assert message is None or (len(message) > 20 and str(place) in message), f"{what}: {message}"
    return message is None


def mutations(
    kind: str, source: Source, folders: dict[str, Path], count: int, scratch: Path
) -> tuple[int, int]:
    """(tried, read in spite of it); the folder is whole again afterwards."""
    rng = np.random.default_rng([1, *kind.encode()])
    if kind == "body.pkl":
        path, folder = scratch / "body.pkl", scratch
        whole = official_pickle(path, body_content(), 2).read_bytes()

        def read() -> None:
            load_body_arrays(path)
    elif kind in PICTURES:
        folder = folders["refined"]
        path = folder / PICTURES[kind]
        whole = path.read_bytes()

        def read() -> None:
            read_picture(path)
    else:
        name, _ = kind.rsplit(", ", 1)
        layout, file, load, save = TABLES[name]
        folder = folders[layout]
        path = folder / file
        whole, content = path.read_bytes(), load(path)

        def read() -> None:
            read_all(folder)

    assert attempt(read, f"{kind}, undamaged", folder)  # else every refusal would be for another reason
    tried = sound = 0
    try:
        for number in range(count):
            if kind.endswith("values"):
                changed = mutated_value(content, rng, json_only=kind.startswith("metadata"))
                try:
                    save(path, changed)
                except (TypeError, ValueError, UnicodeError):  # this format cannot hold such a value
                    continue
            else:
                path.write_bytes(mutated_bytes(whole, rng))
            tried += 1
            sound += attempt(read, f"{kind} {number}", folder)
    finally:
        path.write_bytes(whole)
    return tried, sound


def fuzz(kind, count, source, folders, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    with PeakMemory() as peak:
        tried, sound = mutations(kind, source, folders, count, tmp_path)
    assert tried == count and sound < count
    assert not (tmp_path / "RAN").exists()
    assert peak.megabytes < MEGABYTES


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", KINDS)
def test_a_few_damaged_files(kind, source, folders, tmp_path, monkeypatch):
    fuzz(kind, FEW, source, folders, tmp_path, monkeypatch)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", KINDS)
def test_many_damaged_files(kind, source, folders, tmp_path, monkeypatch):
    fuzz(kind, MANY, source, folders, tmp_path, monkeypatch)


@pytest.mark.parametrize("gadget", GADGETS)
def test_the_spliced_code_is_refused_on_its_own(gadget, tmp_path, monkeypatch):
    from occfusion.files.unpickle import loads

    monkeypatch.chdir(tmp_path)
    with pytest.raises(OccfusionError, match="not allowed"):
        loads(gadget, "gadget")
    assert not (tmp_path / "RAN").exists()
