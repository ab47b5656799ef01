"""A clip as it comes from a camera or a phone: a video file or a folder of pictures, upright, at a bounded size."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.errors import ConfigError, DataError
from occfusion.files.naming import natural

Picture = NDArray[np.uint8]

VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".webp")
SIDE = 1280
"""Longer side, in pixels, of what is decoded, unless asked otherwise: 4K holds no more that the models could use."""
RATE = 30.0
"""Frames a second beyond which frames are passed over, unless asked otherwise."""
UNEVEN = 0.25
"""Share by which the middle half of the frames' distances in time may differ before a clip counts as uneven."""
SAME_PLACE = 0.5
"""Edges so much alike (correlation) are of the same place: a real clip has 0.95 where the sun bursts into the lens."""
COMBED = 1.6
"""Differences between neighbouring rows against those between every second one, from which on rows are interlaced."""


@dataclass(frozen=True)
class Clip:
    """What a clip holds, before its pictures are decoded.

    Attributes:
        path: the video, or the folder.
        pictures: files of a folder, in order; empty for a video.
        frames: how many there are, as the container says; counted where it does not, as browsers' recordings.
        fps: frames a second; None for a folder.
        turned: degrees by which a phone says that its pictures are to be turned, which decoding does.
    """

    path: Path
    pictures: tuple[Path, ...]
    frames: int
    fps: float | None
    turned: int


@dataclass(frozen=True)
class Shot:
    """The decoded frames of a clip.

    Attributes:
        pictures: `[H, W, 3]` each, RGB.
        numbers: each picture's place in the clip, from 0.
        seconds: each picture's time; the place in the folder where there is no time.
        scale: pixels of a picture here a pixel of the file.
        notes: what a user should know, in sentences.
    """

    pictures: list[Picture]
    numbers: list[int]
    seconds: list[float]
    scale: float
    notes: list[str]

    def __len__(self) -> int:
        """Returns the number of pictures."""
        return len(self.pictures)

    def at(self, places: Sequence[int]) -> Shot:
        """Returns some of the frames."""
        return Shot(
            [self.pictures[k] for k in places], [self.numbers[k] for k in places],
            [self.seconds[k] for k in places], self.scale, self.notes,
        )  # fmt: skip

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.pictures[0].shape[1], self.pictures[0].shape[0]


def open_clip(path: Path | str) -> Clip:
    """Returns what a video or a folder of pictures holds.

    Raises:
        DataError: there is no such file, it is one still picture, it is no video, or a folder has no pictures.
    """
    path = Path(path)
    if path.is_dir():
        files = [p for p in path.iterdir() if p.suffix.lower() in PICTURE_SUFFIXES]
        files.sort(key=lambda p: (natural(p.stem), p.name))
        if not files:
            raise DataError(f"{path}: holds no pictures ({', '.join(PICTURE_SUFFIXES)}).")
        return Clip(path, tuple(files), len(files), None, 0)
    if not path.is_file():
        raise DataError(f"{path}: no such file; give a video or a folder of its frames.")
    if path.suffix.lower() in PICTURE_SUFFIXES:
        raise DataError(f"{path}: is one picture; an avatar needs a video, or a folder of its frames.")
    capture = _capture(path)
    try:
        frames, fps = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), float(capture.get(cv2.CAP_PROP_FPS))
        turned = int(capture.get(cv2.CAP_PROP_ORIENTATION_META)) % 360
        if frames <= 0:
            frames = sum(1 for _ in iter(capture.grab, False))
    finally:
        capture.release()
    if not frames:
        raise DataError(f"{path}: no frame could be decoded; the file is damaged or empty.")
    return Clip(path, (), frames, fps if np.isfinite(fps) and fps > 0 else None, turned)


