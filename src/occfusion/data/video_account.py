"""What the reader of a video folder took, in words."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from occfusion.data.pose_tracks import Track, Tracks
from occfusion.data.scene import Taken
from occfusion.data.video_form import Form
from occfusion.data.video_pictures import Pairs


def account(
    folder: Path,
    pairs: Pairs,
    used: Sequence[int],
    tracks: Tracks,
    form: Form,
    masks: str,
    person: int | None,
    *,
    shapes: Sequence[str],
    moving: bool,
) -> Taken:
    """Returns what was taken of a folder.

    Args:
        folder: the sequence's folder.
        pairs: its pictures and masks.
        used: the pictures that are frames.
        tracks: its pose files.
        form: whose program wrote it.
        masks: name of the mask folder.
        person: the value of the wanted person in the masks.
        shapes: where each pose file's shape comes from.
        moving: the camera is given for each picture.
    """
    without_pose = len(pairs.masks) - len(used)
    lost = [f"{pairs.unmasked} dropped for want of a mask"] if pairs.unmasked else []
    lost += [f"{without_pose} dropped because no pose track covers them"] if without_pose else []
    left_out = sorted({track.motion.left_out for track in tracks.read if track.motion.left_out})
    suffix = next(iter(pairs.masks.values())).suffix
    values = "every value but 0" if person is None else f"value {person} (dataset.person)"
    folders = [path.name for path in sorted(folder.glob("masks*")) if path.is_dir() and path.name != masks]
    others = [*tracks.others, *(f"{name}/ (dataset.masks={name} reads it)" for name in folders)]
    others += [f"{pairs.lone_masks} masks that belong to no picture"] if pairs.lone_masks else []
    return Taken(
        layout="video" + (", as InstantAvatar's scripts write it" if form.marks else ""),
        pictures=f"images/, {len(used)} of {pairs.pictures}" + "".join(f"; {text}" for text in lost),
        body="; ".join(map(_said, tracks.read)) + "".join(f"; left out: {text}" for text in left_out),
        shape="; ".join(dict.fromkeys(shapes)),
        masks=f"{masks}/, {suffix} files; the person is {values}",
        cameras="cameras.npz, "
        + ("given for each picture" if moving else "one that stands still")
        + (", the one that ROMP assumes for every video" if form.assumed_camera else ""),
        centres=form.centres,
        others="; ".join(others),
    )


def remarks(cameras: Path, form: Form, tracks: Tracks) -> tuple[str, ...]:
    """Returns what is doubtful: poses fitted under one camera beside another program's."""
    fitted = [track.name for track in tracks.read if "anim_nerf" in track.name]
    if not (form.assumed_camera and fitted):
        return ()
    return (
        f"{cameras}: is the camera that ROMP assumes for every video, but {fitted[0]} was fitted under "
        "PeopleSnapshot's own; process-sequence.sh has written over it. Write it again with "
        "preprocess_PeopleSnapshot.py, or read poses.npz (dataset.poses).",
    )


def _said(track: Track) -> str:
    pictures, rows = track.pictures, len(track.motion)
    where = f"[{pictures.start}, {pictures.stop}, {pictures.step}]"
    return (
        f"{track.name} ({track.motion.form}), {rows} rows for the pictures {where}, known by {track.known_by}"
    )
