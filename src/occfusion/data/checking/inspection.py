"""A full look into a data folder: everything that is wrong at once, not only what comes first."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import wraps
from itertools import pairwise

import numpy as np

from occfusion.data.checking import checks, survey, validation
from occfusion.data.posing import Poser
from occfusion.data.sampling import evenly
from occfusion.data.scene import Array, BodyParameters, Calibration, Scene
from occfusion.errors import DataError, OccfusionError
from occfusion.files.images import image_size
from occfusion.human.coverage import BodyCoverage

LEVELS = ("ok", "note", "doubt", "error")


@dataclass(frozen=True)
class Finding:
    """One line of the table.

    Attributes:
        level: `ok`; `note`: worth knowing; `doubt`: training starts, its result may suffer; `error`: training
            does not start.
        topic: what was looked at.
        text: what was found.
        cure: what to do; empty where there is nothing to do.
    """

    level: str
    topic: str
    text: str
    cure: str = ""


def worst(findings: Iterable[Finding]) -> str:
    """Returns the gravest level among findings."""
    return LEVELS[max((LEVELS.index(finding.level) for finding in findings), default=0)]


def guarded(topic: str, look: Callable[[], Iterable[Finding]]) -> list[Finding]:
    """Returns what `look` finds; an error that it raises becomes the last finding, and the rest can go on."""
    found: list[Finding] = []
    try:
        for finding in look():
            found.append(finding)
    except OccfusionError as error:
        found.append(Finding("error", topic, str(error)))
    return found


def listed(items: Iterable[object], most: int = 8) -> str:
    """Returns items as text, cut after the first few."""
    shown = list(items)
    more = f" and {len(shown) - most} more" if len(shown) > most else ""
    return ", ".join(str(item) for item in shown[:most]) + more


INSPECTED_FRAMES = 12
"""Frames whose pictures are opened; parameters and the presence of files are checked for all frames."""

INSPECTED_HELD_OUT = 2
"""Frames whose sizes are compared in the cameras that are not trained on."""

SHARP_TURN = 1.0
"""Largest plausible turn of the whole body from one frame to the next, radians: more is a flipped fit."""

JUMP = 0.5
"""Largest plausible way of the body from one frame to the next, metres."""


@dataclass
class Inspection:
    """What is inspected, and what was understood of it so far.

    Attributes:
        scene: the reader.
        poser: the body.
        camera: index of the camera that is to be trained on.
        sound: calibrations that could be read, by index.
        bodies: body parameters that could be read, by frame.
        people: what the masks of the frames that were opened show.
        coverage: how well the training camera shows the body, once that was looked at.
    """

    scene: Scene
    poser: Poser
    camera: int = 0
    sound: dict[int, Calibration] = field(default_factory=dict)
    bodies: dict[int, BodyParameters] = field(default_factory=dict)
    people: dict[int, survey.Person] = field(default_factory=dict)
    coverage: BodyCoverage | None = None

    def view(self, frame: int) -> Calibration:
        """Returns the camera that is to be trained on, as it was at a frame."""
        return self.scene.view(frame, self.camera) if self.scene.zooms else self.sound[self.camera]

    def posed_frames(self) -> list[int]:
        """Returns the frames that have parameters and, of the camera that is to be trained on, a picture."""
        return [frame for frame in sorted(self.bodies) if self.scene.shows(frame, self.camera)]

    def sample(self) -> list[int]:
        """Returns a few frames, evenly spread."""
        return evenly(range(self.scene.num_frames), INSPECTED_FRAMES)


Look = Callable[[Inspection], Iterable[Finding]]


def looks_at(topic: str) -> Callable[[Look], Callable[[Inspection], list[Finding]]]:
    """Makes a look at an inspection one that `guarded` guards."""

    def decorate(look: Look) -> Callable[[Inspection], list[Finding]]:
        return wraps(look)(lambda inspection: guarded(topic, lambda: look(inspection)))

    return decorate


@looks_at("files")
def inspect_files(inspection: Inspection) -> Iterator[Finding]:
    """Returns what is missing, of all frames and cameras."""
    scene, missing, total = inspection.scene, [], 0
    for frame in range(scene.num_frames):
        missing += [path for path in scene.evidence(frame) if not path.is_file()]
        for camera in range(len(scene.cameras)):
            if not scene.shows(frame, camera):
                continue
            total += 1
            missing += [path for path in scene.files(frame, camera).all() if not path.is_file()]
    if not missing:
        yield Finding("ok", "files", f"all there: {scene.num_frames} frames of {len(scene.cameras)} cameras")
        return
    unique = sorted(set(missing))
    names = listed((os.path.relpath(path, scene.root) for path in unique), 4)
    yield Finding(
        "error", "files", f"{len(unique)} files of {total} views are missing: {names}",
        "complete them, or choose dataset.train_frames, train_camera and test_cameras that are whole",
    )  # fmt: skip


def inspect_cameras(inspection: Inspection) -> list[Finding]:
    """Returns what is wrong with each camera: rotation, unit, focal length, principal point, sizes."""
    found: list[Finding] = []
    for camera, name in enumerate(inspection.scene.cameras):
        found += guarded(f"camera {name}", lambda camera=camera: _camera(inspection, camera))  # type: ignore[misc]
    if inspection.sound and not found:
        focal = [calibration.K[0, 0] for calibration in inspection.sound.values()]
        determinants = {round(float(np.linalg.det(c.R)), 6) for c in inspection.sound.values()}
        text = (
            f"{len(inspection.sound)} sound: det R {listed(sorted(determinants))}, focal lengths {min(focal):.0f} to "
            f"{max(focal):.0f} px"
        )
        found.append(Finding("ok", "cameras", text))
    return found


def _camera(inspection: Inspection, camera: int) -> Iterator[Finding]:
    scene = inspection.scene
    calibration = scene.calibration(camera)
    count = INSPECTED_FRAMES if camera == inspection.camera else INSPECTED_HELD_OUT
    shown = [frame for frame in range(scene.num_frames) if scene.shows(frame, camera)] or [0]
    views = [(f, camera) for f in evenly(shown, count) if scene.files(f, camera).rgb.is_file()]
    if views:
        size = image_size(scene.files(*views[0]).rgb)
        for frame in shown if scene.zooms else shown[:1]:
            K = scene.view(frame, camera).K
            checks.check_intrinsics(K, size, f"{scene.root}, K of camera {calibration.name}, frame {frame}")
        here = [view for view in views if all(path.is_file() for path in scene.files(*view).all())]
        survey.require_sizes(scene, here, {camera: size})
    inspection.sound[camera] = calibration
    yield from ()


def inspect_bodies(inspection: Inspection) -> list[Finding]:
    """Returns which frames have parameters that cannot be, that jump, or a body of a strange height."""
    bad: dict[int, str] = {}
    for frame in range(inspection.scene.num_frames):
        try:
            inspection.bodies[frame] = inspection.scene.parameters(frame)
        except DataError as error:
            bad[frame] = str(error)
    found: list[Finding] = []
    if bad:
        first = next(iter(bad))
        found.append(
            Finding("error", "bad frames", f"{len(bad)}: {listed(bad)}; the first: {bad[first]}",
                    "mend or leave out these frames")
        )  # fmt: skip
    found += _given_joints(inspection)
    return found + (guarded("body", lambda: _bodies(inspection)) if inspection.bodies else [])


def _given_joints(inspection: Inspection) -> list[Finding]:
    """Returns what the folder's own joints say of the body: a doubt, as another one may be given in training."""
    if inspection.poser.stands_in:
        return []
    try:
        warnings = inspection.scene.body_warnings(inspection.poser.pose)
    except DataError as error:
        warnings = [str(error)]
    return [Finding("doubt", "body file", text) for text in warnings]


