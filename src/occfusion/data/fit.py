"""Does the body lie where the masks are? And if not: which known mistake would explain it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from occfusion.data import checks, overlap, survey
from occfusion.data.findings import Finding, guarded, listed
from occfusion.data.inspection import Look, vertices_of
from occfusion.data.mistakes import explain
from occfusion.data.scene import Array, Calibration
from occfusion.data.validation import DOUBTFUL_OVERLAP, JOINTS_INSIDE, MISSED
from occfusion.errors import DataError


def inspect_fit(look: Look) -> list[Finding]:
    """Returns how well projected body, joints and masks agree, in the frames whose masks were opened."""
    return guarded("fit", lambda: _fit(look))


def _fit(look: Look) -> Iterator[Finding]:
    camera = look.sound.get(look.camera)
    frames = [f for f, person in look.people.items() if not person.seen.empty and f in look.bodies]
    if camera is None or not frames:
        yield Finding(
            "note", "fit", "not checked: it needs a sound camera, parameters and a mask of one frame"
        )
        return
    posed = {frame: vertices_of(look, frame) for frame in frames}
    whole = {frame: look.people[frame].whole.full() for frame in frames}
    size = next(iter(whole.values())).shape[::-1]
    outside = []
    for frame, found in posed.items():
        assert found is not None  # frames are those with parameters
        try:
            checks.check_in_view(found[0], camera, (size[0], size[1]), f"frame {frame}")
        except DataError as error:
            outside.append((frame, str(error)))
    if outside:
        level = "error" if len(outside) == len(frames) else "doubt"
        yield Finding(level, "in view", f"{len(outside)} of {len(frames)} frames: {outside[0][1]}")
    scores = [overlap.mask_overlap(posed[f][0], camera, whole[f]) for f in frames]  # type: ignore[index]
    iou, inside = np.mean(scores, axis=0)
    unknown = look.scene.files(frames[0], look.camera).truth_unknown
    good = (inside if unknown else iou) >= DOUBTFUL_OVERLAP
    away = np.median([checks.project(posed[f][1], camera)[1].mean() for f in frames])  # type: ignore[index]
    text = (
        f"IoU of projected body and mask {iou:.2f}, {inside:.0%} of the mask inside the body, the person "
        f"{away:.3g} m from the camera"
    )
    vertices = [posed[f][0] for f in frames]  # type: ignore[index]
    explanation = (
        ""
        if good
        else explain(vertices, [whole[f] for f in frames], camera)
        or ("check R, T, K, Rh, Th, the body file, and that masks and parameters are of the same person")
    )
    yield Finding("ok" if good else "error" if inside < MISSED else "doubt", "fit", text, explanation)
    joints = np.mean([overlap.joints_inside(posed[f][1], camera, whole[f]) for f in frames])  # type: ignore[index]
    fine = joints >= JOINTS_INSIDE or unknown
    yield Finding(
        "ok" if fine else "doubt", "joints", f"{joints:.0%} of the joints are inside the mask",
        "" if fine else "check cameras, poses, and that mask and parameters are of the same person",
    )  # fmt: skip
    yield from _occlusion(look, frames, posed, camera, unknown)  # type: ignore[arg-type]


def _occlusion(
    look: Look, frames: list[int], posed: dict[int, tuple[Array, Array]], camera: Calibration, unknown: bool
) -> Iterator[Finding]:
    if unknown:
        shares = [overlap.seen_share(posed[f][0], camera, look.people[f].seen.full()) for f in frames]
        how = "estimated from the projected body"
    else:
        shares = [look.people[f].visible_share(None) for f in frames]
        how = "from complete masks, or nothing is known to hide anything"
    hidden = {f: 1 - s for f, s in zip(frames, shares, strict=True)}
    each = listed((f"{frame}: {share:.0%}" for frame, share in hidden.items()), 12)
    text = f"hidden share by frame ({how}): {each}"
    yield Finding("note" if max(hidden.values()) > 0 else "ok", "occlusion", text)


def inspect_other_cameras(look: Look) -> list[Finding]:
    """Returns the cameras, other than the one trained on, where the body misses the mask in one frame."""

    def findings() -> Iterator[Finding]:
        frame = next((f for f in look.sample() if f in look.bodies), None)
        others = [index for index in look.sound if index != look.camera]
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
