"""Does the body lie where the masks are? If not: which known error would explain it; and a picture that shows it."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.data.cameras import Lens
from occfusion.data.checking import checks, overlap, survey
from occfusion.data.checking.inspection import Finding, Inspection, guarded, listed, posed_bodies
from occfusion.data.checking.overlap import LOW_OVERLAP, SUSPECT, explain_misfit, find_exchange
from occfusion.data.checking.validation import JOINTS_INSIDE, MISSED
from occfusion.data.outline_offsets import View
from occfusion.data.registration import register
from occfusion.data.scene import Array, Calibration
from occfusion.errors import DataError
from occfusion.files.images import read_rgb

REGISTERED, REGISTERED_SIZE = 40, 512
"""Frames, and the longer side of their masks, by which a shift of the pictures is measured."""


def inspect_fit(inspection: Inspection) -> list[Finding]:
    """Returns how well projected body, joints and masks agree, in the frames whose masks were opened."""
    return guarded("fit", lambda: _fit(inspection))


def _fit(inspection: Inspection) -> Iterator[Finding]:
    posed = posed_bodies(inspection)
    if inspection.camera not in inspection.sound or not posed:
        yield Finding(
            "note", "fit", "not checked: it needs a sound camera, parameters and a mask of one frame"
        )
        return
    masks = {frame: inspection.people[frame].whole.full() for frame in posed}
    seen = {frame: inspection.view(frame) for frame in posed}
    yield from _in_view(posed, masks, seen)
    bodies = {frame: vertices for frame, (vertices, _) in posed.items()}
    scores = [overlap.mask_overlap(bodies[frame], seen[frame], masks[frame]) for frame in posed]
    iou, inside = np.mean(scores, axis=0)
    crowded = any(inspection.people[frame].crowded for frame in posed)
    unknown = crowded or inspection.scene.files(next(iter(posed)), inspection.camera).truth_unknown
    good = (inside if unknown else iou) >= LOW_OVERLAP
    away = np.median([checks.project(joints, seen[f])[1].mean() for f, (_, joints) in posed.items()])
    text = (
        f"IoU of projected body and mask {iou:.2f}, {inside:.0%} of the mask inside the body, the person "
        f"{away:.3g} m from the camera"
    )
    cure = ""
    if not good:
        cure = explain_misfit(list(bodies.values()), list(masks.values()), list(seen.values())) or (
            "check R, T, K, Rh, Th, the body file, and that masks and parameters are of the same person"
        )
    yield Finding("ok" if good else "error" if inside < MISSED else "doubt", "fit", text, cure)
    shares = [
        overlap.joints_inside(joints, seen[frame], masks[frame]) for frame, (_, joints) in posed.items()
    ]
    joints_share = np.mean(shares)
    fine = joints_share >= JOINTS_INSIDE or unknown
    yield Finding(
        "ok" if fine else "doubt", "joints", f"{joints_share:.0%} of the joints are inside the mask",
        "" if fine else "check cameras, poses, and that mask and parameters are of the same person",
    )  # fmt: skip
    yield _occlusion(inspection, bodies, seen, unknown)


def _in_view(
    posed: dict[int, tuple[Array, Array]], masks: dict[int, NDArray[np.bool_]], seen: dict[int, Calibration]
) -> Iterator[Finding]:
    outside = []
    for frame, (vertices, _) in posed.items():
        height, width = masks[frame].shape
        try:
            checks.check_in_view(vertices, seen[frame], (width, height), f"frame {frame}")
        except DataError as error:
            outside.append(str(error))
    if outside:
        level = "error" if len(outside) == len(posed) else "doubt"
        yield Finding(level, "in view", f"{len(outside)} of {len(posed)} frames: {outside[0]}")


def _occlusion(
    inspection: Inspection, bodies: dict[int, Array], seen: dict[int, Calibration], unknown: bool
) -> Finding:
    if unknown:
        shares = [
            overlap.seen_share(body, seen[f], inspection.people[f].seen.full()) for f, body in bodies.items()
        ]
        how = "estimated from the projected body"
    else:
        shares = [inspection.people[frame].visible_share(None) for frame in bodies]
        how = "from complete masks, or nothing is known to hide anything"
    hidden = {frame: 1 - share for frame, share in zip(bodies, shares, strict=True)}
    each = listed((f"{frame}: {share:.0%}" for frame, share in hidden.items()), 12)
    level = "note" if max(hidden.values()) > 0 else "ok"
    return Finding(level, "occlusion", f"hidden share by frame ({how}): {each}")


def inspect_registration(inspection: Inspection) -> list[Finding]:
    """Returns whether pictures of the training camera are shifted or scaled as a whole against the projected body."""
    return guarded("registration", lambda: _registration(inspection))


def _registration(inspection: Inspection) -> Iterator[Finding]:
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
    frames = sorted(frame for frame in inspection.bodies if inspection.scene.shows(frame, inspection.camera))
    chosen = {int(k) for k in np.linspace(0, len(frames) - 1, REGISTERED).round()} if frames else set()
    views = []
    for frame in (frames[k] for k in sorted(chosen)):
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


def inspect_other_cameras(inspection: Inspection) -> list[Finding]:
    """Returns the cameras, other than the one trained on, where the body misses the mask in one frame."""

    def findings() -> Iterator[Finding]:
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
            text = (
                f"body and mask overlap badly in {len(bad)} of {len(others)} in frame {frame}: {listed(bad)}"
            )
            yield Finding("doubt", "other cameras", text, "check their R and T")
        else:
            yield Finding("ok", "other cameras", f"body and mask fit in all {len(others)} in frame {frame}")

    return guarded("other cameras", findings)


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
    frames = list(posed)
    chosen = sorted({frames[int(k)] for k in np.linspace(0, len(frames) - 1, COLUMNS).round()})
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
