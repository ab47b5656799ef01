"""Finding a person in a picture: MediaPipe's pose detector and landmark model, without MediaPipe.

The two models are files of MediaPipe (Apache-2.0, see `assets/NOTICE.md`) and run through `ai-edge-litert`. What
stands around them is ours and follows the graphs in google-ai-edge/mediapipe: anchors and boxes
`mediapipe/modules/pose_detection/pose_detection_cpu.pbtxt@d7c287c4`, regions
`mediapipe/modules/pose_landmark/pose_detection_to_roi.pbtxt@d7c287c4` and `pose_landmarks_to_roi.pbtxt@a9b643e0`,
outputs `tensors_to_pose_landmarks_and_segmentation.pbtxt@710fb3de`, refinement by the heat map
`mediapipe/calculators/util/refine_landmarks_from_heatmap_calculator.cc`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from occfusion.errors import ConfigError
from occfusion.footage.landmarks import ARMS, COUNT, LEGS, MIRRORED

Floats = NDArray[np.float64]
Picture = NDArray[np.uint8]

DETECTOR, LANDMARKS = "pose_detection.tflite", "pose_landmark_full.tflite"
DETECTOR_SIDE, LANDMARK_SIDE = 224, 256
MIN_SCORE = 0.5
"""Detections below it are dropped, and people whose landmarks score less are lost: the graphs' own thresholds."""
OVERLAP = 0.3
"""Boxes that share so much (IoU) are the same person."""
ENLARGED = 1.25
"""Side of the region against twice the distance of the two points that span it."""
KERNEL = 7
"""Cells of the heat map, a side, in which a landmark is refined."""
MIN_PEAK = 0.5
CLEARLY = 0.5
"""Two looks take sides otherwise where they are so much nearer once exchanged: from the side, arms cover arms."""
AUXILIARY = (33, 34)
"""Of the model's 39 points the two that span the next frame's region: its middle and a point on its circle."""


@dataclass(frozen=True)
class Region:
    """A turned square of a picture.

    Attributes:
        x: middle, pixels.
        y: middle, pixels.
        side: pixels.
        turn: radians, clockwise in the picture; 0 for a person who stands upright.
    """

    x: float
    y: float
    side: float
    turn: float

    def to_picture(self, size: int) -> Floats:
        """Returns the affine map `[2, 3]` from `size` x `size` pixels of the square into the picture.

        Both count the middle of the first pixel as 0.5.
        """
        cosine, sine = np.cos(self.turn) * self.side / size, np.sin(self.turn) * self.side / size
        half = size / 2
        return np.array(
            [
                [cosine, -sine, self.x - cosine * half + sine * half],
                [sine, cosine, self.y - sine * half - cosine * half],
            ]
        )

    def warp(self, size: int, shrunk: Floats | float = 1.0) -> Floats:
        """Returns the same map as OpenCV wants it, which counts the middle of the first pixel as 0.

        Args:
            size: pixels a side of the square.
            shrunk: pixels of the picture that is warped for each of the picture, in x and y.
        """
        out = self.to_picture(size) * np.broadcast_to(shrunk, 2)[:, None]
        out[:, 2] += out[:, :2].sum(axis=1) * 0.5 - 0.5
        return out

    @staticmethod
    def spanned(middle: Floats, point: Floats) -> Region:
        """Returns the region about a middle whose upper end of the body is a point, both `[2]`, pixels."""
        across, down = point - middle
        turn = np.pi / 2 - np.arctan2(-down, across)
        turn -= 2 * np.pi * np.floor((turn + np.pi) / (2 * np.pi))
        return Region(
            float(middle[0]), float(middle[1]), 2 * ENLARGED * float(np.hypot(across, down)), float(turn)
        )


@dataclass(frozen=True)
class Detection:
    """A person as the detector sees them.

    Attributes:
        score: 0..1.
        region: where the whole person is.
    """

    score: float
    region: Region


@dataclass(frozen=True)
class Sighting:
    """A person as the landmark model sees them.

    Attributes:
        score: that somebody is there, 0..1.
        pixels: of the landmarks, `[33, 2]`.
        confidence: that a landmark is in the picture and not hidden, `[33]`.
        world: `[33, 3]`, metres, from the middle of the hips, axes as the camera's.
        mask: that a pixel of the region shows the person, `[256, 256]`, 0..1.
        region: that was looked at.
        following: where to look in the next frame.
    """

    score: float
    pixels: Floats
    confidence: Floats
    world: Floats
    mask: NDArray[np.float32]
    region: Region
    following: Region