def _bodies(inspection: Inspection) -> Iterator[Finding]:
    frames = sorted(inspection.bodies)
    heights = [
        float(np.ptp(inspection.poser.rest_vertices(inspection.bodies[frame].betas), axis=0).max())
        for frame in {0: frames[0], 1: frames[-1]}.values()
    ]
    low, high = validation.HEIGHT
    shapes = {inspection.bodies[frame].betas.tobytes() for frame in frames}
    sound = low <= min(heights) and max(heights) <= high
    yield Finding(
        "ok" if sound else "error", "height", f"{heights[0]:.2f} m at rest, {len(shapes)} shape(s)",
        "" if sound else f"a person has {low} to {high} m: check `shapes` and the unit of the body file",
    )  # fmt: skip
    jumps = [b for a, b in pairwise(frames) if b == a + 1 and _jumps(inspection, a, b)]
    if jumps:
        yield Finding(
            "doubt", "motion", f"{len(jumps)} frames jump or turn sharply against the one before: {listed(jumps)}",
            "look at these poses; leave the frames out if they are wrong",
        )  # fmt: skip


def _jumps(inspection: Inspection, before: int, after: int) -> bool:
    a, b = inspection.bodies[before], inspection.bodies[after]
    turn = checks.turn_between(a.global_orient, b.global_orient)
    step = b.transl - a.transl
    if inspection.scene.zooms:  # distance trades for focal length: nearer or farther is no motion
        ray = a.transl - inspection.scene.calibration(inspection.camera).centre
        step = step - ray * (step @ ray) / max(float(ray @ ray), JUMP)
    return bool(np.linalg.norm(step) > JUMP or turn > SHARP_TURN)


@looks_at("masks")
def inspect_masks(inspection: Inspection) -> Iterator[Finding]:
    """Returns what the masks of the training camera show in a few frames."""
    where, frames = str(inspection.scene.root), inspection.sample()
    unreadable = []
    for frame in frames:
        try:
            inspection.people[frame] = survey.read_person(inspection.scene, frame, inspection.camera)
        except DataError as error:
            unreadable.append(str(error))
    for text in unreadable[:3]:
        yield Finding("error", "masks", text)
    seen = {frame: person.seen for frame, person in inspection.people.items()}
    empty = [frame for frame, person in seen.items() if person.empty]
    if empty:
        level = "error" if len(empty) == len(seen) else "doubt"
        yield Finding(
            level, "masks", f"{len(empty)} of {len(frames)} frames looked at show nobody: {listed(empty)}",
            "such frames are left out; check the masks if somebody is in them",
        )  # fmt: skip
    warnings = validation.mask_warnings(where, list(seen), list(seen.values()))
    for text in warnings:
        yield Finding("doubt", "masks", text)
    shares = [int(p.crop().sum()) / (p.width * p.height) for p in seen.values() if not p.empty]
    if shares:
        text = f"cover {min(shares):.1%} to {max(shares):.1%} of the picture in {len(shares)} frames"
        yield Finding("ok" if not (warnings or empty or unreadable) else "note", "masks", text)


def posed_bodies(inspection: Inspection) -> dict[int, tuple[Array, Array]]:
    """Returns vertices and joints in the world by frame, where mask and parameters could be read.

    Each is `[V, 3]` and `[24, 3]`, metres.
    """
    frames = [
        f for f, person in inspection.people.items() if not person.seen.empty and f in inspection.bodies
    ]
    return {frame: inspection.poser.pose(inspection.bodies[frame]) for frame in frames}
