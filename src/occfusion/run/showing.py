"""What is to be shown of a run, by the words that users type: its motion, its light, the path of the camera."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from occfusion.errors import ConfigError
from occfusion.evaluation.pictures import to_uint8
from occfusion.files.run_folder import RunFolder
from occfusion.human.rendering import Renderer
from occfusion.motion import (
    EMBEDDED_CLIPS,
    Clip,
    Performance,
    at_rest,
    embedded_clip,
    leg_length,
    perform,
    read_clip,
    read_sequence,
    spread_rows,
)
from occfusion.run.bodies import make_body, make_data
from occfusion.run.loaded import LoadedRun, read_settings
from occfusion.run.sequence import ensure_sequence
from occfusion.show.drawing import Painter, parse_light, world_to_clip
from occfusion.show.film import Picture
from occfusion.show.paths import Framing, Shot, bullet_time, fitted, spiral, still, turntable
from occfusion.show.views import HELD_OUT, TRAIN, View, read_views

SEQUENCE = "sequence"
PATHS = ("turntable", "canonical", "held-out", "train", "bullet-time", "spiral")
OWN_CAMERAS = {"held-out": HELD_OUT, "train": TRAIN}
"""Paths along cameras of the data set, and their group in the run's record."""
MOVING_PATHS = (*OWN_CAMERAS, "bullet-time")
"""Paths on which the sequence plays where no other motion is asked for; a file of cameras is one more."""
FRAMES = 120
"""Pictures of a path on which nothing moves."""
DEFAULT_SIZE = 512
MOST_FPS = 60.0


@dataclass(frozen=True)
class MotionChoice:
    """Which motion is shown, and which part.

    Attributes:
        words: `sequence`, an embedded clip, another run's folder, or a file; None: the sequence's first frame stands.
        own_fps: frames a second of a file that does not say.
        fps: frames a second to be shown; None: the clip's own.
        start: seconds left out at its start.
        seconds: how long; None: to its end.
    """

    words: str | None = None
    own_fps: float | None = None
    fps: float | None = None
    start: float = 0.0
    seconds: float | None = None


def find_clip(run: LoadedRun, choice: MotionChoice) -> tuple[Clip, float | None]:
    """Returns the clip that a user means and the length of the mover's legs, None where that is not known.

    Raises:
        OccfusionError: there is none of that name, or it cannot be read.
    """
    legs = None
    words = SEQUENCE if choice.words is None else choice.words
    path = Path(words)
    if words == SEQUENCE:
        clip = run.clip
    elif words in EMBEDDED_CLIPS:
        clip = embedded_clip(words)
    elif (other := RunFolder(path)).config.is_file():
        settings = read_settings(other)
        ensure_sequence(other, settings)
        clip = read_sequence(other.motion, path.name)
        assert clip.betas is not None
        legs = leg_length(make_body(settings.body).rest(torch.from_numpy(clip.betas).float()).joints)
        clip = replace(clip, numbers=None, betas=None)
    elif path.is_file():
        clip = read_clip(path, choice.own_fps)
    else:
        raise ConfigError(
            f"--motion {words}: {SEQUENCE}, a clip of {', '.join(EMBEDDED_CLIPS)}, another run's folder, or a file of "
            "AMASS, AIST++ or smplx's names; there is no such file or run"
        )
    if choice.own_fps is not None:
        clip = replace(clip, fps=choice.own_fps)
    if choice.words is None:
        return clip[:1], legs
    clip = clip.part(choice.start, choice.seconds)
    wanted = choice.fps
    if wanted is None and clip.fps is not None and clip.fps > MOST_FPS:
        wanted = clip.fps / np.ceil(clip.fps / MOST_FPS)
    return clip if wanted is None or clip.fps is None else clip.resampled(wanted), legs


def find_performance(run: LoadedRun, choice: MotionChoice) -> Performance:
    """Returns the motion that a user means as a run's avatar performs it."""
    clip, legs = find_clip(run, choice)
    return perform(clip, run.avatar.body, run.betas, legs)


@dataclass(frozen=True)
class Showing:
    """One run, ready to be drawn.

    Attributes:
        painter: draws it.
        shots: what is to be drawn, picture by picture.
        views: the views of the run that the shots are from, for the input beside them; empty: none.
        fps: frames a second that its motion is to be played with; None where nobody says.
    """

    painter: Painter
    shots: list[Shot]
    views: list[View]
    fps: float | None


