"""Files that others give us, damaged and poisoned by the hundred: a named error or a sound result, and nothing runs.

Data folders have theirs in `data/test_fuzz.py`, configurations in `app/test_guarded.py`.
"""

from __future__ import annotations

import json
import os
import pickle
import struct
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import joblib
import numpy as np
import pytest
import torch
import yaml

from data.mutations import GADGETS, mutated_bytes
from occfusion.errors import OccfusionError
from occfusion.files.checkpoint import read_checkpoint
from occfusion.files.digest import changed
from occfusion.files.images import read_rgb
from occfusion.files.jsonfile import load_json
from occfusion.files.run_folder import RunFolder
from occfusion.files.video import write_frames
from occfusion.footage.clip import Clip, Shot, open_clip
from occfusion.human import Avatar, Body, load_avatar, save_avatar
from occfusion.importing.bodies import read_bodies
from occfusion.importing.cameras import read_intrinsics
from occfusion.importing.keypoints import read_keypoints
from occfusion.importing.masks import read_masks
from occfusion.motion.files import read_clip
from occfusion.run.loaded import read_settings
from occfusion.settings.schema import Settings
from oracles.people import make_arrays

FEW, MANY = 6, 200
"""Mutations of each kind, and in the slow run: of 16 kinds 96 and 3200."""
WATCHED = (
    "os.system",
    "os.exec",
    "os.posix_spawn",
    "subprocess.Popen",
    "os.remove",
    "shutil.rmtree",
    "os.fork",
)
"""Events of Python's audit that a file must not cause."""
SHOT = Shot([np.zeros((24, 32, 3), np.uint8)] * 2, [0, 1], [0.0, 0.1], 1.0, [])


class _Watch:
    """Notes what a file had Python do; audit hooks cannot be removed, so there is one for all tests."""

    is_on = False
    seen: list[str] = []  # noqa: RUF012

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        if self.is_on and (event in WATCHED or (event == "open" and "RAN" in str(arguments[0]))):
            self.seen.append(event)


WATCH = _Watch()
sys.addaudithook(WATCH)


@pytest.fixture(autouse=True)
def watch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.chdir(tmp_path)
    WATCH.seen.clear()
    yield
    assert WATCH.seen == [] and not (tmp_path / "RAN").exists()


