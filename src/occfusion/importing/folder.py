"""Writing a fitted clip as a `dataset=video` folder, whole or not at all, with its report."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from shlex import quote
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from occfusion.errors import ConfigError, DataError
from occfusion.files.atomic import atomic_write, write_bytes, write_json, write_png
from occfusion.files.video import write_frames
from occfusion.fitting.batch import height_at_rest
from occfusion.fitting.pipeline import Fit
from occfusion.fitting.quality import overlay, posed
from occfusion.footage.people import ranges
from occfusion.human import Body
from occfusion.human.body import EMBEDDED_BODY
from occfusion.importing.sources import Sources
from occfusion.synth.fullbody import asset_bytes

Picture = NDArray[np.uint8]

REPORT, FIT_REPORT = "import.json", "fit.json"
PERSON, OCCLUDER = 1, 2
"""Values of the masks where something stands before the person: who else is in them is an occluder to training."""
SHEET = 8
"""Pictures on the overlay sheet."""
HELD_OUT = 0.2
"""Share of the frames, the last, that the printed command holds out for evaluation."""
TRAINED_SIZE = 512
"""Pixels of the longer side of training pictures, `dataset.image_size` where it is not named."""
TRAINED_HEIGHT = 200
"""Pixels that a person is high in training pictures, at least, where the clip has as many."""
NO_WORD = re.compile(r"null|true|false|[+-]?(nan|inf|[\d._]+(e[+-]?\d+)?)", re.IGNORECASE)
"""What Hydra takes for nothing, a truth value or a number, and writes otherwise."""
COVERED = 0.85
"""Share of the body that masks cover, median, from which on nothing stands before the person."""


def require_free(output: Path) -> None:
    """Raises ConfigError when a folder is already something else than an import, which may be replaced."""
    if output.exists() and not (
        output.is_dir() and ((output / REPORT).is_file() or not any(output.iterdir()))
    ):
        raise ConfigError(
            f"--output {output}: is there already and was not made by import; choose another name."
        )


def write_folder(
    output: Path,
    sources: Sources,
    fit: Fit,
    body: Body,
    *,
    embedded: bool,
    facts: dict[str, Any],
    mend: Callable[[Path], tuple[Fit, dict[str, Any]]] | None = None,
) -> Fit:
    """Writes cameras, poses, pictures, masks, the overlay and the report; returns the fit that is written.

    Args:
        output: the folder; an earlier import there is replaced.
        sources: pictures and masks.
        fit: the body.
        body: that was fitted.
        embedded: whether it is the free body of the package, which is laid into the folder.
        facts: more of the report: where each part comes from.
        mend: takes the folder of what is not whole yet, with all that training needs; gives the fit to be written
            instead, and facts of it.

    Raises:
        DataError: it cannot be written.
    """
    require_free(output)
    output.parent.mkdir(parents=True, exist_ok=True)
    with _unfinished(output.with_name(f".{output.name}.partial"), output) as partial:
        _write_bodies(partial, sources, fit, body, embedded, 1.0)
        for k, picture in enumerate(sources.shot.pictures):
            write_png(partial / "images" / f"{k:06d}.png", picture)
            write_png(partial / "masks" / f"{k:06d}.png", _numbered(sources, k))
        if mend is not None:
            fit, mended = mend(partial)
            facts = {**facts, **mended}
            _write_poses(partial, fit)
        _write_overlay(partial, sources, fit, body)
        _write_report(partial / REPORT, {**facts, **_report(sources, fit, body)})
        if output.exists():
            shutil.rmtree(output)
        partial.rename(output)
    return fit


def write_bodies(
    output: Path, sources: Sources, fit: Fit, body: Body, *, embedded: bool, facts: dict[str, Any]
) -> None:
    """Writes camera, poses, overlay and report beside what a folder has; the camera only where there is none.

    The camera is that of the clip's own pictures, also where smaller ones were fitted to.

    Raises:
        DataError: it cannot be written.
    """
    output.mkdir(parents=True, exist_ok=True)
    with _unfinished(output / ".fit.partial", output) as partial:
        _write_bodies(partial, sources, fit, body, embedded, sources.shot.scale)
        _write_overlay(partial, sources, fit, body)
        _write_report(partial / FIT_REPORT, {**facts, **_report(sources, fit, body)})
        if (output / "cameras.npz").exists():
            (partial / "cameras.npz").unlink()
        for file in sorted(partial.iterdir()):
            file.replace(output / file.name)


@contextmanager
def _unfinished(partial: Path, output: Path) -> Iterator[Path]:
    """Yields a folder for what is not whole yet, gone afterwards; says of `output` what the disk refuses."""
    shutil.rmtree(partial, ignore_errors=True)
    try:
        yield partial
    except OSError as error:
        raise DataError(
            f"{output}: cannot be written ({error.strerror or error}); check space and rights."
        ) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _write_bodies(folder: Path, sources: Sources, fit: Fit, body: Body, embedded: bool, scale: float) -> None:
    """Writes the camera of pictures that are 1 / `scale` as large, poses, and the free body."""
    width, height = (round(length / scale) for length in sources.shot.size)
    K = np.diag([1 / scale, 1 / scale, 1.0]) @ fit.solution.K
    with atomic_write(folder / "cameras.npz") as stream:
        np.savez(stream, intrinsic=K, extrinsic=np.eye(4), height=height, width=width, pixel_centres=0.5)
    _write_poses(folder, fit)
    if embedded:
        write_bytes(folder / "body.npz", asset_bytes(EMBEDDED_BODY))


def _write_poses(folder: Path, fit: Fit) -> None:
    solution = fit.solution
    with atomic_write(folder / "poses.npz") as stream:
        np.savez(
            stream, betas=solution.betas, global_orient=solution.global_orient, body_pose=solution.body_pose,
            transl=solution.transl,
        )  # fmt: skip


def _write_overlay(folder: Path, sources: Sources, fit: Fit, body: Body) -> None:
    times = np.asarray(sources.shot.seconds)
    gap = float(np.median(np.diff(times))) if len(times) > 1 and not sources.clip.pictures else 0.1
    write_frames(
        folder / "overlay.mp4", overlays(sources, fit, body), fps=float(np.clip(1 / max(gap, 1e-3), 1, 60))
    )
    write_png(folder / "overlay.png", _sheet(sources, fit, body))


def _numbered(sources: Sources, k: int) -> NDArray[Any]:
    """Returns a frame's mask; with numbers where it is known what stands before the person."""
    if sources.hidden is None:
        return sources.masks[k]
    numbers = np.where(sources.hidden[k], OCCLUDER, 0).astype(np.uint8)
    numbers[sources.masks[k]] = PERSON
    return numbers


