"""Frames of a prepared scene: reads, packs, remembers, and hands out tensors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from threading import Lock
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from occfusion.data.cameras import Lens
from occfusion.data.checking.checks import check_angles
from occfusion.data.outline_offsets import NONE, Correction
from occfusion.data.packing import Packed, pack
from occfusion.data.prepare import Prepared
from occfusion.data.scene import BodyParameters
from occfusion.errors import DataError
from occfusion.fields import bits
from occfusion.files.images import image_size, read_mask
from occfusion.geometry.zbuffer import rasterize_mesh
from occfusion.types import Camera, Frame, Pose, Truth


class Sized(Protocol):
    """Something that knows how many bytes it takes."""

    @property
    def nbytes(self) -> int:
        """Bytes of its arrays."""


T = TypeVar("T", bound=Sized)


class BoundedCache(Generic[T]):
    """Keeps what is made until the bound is reached, then keeps what it has.

    Nothing is ever thrown out: training visits all frames in turn, and throwing out the oldest would then
    throw out exactly those that come next.
    """

    def __init__(self, max_bytes: int, max_items: int | None = None) -> None:
        self._left, self._max_items = max_bytes, max_items
        self._kept: dict[object, T] = {}
        self._lock = Lock()

    def get(self, key: object, make: Callable[[], T]) -> T:
        """Returns what is kept under `key`, or makes it and keeps it if it still fits."""
        found = self._kept.get(key)
        if found is None:
            found = make()
            with self._lock:
                has_room = self._max_items is None or len(self._kept) < self._max_items
                if key not in self._kept and has_room and found.nbytes <= self._left:
                    self._kept[key] = found
                    self._left -= found.nbytes
        return found

    def __len__(self) -> int:
        """Number of items kept."""
        return len(self._kept)

    def __contains__(self, key: object) -> bool:
        """Returns whether something is kept under a key."""
        return key in self._kept


MOST_CACHED = 1000
"""Decoded frames: of more, a stage sees each about once, and reading it again costs less than keeping it."""
_KEPT_LENSES = 3
"""Undistortion maps take 6 bytes a pixel and camera; held-out views are visited camera by camera."""


class Views:
    """Makes the frames of a prepared scene at one size.

    Attributes:
        complete_masks: where the complete mask of a frame lies, if it has one; None where no stage has made any.
        corrections: what the intrinsics of a camera lack, by its index, in pixels of the stored pictures.
        gains: what the colours of training frames are divided by, `[N, 3]`, by position; None: they stay as they are.
    """

    def __init__(self, prepared: Prepared, image_size: int, cache_bytes: int) -> None:
        self._prepared = prepared
        self._image_size = image_size
        self._cache: BoundedCache[Packed] = BoundedCache(cache_bytes, MOST_CACHED)
        self._lenses: dict[int, Lens] = {}
        self._parameters: dict[int, BodyParameters] = {}
        self.complete_masks: Callable[[int], Path | None] | None = None
        self._complete: dict[Path, bits.Packed] = {}
        self._lock = Lock()
        self.corrections: dict[int, Correction] = {}
        self.gains: NDArray[np.float32] | None = None

    def train_frame(self, position: int, *, truth: bool, complete: bool = False) -> Frame:
        """Returns the training frame at a position; kept in memory while there is room.

        Args:
            position: in the training frames.
            truth: with the unoccluded person.
            complete: with its complete mask, where `complete_masks` says where that lies.

        Raises:
            DataError: the complete mask is missing or of another size.
        """
        ready = self._prepared
        frame, hidden = ready.train[position], ready.hidden[position]
        files, lens = ready.scene.files(frame, ready.camera), self.lens_at(frame, ready.camera)
        packed = self._cache.get(position, lambda: pack(files, lens, hidden))
        made = self._frame(packed, files.name, frame, ready.camera, truth)
        if self.gains is not None:
            made = _evened(made, self.gains[position])
        path = self.complete_masks(frame) if self.complete_masks is not None and complete else None
        return made if path is None else replace(made, complete_mask=self._complete_mask(path, packed.size))

    def is_kept(self, position: int) -> bool:
        """Returns whether the training frame at a position is decoded already, so that it takes next to nothing."""
        return position in self._cache

    def _complete_mask(self, path: Path, size: tuple[int, int]) -> Tensor:
        width, height = size
        if path not in self._complete:  # a bit a pixel: 100 frames of 512 px take 3 MB
            if not path.is_file():
                raise DataError(f"{path}: the complete mask of this frame is missing; run stage=init")
            mask = read_mask(path)
            if mask.shape != (height, width):
                raise DataError(
                    f"{path}: {mask.shape[1]} x {mask.shape[0]} pixels, but frames have {width} x {height}; "
                    "the mask is of another run"
                )
            self._complete[path] = bits.packed(mask)
        return torch.from_numpy(bits.unpacked(self._complete[path]))

    def test_frame(self, frame: int, camera: int) -> Frame:
        """Returns a held-out view: unoccluded, its truth being what it shows."""
        files = self._prepared.scene.files(frame, camera)
        packed = pack(files, self.lens_at(frame, camera), clean=True)
        return self._frame(packed, files.name, frame, camera, True)

    def lens(self, camera: int) -> Lens:
        """Returns how a camera's stored pictures become frames."""
        with self._lock:  # training frames are read ahead while held-out ones are evaluated
            lens = self._lenses.pop(camera, None) or self._make_lens(camera)
            self._lenses[camera] = lens  # the last used stands last
            while len(self._lenses) > _KEPT_LENSES:
                del self._lenses[next(iter(self._lenses))]
        return lens

    def lens_at(self, frame: int, camera: int) -> Lens:
        """Returns how a camera's stored picture of a frame becomes one of ours: the lens may have zoomed."""
        lens, scene = self.lens(camera), self._prepared.scene
        return replace(lens, calibration=scene.view(frame, camera)) if scene.zooms else lens

    def camera_at(self, frame: int, camera: int) -> Camera:
        """Returns the camera of a frame at its size, corrected by what `corrections` has for it."""
        lens, correction = self.lens_at(frame, camera), self.corrections.get(camera, NONE)
        return correction.resized(lens.size[0] / lens.source[0]).corrected(lens.camera())

    def _make_lens(self, camera: int) -> Lens:
        scene = self._prepared.scene
        frame = self._prepared.train[0] if camera == self._prepared.camera else self._prepared.test[0]
        source = image_size(scene.files(frame, camera).rgb)
        return Lens.fitted(scene.calibration(camera), source, self._image_size)

    def parameters(self, frame: int) -> BodyParameters:
        """Returns the body parameters of a frame of the sequence."""
        if frame not in self._parameters:
            found = self._prepared.scene.parameters(frame)
            check_angles(
                np.concatenate([np.ravel(found.global_orient), np.ravel(found.body_pose)]),
                f"{self._prepared.scene.root}, frame {frame}",
            )
            self._parameters[frame] = found
        return self._parameters[frame]

    def pose(self, frame: int) -> Pose:
        """Returns the same as tensors."""
        found = self.parameters(frame)
        parts = (found.betas, found.global_orient, found.body_pose, found.transl)
        betas, global_orient, body_pose, transl = (torch.tensor(part, dtype=torch.float32) for part in parts)
        return Pose(betas, global_orient, body_pose, transl, frame)

    def _frame(self, packed: Packed, name: str, frame: int, camera: int, truth: bool) -> Frame:
        known = packed.truth() if truth else None
        return Frame(
            index=frame,
            camera_index=camera,
            name=name,
            rgb=packed.rgb(),
            visible_mask=packed.visible_mask(),
            occluded=packed.occluded() if truth else None,
            complete_mask=None,
            truth=None if known is None else Truth(*known, self._true_depth(frame, camera)),
            camera=self.camera_at(frame, camera),
            pose=self.pose(frame),
        )

    def _true_depth(self, frame: int, camera: int) -> Tensor | None:
        """Returns the depth of the true surface, `[H, W]`, infinite where there is none; None if not known."""
        if self._prepared.scene.surface is None:
            return None
        surface, view = self._prepared.scene.surface(frame), self.camera_at(frame, camera)
        viewmat, K = view.viewmat.double().numpy(), view.K.double().numpy()
        points = surface.vertices @ viewmat[:3, :3].T + viewmat[:3, 3]
        depths = points[:, 2]
        pixels = (points @ K.T)[:, :2] / np.where(depths > 0, depths, 1.0)[:, None]
        seen = rasterize_mesh(pixels, depths, surface.faces, view.width, view.height)
        return torch.from_numpy(seen.depth)


def _evened(frame: Frame, gain: NDArray[np.float32]) -> Frame:
    """Returns a frame with its colours, and those of its truth, divided by a gain `[3]`; brighter ones are clipped."""

    def even(rgb: Tensor) -> Tensor:  # by NumPy: see `packing`
        return torch.from_numpy(np.minimum(rgb.numpy() / gain, np.float32(1.0)))

    truth = frame.truth and replace(frame.truth, rgb=even(frame.truth.rgb))
    return replace(frame, rgb=even(frame.rgb), truth=truth)


def frame_to(frame: Frame, device: torch.device | str) -> Frame:
    """Returns the frame with its pictures on `device`.

    Pose and camera stay on the host, which does with them what a device would be started a hundred times for.
    """

    def moved(record: Any) -> dict[str, Any]:
        parts = {field.name: getattr(record, field.name) for field in fields(record)}
        return {name: part.to(device) for name, part in parts.items() if isinstance(part, Tensor)}

    truth = frame.truth and replace(frame.truth, **moved(frame.truth))
    return replace(frame, **moved(frame), truth=truth)
