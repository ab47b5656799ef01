"""The checks before training that need cameras, poses and masks together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from occfusion.data.checking import checks, overlap, survey
from occfusion.data.checking.overlap import LOW_OVERLAP, SUSPECT, explain_misfit, find_exchange
from occfusion.data.posing import Poser
from occfusion.data.prepare import Prepared
from occfusion.data.sampling import evenly
from occfusion.data.scene import Array, Calibration, Scene
from occfusion.data.silhouette import Silhouette
from occfusion.data.views import Views
from occfusion.errors import DataError
from occfusion.human.body import leading_betas

HEIGHT = (0.5, 3.0)
"""Plausible heights of a person at rest, metres."""

CHECKED_FRAMES = 5
"""Frames whose projected body is compared with the mask."""

FULL_MASK, TINY_MASK = 0.9, 0.002
"""Shares of a picture above and below which a person's mask is doubtful."""

JOINTS_INSIDE = 0.6
"""Share of the joints inside the mask below which it is reported; embedded people have 0.87 to 1."""

MISSED = 0.1
"""Mean share of the mask inside the body below which the two cannot belong together."""


def validate(prepared: Prepared, views: Views, poser: Poser) -> list[str]:
    """Returns what is doubtful about the data, one sentence each.

    Looks at everything that training and evaluation will read, as far as that is cheap: all files are
    there, all headers agree, all cameras and poses are sound, and in a few frames the body is where the
    mask is.

    Raises:
        DataError: something cannot be; says what, where, and what to do.
    """
    scene = prepared.scene
    selected = [*prepared.train_views, *prepared.test_views]
    survey.require_files(scene, selected)
    cameras = sorted({camera for _, camera in selected})
    sizes = {camera: views.lens(camera).source for camera in cameras}
    survey.require_sizes(scene, selected, sizes)
    for frame, camera in selected if scene.zooms else [(prepared.train[0], camera) for camera in cameras]:
        calibration = scene.view(frame, camera)
        where = f"{scene.root}, K of camera {calibration.name}"
        where += f" in {scene.files(frame, camera).name}" if scene.zooms else ""
        checks.check_intrinsics(calibration.K, sizes[camera], where)
    for frame in sorted({*prepared.train, *prepared.test}):
        _check_betas(views.parameters(frame).betas, scene, frame, poser)
    _check_height(poser.rest_vertices(views.parameters(prepared.train[0]).betas), str(scene.root))
    warnings = [*scene.remarks, *([_left_out(prepared)] if prepared.left_out else [])]
    warnings += scene.body_warnings(poser.pose)
    warnings += mask_warnings(str(scene.root), prepared.train, [person.seen for person in prepared.people])
    try:
        doubts = _check_projection(prepared, views, poser)
    except DataError:
        _refuse_exchanged_cameras(prepared, views, poser)  # says more, where it is that
        raise
    fits = _held_out_fits(prepared, views, poser)
    held_out = _held_out_warnings(prepared, fits)
    if doubts or any(fit < SUSPECT for fit in fits.values()):
        _refuse_exchanged_cameras(prepared, views, poser)
    return warnings + doubts + held_out


def _refuse_exchanged_cameras(prepared: Prepared, views: Views, poser: Poser) -> None:
    """Looks among all cameras of the scene, for the other one need not be one that the run reads."""
    scene, moments = prepared.scene, []
    for frame in evenly(prepared.train, CHECKED_FRAMES):
        seen = []
        for camera in range(len(scene.cameras)):
            try:
                person = survey.read_person(scene, frame, camera).whole
                seen.append((scene.view(frame, camera), person.full()))
            except DataError:  # a camera that the run does not read; those that it reads were opened before
                continue
        moments.append((poser.pose(views.parameters(frame))[0], seen))
    if len({tuple(camera.name for camera, _ in seen) for _, seen in moments}) > 1:
        return
    if found := find_exchange(moments):
        raise DataError(f"{scene.root}: {found}, mean of {len(moments)} frames. Exchange them back.")


def estimated_shares(prepared: Prepared, views: Views, poser: Poser) -> list[float]:
    """Returns which share of the projected body the mask of each training frame covers."""
    scene, camera = prepared.scene, prepared.camera
    return [
        overlap.seen_share(
            poser.pose(views.parameters(frame))[0], scene.view(frame, camera), person.seen.full()
        )
        for frame, person in zip(prepared.train, prepared.people, strict=True)
    ]


def mask_warnings(where: str, frames: Sequence[int], people: Sequence[Silhouette]) -> list[str]:
    """Returns what is odd about the masks of some frames, one sentence each: full, tiny, in pieces."""
    shares = [int(person.crop().sum()) / (person.width * person.height) for person in people]
    warnings = []
    full = [frame for frame, share in zip(frames, shares, strict=True) if share > FULL_MASK]
    if full:
        warnings.append(
            f"{where}: the mask covers more than {FULL_MASK:.0%} of the picture in {len(full)} frames, first "
            f"{full[0]}; is it inverted (person 0, background 255)?"
        )
    tiny = [frame for frame, share in zip(frames, shares, strict=True) if 0 < share < TINY_MASK]
    if tiny:
        warnings.append(
            f"{where}: the mask covers less than {TINY_MASK:.1%} of the picture in {len(tiny)} frames, first "
            f"{tiny[0]}; is somebody in them? Leave them out with dataset.train_frames if not."
        )
    return warnings


def _left_out(prepared: Prepared) -> str:
    shown = ", ".join(str(frame) for frame in prepared.left_out[:10])
    count = len(prepared.left_out)
    return f"{prepared.scene.root}: {count} training frames show no person and are left out: {shown}"