def overlays(
    sources: Sources, fit: Fit, body: Body, frames: Sequence[int] | None = None
) -> Iterator[Picture]:
    """Yields pictures with mask (green outline), body (red) and key points (yellow); of all frames, or of some."""
    faces = body.faces.numpy()
    wanted = set(range(len(sources.shot)) if frames is None else frames)
    for k, (vertices, _) in enumerate(posed(body, fit.solution)):
        if k in wanted:
            yield overlay(
                sources.shot.pictures[k], sources.masks[k], vertices, fit.solution.K, faces, fit.points, k
            )


def _sheet(sources: Sources, fit: Fit, body: Body) -> Picture:
    chosen = sorted({int(k) for k in np.linspace(0, len(sources.shot) - 1, SHEET).round()})
    pictures = list(overlays(sources, fit, body, chosen))
    scale = 360 / pictures[0].shape[0]
    small = [
        np.asarray(cv2.resize(p, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)) for p in pictures
    ]
    if len(small) % 2:
        small.append(np.zeros_like(small[0]))
    half = len(small) // 2
    return np.vstack([np.hstack(small[:half]), np.hstack(small[half:])]).astype(np.uint8)


def _report(sources: Sources, fit: Fit, body: Body) -> dict[str, Any]:
    numbers = sources.shot.numbers
    quality = fit.quality
    return {
        "frames": len(numbers),
        "numbers": list(numbers),
        "camera": sources.intrinsics.source,
        "focal_pixels": float(fit.solution.K[0, 0]),
        "height_metres": float(height_at_rest(body, torch.tensor(fit.solution.betas, dtype=torch.float32))),
        "trusted": quality.trusted,
        **quality.summary(),
        "doubtful_frames": [numbers[k] for k in quality.doubtful],
        "left_and_right_exchanged": [numbers[k] for k in fit.swapped],
        "reprojection_percent_of_height": _plain(quality.pixels),
        "mask_iou": _plain(quality.iou),
        "mask_inside_body": _plain(quality.inside),
        "losses": fit.solution.losses,
        "notes": sources.notes,
    }


def _write_report(path: Path, report: dict[str, Any]) -> None:
    """Writes a report, and beside it the same in words."""
    write_json(path, report)
    write_bytes(path.with_suffix(".txt"), "\n".join(_lines(report)).encode() + b"\n")


