"""`python -m occfusion import CLIP --output DIR`: from a video of a person to a data folder."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console

from occfusion.cli import check
from occfusion.cli.mending import mended_by_colour
from occfusion.errors import ConfigError
from occfusion.fitting.pipeline import Fit, fit_body
from occfusion.fitting.quality import covered_share
from occfusion.footage.clip import SIDE
from occfusion.human import Body, embedded_body, load_body
from occfusion.importing.adopt import adopt
from occfusion.importing.aligning import aligned_with_masks
from occfusion.importing.bodies import TOOLS
from occfusion.importing.folder import (
    PERSON,
    TRAINED_HEIGHT,
    TRAINED_SIZE,
    picture_size,
    require_free,
    said,
    training_command,
    training_overrides,
    write_folder,
)
from occfusion.importing.hiding import told_apart
from occfusion.importing.mhr import is_mhr
from occfusion.importing.sources import Choice, Given, Sources, gather

NOT_TRUSTED = 2
SHORTEST, TALLEST = 0.5, 2.5
"""Metres."""
KEY_POINTS_OF = "sam-3d-body"
"""The tool of `--from` whose key points are taken, since its body is not SMPL's."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of the verb."""
    parser.add_argument("clip", type=Path, metavar="CLIP", help="a video, or a folder of its frames")
    parser.add_argument("--output", type=Path, required=True, help="the data folder to make")
    parser.add_argument(
        "--from", dest="given", nargs="+", metavar="[TOOL] FILE",
        help=f"the body from another tool's file ({', '.join(TOOLS)}, {KEY_POINTS_OF}; told from the content "
        "where TOOL is left out)",
    )  # fmt: skip
    parser.add_argument(
        "--from-person", type=int, help="the tool's number of the person (default: in most frames)"
    )
    parser.add_argument(
        "--mending", choices=("auto", "on", "off"), default="auto",
        help="move poses until the colours of all frames agree, by a short training; auto: those of an own fit, not "
        "those of --from (default: auto)",
    )  # fmt: skip
    add_choice(parser)


def add_choice(parser: argparse.ArgumentParser) -> None:
    """Declares what `import` and `fit` share."""
    parser.add_argument("--body", type=Path, help="an SMPL file to fit (default: the free body)")
    parser.add_argument(
        "--keypoints", type=Path,
        help="key points of another tool: COCO's or AlphaPose's .json, OpenPose's folder, MediaPipe's .json",
    )  # fmt: skip
    parser.add_argument(
        "--masks", type=Path,
        help="masks of another tool: a folder of pictures, SAM 2's folder, COCO's .json, a video of mattes",
    )  # fmt: skip
    parser.add_argument("--masks-person", type=int, help="the person's number where masks number several")
    parser.add_argument(
        "--occluder", type=Path,
        help="masks of what stands before the person (default: found where the mask ends inside of the body)",
    )  # fmt: skip
    parser.add_argument(
        "--no-occluder", action="store_true", help="nothing stands before the person: look for nothing"
    )
    parser.add_argument(
        "--camera",
        type=Path,
        help="intrinsics: cameras.npz, transforms.json, COLMAP's cameras.txt, fx fy cx cy",
    )
    parser.add_argument("--every", type=int, help="take each so-manyth frame (default: at most 30 a second)")
    parser.add_argument("--frames", type=int, help="at most so many frames")
    parser.add_argument(
        "--choose", choices=("even", "sharpest", "unlike"), default="even",
        help="which --frames: evenly spread, the sharpest of each stretch, those least alike (default: even)",
    )  # fmt: skip
    parser.add_argument("--start", type=int, default=0, help="first frame (default: 0)")
    parser.add_argument("--stop", type=int, help="frame after the last (default: the end)")
    parser.add_argument(
        "--size", type=int, default=SIDE, help=f"longer side of the pictures (default: {SIDE})"
    )
    parser.add_argument(
        "--rotate", type=int, default=0, choices=(0, 90, 180, 270),
        help="turn clockwise, degrees; what other tools found is to be of the turned pictures",
    )  # fmt: skip
    parser.add_argument("--person", type=int, help="which of several people, from 1")
    parser.add_argument(
        "--focal", type=float, help="focal length in pixels of the file (default: EXIF, else a guess)"
    )
    parser.add_argument(
        "--height", type=float,
        help="of the person, metres: one camera does not tell it (default: as people most often are)",
    )  # fmt: skip
    parser.add_argument("--seed", type=int, default=0)


def choice_of(arguments: argparse.Namespace) -> Choice:
    """Returns the frames and the person that the arguments ask for.

    Raises:
        ConfigError: out of range.
    """
    if arguments.frames is not None and arguments.frames < 1:
        raise ConfigError(f"--frames {arguments.frames}: give 1 or more.")
    if arguments.height is not None and not SHORTEST <= arguments.height <= TALLEST:
        raise ConfigError(
            f"--height {arguments.height:g}: give the person's height in metres, {SHORTEST:g} to {TALLEST:g}."
        )
    if not 128 <= arguments.size <= 4096:
        raise ConfigError(f"--size {arguments.size}: give 128 to 4096 pixels.")
    return Choice(
        arguments.every, arguments.frames, arguments.start, arguments.stop, arguments.size, arguments.rotate,
        arguments.person, arguments.focal, arguments.choose,
    )  # fmt: skip


def given_of(arguments: argparse.Namespace) -> Given:
    """Returns what other tools found.

    Raises:
        ConfigError: two answers to the same question.
    """
    if arguments.occluder is not None and arguments.no_occluder:
        raise ConfigError("--occluder and --no-occluder: give one of them.")
    if arguments.camera is not None and arguments.focal is not None:
        raise ConfigError("--camera and --focal: give one of them.")
    return Given(
        arguments.keypoints, arguments.masks, arguments.occluder, arguments.camera, arguments.masks_person
    )


