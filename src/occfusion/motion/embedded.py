"""Clips that come with the package: two recordings and six movements set by hand."""

from __future__ import annotations

import numpy as np

from occfusion.errors import ConfigError
from occfusion.fields import nearest
from occfusion.motion.clip import Clip
from occfusion.synth.fullbody import asset_arrays
from occfusion.synth.motion import CLIP_RATE, MOVE_SECONDS
from occfusion.synth.moves import HELD_OUT_MOVES, TRAINING_MOVES

_RECORDED = ("cmu_01_01", "cmu_01_03")
_MOVES = {move.__name__: move for move in (*TRAINING_MOVES, *HELD_OUT_MOVES)}

EMBEDDED_CLIPS = (*_MOVES, *_RECORDED)
"""Names of the clips."""


def embedded_clip(name: str) -> Clip:
    """Returns an embedded clip, y up, 30 frames a second; whoever stands faces +z.

    Raises:
        ConfigError: there is none of that name.
    """
    if name in _MOVES:
        count = round(MOVE_SECONDS * CLIP_RATE)
        poses = _MOVES[name](np.linspace(0.0, 1.0, count), np.random.default_rng(0)).reshape(count, 72)
        transl = np.zeros((count, 3))
    elif name in _RECORDED:
        arrays = asset_arrays("motions_cmu.npz")
        # the first frame of a recording is the T-pose it was calibrated in
        poses = arrays[f"{name}_pose"][1:].astype(np.float64)
        transl = arrays[f"{name}_trans"][1:].astype(np.float64)
    else:
        raise ConfigError(f"motion {name}: no embedded clip of that name; {nearest(name, EMBEDDED_CLIPS)}")
    return Clip(name, poses[:, :3], poses[:, 3:], transl, CLIP_RATE, "y")