class Model:
    """A tflite file, ready to run.

    Args:
        name: of a file in the package's assets.

    Raises:
        ConfigError: `ai-edge-litert` is not installed.
    """

    def __init__(self, name: str) -> None:
        try:
            from ai_edge_litert.interpreter import Interpreter
        except ImportError as error:
            raise ConfigError(
                "finding a person in a clip needs the package ai-edge-litert: pip install 'occfusion[video]'. "
                "Without it, give the body that another tool found (--from)."
            ) from error
        content = (resources.files("occfusion") / "assets" / name).read_bytes()
        self._interpreter = Interpreter(model_content=content, num_threads=1)
        self._interpreter.allocate_tensors()
        self._input = self._interpreter.get_input_details()[0]["index"]
        self._outputs = {part["name"]: part["index"] for part in self._interpreter.get_output_details()}

    def __call__(self, picture: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
        """Returns the outputs by name for an input without its batch axis."""
        self._interpreter.set_tensor(self._input, picture[None])
        self._interpreter.invoke()
        return {name: self._interpreter.get_tensor(index) for name, index in self._outputs.items()}


@cache
def anchors() -> Floats:
    """Returns the middles of the detector's 2254 anchors, `[2254, 2]`, in shares of the input's side.

    Strides 8, 16 and three times 32; two anchors a cell and layer; cells row by row, all layers of a stride together.
    """
    parts = []
    for stride, layers in ((8, 1), (16, 1), (32, 3)):
        count = DETECTOR_SIDE // stride
        place = (np.arange(count) + 0.5) / count
        cells = np.stack(np.meshgrid(place, place), axis=-1).reshape(-1, 2)
        parts.append(np.repeat(cells, 2 * layers, axis=0))
    return np.concatenate(parts)


class Detector:
    """Finds the people of a picture."""

    def __init__(self) -> None:
        self._model = Model(DETECTOR)

    def __call__(self, picture: Picture) -> list[Detection]:
        """Returns the people of a picture `[H, W, 3]`, RGB, the surest first; empty for none."""
        height, width = picture.shape[:2]
        side = max(height, width)
        whole = Region(width / 2, height / 2, side, 0.0)
        outputs = self._model(_cut(picture, whole, DETECTOR_SIDE) * 2.0 - 1.0)
        boxes, scores = decode(outputs["Identity"][0], outputs["Identity_1"][0, :, 0])
        found = []
        for box, score in merged(boxes, scores):
            points = box[4:].reshape(4, 2) * side + [whole.x - side / 2, whole.y - side / 2]
            found.append(Detection(score, Region.spanned(points[0], points[1])))
        return found


def decode(raw: NDArray[np.floating], logits: NDArray[np.floating]) -> tuple[Floats, Floats]:
    """Returns boxes and scores of the anchors that are sure enough.

    Args:
        raw: `[2254, 12]`: middle, size and four points, pixels of the input against the anchor's middle.
        logits: `[2254]`.

    Returns:
        `[K, 12]` in shares of the input's side, the size not moved by the anchor; `[K]`.
    """
    scores = 1.0 / (1.0 + np.exp(-np.clip(logits.astype(np.float64), -100.0, 100.0)))
    sure = scores >= MIN_SCORE
    boxes = raw[sure].astype(np.float64) / DETECTOR_SIDE
    middles = anchors()[sure]
    boxes[:, :2] += middles
    boxes[:, 4:] += np.tile(middles, 4)
    return boxes, scores[sure]


def merged(boxes: Floats, scores: Floats) -> list[tuple[Floats, float]]:
    """Returns one box for each person, the mean of those that overlap, weighted by score; the surest first."""
    left = list(np.argsort(-scores))
    found = []
    while left:
        best = left[0]
        same = [k for k in left if k == best or _iou(boxes[best], boxes[k]) > OVERLAP]
        weights = scores[same]
        found.append(((boxes[same] * weights[:, None]).sum(axis=0) / weights.sum(), float(scores[best])))
        left = [k for k in left if k not in same]
    return found


def _iou(a: Floats, b: Floats) -> float:
    low = np.maximum(a[:2] - a[2:4] / 2, b[:2] - b[2:4] / 2)
    high = np.minimum(a[:2] + a[2:4] / 2, b[:2] + b[2:4] / 2)
    both = float(np.prod(np.maximum(high - low, 0.0)))
    return both / max(float(np.prod(a[2:4]) + np.prod(b[2:4])) - both, 1e-12)


class Landmarker:
    """Finds the landmarks and the mask of the person in a region, and in its mirror image: the mean is nearer."""

    def __init__(self) -> None:
        self._model = Model(LANDMARKS)

    def __call__(self, picture: Picture, region: Region) -> Sighting:
        """Returns what is seen in a region of a picture `[H, W, 3]`, RGB."""
        cut = _cut(picture, region, LANDMARK_SIDE)
        seen = self._look(cut)
        other = self._look(np.ascontiguousarray(cut[:, ::-1])).mirrored().with_sides_of(seen)
        trust = np.stack([look.chance**2 for look in (seen, other)]) + 1e-3
        trust = (trust / trust.sum(axis=0))[..., None]
        places = seen.places.copy()
        places[:COUNT] = trust[0] * seen.places[:COUNT] + trust[1] * other.places[:COUNT]
        world = trust[0] * seen.world + trust[1] * other.world
        to_picture = region.to_picture(LANDMARK_SIDE)
        pixels = places @ to_picture[:, :2].T + to_picture[:, 2]
        cosine, sine = np.cos(region.turn), np.sin(region.turn)
        world[:, :2] = world[:, :2] @ np.array([[cosine, sine], [-sine, cosine]])
        inside = (pixels[:COUNT] >= 0).all(axis=1) & (pixels[:COUNT] < picture.shape[1::-1]).all(axis=1)
        return Sighting(
            seen.score,
            pixels[:COUNT],
            np.where(inside, 0.5 * (seen.chance + other.chance), 0.0),
            world,
            0.5 * (seen.mask + other.mask),
            region,
            Region.spanned(pixels[AUXILIARY[0]], pixels[AUXILIARY[1]]),
        )

    def _look(self, cut: NDArray[np.float32]) -> _Look:
        outputs = self._model(cut)
        points = outputs["Identity"].reshape(39, 5).astype(np.float64)
        return _Look(
            float(outputs["Identity_1"].reshape(-1)[0]),
            refined(points[:, :2], outputs["Identity_3"][0]),
            _sigmoid(points[:COUNT, 3]) * _sigmoid(points[:COUNT, 4]),
            outputs["Identity_4"].reshape(39, 3)[:COUNT].astype(np.float64),
            _sigmoid(outputs["Identity_2"][0, :, :, 0]).astype(np.float32),
        )


@dataclass(frozen=True)
class _Look:
    """What the model says of one input: score, `[39, 2]` pixels, `[33]` chances, `[33, 3]` metres, a mask."""

    score: float
    places: Floats
    chance: Floats
    world: Floats
    mask: NDArray[np.float32]

    def mirrored(self) -> _Look:
        """Returns what it says of the input's mirror image."""
        places, world = self.places.copy(), self.world[MIRRORED] * np.array([-1.0, 1.0, 1.0])
        places[:COUNT] = places[MIRRORED]
        places[:, 0] = LANDMARK_SIDE - places[:, 0]
        return _Look(self.score, places, self.chance[MIRRORED], world, self.mask[:, ::-1])

    def with_sides_of(self, other: _Look) -> _Look:
        """Returns the look with left and right exchanged, of arms and legs each, where another look has them so.

        The model may take the left for the right in one of them; the mean of both would be in the middle.
        """
        order = np.arange(COUNT)
        for part in (ARMS, LEGS):
            own, theirs = self.places[:COUNT], other.places[part]
            apart = [np.linalg.norm(own[rows] - theirs, axis=1).mean() for rows in (part, MIRRORED[part])]
            if apart[1] < CLEARLY * apart[0]:
                order[part] = MIRRORED[part]
        places = np.concatenate([self.places[order], self.places[COUNT:]])
        return _Look(self.score, places, self.chance[order], self.world[order], self.mask)


def refined(points: Floats, heat: NDArray[np.float32]) -> Floats:
    """Returns landmarks moved to the centre of their heat about them, where it is sure.

    Args:
        points: `[39, 2]`, pixels of the 256 x 256 input.
        heat: logits, `[64, 64, 39]`.
    """
    out, side = points.copy(), heat.shape[0]
    reach = (KERNEL - 1) // 2
    for k, (x, y) in enumerate(points * side / LANDMARK_SIDE):
        column, row = int(x), int(y)
        if x < 0 or y < 0 or column >= side or row >= side:
            continue
        rows, columns = (np.arange(max(0, c - reach), min(side, c + reach + 1)) for c in (row, column))
        chance = _sigmoid(heat[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1, k])
        if chance.max() >= MIN_PEAK:
            total = chance.sum()
            out[k] = np.array([(chance.sum(axis=0) @ columns), (chance.sum(axis=1) @ rows)]) / total
            out[k] *= LANDMARK_SIDE / side
    return out


def _cut(picture: Picture, region: Region, size: int) -> NDArray[np.float32]:
    """Returns a region as `[size, size, 3]`, 0..1; what lies outside of the picture is 0."""
    source: NDArray[Any] = picture
    shrink = region.side / size
    if shrink > 2.0:  # bilinear sampling alone would skip pixels
        step = 1 / np.floor(shrink)
        source = cv2.resize(picture, None, fx=step, fy=step, interpolation=cv2.INTER_AREA)
    warp = region.warp(size, np.array(source.shape[1::-1]) / picture.shape[1::-1])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    part = cv2.warpAffine(source, warp, (size, size), flags=flags, borderMode=cv2.BORDER_CONSTANT)
    return part.astype(np.float32) / 255.0


def _sigmoid(values: NDArray[Any]) -> NDArray[Any]:
    return 1.0 / (1.0 + np.exp(-np.clip(values, -60.0, 60.0)))