def _check_betas(betas: Array, scene: Scene, frame: int, poser: Poser) -> None:
    """Refuses what the body would refuse in the middle of the work, there without a file's name."""
    if not getattr(poser.body, "cut_betas", False):
        files = ", ".join(path.name for path in scene.evidence(frame))
        leading_betas(betas, poser.num_betas, f"{scene.root}, frame {frame} ({files}), betas")


def _check_height(vertices: Array, where: str) -> None:
    height = float(np.ptp(vertices, axis=0).max())
    if not HEIGHT[0] <= height <= HEIGHT[1]:
        raise DataError(
            f"{where}: the body is {height:.3g} m tall at rest, not {HEIGHT[0]} to {HEIGHT[1]} m; check "
            "`shapes` and the unit of the body file."
        )


def _check_projection(prepared: Prepared, views: Views, poser: Poser) -> list[str]:
    where, camera = str(prepared.scene.root), prepared.scene.calibration(prepared.camera)
    frames = evenly(prepared.train, CHECKED_FRAMES)
    masks = [person.whole.full() for person in evenly(prepared.people, CHECKED_FRAMES)]
    posed = [poser.pose(views.parameters(frame)) for frame in frames]
    cameras = [prepared.scene.view(frame, prepared.camera) for frame in frames]
    seen = list(zip([vertices for vertices, _ in posed], cameras, masks, strict=True))
    try:
        for frame, (vertices, view, mask) in zip(frames, seen, strict=True):
            checks.check_in_view(vertices, view, mask.shape[::-1], f"{where}, frame {frame}")
    except DataError as error:
        raise DataError(f"{error}{_explanation(seen)}") from None
    fits = [overlap.mask_overlap(*view) for view in seen]
    inside = float(np.mean([share for _, share in fits]))
    if inside < MISSED:
        raise DataError(
            f"{where}: the projected body misses the person's mask in camera {camera.name}: "
            f"{inside:.0%} of the mask is inside it, mean of {len(frames)} frames. Check R "
            "(transposed?), T (millimetres), Rh and Th, and that the body file is the one the "
            f"parameters were fitted with.{_explanation(seen)}"
        )
    if any(prepared.unknown):  # what is hidden lowers the IoU of a perfect fit; the rest must be inside
        if inside >= LOW_OVERLAP:
            return []
        return [
            f"{where}: only {inside:.0%} of the visible mask is inside the projected body in camera "
            f"{camera.name}, mean of {len(frames)} frames; embedded people have 80 % and more. Check the cameras, the "
            f"parameters, the body file, and that the masks are of the same person."
            f"{_explanation(seen)}"
        ]
    iou, worst = min(zip([iou for iou, _ in fits], frames, strict=True))
    if iou < LOW_OVERLAP:
        return [
            f"{where}, frame {worst}: projected body and mask overlap by only {iou:.2f} (IoU) in "
            f"camera {camera.name}; a good fit has 0.8. Check the cameras, Rh, Th, the body file, the masks."
            f"{_explanation(seen)}"
        ]
    shares = [overlap.joints_inside(p[1], view, m) for p, view, m in zip(posed, cameras, masks, strict=True)]
    if (share := float(np.mean(shares))) < JOINTS_INSIDE:
        return [
            f"{where}: only {share:.0%} of the joints lie inside the mask in camera {camera.name}, mean of "
            f"{len(frames)} frames; embedded people in full view have 87 % and more. Check cameras, poses and masks."
        ]
    return []


def _explanation(seen: Sequence[tuple[Array, Calibration, NDArray[np.bool_]]]) -> str:
    reason = explain_misfit(seen)
    return f" {reason[0].upper()}{reason[1:]}." if reason else ""


def _held_out_fits(prepared: Prepared, views: Views, poser: Poser) -> dict[str, float]:
    """Returns the IoU of body and mask in the first test frame by the names of held-out cameras that show a person."""
    vertices, _ = poser.pose(views.parameters(prepared.test[0]))
    fits = {}
    for index in prepared.cameras:
        person = survey.read_person(prepared.scene, prepared.test[0], index).whole
        camera = prepared.scene.calibration(index)
        if not person.empty:
            fits[camera.name] = overlap.mask_overlap(vertices, camera, person.full())[0]
    return fits


def _held_out_warnings(prepared: Prepared, fits: dict[str, float]) -> list[str]:
    """Returns a sentence on views that are not measured, on masks without a person, and on cameras that do not fit."""
    where = f"{prepared.scene.root}, frame {prepared.test[0]}"
    warnings, trained = [], set(prepared.train_views)
    asked = [(moment, camera) for camera in prepared.cameras for moment in prepared.test]
    dropped = sum(view in trained for view in asked)
    if 0 < dropped < len(asked):
        warnings.append(
            f"{prepared.scene.root}: {dropped} of {len(asked)} held-out views are trained on and not measured; leave "
            "dataset.train_camera out of dataset.test_cameras."
        )
    if prepared.cameras and not fits:
        warnings.append(
            f"{where}: no mask of the {len(prepared.cameras)} held-out cameras shows a person; figures of views "
            "without a person are null. Check their masks."
        )
    doubtful = [name for name, fit in fits.items() if fit < LOW_OVERLAP]
    if doubtful:
        warnings.append(
            f"{where}: projected body and mask overlap badly (IoU below {LOW_OVERLAP}) in {len(doubtful)} of "
            f"{len(prepared.cameras)} held-out cameras: {', '.join(doubtful[:5])}. Check their R and T."
        )
    return warnings
