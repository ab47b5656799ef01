"""From layers to pictures: backgrounds, layers and runs side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.errors import ConfigError
from occfusion.evaluation.pictures import captioned
from occfusion.files.images import read_rgb
from occfusion.show.drawing import Layers

Picture = NDArray[Any]
Background = torch.Tensor | None
"""`[H, W, 3]` in 0..1, at the size of the pictures, or `[3]`; None: nothing, pictures have alpha."""
TRANSPARENT = "transparent"
COLOURS = {"black": (0, 0, 0), "white": (255, 255, 255), "grey": (128, 128, 128)}
MILLIMETRES = 1000.0
_NEAR_IS = 1.0, 0.25
"""Grey of the nearest and of the farthest depth that a film shows."""


def parse_background(words: str, width: int, height: int) -> Background:
    """Returns what lies behind the person by a user's word.

    Args:
        words: `black`, `white`, `grey`, `#rrggbb`, `transparent`, or a picture, which covers the whole.
        width: of the pictures.
        height: of the pictures.

    Raises:
        ConfigError: none of these.
        DataError: the picture cannot be read.
    """
    if words == TRANSPARENT:
        return None
    if words in COLOURS:
        return torch.tensor(COLOURS[words]) / 255
    if words.startswith("#"):
        try:
            red, green, blue = bytes.fromhex(words[1:])
        except ValueError:
            raise ConfigError(
                f"--background {words}: a colour has six hexadecimal digits, such as #2060a0"
            ) from None
        return torch.tensor([red, green, blue]) / 255
    if not Path(words).is_file():
        raise ConfigError(
            f"--background {words}: {', '.join(COLOURS)}, #rrggbb, {TRANSPARENT}, or a picture's file; there is none"
        )
    image = read_rgb(Path(words))
    scale = max(width / image.shape[1], height / image.shape[0])
    grown = cv2.resize(
        image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    )
    top, left = (grown.shape[0] - height) // 2, (grown.shape[1] - width) // 2
    cut = grown[max(top, 0) :, max(left, 0) :][:height, :width]
    cut = cv2.resize(cut, (width, height)) if cut.shape[:2] != (height, width) else cut
    return torch.from_numpy(np.ascontiguousarray(cut)).float() / 255


def picture_of(
    layers: Layers, layer: str, background: Background, depths: tuple[float, float] | None
) -> Picture:
    """Returns one layer as a picture.

    Args:
        layers: what was drawn.
        layer: which.
        background: behind colours and normals.
        depths: the nearest and the farthest that a film's grey stands for, metres; None: depth is uint16 millimetres.
    """
    if layer == "alpha":
        return _bytes(layers.alpha)
    if layer == "depth":
        if depths is None:
            whole = (layers.depth * MILLIMETRES).clamp(0, 65535).round()
            return whole.to(torch.int32).numpy().astype(np.uint16)
        near, far = depths
        share = ((layers.depth - near) / max(far - near, 1e-6)).clamp(0, 1)
        grey = _NEAR_IS[0] + share * (_NEAR_IS[1] - _NEAR_IS[0])
        return _bytes(torch.where(layers.alpha > 0.5, grey, 0.0))
    over_black = layers.rgb
    if layer == "normals":
        assert layers.normals is not None
        over_black = (0.5 * layers.normals + 0.5) * layers.alpha[..., None]
    if background is None:
        straight = over_black / layers.alpha.clamp_min(1e-6)[..., None]
        return _bytes(torch.cat([straight, layers.alpha[..., None]], dim=-1))
    if not bool(background.any()):
        return _bytes(over_black)
    return _bytes(torch.addcmul(over_black, 1 - layers.alpha[..., None], background))


def _bytes(values: torch.Tensor) -> Picture:
    whole = values.detach().contiguous().numpy()
    rows = whole.reshape(len(whole), -1)
    # one pass instead of four: rounds to the nearest, ends at 0 and 255
    return np.asarray(cv2.addWeighted(rows, 255.0, rows, 0.0, 0.0, dtype=cv2.CV_8U)).reshape(whole.shape)


def side_by_side(pictures: Sequence[Picture], names: Sequence[str]) -> Picture:
    """Returns pictures of one height beside each other, each below its name; without names where there is but one.

    Names stand on white; pictures with alpha keep it.

    Raises:
        ConfigError: pictures of several heights.
    """
    if len({picture.shape[0] for picture in pictures}) > 1:
        heights = ", ".join(str(picture.shape[0]) for picture in pictures)
        raise ConfigError(
            f"pictures {heights} pixels high do not fit beside each other; give one --size for all"
        )
    if len(pictures) == 1 and not names:
        return pictures[0]
    has_alpha = any(picture.shape[2:] == (4,) for picture in pictures)
    coloured = [_coloured(picture, has_alpha) for picture in pictures]
    if names:
        coloured = [_captioned(picture, name) for picture, name in zip(coloured, names, strict=True)]
    return np.concatenate(coloured, axis=1)


def _captioned(picture: Picture, name: str) -> Picture:
    if picture.shape[2] == 3:
        return captioned(picture, name)
    bar = captioned(picture[..., :3], name)[: -picture.shape[0]]
    opaque = np.full((*bar.shape[:2], 1), 255, np.uint8)
    return np.concatenate([np.concatenate([bar, opaque], axis=2), picture])


def _coloured(picture: Picture, has_alpha: bool) -> Picture:
    """Returns a picture with 3 channels, or 4 where others have alpha."""
    if picture.ndim == 2:
        picture = np.repeat(picture[..., None], 3, axis=2)
    if has_alpha and picture.shape[2] == 3:
        picture = np.concatenate([picture, np.full((*picture.shape[:2], 1), 255, np.uint8)], axis=2)
    return picture
