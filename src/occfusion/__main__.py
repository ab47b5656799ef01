"""`python -m occfusion VERB`: everything but training."""

from __future__ import annotations

import argparse
import importlib
import sys
from types import ModuleType

from occfusion.errors import OccfusionError

VERBS = {
    "synth": "write an embedded scene to disk in ZJU-MoCap's layout",
    "check": "inspect a data folder: what is there, what is wrong with it, what to do",
    "convert-body": "write a body of SMPL's family, as it was downloaded, into a safe file, once",
    "render": "render a trained run along a path of cameras",
    "report": "finished runs side by side: curves, tables, pictures, as an HTML page and Markdown",
    "bench": "speed and error of the rasteriser and of the parts of a training step",
}


def main(arguments: list[str] | None = None) -> int:
    """Runs one verb; returns the process's exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    parser = argparse.ArgumentParser(prog="occfusion", description=__doc__)
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    for name, text in VERBS.items():
        sub = verbs.add_parser(name, help=text, description=text)
        # a verb's module is imported only when that verb is asked for
        if arguments[:1] == [name]:
            _module(name).add_arguments(sub)
    parsed = parser.parse_args(arguments)
    try:
        return int(_module(parsed.verb).run(parsed))
    except OccfusionError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130


def _module(verb: str) -> ModuleType:
    return importlib.import_module(f"occfusion.cli.{verb.replace('-', '_')}")


if __name__ == "__main__":
    sys.exit(main())
