"""`occfusion VERB` and `python -m occfusion VERB`: everything there is to do."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Sequence
from types import ModuleType

from occfusion.cli.interrupts import keep_interrupts
from occfusion.cpu.loading import loading, loading_to_draw
from occfusion.errors import OccfusionError

TRAIN = "train"
"""The verb that Hydra reads the rest of the command line for, as for `python train.py`."""
VERBS = {
    TRAIN: "train an avatar: overrides as for `python train.py`",
    "synth": "write an embedded scene to disk in ZJU-MoCap's layout",
    "import": "make a data folder from a video of a person: key points, masks, camera and body",
    "fit": "a body for a clip's key points and masks, with overlay and figures",
    "check": "inspect a data folder: what is there, what is wrong with it, what to do",
    "convert-body": "write a body of SMPL's family, as it was downloaded, into a safe file, once",
    "render": "pictures of a trained avatar: any camera, any motion, several runs side by side",
    "view": "turn and move avatars on a page in the browser, also while they are trained",
    "export": "take a trained avatar away: Gaussians for viewers, a mesh, a page that plays it",
    "report": "finished runs side by side: curves, tables, pictures, as an HTML page and Markdown",
    "replay": "one kept step of a run alone, which was not finite",
    "stability": "stiff and extreme cases: errors against oracles along each axis, with bounds",
    "bench": "speed and error of the rasteriser and of the parts of a training step",
}
MODULES = {"import": "import_clip"}
"""Modules of verbs whose word is one of Python's own."""
DRAWS = "render"
"""The verb that does nothing but draw."""


def main(arguments: list[str] | None = None) -> int:
    """Runs one verb; returns the process's exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments[:1] == ["-sc"]:
        return _complete(arguments)
    keep_interrupts()
    try:
        return _train(arguments[1:]) if arguments[:1] == [TRAIN] else _run_verb(arguments)
    except OccfusionError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("stopped by SIGINT", file=sys.stderr)
        return 130


def _train(arguments: Sequence[str]) -> int:
    from occfusion.cli.train import find_config_dir
    from occfusion.cli.train import main as train

    return train(find_config_dir(), arguments)


def _complete(arguments: Sequence[str]) -> int:
    """Answers a shell that completes `occfusion …`: Hydra's rule for shells asks the program, not its verb."""
    program, _, rest = os.environ.get("COMP_LINE", "").lstrip().partition(" ")
    verb, space, overrides = rest.lstrip().partition(" ")
    if not space:
        print("\n".join(VERBS))
    elif verb == TRAIN:
        os.environ["COMP_LINE"] = f"{program} {overrides}"
        return _train(arguments)
    return 0


def _run_verb(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="occfusion", description=__doc__)
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    for name, text in VERBS.items():
        sub = verbs.add_parser(name, help=text, description=text)
        # a verb's module is imported only when that verb is asked for
        if arguments[:1] == [name]:
            if not {"-h", "--help"} & set(arguments):  # what it imports takes seconds, and says nothing
                print(f"occfusion {name}: the program is loaded", file=sys.stderr, flush=True)
            _module(name).add_arguments(sub)
    parsed = parser.parse_args(arguments)
    return int(_module(parsed.verb).run(parsed))


def _module(verb: str) -> ModuleType:
    name = f"occfusion.cli.{MODULES.get(verb, verb.replace('-', '_'))}"
    if name not in sys.modules:
        with loading_to_draw() if verb == DRAWS else loading():
            importlib.import_module(name)
    return sys.modules[name]


if __name__ == "__main__":
    sys.exit(main())
