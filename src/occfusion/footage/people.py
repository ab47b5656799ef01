"""Following one person through a clip."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from occfusion.errors import ConfigError, DataError
from occfusion.footage.blazepose import MIN_SCORE, Detection, Detector, Landmarker, Region, Sighting
from occfusion.footage.landmarks import COUNT, INDEX, KeyPoints

Picture = NDArray[np.uint8]

SAMPLED = 12
"""Pictures of a clip, evenly spread, in which people are counted."""
SMALLER = 0.5
"""People below this share of the largest one's size are bystanders, told of but not asked about."""
SAME = 0.6
"""Share of the smaller box that two boxes of the same person have in common."""
OFTEN = 0.25
"""Share of the pictures in which there must be several people for it to be asked which one is meant."""
LOST_SHARE = 0.5
"""A clip that shows the person in fewer of its frames is refused."""
JUMP = 1.2
"""Of the region's usual side, which is about a body's length: who is found again so far away may be somebody else."""
UPSIDE_DOWN = 0.8
"""Share of the frames with the feet above the head from which on a clip stands on its head."""


@dataclass(frozen=True)
class Track:
    """One person through a clip.

    Attributes:
        sightings: of each picture; None where the person was not found.
        notes: what a user should know, in sentences.
    """

    sightings: list[Sighting | None]
    notes: list[str]

    def keypoints(self) -> KeyPoints:
        """Returns the landmarks of all pictures; confidence 0 where the person was not found."""
        nothing = np.zeros((COUNT, 2)), np.zeros(COUNT), np.zeros((COUNT, 3)), 0.0
        rows = [nothing if s is None else (s.pixels, s.confidence, s.world, s.score) for s in self.sightings]
        pixels, confidence, world, presence = (
            np.stack([np.asarray(row[k]) for row in rows]) for k in range(4)
        )
        return KeyPoints(pixels, confidence, world, presence)


def follow(
    pictures: Sequence[Picture],
    numbers: Sequence[int],
    *,
    person: int | None = None,
    advance: Callable[[], None] = lambda: None,
) -> Track:
    """Returns where one person is in each picture of one shot.

    The person is found in the picture that shows them best and followed from there to both ends: the landmarks of
    a picture say where to look in the next. Who is lost is looked for by the detector, near the last place.

    Args:
        pictures: `[H, W, 3]`, RGB.
        numbers: each picture's place in the clip, for messages.
        person: which of several, from 1, as listed in the error that asks; None for the only or by far largest one.
        advance: called after each picture.

    Raises:
        ConfigError: there is no such person.
        DataError: nobody is there, several people are as large, the person is in too few frames, or the pictures
            stand on their heads.
    """
    detector, landmarker = Detector(), Landmarker()
    notes: list[str] = []
    first, region = _choose(pictures, numbers, detector, landmarker, person, notes)
    sightings: list[Sighting | None] = [None] * len(pictures)
    for order in (range(first, len(pictures)), range(first, -1, -1)):
        place: Region | None = region
        last = region
        for k in order:
            if k == first and sightings[k] is not None:
                place = last = sightings[k].following  # type: ignore[union-attr]
                continue
            seen = None if place is None else landmarker(pictures[k], place)
            if seen is None or seen.score < MIN_SCORE:
                there = detector(pictures[k])
                near = _nearest(there, last)
                if near is None and person is None and len(there) == 1:  # nobody else it could be
                    near = there[0]
                seen = None if near is None else landmarker(pictures[k], near.region)
            if seen is not None and seen.score >= MIN_SCORE and _in_picture(seen, pictures[k]):
                sightings[k], place, last = seen, seen.following, seen.following
            else:
                place = None
            advance()
    _require(sightings, numbers, notes)
    return Track(sightings, notes)


def _choose(
    pictures: Sequence[Picture],
    numbers: Sequence[int],
    detector: Detector,
    landmarker: Landmarker,
    person: int | None,
    notes: list[str],
) -> tuple[int, Region]:
    """Returns the picture to start from and the region of the person there."""
    places = sorted({int(k) for k in np.linspace(0, len(pictures) - 1, SAMPLED).round()})
    seen = {k: _people(pictures[k], detector, landmarker) for k in places}
    if not any(seen.values()):
        raise DataError(
            f"nobody was found in the frames {', '.join(str(numbers[k]) for k in places)}: is a person there, upright "
            "and at least a tenth of the picture's height?"
        )
    # the picture with the most people in it tells them apart, unless more than one is the exception
    crowded = [k for k in places if _large(seen[k]) > 1]
    usual = [k for k in places if len(seen[k]) == 1]
    rare = person is None and usual and len(crowded) < OFTEN * sum(bool(seen[k]) for k in places)
    start = max(
        usual if rare else places, key=lambda k: (len(seen[k]), max((s.score for s in seen[k]), default=0.0))
    )
    people = sorted(seen[start], key=lambda s: s.region.x)
    if rare and crowded:
        notes.append(f"a second person seems to be in frame {', '.join(str(numbers[k]) for k in crowded)}.")
    listed = ", ".join(
        f"{k + 1} at x={s.region.x:.0f} y={s.region.y:.0f}, {s.region.side / (2 * 1.25):.0f} px"
        for k, s in enumerate(people)
    )
    if person is not None:
        if not 1 <= person <= len(people):
            raise ConfigError(
                f"--person {person}: frame {numbers[start]} shows {listed}; choose one of these."
            )
        return start, people[person - 1].following
    if _large(people) > 1:
        raise DataError(
            f"{len(people)} people are in frame {numbers[start]}, from the left: {listed}. Say which one: --person 1 "
            f"to {len(people)}."
        )
    largest = max(range(len(people)), key=lambda k: people[k].region.side)
    if len(people) > 1:
        notes.append(
            f"{len(people)} people are in frame {numbers[start]}: {listed}; person {largest + 1}, by far the largest, "
            "is followed (--person for another)."
        )
    return start, people[largest].following


