"""Opens a folder in whatever layout it has: for checks, and for those who write readers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from occfusion.data.humannerf_layout import HumanNerfScene
from occfusion.data.layouts import find_layout
from occfusion.data.ocmotion_chomp import ChompScene, sequence_names
from occfusion.data.ocmotion_w2a import W2aScene
from occfusion.data.scene import Array, Scene
from occfusion.data.video_layout import VideoScene
from occfusion.data.zju_layout import ZjuScene
from occfusion.errors import ConfigError


def open_folder(
    folder: Path,
    pelvis: Callable[[Array], Array],
    masks: str | None = None,
    sequence: str | None = None,
    person: int | None = None,
    *,
    numbered: bool = False,
) -> tuple[str, Scene]:
    """Returns the layout's name and the reader of a sequence.

    Args:
        folder: the sequence's folder.
        pelvis: gives the pelvis at rest, `[3]` in metres, for shape coefficients `[B]`.
        masks: mask folder, the layout's own when None.
        sequence: which one, where the folder holds several (`chomp`).
        person: which one, where the files tell people apart.
        numbered: masks hold the people's ids (`chomp`; elsewhere `person` says it).

    Raises:
        DataError: no known layout, or its files are missing, damaged or inconsistent.
        ConfigError: a sequence has to be named.
    """
    layout = find_layout(folder)
    match layout:
        case "humannerf":
            return layout, HumanNerfScene(folder, pelvis, masks or "masks")
        case "w2a":
            return layout, W2aScene(folder, pelvis, masks or "masks", person)
        case "video":
            return layout, VideoScene(folder, pelvis, masks or "masks", person)
        case "chomp":
            if sequence is None:
                raise ConfigError(
                    f"{folder}: holds several sequences; name one (--scene here, dataset.scene in training) of "
                    f"{', '.join(sequence_names(folder))[:400]}."
                )
            return layout, ChompScene(folder, sequence, pelvis, masks or "mask", person, numbered=numbered)
        case _:
            return layout, ZjuScene(folder, pelvis, masks or "mask", refined=layout == "refined")
