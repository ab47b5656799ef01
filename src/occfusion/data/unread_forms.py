"""Forms that are known and not read, each with the program that makes one of it that is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

_PROGRAM = "of tijiang13/InstantAvatar"


@dataclass(frozen=True)
class UnreadForm:
    """A form that others have to convert first.

    Attributes:
        marks: names that a folder has, all of them.
        what: the form in words, and why it is not read.
        cure: what makes a form of it that is read.
    """

    marks: tuple[str, ...]
    what: str
    cure: str


UNREAD = (
    UnreadForm(
        ("images", "segmentations", "sparse"),
        "NeuMan's own form (apple/ml-neuman): COLMAP's cameras in sparse/, 255 = background in segmentations/, "
        "and poses that alignments.npy scales anew in each picture",
        f"scripts/custom/process-sequence.sh {_PROGRAM} makes cameras.npz, masks/ and poses of its images/",
    ),
    UnreadForm(
        ("camera.pkl", "reconstructed_poses.hdf5"),
        "PeopleSnapshot as released: a video, and HDF5 files of masks and poses",
        f"scripts/peoplesnapshot/preprocess_PeopleSnapshot.py {_PROGRAM} makes cameras.npz, images/, masks/ "
        "and poses.npz",
    ),
)


def why_unread(folder: Path) -> str | None:
    """Returns which form that is not read a folder has, and what to do; None where it has none of them."""
    for form in UNREAD:
        if all((folder / mark).exists() for mark in form.marks):
            return f"is of {form.what}. It is not read; {form.cure}, which dataset=video reads."
    return None
