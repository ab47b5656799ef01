"""Does the body lie where the masks are? And if not: which known mistake would explain it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from occfusion.data import checks, overlap, survey
from occfusion.data.findings import Finding, guarded, listed
from occfusion.data.inspection import Look, posed_bodies
from occfusion.data.lens import Lens
from occfusion.data.mistakes import explain
from occfusion.data.offsets import View
from occfusion.data.registration import register
from occfusion.data.scene import Array, Calibration
from occfusion.data.validation import DOUBTFUL_OVERLAP, JOINTS_INSIDE, MISSED
from occfusion.errors import DataError

REGISTERED, REGISTERED_SIZE = 40, 512
"""Frames, and the longer side of their masks, by which a shift of the pictures is measured."""


def inspect_fit(look: Look) -> list[Finding]:
    """Returns how well projected body, joints and masks agree, in the frames whose masks were opened."""
    return guarded("fit", lambda: _fit(look))


def _fit(look: Look) -> Iterator[Finding]:
    posed = posed_bodies(look)
    if look.camera not in look.sound or not posed:
        yield Finding(
            "note", "fit", "not checked: it needs a sound camera, parameters and a mask of one frame"
        )
        return
    masks = {frame: look.people[frame].whole.full() for frame in posed}
    seen = {frame: look.view(frame) for frame in posed}
    yield from _in_view(posed, masks, seen)
    bodies = {frame: vertices for frame, (vertices, _) in posed.items()}
    scores = [overlap.mask_overlap(bodies[frame], seen[frame], masks[frame]) for frame in posed]
    iou, inside = np.mean(scores, axis=0)
    crowded = any(look.people[frame].crowded for frame in posed)
    unknown = crowded or look.scene.files(next(iter(posed)), look.camera).truth_unknown
    good = (inside if unknown else iou) >= DOUBTFUL_OVERLAP
    away = np.median([checks.project(joints, seen[f])[1].mean() for f, (_, joints) in posed.items()])
    text = (
        f"IoU of projected body and mask {iou:.2f}, {inside:.0%} of the mask inside the body, the person "
        f"{away:.3g} m from the camera"
    )
    cure = ""
    if not good:
        cure = explain(list(bodies.values()), list(masks.values()), list(seen.values())) or (
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
    yield _occlusion(look, bodies, seen, unknown)


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


def _occlusion(look: Look, bodies: dict[int, Array], seen: dict[int, Calibration], unknown: bool) -> Finding:
    if unknown:
        shares = [overlap.seen_share(body, seen[f], look.people[f].seen.full()) for f, body in bodies.items()]
        how = "estimated from the projected body"
    else:
        shares = [look.people[frame].visible_share(None) for frame in bodies]
        how = "from complete masks, or nothing is known to hide anything"
    hidden = {frame: 1 - share for frame, share in zip(bodies, shares, strict=True)}
    each = listed((f"{frame}: {share:.0%}" for frame, share in hidden.items()), 12)
    level = "note" if max(hidden.values()) > 0 else "ok"
    return Finding(level, "occlusion", f"hidden share by frame ({how}): {each}")


def inspect_registration(look: Look) -> list[Finding]:
    """Returns whether pictures of the training camera are shifted or scaled as a whole against the projected body."""
    return guarded("registration", lambda: _registration(look))


def _registration(look: Look) -> Iterator[Finding]:
    faces = getattr(look.poser.body, "faces", None)
    if look.camera not in look.sound or not look.bodies or faces is None or look.poser.stands_in:
        yield Finding(
            "note", "registration", "not measured: it needs a sound camera, parameters and their body file"
        )
        return
    frames = sorted(frame for frame in look.bodies if look.scene.shows(frame, look.camera))
    chosen = {int(k) for k in np.linspace(0, len(frames) - 1, REGISTERED).round()} if frames else set()
    views = []
    for frame in (frames[k] for k in sorted(chosen)):
        person = look.people.get(frame) or survey.look_at_person(look.scene, frame, look.camera)
        lens = Lens.fitted(look.view(frame), (person.whole.width, person.whole.height), REGISTERED_SIZE)
        vertices = look.poser.pose(look.bodies[frame])[0]
        views.append(View(frame, vertices, lens.camera(), lens.mask(person.seen.full())))
    rest = look.poser.rest_vertices(next(iter(look.bodies.values())).betas)
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


def inspect_other_cameras(look: Look) -> list[Finding]:
    """Returns the cameras, other than the one trained on, where the body misses the mask in one frame."""

    def findings() -> Iterator[Finding]:
        frame = next((f for f in look.sample() if f in look.bodies), None)
        others = [index for index in look.sound if index != look.camera]
        others = [index for index in others if frame is not None and look.scene.shows(frame, index)]
        if frame is None or not others:
            return
        vertices = look.poser.pose(look.bodies[frame])[0]
        bad = []
        for index in others:
            person = survey.look_at_person(look.scene, frame, index).whole
            fit = overlap.mask_overlap(vertices, look.sound[index], person.full())[0]
            if not person.empty and fit < DOUBTFUL_OVERLAP:
                bad.append(look.sound[index].name)
        if bad:
            text = (
                f"body and mask overlap badly in {len(bad)} of {len(others)} in frame {frame}: {listed(bad)}"
            )
            yield Finding("doubt", "other cameras", text, "check their R and T")
        else:
            yield Finding("ok", "other cameras", f"body and mask fit in all {len(others)} in frame {frame}")

    return guarded("other cameras", findings)
