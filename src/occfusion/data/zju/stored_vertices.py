"""Do the body file and the parameters give the vertices that ZJU-MoCap keeps beside them, and by which rule?

A fit was made with or without pose blend shapes, and no file says which. Where the vertices of the fit lie beside
its parameters they tell: whichever rule gives them is the fit's. Where they do not, the folder's name does, as in
Neural Body's `extract_vertices.py`: `new` in it means with.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from occfusion.data.checking import checks
from occfusion.data.posing import Poser, RestBody
from occfusion.data.sampling import evenly
from occfusion.data.scene import Array
from occfusion.data.zju.zju_layout import ZjuScene
from occfusion.errors import DataError
from occfusion.files.arrays import load_npy
from occfusion.human.body import Body, without_pose_blend_shapes

LIMIT = 0.005
"""Farthest that a vertex may be from where it is kept, metres. The right body by the right rule is off by 0.0005 mm
(float32, embedded scenes), one whose first three shape coefficients are off by 1 by 11 to 140 mm."""

REMARKABLE = LIMIT / 10
"""From here up it is said in a remark."""

FRAMES = 3
"""Moments that are compared, evenly spread."""

_MM = 1000.0
WITH, WITHOUT = "with pose blend shapes", "without pose blend shapes"
_SETTING = {WITH: "body.pose_blend_shapes=true", WITHOUT: "body.pose_blend_shapes=false"}


@dataclass(frozen=True)
class Distance:
    """How far two sets of vertices are apart, metres.

    Attributes:
        largest: of any vertex.
        mean: over all vertices.
    """

    largest: float
    mean: float

    def __str__(self) -> str:
        return f"{_MM * self.largest:.3g} mm at most and {_MM * self.mean:.3g} mm in the mean"


def compare_with_stored(scene: ZjuScene, body: RestBody) -> ZjuScene:
    """Returns the reader, having noted in what it took how the body fits the vertices kept beside the parameters.

    A rule that is not the fit's becomes a remark with its millimetres; so does an old fit without vertices.

    Args:
        scene: the reader; nothing is read where neither vertices nor a doubt about the rule are there.
        body: the body of the run.

    Raises:
        DataError: vertices of another form, or the body gives them by neither rule.
    """
    posers, used = {WITHOUT: Poser(body)}, WITHOUT
    if isinstance(body, Body) and body.posedirs is not None:
        posers, used = {WITH: Poser(body), WITHOUT: Poser(without_pose_blend_shapes(body))}, WITH
    kept = evenly([frame for frame in range(scene.num_frames) if _has(scene, frame, vertices=True)], FRAMES)
    if not kept:
        if used == WITH and not scene.fit.blended:
            _remark_old_fit(scene, posers)
        if used == WITHOUT and scene.fit.blended and isinstance(body, Body):
            _note(scene, f"posed {WITHOUT}, which the body does not have or was told to leave out")
        return scene
    stored = {frame: _stored(scene, frame) for frame in kept}
    posed = {rule: _posed(scene, poser, kept) for rule, poser in posers.items()}
    counts = len(next(iter(posed[used].values()))), len(next(iter(stored.values())))
    folder = f"{scene.fit.vertices}/"
    if counts[0] != counts[1]:
        _note(scene, f"not compared with {folder}, which has {counts[1]} vertices and the body {counts[0]}")
        return scene
    found = {rule: _distance(vertices, stored) for rule, vertices in posed.items()}
    best = min(found, key=lambda rule: found[rule].largest)
    if found[best].largest > LIMIT:
        measured = "; ".join(f"{rule} {distance}" for rule, distance in found.items())
        lacks = used == WITHOUT and scene.fit.blended
        hint = f" This fit was made {WITH}: {_SETTING[WITH]}, and a file that has them." if lacks else ""
        raise DataError(
            f"{scene.root / scene.fit.vertices}: the body file gives other vertices from {scene.fit_name}/ than are "
            f"kept here, in {len(kept)} moments: {measured}; {_MM * LIMIT:g} mm are allowed. Use the body that "
            "they were made with (body.path; for ZJU-MoCap SMPL's neutral one), or move this folder away if the "
            f"parameters were changed on purpose.{hint}"
        )
    rule = f" {best}" if len(found) > 1 else ""
    _note(scene, f"gives the vertices of {folder}{rule}, off by {found[best]}")
    if best != used and found[used].largest > REMARKABLE:
        _remark(scene, best, used, found[used], f"as {folder} shows")
    elif found[best].largest > REMARKABLE:
        text = (
            f"the body file gives the vertices of {folder} but for {found[best]}: it is not quite the fit's"
        )
        scene.remarks = (*scene.remarks, f"{scene.root}: {text}")
    return scene


def _remark_old_fit(scene: ZjuScene, posers: dict[str, Poser]) -> None:
    frames = evenly(
        [frame for frame in range(scene.num_frames) if _has(scene, frame, vertices=False)], FRAMES
    )
    if frames:
        both = {rule: _posed(scene, poser, frames) for rule, poser in posers.items()}
        _remark(
            scene, WITHOUT, WITH, _distance(both[WITH], both[WITHOUT]),
            f"as Neural Body says of this folder; there is no {scene.fit.vertices}/ to see it by",
        )  # fmt: skip


def _remark(scene: ZjuScene, rule: str, used: str, off: Distance, reason: str) -> None:
    text = f"{scene.fit_name}/ was fitted {rule} ({reason}), and the body is posed {used}"
    scene.remarks = (
        *scene.remarks,
        f"{scene.root}: {text}: its surface is off by {off}. {_SETTING[rule]} poses it as it was fitted.",
    )
    _note(scene, f"posed {used}, which is off by {off} ({_SETTING[rule]})")


def _note(scene: ZjuScene, text: str) -> None:
    scene.taken = replace(scene.taken, body=f"{scene.taken.body}; {text}")


def _has(scene: ZjuScene, frame: int, *, vertices: bool) -> bool:
    files = (*scene.evidence(frame), *([scene.vertices_file(frame)] if vertices else []))
    return all(path.is_file() for path in files)


def _stored(scene: ZjuScene, frame: int) -> Array:
    path = scene.vertices_file(frame)
    content = load_npy(path)
    return checks.numbers(content, (checks.count_of(content) // 3, 3), str(path))


def _posed(scene: ZjuScene, poser: Poser, frames: list[int]) -> dict[int, Array]:
    return {frame: poser.pose(scene.parameters(frame))[0] for frame in frames}


def _distance(first: dict[int, Array], second: dict[int, Array]) -> Distance:
    apart = [np.linalg.norm(first[frame] - second[frame], axis=1) for frame in first]
    return Distance(float(np.max(apart)), float(np.mean(apart)))
