"""Does the body lie where the masks are? If not: which known error would explain it; and a picture that shows it.

And from how many directions the video shows each place of the body.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.data.cameras import Lens
from occfusion.data.checking import checks, overlap, survey
from occfusion.data.checking.inspection import Finding, Inspection, listed, looks_at, posed_bodies
from occfusion.data.checking.overlap import LOW_OVERLAP, SUSPECT, explain_misfit, find_exchange
from occfusion.data.checking.validation import JOINTS_INSIDE, MISSED
from occfusion.data.outline_offsets import View
from occfusion.data.registration import register
from occfusion.data.sampling import evenly, spread
from occfusion.data.scene import Array, Calibration
from occfusion.errors import DataError
from occfusion.files.images import read_rgb
from occfusion.geometry.coverage import Sighting
from occfusion.human.body import Body
from occfusion.human.coverage import BodyCoverage, cover_body

REGISTERED, REGISTERED_SIZE = 40, 512
"""Frames, and the longer side of their masks, by which a shift of the pictures is measured."""


@looks_at("fit")
def inspect_fit(inspection: Inspection) -> Iterator[Finding]:
    """Returns how well projected body, joints and masks agree, in the frames whose masks were opened."""
    posed = posed_bodies(inspection)
    if inspection.camera not in inspection.sound or not posed:
        yield Finding(
            "note", "fit", "not checked: it needs a sound camera, parameters and a mask of one frame"
        )
        return
    views = {
        frame: (vertices, inspection.view(frame), inspection.people[frame].whole.full())
        for frame, (vertices, _) in posed.items()
    }
    yield from _in_view(views)
    iou, inside = np.mean([overlap.mask_overlap(*view) for view in views.values()], axis=0)
    crowded = any(inspection.people[frame].crowded for frame in posed)
    unknown = crowded or inspection.scene.files(next(iter(posed)), inspection.camera).truth_unknown
    good = (inside if unknown else iou) >= LOW_OVERLAP
    joints = [(places, *views[frame][1:]) for frame, (_, places) in posed.items()]
    away = np.median([checks.project(places, camera)[1].mean() for places, camera, _ in joints])
    text = (
        f"IoU of projected body and mask {iou:.2f}, {inside:.0%} of the mask inside the body, the person "
        f"{away:.3g} m from the camera"
    )
    cure = ""
    if not good:
        cure = explain_misfit(list(views.values())) or (
            "check R, T, K, Rh, Th, the body file, and that masks and parameters are of the same person"
        )
    yield Finding("ok" if good else "error" if inside < MISSED else "doubt", "fit", text, cure)
    joints_share = np.mean([overlap.joints_inside(*view) for view in joints])
    fine = joints_share >= JOINTS_INSIDE or unknown
    yield Finding(
        "ok" if fine else "doubt", "joints", f"{joints_share:.0%} of the joints are inside the mask",
        "" if fine else "check cameras, poses, and that mask and parameters are of the same person",
    )  # fmt: skip
    yield _occlusion(inspection, views, unknown)


Views = dict[int, tuple[Array, Calibration, NDArray[np.bool_]]]
"""By frame the body in the world, the camera, and the whole person in the mask."""


def _in_view(views: Views) -> Iterator[Finding]:
    outside = []
    for frame, (vertices, camera, mask) in views.items():
        try:
            checks.check_in_view(vertices, camera, mask.shape[::-1], f"frame {frame}")
        except DataError as error:
            outside.append(str(error))
    if outside:
        level = "error" if len(outside) == len(views) else "doubt"
        yield Finding(level, "in view", f"{len(outside)} of {len(views)} frames: {outside[0]}")


def _occlusion(inspection: Inspection, views: Views, unknown: bool) -> Finding:
    people = {frame: inspection.people[frame] for frame in views}
    if unknown:
        shares = [
            overlap.seen_share(*views[frame][:2], person.seen.full()) for frame, person in people.items()
        ]
        how = "estimated from the projected body"
    else:
        shares = [person.visible_share(None) for person in people.values()]
        how = "from complete masks, or nothing is known to hide anything"
    hidden = {frame: 1 - share for frame, share in zip(people, shares, strict=True)}
    each = listed((f"{frame}: {share:.0%}" for frame, share in hidden.items()), 12)
    level = "note" if max(hidden.values()) > 0 else "ok"
    return Finding(level, "occlusion", f"hidden share by frame ({how}): {each}")


@looks_at("registration")
def inspect_registration(inspection: Inspection) -> Iterator[Finding]:
    """Returns whether pictures of the training camera are shifted or scaled as a whole against the projected body."""
    faces = getattr(inspection.poser.body, "faces", None)
    if (
        inspection.camera not in inspection.sound
        or not inspection.bodies
        or faces is None
        or inspection.poser.stands_in
    ):
        yield Finding(
            "note", "registration", "not measured: it needs a sound camera, parameters and their body file"
        )
        return
    views = []
    for frame in evenly(inspection.posed_frames(), REGISTERED):
        person = inspection.people.get(frame) or survey.read_person(
            inspection.scene, frame, inspection.camera
        )
        lens = Lens.fitted(inspection.view(frame), (person.whole.width, person.whole.height), REGISTERED_SIZE)
        vertices = inspection.poser.pose(inspection.bodies[frame])[0]
        views.append(View(frame, vertices, lens.camera(), lens.mask(person.seen.full())))
    rest = inspection.poser.rest_vertices(next(iter(inspection.bodies.values())).betas)
    found = register(views, faces.cpu().numpy(), rest)
    if found is None:
        yield Finding("note", "registration", "outlines of body and masks tell too little of a shift")
        return
    size = max(views[0].camera.width, views[0].camera.height)
    text = f"{found.text()}, at {size} px"
    if found.correction.is_none:
        yield Finding("ok", "registration", f"{text}: nothing is certainly off")
        return
    yield Finding(
        "doubt", "registration", f"{text}: certainly off",
        "training corrects the cameras (registration=off: it does not); look for a crop, a resampling or principal "
        "points that count pixels from another corner",
    )  # fmt: skip


@looks_at("other cameras")
def inspect_other_cameras(inspection: Inspection) -> Iterator[Finding]:
    """Returns the cameras, other than the one trained on, where the body misses the mask in one frame."""
    frame = next((f for f in inspection.sample() if f in inspection.bodies), None)
    others = [index for index in inspection.sound if index != inspection.camera]
    others = [index for index in others if frame is not None and inspection.scene.shows(frame, index)]
    if frame is None or not others:
        return
    vertices = inspection.poser.pose(inspection.bodies[frame])[0]
    fits, seen = {}, []
    if inspection.camera in inspection.sound and frame in inspection.people:
        seen.append((inspection.view(frame), inspection.people[frame].whole.full()))
    for index in others:
        person = survey.read_person(inspection.scene, frame, index).whole
        seen.append((inspection.sound[index], person.full()))
        if not person.empty:
            fits[inspection.sound[index].name] = overlap.mask_overlap(vertices, *seen[-1])[0]
    bad = [name for name, fit in fits.items() if fit < LOW_OVERLAP]
    if any(fit < SUSPECT for fit in fits.values()) and (exchange := find_exchange([(vertices, seen)])):
        text = f"frame {frame}: {exchange}"
        yield Finding("error", "other cameras", text, "exchange them back in the camera file")
    elif bad:
        text = f"body and mask overlap badly in {len(bad)} of {len(others)} in frame {frame}: {listed(bad)}"
        yield Finding("doubt", "other cameras", text, "check their R and T")
    else:
        yield Finding("ok", "other cameras", f"body and mask fit in all {len(others)} in frame {frame}")


HEIGHT = 480
"""Rows of each column of the overlay."""

COLUMNS = 4
MASK_COLOUR, BODY_COLOUR, JOINT_COLOUR = (40, 220, 60), (240, 60, 40), (255, 230, 40)


def draw_overlay(inspection: Inspection) -> NDArray[np.uint8] | None:
    """Returns a few training pictures with the mask's edge (green), the body's (red) and its joints (yellow).

    None where no frame has picture, mask, camera and parameters.
    """
    posed = posed_bodies(inspection)
    if inspection.camera not in inspection.sound or not posed:
        return None
    chosen = sorted(evenly(list(posed), COLUMNS))
    columns = [
        column for frame in chosen if (column := _column(inspection, frame, *posed[frame])) is not None
    ]
    return np.concatenate(columns, axis=1) if columns else None


def _column(inspection: Inspection, frame: int, vertices: Array, joints: Array) -> NDArray[np.uint8] | None:
    camera = inspection.view(frame)
    try:
        picture = read_rgb(inspection.scene.files(frame, inspection.camera).rgb)
    except DataError:  # reported where the files are checked
        return None
    mask = inspection.people[frame].seen.full()
    scale = HEIGHT / picture.shape[0]
    size = (max(round(picture.shape[1] * scale), 1), HEIGHT)
    canvas = np.array(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    _edge(canvas, mask, MASK_COLOUR)
    _edge(canvas, overlap.body_outline(vertices, camera, picture.shape), BODY_COLOUR)
    pixels, depth = checks.project(joints, camera)
    for x, y in pixels[depth > 0] * scale:
        if abs(x) < 2 * size[0] and abs(y) < 2 * HEIGHT:
            cv2.circle(canvas, (round(x), round(y)), 2, JOINT_COLOUR, -1)
    name = inspection.scene.files(frame, inspection.camera).name
    cv2.putText(canvas, name[-40:], (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 255), 1, cv2.LINE_AA)
    return canvas


def _edge(canvas: NDArray[np.uint8], mask: NDArray[np.bool_], colour: tuple[int, int, int]) -> None:
    size = (canvas.shape[1], canvas.shape[0])
    scaled = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    edges, _ = cv2.findContours(scaled, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(canvas, edges, -1, colour, 1)


COVERED_FRAMES = 60
"""Frames whose masks are held against the body, evenly spread; a run takes more."""
COVERED_SIDE = 512
"""Longer side of the masks that the body is held against, pixels."""


def _measure_coverage(inspection: Inspection) -> BodyCoverage | None:
    """Returns how well the training camera shows the body; None where no frame has camera, mask and parameters."""
    body = inspection.poser.body
    if inspection.camera not in inspection.sound or not isinstance(body, Body):
        return None
    frames = inspection.posed_frames()
    chosen = (frames[k] for k in spread(len(frames), COVERED_FRAMES))
    return cover_body((s for frame in chosen if (s := _sighting(inspection, frame)) is not None), body)


def _sighting(inspection: Inspection, frame: int) -> Sighting | None:
    try:
        mask = survey.read_person(inspection.scene, frame, inspection.camera).seen.full()
    except DataError:  # reported where masks are looked at
        return None
    camera = inspection.view(frame)
    vertices, _ = inspection.poser.pose(inspection.bodies[frame])
    pixels, depths = checks.project(vertices, camera)
    scale = min(1.0, COVERED_SIDE / max(mask.shape))
    size = (max(round(mask.shape[1] * scale), 1), max(round(mask.shape[0] * scale), 1))
    small = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST).astype(bool)
    return Sighting(vertices, pixels * scale, depths, camera.centre, float(camera.K[0, 0]) * scale, small)


@looks_at("directions")
def inspect_coverage(inspection: Inspection) -> Iterator[Finding]:
    """Returns from how many directions the body is seen, and which parts nobody sees; `inspection` keeps it."""
    inspection.coverage = _measure_coverage(inspection)
    if inspection.coverage is None:
        return
    yield Finding("ok", "directions", inspection.coverage.text())
    for text in inspection.coverage.warnings():
        yield Finding(
            "note", "directions", text, "film the person from more sides, or let them turn round once"
        )
