"""Which layout a folder has: one rule for training, for checks and for whoever opens a folder.

Names alone decide, but for one pair. A folder that HumanNeRF's preparation has worked on keeps the
`metadata.json` it was made from, and so has the layouts `humannerf` and `w2a`. It is read as upstream does: from
the tables, unless it was cut from OcMotion, where people really are hidden: its name ends in `_w2a`, or its
`metadata.json` gives `trans`, which HumanNeRF's own script does not know.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from occfusion.data.scene import Scene
from occfusion.errors import ConfigError, DataError
from occfusion.files.jsonfile import load_json

_PROGRAM = "of tijiang13/InstantAvatar"

_UNREAD = {
    (
        "images",
        "segmentations",
        "sparse",
    ): "NeuMan's own form (apple/ml-neuman): COLMAP's cameras in sparse/, 255 = "
    "background in segmentations/, and poses that alignments.npy scales anew in each picture. It is not read; "
    f"scripts/custom/process-sequence.sh {_PROGRAM} makes cameras.npz, masks/ and poses of its images/",
    (
        "camera.pkl",
        "reconstructed_poses.hdf5",
    ): "PeopleSnapshot as released: a video, and HDF5 files of masks and "
    f"poses. It is not read; scripts/peoplesnapshot/preprocess_PeopleSnapshot.py {_PROGRAM} makes cameras.npz, "
    "images/, masks/ and poses.npz",
}
"""Forms that others have to convert first, by the names that a folder of each has, all of them."""


def why_unread(folder: Path) -> str | None:
    """Returns which form that is not read a folder has, and what to do; None where it has none of them."""
    for marks, words in _UNREAD.items():
        if all((folder / mark).exists() for mark in marks):
            return f"is of {words}, which dataset=video reads."
    return None


AUTO = "auto"
"""What `dataset.layout` and `--layout` say to have the folder looked at."""

HELD_OUT = "_eval"
"""End of the name of the folder in which OccNeRF's preparation puts the held-out cameras of `377`."""


@dataclass(frozen=True)
class Layout:
    """A form in which sequences lie on disk.

    Attributes:
        name: what settings and messages call it.
        parts: names a whole folder has, each with its alternatives; folders end in `/`.
        marks: those of the parts, by position, by which the layout is known.
        any_mark: one of the marks is enough.
    """

    name: str
    parts: tuple[tuple[str, ...], ...]
    marks: tuple[int, ...]
    any_mark: bool = False

    @property
    def needs(self) -> str:
        """What a person would look for, in words."""
        return ", ".join(" or ".join(part) for part in self.parts)

    def fits(self, folder: Path) -> bool:
        """Whether a folder is of this layout, whole or not."""
        found = [_has(folder, self.parts[mark]) for mark in self.marks]
        return any(found) if self.any_mark else all(found)

    def share(self, folder: Path) -> float:
        """Returns which share of the parts a folder has, 0..1."""
        return sum(_has(folder, part) for part in self.parts) / len(self.parts)

    def lacks(self, folder: Path) -> list[str]:
        """Returns the parts that a folder has not; masks may lie elsewhere, as a setting says."""
        return [" or ".join(part) for part in self.parts if part != MASKS and not _has(folder, part)]


def _has(folder: Path, part: tuple[str, ...]) -> bool:
    return any((folder / name).is_dir() if name.endswith("/") else (folder / name).exists() for name in part)


MASKS, IMAGES = ("masks/",), ("images/",)

LAYOUTS = (
    Layout("refined", (("annots.npy",), ("smpl_params/",)), (1,)),
    Layout("original", (("annots.npy",), ("new_params/", "params/")), (0, 1), any_mark=True),
    Layout("w2a", (("metadata.json",), IMAGES, MASKS), (0, 1)),
    Layout("humannerf", (("cameras.pkl",), ("mesh_infos.pkl",), IMAGES, MASKS), (0, 1)),
    Layout(
        "video",
        (("cameras.npz",), ("poses.npz", "poses_optimized.npz", "poses/"), IMAGES, MASKS),
        (0, 2),
    ),
    Layout("chomp", (("annot/train.pkl", "annot/test.pkl"),), (0,)),
)

ZJU = ("refined", "original", "humannerf")
OCMOTION = ("w2a", "chomp")
DATASETS = {**dict.fromkeys(ZJU, "zju"), **dict.fromkeys(OCMOTION, "ocmotion"), "video": "video"}
"""Which `dataset=` reads each layout."""