def make_showing(
    run: LoadedRun,
    path: str,
    motion: MotionChoice,
    *,
    light: str = "estimated",
    size: tuple[int, int] | None = None,
    frames: int | None = None,
    moment: int | None = None,
    renderer: Renderer,
) -> Showing:
    """Returns a run with its motion and the cameras of a path.

    Args:
        run: whose avatar.
        path: one of `PATHS`, or a file of cameras.
        motion: which one plays; on paths along the run's own cameras the sequence, if nothing else is said.
        light: see `show.drawing.parse_light`.
        size: width and height; None: `DEFAULT_SIZE`, on given cameras their own.
        frames: pictures; None: as many as the motion or the path has.
        moment: frame of the motion at which time stands, for bullet-time; None: its middle.
        renderer: draws.

    Raises:
        OccfusionError: anything that the user can mend.
    """
    if path not in PATHS and not Path(path).is_file():
        raise ConfigError(f"--path {path}: {', '.join(PATHS)}, or a file of cameras; there is no such file")
    is_given = path in OWN_CAMERAS or path not in PATHS
    if motion.words is None and (is_given or path in MOVING_PATHS):
        motion = replace(motion, words=SEQUENCE)
    own = perform(run.clip, run.avatar.body, run.betas)
    performance = own if motion == MotionChoice(SEQUENCE) else find_performance(run, motion)
    lit = parse_light(light, run.avatar, own.upright)
    framing = Framing(*(size or (DEFAULT_SIZE, DEFAULT_SIZE)), run.pixel)
    views: list[View] = []
    if path == "canonical":
        means = run.avatar.gaussians.means.detach().cpu().double().numpy()
        low, high = np.quantile(means, (0.001, 0.999), axis=0)
        middle = 0.5 * (low + high) * (1.0, 0.0, 1.0)
        performance = at_rest(low - middle, high - middle)
        shots = [
            replace(shot, row=None) for shot in turntable(performance, [0] * (frames or FRAMES), framing)
        ]
    elif is_given:
        views = run.views(OWN_CAMERAS[path]) if path in OWN_CAMERAS else read_views(Path(path))
        rows, views = _rows_of_views(views, performance, frames, follows=path in OWN_CAMERAS)
        pixel = None if path in OWN_CAMERAS else run.pixel
        shots = still(performance, rows, views, world_to_clip(own, performance), size, pixel)
        views = views if path in OWN_CAMERAS and performance.clip.numbers is not None else []
    elif path == "bullet-time":
        middle_row = len(performance) // 2 if moment is None else moment
        shots = bullet_time(performance, middle_row, frames or FRAMES, framing)
    else:
        count = frames or (len(performance) if len(performance) > 1 else FRAMES)
        rows = list(spread_rows(count, len(performance)))
        shots = (turntable if path == "turntable" else spiral)(performance, rows, framing)
    painter = Painter(run.avatar, performance, lit, renderer)
    return Showing(painter, shots, views, performance.clip.fps if len(performance) > 1 else None)


def _rows_of_views(
    views: list[View], performance: Performance, frames: int | None, *, follows: bool
) -> tuple[list[int], list[View]]:
    """Returns which frame of the motion each view shows, and the views."""
    numbers = performance.clip.numbers
    if follows and numbers is not None:
        places = {number: row for row, number in enumerate(numbers.tolist())}
        known = [view for view in views if view.frame is not None and float(view.frame) in places]
        if not known:
            raise ConfigError(
                "no picture of these cameras lies in the part of the sequence that is asked for"
            )
        chosen = known if frames is None else [known[k] for k in spread_rows(frames, len(known))]
        return [places[float(view.frame)] for view in chosen if view.frame is not None], chosen
    count = frames or max(len(views), len(performance))
    return list(spread_rows(count, len(performance))), [views[k] for k in spread_rows(count, len(views))]


def inputs_of(run: LoadedRun, views: list[View], size: tuple[int, int] | None) -> Iterator[Picture]:
    """Yields what the training camera saw at its views, fitted into a size; the data set is opened for it.

    Raises:
        OccfusionError: the data are not where they were.
    """
    import cv2

    data = make_data(run.settings, make_body(run.settings.body))
    data.setup()
    positions = {frame: position for position, frame in enumerate(data.train_indices)}
    for view in views:
        assert view.frame is not None
        frame = data.train_frame(positions[view.frame], truth=False)
        picture: Picture = to_uint8(frame.rgb)
        if size is not None:
            camera, scale = fitted(view.camera, *size)
            place = np.array([[scale, 0.0, 0.0], [0.0, scale, 0.0]])
            place[:, 2] = (camera.K[:2, 2] - scale * view.camera.K[:2, 2]).numpy()
            # pixel centres lie at +0.5
            place[:, 2] += 0.5 * scale - 0.5
            picture = cv2.warpAffine(picture, place, size, flags=cv2.INTER_LINEAR)
        yield picture


def run_names(folders: Sequence[Path]) -> list[str]:
    """Returns names that tell runs apart: of their paths what not all share."""
    parts = [folder.resolve().parts for folder in folders]
    shortest = min(len(part) for part in parts)
    first = next((k for k in range(shortest) if len({part[k] for part in parts}) > 1), shortest - 1)
    last = next((k for k in range(1, shortest - first + 1) if len({part[-k] for part in parts}) > 1), 1)
    return ["/".join(part[first : len(part) - last + 1]) or part[-1] for part in parts]