def _people(picture: Picture, detector: Detector, landmarker: Landmarker) -> list[Sighting]:
    """Returns the people of a picture that the landmark model confirms, each once."""
    found: list[Sighting] = []
    for detection in detector(picture):
        sighting = landmarker(picture, detection.region)
        if sighting.score < MIN_SCORE or not _in_picture(sighting, picture):
            continue
        if all(_apart(sighting, other) for other in found):
            found.append(sighting)
    return found


def _large(people: Sequence[Sighting]) -> int:
    """Returns how many people are not far smaller than the largest."""
    sizes = np.array([sighting.region.side for sighting in people])
    return int((sizes >= SMALLER * sizes.max()).sum()) if len(sizes) else 0


def _apart(one: Sighting, other: Sighting) -> bool:
    """Whether two sightings are of two people: the boxes about their landmarks share little."""
    boxes = [(s.pixels.min(axis=0), s.pixels.max(axis=0)) for s in (one, other)]
    extent = np.minimum(boxes[0][1], boxes[1][1]) - np.maximum(boxes[0][0], boxes[1][0])
    both = float(np.prod(np.maximum(extent, 0.0)))
    areas = [float(np.prod(high - low)) for low, high in boxes]
    return both < SAME * min(areas)


def _in_picture(sighting: Sighting, picture: Picture) -> bool:
    """Whether the trunk's middle is in the picture, or near it."""
    trunk = [INDEX[name] for name in ("left_hip", "right_hip", "left_shoulder", "right_shoulder")]
    limits, place = np.array(picture.shape[1::-1]), sighting.pixels[trunk].mean(axis=0)
    return bool(((place > -0.1 * limits) & (place < 1.1 * limits)).all())


def _nearest(detections: list[Detection], last: Region) -> Detection | None:
    """Returns the detection that continues a region: near it and of its size; None where there is none."""
    near = [
        d
        for d in detections
        if np.hypot(d.region.x - last.x, d.region.y - last.y) < last.side
        and 0.5 < d.region.side / last.side < 2.0
    ]
    return min(near, key=lambda d: np.hypot(d.region.x - last.x, d.region.y - last.y), default=None)


def _require(sightings: list[Sighting | None], numbers: Sequence[int], notes: list[str]) -> None:
    lost = [numbers[k] for k, sighting in enumerate(sightings) if sighting is None]
    if len(lost) > (1 - LOST_SHARE) * len(sightings):
        there = [numbers[k] for k, sighting in enumerate(sightings) if sighting is not None]
        raise DataError(
            f"the person is in only {len(there)} of {len(sightings)} frames ({ranges(there)}); give that part alone: "
            f"--start {there[0]} --stop {there[-1] + 1}."
        )
    if lost:
        notes.append(f"the person is not seen in {len(lost)} frames ({ranges(lost)}), which are left out.")
    _require_one(sightings, numbers)
    seen = [s for s in sightings if s is not None]
    nose, feet = INDEX["nose"], [INDEX["left_ankle"], INDEX["right_ankle"]]
    turned = np.mean([s.pixels[nose, 1] > s.pixels[feet, 1].max() for s in seen])
    if turned > UPSIDE_DOWN:
        raise DataError(
            f"the person stands on the head in {turned:.0%} of the frames: the video is upside down. Turn it by 180 "
            "degrees first (--rotate 180)."
        )


def _require_one(sightings: list[Sighting | None], numbers: Sequence[int]) -> None:
    """Raises DataError where the place jumps, as it does from one person to another."""
    found = [k for k, sighting in enumerate(sightings) if sighting is not None]
    size = float(np.median([s.region.side for s in sightings if s is not None]))
    jumps = []
    for before, after in pairwise(found):
        one, other = sightings[before], sightings[after]
        assert one is not None and other is not None
        if np.hypot(one.region.x - other.region.x, one.region.y - other.region.y) > JUMP * size:
            jumps.append((before, after))
    if not jumps:
        return
    ends = [found[0], *(k for jump in jumps for k in jump), found[-1]]
    stretches = [(numbers[a], numbers[b] + 1) for a, b in zip(ends[::2], ends[1::2], strict=True)]
    start, stop = max(stretches, key=lambda part: part[1] - part[0])
    told = ", ".join(f"{numbers[a]} and {numbers[b]}" for a, b in jumps[:4])
    raise DataError(
        f"the person is at places far apart in the frames {told}: somebody else may have been found. Give one part "
        f"alone; the longest: --start {start} --stop {stop}."
    )


def ranges(numbers: Sequence[int], most: int = 6) -> str:
    """Returns numbers in words, as `3, 7-12`; at most so many stretches."""
    stretches: list[list[int]] = []
    for number in numbers:
        if stretches and number == stretches[-1][1] + 1:
            stretches[-1][1] = number
        else:
            stretches.append([number, number])
    words = [str(a) if a == b else f"{a}-{b}" for a, b in stretches[:most]]
    return ", ".join(words) + (" ..." if len(stretches) > most else "")
