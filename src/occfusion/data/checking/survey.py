"""A look over the data before training: files, sizes, who is in the pictures, how much is hidden."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from occfusion.data.scene import Scene
from occfusion.data.silhouette import Hidden, Silhouette, read_people, require_size
from occfusion.errors import DataError
from occfusion.files.images import read_mask, sound_size

SCAN_THREADS = 2
"""Masks decode outside the interpreter's lock; more threads than this only help on larger machines."""

HASHED_AT_ONCE = 1 << 20
"""Bytes read at a time: annotations of a whole data set can have half a gigabyte."""


@dataclass(frozen=True)
class Person:
    """What the masks of one training picture show, at the stored size.

    Attributes:
        whole: the person, with hidden parts where the data set has a complete mask.
        seen: the person in the picture as it was taken.
        crowded: whether somebody else touches the person, so that it is not known what is behind.
    """

    whole: Silhouette
    seen: Silhouette
    crowded: bool = False

    def visible_share(self, hidden: Hidden | None) -> float:
        """Returns which share of the whole person is seen past real and simulated occluders."""
        total = int(self.whole.crop().sum())
        if total == 0:
            return 0.0
        return min(int(self.seen.crop().sum()) * self.seen.share_outside(hidden) / total, 1.0)


def require_files(scene: Scene, views: Iterable[tuple[int, int]]) -> None:
    """Raises DataError naming the first missing file of `(frame, camera)` views and of their poses."""
    needed = dict.fromkeys(
        path
        for frame, camera in views
        for path in (*scene.evidence(frame), *scene.files(frame, camera).all())
    )
    missing = [path for path in needed if not path.is_file()]
    if missing:
        more = f" and {len(missing) - 1} more files" if len(missing) > 1 else ""
        raise DataError(
            f"{missing[0]}: file not found{more}, out of {len(needed)} that this training needs. Complete the "
            "folder, or choose dataset.train_frames and dataset.test_cameras that it has."
        )


def require_sizes(scene: Scene, views: Iterable[tuple[int, int]], sizes: dict[int, tuple[int, int]]) -> None:
    """Raises DataError unless pictures and masks of each camera can be read and declare that camera's size.

    Args:
        scene: the reader.
        views: `(frame, camera)` to look at; only the beginnings and ends of the files are read.
        sizes: (width, height) of each camera.
    """
    for frame, camera in views:
        for path in scene.files(frame, camera).all():
            require_size(sound_size(path), path, sizes[camera])


def scan_people(scene: Scene, frames: Sequence[int], camera: int) -> list[Person]:
    """Returns what the masks of the training pictures show, in order."""
    with ThreadPoolExecutor(SCAN_THREADS, thread_name_prefix="masks") as pool:
        return list(pool.map(lambda frame: read_person(scene, frame, camera), frames))


def read_person(scene: Scene, frame: int, camera: int) -> Person:
    """Returns what the masks of one picture show."""
    files = scene.files(frame, camera)
    person, hiders = read_people(files)
    seen = Silhouette.of(person)
    if files.complete_mask is not None:
        return Person(Silhouette.of(read_mask(files.complete_mask)), seen)
    return Person(seen, seen, crowded=bool(hiders.any()))


def data_hash(scene: Scene, views: Iterable[tuple[int, int]], settings: str) -> str:
    """Returns a fingerprint of cameras, body parameters, the list of pictures with their sizes, and settings.

    Picture contents are left out: reading them all would take longer than the rest of the preparation.
    """
    digest = hashlib.sha256(settings.encode())
    read: set[Path] = set()
    for frame, camera in views:
        for path in scene.evidence(frame):
            if path not in read:
                read.add(path)
                digest.update(path.name.encode())
                with path.open("rb") as stream:
                    while part := stream.read(HASHED_AT_ONCE):
                        digest.update(part)
        for path in scene.files(frame, camera).all():
            name = Path(os.path.relpath(path, scene.root)).as_posix()
            digest.update(f"{name} {path.stat().st_size}\n".encode())
    return digest.hexdigest()[:16]


def hidden_boxes(hidden: Iterable[Hidden | None]) -> list[list[int] | None]:
    """Returns the rectangle around what is simulated to be hidden in each frame, None for nothing."""
    boxes = [part.box if isinstance(part, Silhouette) else part for part in hidden]
    return [None if box is None else list(box) for box in boxes]


def hidden_digest(hidden: Iterable[Hidden | None]) -> str:
    """Returns a fingerprint of what is hidden in each frame: settings alone do not say what files hold."""
    digest = hashlib.sha256()
    for part in hidden:
        if isinstance(part, Silhouette):
            digest.update(repr(part.box).encode() + part.bits.tobytes())
        else:
            digest.update(repr(part).encode())
    return digest.hexdigest()