def _plain(values: NDArray[np.float64]) -> list[float | None]:
    return [round(float(v), 4) if np.isfinite(v) else None for v in values]


def _lines(report: dict[str, Any]) -> list[str]:
    def said(key: str, scale: float = 1.0) -> str:
        value = report[key]
        return "-" if value is None else f"{scale * value:.3g}"

    doubtful, source = report["doubtful_frames"], report.get("height_source")
    lines = [
        f"frames             {report['frames']}",
        f"camera             {report['camera']}; focal length {report['focal_pixels']:.0f} px",
        f"height             {report['height_metres']:.2f} m" + (f", {source}" if source else ""),
        f"reprojection       {said('median_reprojection_percent_of_height')} % of the person's height (median)",
        f"body and mask      IoU {said('median_mask_iou')}, "
        f"{said('median_mask_inside_body', 100)} % of the mask inside (median)",
        f"doubtful frames    {len(doubtful)}" + (f": {ranges(doubtful)}" if doubtful else ""),
    ]
    if (mended := report.get("mended_by_colour")) is not None:
        lines.append(f"colours            {mended['said']}")
    if report["left_and_right_exchanged"]:
        lines.append(f"sides exchanged    {ranges(report['left_and_right_exchanged'])}")
    lines += [f"note               {note}" for note in report["notes"]]
    lines.append(f"verdict            {'trusted' if report['trusted'] else 'NOT TRUSTED'}")
    return lines


def said(folder: Path, name: str = "import.txt") -> str:
    """Returns the report of a folder in words."""
    return (folder / name).read_text(encoding="utf-8").rstrip()


def picture_size(sources: Sources, height: int, least: int) -> int:
    """Returns the longer side, pixels, of pictures in which the person is `height` high, at most that of the clip's.

    Args:
        sources: pictures and masks of the person.
        height: pixels, of the median frame.
        least: pixels, of the longer side.
    """
    heights = [np.ptp(rows) + 1 for mask in sources.masks if len(rows := np.flatnonzero(mask.any(axis=1)))]
    side = max(sources.shot.size)
    return int(np.clip(round(side * height / float(np.median(heights))), min(least, side), side))


def training_command(
    output: Path, frames: int, body: Path | None, covered: float | None, size: int, *, numbered: bool = False
) -> str:
    """Returns the command that trains on a folder, the last frames held out.

    Args:
        output: the folder.
        frames: that it has.
        body: an SMPL file; None for the free body.
        covered: share of the body that masks cover, median; None where that is not known.
        size: pixels of the longer side of training pictures.
        numbered: whether its masks number the person and what stands before them.
    """
    cut = max(1, round((1 - HELD_OUT) * frames))
    words = training_overrides(output, body, covered, numbered=numbered)
    if size > TRAINED_SIZE:
        words.append(f"dataset.image_size={size}")
    frames_of_each = [
        "dataset.test_cameras=[0]",
        f"dataset.train_frames=[0,{cut},1]",
        f"dataset.test_frames=[{cut},{frames},1]",
    ]
    lines = [["python", "train.py", *words[:3]], frames_of_each, words[3:]]
    return " \\\n    ".join(" ".join(map(quote, line)) for line in lines)


def training_overrides(
    folder: Path, body: Path | None, covered: float | None, *, numbered: bool = False
) -> list[str]:
    """Returns the overrides that name a folder to training, but for the frames.

    Args:
        folder: of an import.
        body: an SMPL file; None for the free body.
        covered: share of the body that masks cover, median; None where that is not known.
        numbered: whether its masks number the person and what stands before them.
    """
    words = [
        "dataset=video",
        override("dataset.root", folder.parent),
        override("dataset.scene", folder.name),
    ]
    words.append("body=anny" if body is None else override("body.path", body))
    if covered is not None and covered >= COVERED:
        words.append("dataset.occluded=false")
    if numbered:
        words.append(f"dataset.person={PERSON}")
    return words


def override(key: str, value: Path | str) -> str:
    """Returns an override of Hydra's, its value in quotes where the grammar would read something else."""
    text = str(value)
    is_plain = re.fullmatch(r"[\w./-]+", text) and not NO_WORD.fullmatch(text)
    if is_plain or text.isdecimal():
        return f"{key}={text}"
    inner = re.sub(r"(\\*)('|$)", lambda found: 2 * found[1] + found[2].replace("'", "\\'"), text)
    inner = inner.replace("${", "\\${")
    return f"{key}='{inner}'"
