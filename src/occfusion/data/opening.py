"""Opens a folder in whatever layout it has: for checks, and for those who write readers."""

from __future__ import annotations

from pathlib import Path

from occfusion.data.layouts import AUTO, find_layout, noted
from occfusion.data.ocmotion.chomp_layout import ChompScene, sequence_names
from occfusion.data.ocmotion.w2a_layout import W2aScene
from occfusion.data.posing import Poser
from occfusion.data.scene import Scene
from occfusion.data.video.video_layout import VideoScene
from occfusion.data.zju.humannerf_layout import HumanNerfScene
from occfusion.data.zju.zju_layout import ZjuScene
from occfusion.errors import ConfigError


def open_folder(
    folder: Path,
    body: Poser,
    masks: str | None = None,
    sequence: str | None = None,
    person: int | None = None,
    *,
    numbered: bool = False,
    layout: str = AUTO,
) -> tuple[str, Scene]:
    """Returns the layout's name and the reader of a sequence.

    Args:
        folder: the sequence's folder.
        body: the body at rest.
        masks: mask folder, the layout's own when None.
        sequence: which one, where the folder holds several (`chomp`).
        person: which one, where the files tell people apart.
        numbered: masks hold the people's ids (`chomp`; elsewhere `person` says it).
        layout: the layout to read it in; `auto` to look.

    Raises:
        DataError: no known layout, or its files are missing, damaged or inconsistent.
        ConfigError: a sequence has to be named, or no layout of that name.
    """
    match found := find_layout(folder, asked=layout):
        case "humannerf":
            scene: Scene = HumanNerfScene(folder, body, masks or "masks")
        case "w2a":
            scene = W2aScene(folder, body.pelvis, masks or "masks", person)
        case "video":
            scene = VideoScene(folder, body.pelvis, masks or "masks", person)
        case "chomp":
            if sequence is None:
                raise ConfigError(
                    f"{folder}: holds several sequences; name one (--scene here, dataset.scene in training) of "
                    f"{', '.join(sequence_names(folder))[:400]}."
                )
            scene = ChompScene(folder, sequence, body.pelvis, masks or "mask", person, numbered=numbered)
        case _:
            scene = ZjuScene(folder, body.pelvis, masks or "mask", refined=found == "refined")
    return found, noted(scene, folder, found)
