"""`python -m occfusion fit`: a body for key points and masks that are there already."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from occfusion.cli import import_clip
from occfusion.cli.import_clip import NOT_TRUSTED, Progress, choice_of, fit_sources, given_of, height_source
from occfusion.errors import ConfigError
from occfusion.human import embedded_body, load_body
from occfusion.importing.folder import FIT_REPORT, said, write_bodies
from occfusion.importing.sources import gather

POSES = "poses.npz"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of the verb."""
    parser.add_argument(
        "clip", type=Path, nargs="?", metavar="CLIP",
        help="a folder with images/, and masks/ and cameras.npz where it has them; or a clip (default: the masks)",
    )  # fmt: skip
    parser.add_argument("--output", type=Path, help="where the poses go (default: into the folder)")
    import_clip.add_choice(parser)


def run(arguments: argparse.Namespace) -> int:
    """Fits; returns 0, or 2 where the fit is not to be trusted."""
    begun, given, clip = time.perf_counter(), given_of(arguments), arguments.clip
    folder = clip if clip is not None and (clip / "images").is_dir() else None
    if folder is not None:
        clip = folder / "images"
        given = given.beside(folder, camera=arguments.focal is None)
    elif clip is None:
        if given.masks is None:
            raise ConfigError("fit: give a clip or a folder, or --masks beside --keypoints.")
        clip = given.masks
    output = arguments.output or folder
    if output is None:
        raise ConfigError("fit: say with --output where the poses go.")
    if (output / POSES).exists() and not (output / FIT_REPORT).exists():
        raise ConfigError(
            f"{output / POSES}: is there already and not of a fit; name another place (--output)."
        )
    chosen = (arguments.every, arguments.frames, arguments.start, arguments.stop)
    if output == folder and chosen != (None, None, 0, None):
        raise ConfigError(
            "fit: poses in the folder are one for each picture; for some of them, give --output."
        )
    body = embedded_body() if arguments.body is None else load_body(arguments.body)
    with Progress() as progress:
        sources = gather(clip, choice_of(arguments), given, trimmed=False, advance=progress)
        sources, fit = fit_sources(body, sources, arguments, progress)
    facts = {
        "clip": clip.name,
        "height_source": height_source(arguments, is_own=True),
        "seconds": round(time.perf_counter() - begun, 1),
    }
    write_bodies(output, sources, fit, body, embedded=arguments.body is None, facts=facts)
    print(said(output, "fit.txt"))
    print(f"written            {output / POSES}, {output / 'overlay.mp4'}")
    return 0 if fit.quality.trusted else NOT_TRUSTED
