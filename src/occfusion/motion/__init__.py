"""Motion for avatars: embedded clips, files and runs; put upright on a floor, at any rate of frames."""

from occfusion.motion.clip import USUAL_FPS, Clip
from occfusion.motion.files import EMBEDDED_CLIPS, embedded_clip, read_clip, read_sequence, write_clip
from occfusion.motion.performance import Performance, at_rest, leg_length, perform, spread_rows

__all__ = [
    "EMBEDDED_CLIPS",
    "USUAL_FPS",
    "Clip",
    "Performance",
    "at_rest",
    "embedded_clip",
    "leg_length",
    "perform",
    "read_clip",
    "read_sequence",
    "spread_rows",
    "write_clip",
]
