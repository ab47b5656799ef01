"""How well a video shows a body, part by part, in numbers and in plain words."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.geometry.coverage import (
    CLASSES,
    UNSEEN,
    Coverage,
    Sighting,
    class_picture,
    cover,
    vertex_areas,
)
from occfusion.geometry.normals import vertex_normals
from occfusion.geometry.zbuffer import rasterize_mesh
from occfusion.human.body import Body
from occfusion.human.posed_mesh import mesh_poser
from occfusion.types import Frame

MOSTLY = 0.5
"""Share of a part's surface from which it counts as not seen, or as seen from one direction."""
LIMBS = {
    "left leg": (1, 4, 7, 10),
    "right leg": (2, 5, 8, 11),
    "left arm": (16, 18, 20, 22),
    "right arm": (17, 19, 21, 23),
}
"""Joints (SMPL's numbers) whose skin belongs to a limb; the neck and the head are 12 and 15, the rest is the trunk."""
HEAD = (12, 15)
SIDES = {"head": ("face", "back of the head"), "trunk": ("chest and belly", "back")}


@dataclass(frozen=True)
class BodyCoverage:
    """How well each place of a body is seen by a video.

    Attributes:
        coverage: by vertex.
        parts: name of each vertex's part, `[V]`.
        areas: square metres of each vertex, `[V]`.
    """

    coverage: Coverage
    parts: NDArray[np.str_]
    areas: NDArray[np.float64]

    def shares(self, part: str | None = None) -> dict[str, float]:
        """Returns the share of the surface, or of a part, in each class; they add up to 1."""
        chosen = np.ones(len(self.parts), bool) if part is None else self.parts == part
        classes, areas = self.coverage.classes[chosen], self.areas[chosen]
        return {name: float(areas[classes == k].sum() / areas.sum()) for name, k in CLASSES.items()}

    def spread(self) -> float | None:
        """Returns the median spread of directions over the surface that is seen, degrees; None where nothing is."""
        seen = self.coverage.classes != UNSEEN
        if not seen.any():
            return None
        order = np.argsort(self.coverage.spread[seen])
        share = np.cumsum(self.areas[seen][order])
        return float(self.coverage.spread[seen][order][np.searchsorted(share, 0.5 * share[-1])])

    def json(self) -> dict[str, Any]:
        """Returns the summary as it stands in `plan.json`."""
        spread = self.spread()
        return {
            "views": self.coverage.views,
            **{name: round(share, 4) for name, share in self.shares().items()},
            "spread_degrees": None if spread is None else round(spread, 1),
            "parts": {
                str(part): {name: round(share, 4) for name, share in self.shares(part).items()}
                for part in np.unique(self.parts)
            },
            "warnings": self.warnings(),
        }

    def text(self) -> str:
        """Returns the summary in a line."""
        shares, spread = self.shares(), self.spread()
        text = (
            f"{shares['seen_many']:.0%} of the body's surface is seen from many directions, "
            f"{shares['seen_one']:.0%} from one, {shares['unseen']:.0%} not at all"
        )
        return text if spread is None else f"{text}; directions spread by {spread:.0f} degrees (median)"

    def warnings(self) -> list[str]:
        """Returns what will be a guess, and what is held from one direction alone, in plain words."""
        unseen, one = [], []
        for part in np.unique(self.parts):
            shares = self.shares(part)
            if shares["unseen"] > MOSTLY:
                unseen.append(str(part))
            elif shares["seen_one"] > MOSTLY * (1.0 - shares["unseen"]):
                one.append(str(part))
        found = []
        if unseen:
            found.append(f"nobody sees {in_words(unseen)}: what is there will be a guess")
        if one:
            found.append(f"seen from one direction alone: {in_words(one)}; depth and sides are a guess there")
        return found


def in_words(parts: Iterable[str]) -> str:
    """Returns parts as a person would list them: front and back of a limb are the limb, two limbs a pair."""
    left = set(parts)
    for limb in LIMBS:
        halves = {f"front of the {limb}", f"back of the {limb}"}
        if halves <= left:
            left = left - halves | {limb}
    if set(SIDES["head"]) <= left:
        left = left - set(SIDES["head"]) | {"head"}
    for kind in ("arm", "leg"):
        for prefix, side in (("", ""), ("front of the ", "front of "), ("back of the ", "back of ")):
            pair = {f"{prefix}left {kind}", f"{prefix}right {kind}"}
            if pair <= left:
                left = left - pair | {f"{side}both {kind}s"}
    words = [part if part.startswith("both") else f"the {part}" for part in sorted(left)]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


@torch.no_grad()
def body_parts(body: Body) -> NDArray[np.str_]:
    """Returns the name of each vertex's part, `[V]`: head, trunk or limb by its joint, front or back by its normal."""
    joint = body.weights.argmax(dim=1).cpu().numpy()
    points, faces = body.v_template.double().cpu().numpy(), body.faces.cpu().numpy()
    is_front = vertex_normals(points, faces)[:, 2] > 0
    names = np.where(is_front, *SIDES["trunk"]).astype("<U32")
    names = np.where(np.isin(joint, HEAD), np.where(is_front, *SIDES["head"]), names)
    for limb, joints in LIMBS.items():
        sides = np.where(is_front, f"front of the {limb}", f"back of the {limb}")
        names = np.where(np.isin(joint, joints), sides, names)
    return names


def cover_body(sightings: Iterable[Sighting], body: Body) -> BodyCoverage | None:
    """Returns how well views show a body; None without any view."""
    faces = body.faces.cpu().numpy()
    coverage = cover(sightings, faces, closed=mesh_poser(body).closed)
    if coverage is None:
        return None
    return BodyCoverage(
        coverage, body_parts(body), vertex_areas(body.v_template.double().cpu().numpy(), faces)
    )


@torch.no_grad()
def sighting_of(frame: Frame, body: Body) -> Sighting:
    """Returns a frame's view of the body, in the pose that the data give."""
    camera = frame.camera
    return Sighting.through(
        mesh_poser(body).pose(frame.pose).vertices,
        camera.viewmat.double().cpu().numpy(),
        camera.K.double().cpu().numpy(),
        frame.visible_mask.cpu().numpy(),
    )


@torch.no_grad()
def class_of_pixels(frame: Frame, body: Body, coverage: BodyCoverage) -> NDArray[np.int8] | None:
    """Returns the class of the place that each pixel of a frame's true mask shows, `[H, W]`, -1 elsewhere.

    None where the truth is not known or the body is not in the picture.
    """
    if frame.truth is None:
        return None
    view = sighting_of(frame, body)
    faces, (height, width) = body.faces.cpu().numpy(), view.visible.shape
    seen = rasterize_mesh(view.pixels, view.depths, faces, width, height)
    return class_picture(coverage.coverage.classes, seen, faces, frame.truth.mask.cpu().numpy())
