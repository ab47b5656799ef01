"""Which layout a folder has, told from the names in it alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from occfusion.errors import DataError


@dataclass(frozen=True)
class Layout:
    """A form in which sequences lie on disk.

    Attributes:
        name: what settings and messages call it.
        needs: what a person would look for, in words.
        fits: says whether a folder has it.
    """

    name: str
    needs: str
    fits: Callable[[Path], bool]


def _has(folder: Path, *names: str) -> bool:
    return all((folder / name).exists() for name in names)


LAYOUTS = (
    Layout("refined", "annots.npy and smpl_params/", lambda f: _has(f, "smpl_params")),
    Layout(
        "original",
        "annots.npy and new_params/ or params/",
        lambda f: any(_has(f, name) for name in ("annots.npy", "new_params", "params")),
    ),
    Layout("w2a", "metadata.json, images/ and masks/", lambda f: _has(f, "metadata.json", "images")),
    Layout(
        "humannerf",
        "cameras.pkl, mesh_infos.pkl, images/ and masks/",
        lambda f: _has(f, "cameras.pkl", "mesh_infos.pkl"),
    ),
    Layout("video", "cameras.npz, poses.npz, images/ and masks/", lambda f: _has(f, "cameras.npz", "images")),
    Layout("chomp", "annot/train.pkl or annot/test.pkl", lambda f: any((f / "annot").glob("t*.pkl"))),
)

ZJU = ("refined", "original", "humannerf")
OCMOTION = ("w2a", "chomp")
DATASETS = {**dict.fromkeys(ZJU, "zju"), **dict.fromkeys(OCMOTION, "ocmotion"), "video": "video"}
"""Which `dataset=` reads each layout."""


def find_layout(folder: Path, among: tuple[str, ...] | None = None) -> str:
    """Returns the name of the layout that a sequence's folder has.

    Args:
        folder: the sequence's folder.
        among: names to choose from; all when None.

    Raises:
        DataError: no such folder, or it has none of them; says what each needs and what is there.
    """
    candidates = [layout for layout in LAYOUTS if among is None or layout.name in among]
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder; {_sequences(folder.parent)}.")
    for layout in candidates:
        if layout.fits(folder):
            return layout.name
    other = next((layout.name for layout in LAYOUTS if layout.fits(folder)), None)
    if other is not None:
        raise DataError(
            f"{folder}: is of the layout {other!r}, which dataset={DATASETS[other]} reads; this data set reads "
            f"{', '.join(layout.name for layout in candidates)}."
        )
    needs = "; ".join(f"{layout.name}: {layout.needs}" for layout in candidates)
    there = ", ".join(sorted(path.name for path in folder.iterdir())[:12]) or "nothing"
    raise DataError(f"{folder}: no layout that is known here. Needed are {needs}. The folder has {there}.")


def sequences_in(root: Path) -> list[Path]:
    """Returns the folders directly inside `root` that hold a sequence."""
    if not root.is_dir():
        return []
    folders = sorted(path for path in root.iterdir() if path.is_dir())
    return [path for path in folders if any(layout.fits(path) for layout in LAYOUTS)]


def _sequences(root: Path) -> str:
    if not root.is_dir():
        return f"there is no {root} either"
    names = [path.name for path in sequences_in(root)]
    there = "the sequences " + ", ".join(names[:20]) if names else "no sequence in any layout known here"
    return f"{root} has {there}"
