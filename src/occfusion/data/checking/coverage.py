"""What `check` says of a video's directions: which places of the body it shows from many, from one, or not at all."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from occfusion.data.checking import checks, survey
from occfusion.data.checking.inspection import Finding, Inspection, guarded
from occfusion.data.sampling import spread
from occfusion.errors import DataError
from occfusion.geometry.coverage import Sighting
from occfusion.human.body import Body
from occfusion.human.coverage import BodyCoverage, cover_body

FRAMES = 60
"""Frames whose masks are held against the body, evenly spread; a run takes more."""
SIDE = 512
"""Longer side of the masks that the body is held against, pixels."""


def measure_coverage(inspection: Inspection) -> BodyCoverage | None:
    """Returns how well the training camera shows the body; None where no frame has camera, mask and parameters."""
    body = inspection.poser.body
    if inspection.camera not in inspection.sound or not isinstance(body, Body):
        return None
    frames = [
        frame for frame in sorted(inspection.bodies) if inspection.scene.shows(frame, inspection.camera)
    ]
    chosen = (frames[k] for k in spread(len(frames), FRAMES))
    return cover_body((s for frame in chosen if (s := _sighting(inspection, frame)) is not None), body)


def _sighting(inspection: Inspection, frame: int) -> Sighting | None:
    try:
        mask = survey.read_person(inspection.scene, frame, inspection.camera).seen.full()
    except DataError:  # reported where masks are looked at
        return None
    camera = inspection.view(frame)
    vertices, _ = inspection.poser.pose(inspection.bodies[frame])
    pixels, depths = checks.project(vertices, camera)
    scale = min(1.0, SIDE / max(mask.shape))
    size = (max(round(mask.shape[1] * scale), 1), max(round(mask.shape[0] * scale), 1))
    small = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST).astype(bool)
    return Sighting(vertices, pixels * scale, depths, camera.centre, float(camera.K[0, 0]) * scale, small)


def inspect_coverage(inspection: Inspection) -> list[Finding]:
    """Returns from how many directions the body is seen, and which parts nobody sees; `inspection` keeps it."""

    def findings() -> Iterator[Finding]:
        inspection.coverage = measure_coverage(inspection)
        if inspection.coverage is None:
            return
        yield Finding("ok", "directions", inspection.coverage.text())
        for text in inspection.coverage.warnings():
            yield Finding(
                "note", "directions", text, "film the person from more sides, or let them turn round once"
            )

    return guarded("directions", findings)
