"""What the intrinsics of a camera lack, where pictures do not lie where it says."""

from __future__ import annotations

from dataclasses import dataclass

from occfusion.types import Camera


@dataclass(frozen=True)
class Correction:
    """What a camera's intrinsics lack; applied by `corrected`.

    Attributes:
        shift: of the principal point, x and y, pixels of the picture that the camera is of.
        scale: of the focal lengths, less 1.
    """

    shift: tuple[float, float] = (0.0, 0.0)
    scale: float = 0.0

    @property
    def is_none(self) -> bool:
        """Whether it changes nothing."""
        return not any((*self.shift, self.scale))

    def resized(self, factor: float) -> Correction:
        """Returns it for the picture made larger by `factor`."""
        return Correction((self.shift[0] * factor, self.shift[1] * factor), self.scale)

    def corrected(self, camera: Camera) -> Camera:
        """Returns the camera with its intrinsics corrected."""
        if self.is_none:
            return camera
        K = camera.K.clone()
        K[[0, 1], [0, 1]] *= 1.0 + self.scale
        K[:2, 2] += K.new_tensor(self.shift)
        return Camera(camera.viewmat, K, camera.width, camera.height)


NONE = Correction()