def find_layout(folder: Path, among: tuple[str, ...] | None = None, asked: str = AUTO) -> str:
    """Returns the name of the layout in which a sequence's folder is read.

    Args:
        folder: the sequence's folder.
        among: the layouts that the caller reads; all when None.
        asked: the layout that the user names; `auto` to look.

    Raises:
        ConfigError: no layout of that name.
        DataError: no such folder, or it has none of them, or lacks a part; says what was looked for, what is
            there, and what is nearest.
    """
    names = {layout.name: layout for layout in LAYOUTS if among is None or layout.name in among}
    if asked != AUTO and asked not in names:
        raise ConfigError(f"layout {asked!r}: choose {AUTO}, {', '.join(names)}.")
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder; {_sequences(folder.parent)}.")
    fitting = [layout.name for layout in LAYOUTS if layout.fits(folder)]
    if asked == AUTO and not fitting:
        unread = why_unread(folder)
        nearest = f"no layout that is known here. {_nearest(folder, list(names.values()))}"
        raise DataError(f"{folder}: {unread or nearest}")
    found = _first(folder, fitting) if asked == AUTO else asked
    if found not in names:
        too = next((name for name in fitting if name in names), None)
        also = "" if too is None else f" It has the layout {too!r} too: dataset.layout={too} reads that."
        raise DataError(
            f"{folder}: is of the layout {found!r}, which dataset={DATASETS[found]} reads; this data set reads "
            f"{', '.join(names)}.{also}"
        )
    if lacking := names[found].lacks(folder):
        raise DataError(_unlike(folder, names[found], lacking, list(names.values())))
    return found


def other_layouts(folder: Path, taken: str) -> str:
    """Returns which layouts a folder has beside the one that was taken, and how to ask for them; empty for none."""
    others = [layout for layout in LAYOUTS if layout.name != taken and layout.fits(folder)]
    return "; ".join(
        f"the layout {layout.name} too (dataset={DATASETS[layout.name]} dataset.layout={layout.name}, or "
        f"--layout {layout.name} of check)"
        for layout in others
        if not layout.lacks(folder)
    )


def noted(scene: Scene, folder: Path, layout: str) -> Scene:
    """Returns the reader, having noted in what it took that the folder has other layouts too."""
    others = other_layouts(folder, layout)
    if others:
        text = "; ".join(part for part in (others, scene.taken.others) if part)
        scene.taken = replace(scene.taken, others=text)
    return scene


def sequences_in(root: Path) -> list[Path]:
    """Returns the folders directly inside `root` that hold a sequence.

    Held-out cameras beside the folder of their training camera are part of that sequence.
    """
    if not root.is_dir():
        return []
    folders = sorted(path for path in root.iterdir() if path.is_dir())
    found = [path for path in folders if any(layout.fits(path) for layout in LAYOUTS)]
    return [path for path in found if held_out_of(path) not in found]


def held_out_of(folder: Path) -> Path | None:
    """Returns the folder whose held-out cameras this folder is named for; None for other names."""
    name = folder.name.removesuffix(HELD_OUT)
    return folder.with_name(name) if name and name != folder.name else None


def _first(folder: Path, fitting: list[str]) -> str:
    """Returns which of the layouts that a folder has is read."""
    if fitting[0] == "w2a" and "humannerf" in fitting and not _from_ocmotion(folder):
        return "humannerf"
    return fitting[0]


def _from_ocmotion(folder: Path) -> bool:
    if folder.name.endswith("_w2a"):
        return True
    try:
        rows: Any = load_json(folder / "metadata.json")
    except DataError:  # whoever reads it says what is wrong
        return False
    row = next(iter(rows.values()), None) if isinstance(rows, Mapping) else None
    return isinstance(row, Mapping) and "trans" in row


def _unlike(folder: Path, layout: Layout, lacking: list[str], candidates: list[Layout]) -> str:
    """Returns what a folder of a layout lacks, and which other layouts it comes as near to."""
    kind = "folder" if lacking[0].endswith("/") else "file"
    as_near = [one for one in candidates if one is not layout and one.share(folder) >= layout.share(folder)]
    others = [f" For {one.name!r} it lacks {', '.join(one.lacks(folder)) or 'nothing'}." for one in as_near]
    return (
        f"{folder / lacking[0]}: {kind} not found. The layout {layout.name!r} needs {layout.needs}; "
        f"{_there(folder)}.{''.join(others)}"
    )


def _nearest(folder: Path, candidates: list[Layout]) -> str:
    """Returns what was looked for, what a folder has, and which layout it is nearest to."""
    needs = "; ".join(f"{layout.name}: {layout.needs}" for layout in candidates)
    near = ""
    for layout in (
        max(candidates, key=lambda one: one.share(folder)),
        max(LAYOUTS, key=lambda one: one.share(folder)),
    ):
        if layout.share(folder) > 0:
            near = f" It is nearest to {layout.name!r}, which also needs {', '.join(layout.lacks(folder))}."
            near += "" if layout in candidates else f" That is read by dataset={DATASETS[layout.name]}."
            break
    inside = [path.name for path in sequences_in(folder)]
    if inside:
        near += f" Sequences lie in it: {', '.join(inside[:20])}; name one of them."
    return f"Needed are {needs}. T{_there(folder)[1:]}.{near}"


def _there(folder: Path) -> str:
    names = [f"{path.name}/" if path.is_dir() else path.name for path in sorted(folder.iterdir())]
    more = f" and {len(names) - 12} more" if len(names) > 12 else ""
    return f"the folder has {', '.join(names[:12]) or 'nothing'}{more}"


def _sequences(root: Path) -> str:
    if not root.is_dir():
        return f"there is no {root} either"
    names = [path.name for path in sequences_in(root)]
    there = "the sequences " + ", ".join(names[:20]) if names else "no sequence in any layout known here"
    return f"{root} has {there}"