def run(arguments: argparse.Namespace) -> int:
    """Imports; returns 0, or 2 where the fit is not to be trusted."""
    require_free(arguments.output)
    if arguments.given is not None and len(arguments.given) > 2:
        raise ConfigError("--from takes a tool's name and its file, or the file alone.")
    begun = time.perf_counter()
    with Progress() as progress:
        given, file = given_of(arguments), None if arguments.given is None else Path(arguments.given[-1])
        if file is not None and (arguments.given[0] == KEY_POINTS_OF or is_mhr(file)):
            given, file = replace(given, keypoints=file), None
        if file is not None and arguments.height is not None:
            raise ConfigError("--height is for a fit of our own: a body of --from has a height already.")
        sources = gather(arguments.clip, choice_of(arguments), given, advance=progress)
        body = embedded_body() if arguments.body is None else load_body(arguments.body)
        if file is None:
            sources, fit = fit_sources(body, sources, arguments, progress)
        else:
            tool = arguments.given[0] if len(arguments.given) == 2 else None
            sources, fit = adopt(
                file, tool, sources, body,
                embedded=arguments.body is None, person=arguments.from_person,
            )  # fmt: skip
    return finish(arguments, sources, fit, body, begun, is_own=file is None)


def fit_sources(
    body: Body, sources: Sources, arguments: argparse.Namespace, advance: Callable[[str], None]
) -> tuple[Sources, Fit]:
    """Returns the body fitted to what was gathered, which is told apart from what stands before the person.

    Its poses are aligned with the outlines of the masks.
    """

    def fitted(seen: Sources) -> Fit:
        return fit_body(
            body, seen.points, seen.masks or None, seen.intrinsics.K, seen.seconds,
            focal_known=seen.intrinsics.known, hidden=seen.hidden, height=arguments.height,
            seed=arguments.seed, advance=advance,
        )  # fmt: skip

    fit = fitted(sources)
    if not arguments.no_occluder:
        sources, fit = told_apart(body, sources, fit, fitted)
    advance("outlines")
    return sources, aligned_with_masks(body, sources, fit)


def height_source(arguments: argparse.Namespace, *, is_own: bool) -> str:
    """Returns where the height of a body comes from, in words.

    Args:
        arguments: of the verb.
        is_own: whether the body is a fit of our own.
    """
    if not is_own:
        return "of the body that was given"
    if arguments.height is not None:
        return "as given"
    return "a guess: one camera does not tell how large a person is (--height)"


def finish(
    arguments: argparse.Namespace, sources: Sources, fit: Fit, body: Body, begun: float, *, is_own: bool
) -> int:
    """Writes the folder, prints the report, checks the folder, and prints the command that trains on it.

    Poses are mended by colours on the way, where that is asked of a fit of our own or of another tool's body.
    """
    output = arguments.output
    facts = {
        "clip": sources.clip.path.name,
        "size": list(sources.shot.size),
        "body": "free body" if arguments.body is None else arguments.body.name,
        "height_source": height_source(arguments, is_own=is_own),
        "seconds": round(time.perf_counter() - begun, 1),
    }
    is_asked = {"auto": is_own, "on": True, "off": False}[arguments.mending]

    def mend(folder: Path) -> tuple[Fit, dict[str, Any]]:
        print("import: poses are mended by colours", file=sys.stderr, flush=True)
        words = training_overrides(
            folder, arguments.body, covered_share(fit.quality), numbered=sources.hidden is not None
        )
        found, told = mended_by_colour(body, sources, fit, folder, words, arguments.seed)
        return found, {**told, "seconds": round(time.perf_counter() - begun, 1)}

    fit = write_folder(
        output,
        sources,
        fit,
        body,
        embedded=arguments.body is None,
        facts=facts,
        mend=mend if is_asked and fit.quality.trusted else None,
    )
    print(said(output))
    print(f"overlay            {output / 'overlay.mp4'}, {output / 'overlay.png'}")
    words = [str(output), "--layout", "video", "--overlay", str(output / "check.png")]
    parser = argparse.ArgumentParser()
    check.add_arguments(parser)
    words += [] if arguments.body is None else ["--body", str(arguments.body)]
    words += [] if sources.hidden is None else ["--person", str(PERSON)]
    failed = check.run(parser.parse_args(words))
    if not fit.quality.trusted:
        print(
            "The fit is NOT trusted: the body does not lie on the person. Look at the overlay; the body of another "
            "tool (--from), the true focal length (--focal) or a part of the clip (--start, --stop) may help."
        )
        return NOT_TRUSTED
    if failed:
        return failed
    command = training_command(
        output,
        len(sources.shot),
        arguments.body,
        covered_share(fit.quality),
        picture_size(sources, TRAINED_HEIGHT, TRAINED_SIZE),
        numbered=sources.hidden is not None,
    )
    print(f"\nTrain on it; the last fifth of the frames is held out:\n\n{command}")
    return 0


class Progress:
    """One line that says how far an import is; nothing where the output is no terminal."""

    def __init__(self) -> None:
        self._status = Console().status("reading")
        self._counts: dict[str, int] = {}

    def __enter__(self) -> Progress:
        """Starts the line."""
        self._status.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        """Takes the line away."""
        self._status.__exit__(None, None, None)

    def __call__(self, stage: str) -> None:
        """Counts one step of a stage."""
        self._counts[stage] = self._counts.get(stage, 0) + 1
        self._status.update(f"{stage} {self._counts[stage]}")