def read_clip(
    clip: Clip,
    *,
    every: int | None = None,
    frames: int | None = None,
    start: int = 0,
    stop: int | None = None,
    side: int = SIDE,
) -> Shot:
    """Returns the chosen frames of a clip, upright.

    Args:
        clip: from `open_clip`.
        every: take each so-manyth frame; None for as many as make at most `RATE` a second.
        frames: at most so many, spread evenly over what `every` leaves.
        start: first frame.
        stop: frame after the last; None for the end.
        side: longer side of the pictures, pixels; smaller ones stay as they are.

    Raises:
        ConfigError: the choice is empty or out of range.
        DataError: nothing can be decoded, or the pictures of a folder differ in size.
    """
    if start < 0 or (stop is not None and stop <= start) or (every is not None and every < 1):
        raise ConfigError(
            f"frames {start} to {stop} by {every}: give 0 <= start < stop and a step from 1 on."
        )
    notes: list[str] = []
    if every is None:
        every = max(1, round((clip.fps or RATE) / RATE))
        if every > 1:
            notes.append(f"{clip.fps:.4g} frames a second: one of {every} is taken (--every 1 for all).")
    wanted = _wanted(clip, every, frames, start, stop)
    shot = Shot([], [], [], 1.0, notes)
    scale, seen = 1.0, 0
    for number, second, picture in _decoded(clip, wanted, stop):
        seen = number + 1
        if picture is None:
            continue
        scale = min(1.0, side / max(picture.shape[:2]))
        if scale < 1.0:
            width, height = (round(length * scale) for length in picture.shape[1::-1])
            picture = np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA))
        if shot.pictures and picture.shape != shot.pictures[0].shape:
            raise DataError(
                f"{clip.path}, frame {number}: {picture.shape[1]} x {picture.shape[0]} pixels, the first has "
                f"{shot.size[0]} x {shot.size[1]}; all must be alike."
            )
        shot.pictures.append(picture)
        shot.numbers.append(number)
        shot.seconds.append(second)
    if not shot.pictures:
        raise DataError(
            f"{clip.path}: no frame from {start} on could be decoded ({seen} were there); the file is damaged or empty."
        )
    last = min(stop or clip.frames, clip.frames)
    if not clip.pictures and seen < last - 1 and (frames is None or seen <= max(wanted, default=0)):
        notes.append(f"damaged after frame {seen - 1} of {clip.frames}: what is before it is used.")
    if scale < 1.0:
        notes.append(f"pictures made smaller to {shot.size[0]} x {shot.size[1]} (--size for another).")
    if clip.turned:
        notes.append(f"turned upright by {clip.turned} degrees, as the file says.")
    return Shot(shot.pictures, shot.numbers, shot.seconds, scale, notes + _doubts(shot, clip))


def cuts(pictures: list[Picture]) -> list[int]:
    """Returns the places, from 1, where a new shot begins.

    A cut changes the whole picture at once: its small grey copy differs from the one before by far more than its
    neighbours do, and so do the colours as a whole. Where edges stay where they are, the light alone has changed.
    """
    if len(pictures) < 3:
        return []
    small = np.stack([_thumbnail(picture) for picture in pictures])
    change = np.abs(np.diff(small, axis=0)).mean(axis=(1, 2, 3))
    usual = np.array(
        [np.median(np.delete(change[max(0, k - 6) : k + 7], min(k, 6))) for k in range(len(change))]
    )
    colours = np.stack([_histogram(picture) for picture in pictures])
    shift = 0.5 * np.abs(np.diff(colours, axis=0)).sum(axis=1)
    sudden = np.flatnonzero((change > 14.0) & (change > 4.0 * usual) & (shift > 0.25))
    return [int(k) + 1 for k in sudden if _same_edges(pictures[k], pictures[k + 1]) < SAME_PLACE]


def chosen(pictures: list[Picture], count: int, way: str) -> list[int]:
    """Returns the places of so many pictures, rising.

    Args:
        pictures: of one shot.
        count: how many; all where there are no more.
        way: `sharpest`, the sharpest of each of `count` stretches; `unlike`, those least alike, which are added one by
            one, each as far as can be from all before.
    """
    if len(pictures) <= count:
        return list(range(len(pictures)))
    if way == "sharpest":
        scores = np.array([sharpness(picture) for picture in pictures])
        return [int(part[scores[part].argmax()]) for part in np.array_split(np.arange(len(pictures)), count)]
    small = np.stack([_thumbnail(picture) for picture in pictures]).reshape(len(pictures), -1)
    kept, away = [0], np.linalg.norm(small - small[0], axis=1)
    while len(kept) < count:
        kept.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(small - small[kept[-1]], axis=1))
    return sorted(kept)


def sharpness(picture: Picture) -> float:
    """Returns how sharp a picture is: the variance of its Laplacian."""
    return float(cv2.Laplacian(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), cv2.CV_64F).var())