class Evil:
    """What a pickle makes when it is read carelessly."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, ("touch RAN",)


# --- whole files of each kind, and what reads them -------------------------------------------------------------


def avatar(path: Path) -> None:
    save_avatar(path, Avatar(Body(make_arrays(), torch.float32), sh_degree=0))


def checkpoint(path: Path) -> None:
    parts = {"state_dict": {"avatar.x": torch.ones(3)}, "global_step": 3, "optimizer_states": [], "loops": {}}
    torch.save(parts, path)


def tensors(path: Path) -> None:
    part = {
        "body_pose": torch.randn(5, 63), "betas": torch.randn(5, 10), "global_orient": torch.randn(5, 3),
        "transl": torch.randn(5, 3),
    }  # fmt: skip
    torch.save(
        {"smpl_params_incam": part, "smpl_params_global": part, "K_fullimg": torch.eye(3).repeat(5, 1, 1)},
        path,
    )


def people(path: Path) -> None:
    rng = np.random.default_rng(0)
    one = {
        "pose": rng.normal(size=(4, 72)),
        "trans": rng.normal(size=(4, 3)),
        "betas": rng.normal(size=(4, 10)),
    }
    joblib.dump({0: one | {"frame_ids": np.arange(4), "verts": np.ones((4, 7, 3))}}, path)


def smpl_codec(path: Path) -> None:
    np.savez(
        path, codecVersion=2, smplVersion=1, gender=0, shapeParameters=np.zeros(10), frameCount=3,
        bodyTranslation=np.zeros((3, 3)), bodyPose=np.zeros((3, 22, 3)), frameRate=30.0,
    )  # fmt: skip
    path.with_name(path.name + ".npz").rename(path)


def motion(path: Path) -> None:
    np.savez(path, poses=np.zeros((4, 72)), trans=np.zeros((4, 3)), betas=np.zeros(10), mocap_framerate=30.0)


def points(path: Path) -> None:
    person = [value for k in range(25) for value in (5.0 + k / 10, float(k % 20), 0.9)]
    frames = [
        {"image_id": f"{k}.jpg", "keypoints": person[:51], "score": 1.0, "category_id": 1} for k in range(2)
    ]
    path.write_text(json.dumps(frames))


def runs(path: Path) -> None:
    one = {"segmentation": {"size": [24, 32], "counts": [100, 60, 608]}, "image_id": 0}
    path.write_text(json.dumps([one, one | {"image_id": 1}]))


def camera_json(path: Path) -> None:
    path.write_text(json.dumps({"K": [[30.0, 0, 16], [0, 30, 12], [0, 0, 1]], "width": 32, "height": 24}))


def camera_npz(path: Path) -> None:
    np.savez(path, intrinsic=np.array([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]]))


def camera_txt(path: Path) -> None:
    path.write_text("# Camera list\n1 PINHOLE 32 24 30 30 16 12\n")


def video(path: Path) -> None:
    write_frames(path, (np.full((24, 32, 3), 40 * k, np.uint8) for k in range(4)), 10.0)


def settings(path: Path) -> None:
    from dataclasses import asdict

    path.write_text(yaml.safe_dump(asdict(Settings())))


def record(path: Path) -> None:
    path.write_text(
        json.dumps({"regions": {"full": {"psnr": 20.0}}, "train_seconds": {"total": 3}, "images": 2})
    )


def picture(path: Path) -> None:
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 255, (24, 32, 3)).astype(np.uint8))


BODY = Body(make_arrays(), torch.float32)


def bodies(path: Path) -> object:
    return read_bodies(path, None, (32, 24), lambda betas: np.zeros(3))


def as_run(name: str, read: Callable[[RunFolder], object]) -> Callable[[Path], object]:
    """Reads a file in its place in a run folder."""

    def within(path: Path) -> object:
        folder = RunFolder(path.parent / "run")
        folder.path.mkdir(exist_ok=True)
        (folder.path / name).write_bytes(path.read_bytes())
        return read(folder)

    return within


CLIP = Clip(Path("clip.mp4"), (), 2, 10.0, 0)
KINDS: dict[str, tuple[str, Callable[[Path], None], Callable[[Path], object]]] = {
    "avatar": ("a.safetensors", avatar, lambda path: load_avatar(path, BODY)),
    "checkpoint": ("last.ckpt", checkpoint, read_checkpoint),
    "tensors of a tool": ("r.pt", tensors, bodies),
    "people of a tool": ("r.pkl", people, bodies),
    "smpl codec": ("r.smpl", smpl_codec, bodies),
    "motion": ("m.npz", motion, read_clip),
    "key points": ("k.json", points, lambda path: read_keypoints(path, CLIP, SHOT)),
    "run lengths": ("m.json", runs, lambda path: read_masks(path, CLIP, SHOT)),
    "camera, json": ("c.json", camera_json, lambda path: read_intrinsics(path, SHOT)),
    "camera, npz": ("c.npz", camera_npz, lambda path: read_intrinsics(path, SHOT)),
    "camera, text": ("cameras.txt", camera_txt, lambda path: read_intrinsics(path, SHOT)),
    "video": ("v.mp4", video, open_clip),
    "picture": ("p.png", picture, read_rgb),
    "configuration of a run": ("config.yaml", settings, as_run("config.yaml", read_settings)),
    "figures of a run": (
        "metrics.json",
        record,
        as_run("metrics.json", lambda folder: folder.read_metrics()),
    ),
    "any json": ("x.json", record, load_json),
}


def try_one(read: Callable[[Path], object], path: Path) -> bool:
    """Returns whether it was read in spite of the damage; anything but a named error is a failure."""
    WATCH.is_on = True
    try:
        read(path)
    except OccfusionError:
        return False
    finally:
        WATCH.is_on = False
    return True


def fuzz(kind: str, count: int, tmp_path: Path) -> None:
    name, write, read = KINDS[kind]
    path = tmp_path / name
    write(path)
    whole, rng = path.read_bytes(), np.random.default_rng(sum(map(ord, kind)))
    assert try_one(read, path), f"{kind}: the whole file is refused"
    read_anyway = 0
    for _ in range(count):
        path.write_bytes(mutated_bytes(whole, rng))
        read_anyway += try_one(read, path)
    assert read_anyway < count


@pytest.mark.parametrize("kind", KINDS)
def test_a_few_damaged_files_of_each_kind(kind: str, tmp_path: Path) -> None:
    fuzz(kind, FEW, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_many_damaged_files_of_each_kind(kind: str, tmp_path: Path) -> None:
    fuzz(kind, MANY, tmp_path)


@pytest.mark.parametrize("kind", KINDS)
def test_files_that_are_another_thing(kind: str, tmp_path: Path) -> None:
    """Pickles that run code, archives of them, bombs, and nothing at all, each under the name of every kind."""
    name, _, read = KINDS[kind]
    path = tmp_path / name
    for protocol in (0, 2, 4):
        path.write_bytes(pickle.dumps({"state_dict": Evil(), "smpl_params_incam": Evil()}, protocol))
        assert not try_one(read, path)
    for content in (
        *GADGETS,
        b"",
        b"\0",
        b"[" * 100_000,
        b'{"a":' * 100_000,
        b"\xff" * 64,
        b"PK\x03\x04",
        b"ply\n",
    ):
        path.write_bytes(content)
        assert not try_one(read, path), content[:20]
    with zipfile.ZipFile(path, "w") as archive:  # torch's form, with code in the place of tensors
        archive.writestr("archive/data.pkl", pickle.dumps(Evil(), 2))
        archive.writestr("archive/version", "3\n")
        archive.writestr("../../RAN", "escaped")
    assert not try_one(read, path)
    torch.save({"state_dict": Evil(), "global_step": 1, "optimizer_states": [], "loops": {}}, path)
    assert not try_one(read, path)
    assert not (tmp_path.parent.parent / "RAN").exists()


def test_an_archive_that_unpacks_to_far_more_than_it_is(tmp_path: Path) -> None:
    path = tmp_path / "m.npz"
    header = b"\x93NUMPY\x01\x00"
    form = b"{'descr': '<f8', 'fortran_order': False, 'shape': (20000000000,), }"
    form = form.ljust(117) + b"\n"
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("poses.npy", "w") as member,
    ):
        member.write(header + struct.pack("<H", len(form)) + form + b"\0" * 10_000_000)
    assert not try_one(read_clip, path)
    assert not try_one(lambda p: read_intrinsics(p, SHOT), path)


@pytest.mark.parametrize(
    "header",
    [
        b"{", b"[]", b"null", b'{"a":{}}', b'{"__metadata__":{"description":"{}"}}',
        b'{"x":{"dtype":"F32","shape":[9999999999],"data_offsets":[0,4]}}',
        b'{"x":{"dtype":"F32","shape":[1],"data_offsets":[0,4]},"y":{"dtype":"F32","shape":[1],"data_offsets":[0,4]}}',
        b'{"x":{"dtype":"F99","shape":[1],"data_offsets":[0,4]}}',
        b'{"x":{"dtype":"F32","shape":[-1],"data_offsets":[4,0]}}',
        b'{"__metadata__":{"description":' + b"[" * 50_000 + b"}}",
        b"{" + b",".join(b'"%d":{"dtype":"F32","shape":[0],"data_offsets":[0,0]}' % k for k in range(100_001)) + b"}",
    ],
)  # fmt: skip
def test_headers_of_safetensors(header: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    for length in (len(header), 2**63, 0, 101_000_000):
        path.write_bytes(struct.pack("<Q", length) + header + b"\0" * 8)
        assert not try_one(lambda p: load_avatar(p, BODY), path)


def test_manifests_do_not_reach_out_of_their_folder(tmp_path: Path) -> None:
    """A hash beside a name that escapes is no reason to look there."""
    inside = tmp_path / "run"
    inside.mkdir()
    (tmp_path / "secret").write_text("x")
    for name in ("../secret", "/etc/passwd", "a/../../secret", "missing"):
        assert changed(inside, {name: "0" * 16})