def _wanted(clip: Clip, every: int, frames: int | None, start: int, stop: int | None) -> set[int] | range:
    end = clip.frames if stop is None else min(stop, clip.frames)
    if start >= end:
        raise ConfigError(f"{clip.path}: has {clip.frames} frames; frame {start} is none of them.")
    every_so_many = range(start, end, every)
    if frames is not None and len(every_so_many) > frames:
        return {every_so_many[int(k)] for k in np.linspace(0, len(every_so_many) - 1, frames).round()}
    return every_so_many


def _decoded(
    clip: Clip, wanted: set[int] | range, stop: int | None
) -> Iterator[tuple[int, float, Picture | None]]:
    """Yields each frame's number, its time in seconds, and its picture where it is wanted."""
    if clip.pictures:
        for number, path in enumerate(clip.pictures):
            if number in wanted:
                picture = cv2.imread(str(path), cv2.IMREAD_COLOR)  # turns as EXIF says
                if picture is None:
                    raise DataError(f"{path}: cannot be read as a picture; replace it or take it out.")
                yield number, float(number), _rgb(picture)
        return
    capture, number = _capture(clip.path), 0
    try:
        while (stop is None or number < stop) and capture.grab():
            picture = None
            second = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
            if number in wanted:
                good, raw = capture.retrieve()
                picture = _rgb(raw) if good and raw is not None else None
            yield number, second, picture
            number += 1
    finally:
        capture.release()


def _rgb(picture: NDArray[Any]) -> Picture:
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def _capture(path: Path) -> cv2.VideoCapture:
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    if not capture.isOpened():
        raise DataError(
            f"{path}: cannot be opened as a video; it is damaged, cut short, or no video. Videos are usually "
            f"{', '.join(VIDEO_SUFFIXES)}."
        )
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
    return capture


def _doubts(shot: Shot, clip: Clip) -> list[str]:
    doubts = []
    gaps = np.diff(shot.seconds)
    steps = np.diff(shot.numbers)
    if not clip.pictures and len(gaps) > 4 and (gaps > 0).all():
        pace = gaps / steps
        low, high = np.percentile(pace, [25, 75])
        if high > (1 + UNEVEN) * low:
            doubts.append(
                f"frames come unevenly, {low * 1000:.0f} to {high * 1000:.0f} ms: their own times are used."
            )
    combed = [combing(picture) for picture in shot.pictures[:: max(1, len(shot) // 8)]]
    if np.median(combed) > COMBED:
        doubts.append(
            "rows of odd and even number show different moments (interlaced): edges will be torn. Convert the video "
            "first, for example with ffmpeg's filter bwdif."
        )
    return doubts


def combing(picture: Picture) -> float:
    """Returns how much neighbouring rows differ against rows two apart; above 1 only where fields are interlaced."""
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32)
    near, far = np.abs(grey[1:] - grey[:-1])[:-1], np.abs(grey[2:] - grey[:-2])
    moving = near > 12.0
    if moving.mean() < 1e-3:
        return 0.0
    return float(near[moving].mean() / max(float(far[moving].mean()), 1e-3))


def _thumbnail(picture: Picture) -> NDArray[np.float32]:
    return np.asarray(cv2.resize(picture, (32, 32), interpolation=cv2.INTER_AREA)).astype(np.float32)


def _same_edges(one: Picture, other: Picture) -> float:
    """Returns how alike the edges of two small copies are, -1..1."""
    steps = []
    for picture in (one, other):
        grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
        small = np.asarray(cv2.resize(grey, (64, 64), interpolation=cv2.INTER_AREA), dtype=np.float32)
        steps.append(np.stack([cv2.Sobel(small, -1, 1, 0), cv2.Sobel(small, -1, 0, 1)]))
    a, b = steps
    return float((a * b).sum() / max(float(np.sqrt((a * a).sum() * (b * b).sum())), 1e-6))


def _histogram(picture: Picture) -> NDArray[np.float64]:
    small = np.asarray(cv2.resize(picture, (64, 64), interpolation=cv2.INTER_AREA)).reshape(-1, 3)
    counts, _ = np.histogramdd(small, bins=(6, 6, 6), range=((0, 256),) * 3)
    return np.asarray(counts.reshape(-1) / len(small))
