"""`python -m occfusion convert-body SMPL_NEUTRAL.pkl smpl_neutral.npz`: reads once, through the allow-list."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from occfusion.errors import ConfigError
from occfusion.files.bodyfile import load_body_arrays, save_body_arrays

SUFFIXES = (".npz", ".safetensors")
SMPL_VERTICES = 6890


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of the verb."""
    parser.add_argument(
        "source", type=Path, metavar="IN", help="the official .pkl (Python 2, chumpy), .npz or .safetensors"
    )
    parser.add_argument("target", type=Path, metavar="OUT", help="a .npz or .safetensors file to write")
    parser.add_argument("--force", action="store_true", help="replace OUT when it exists")


def run(arguments: argparse.Namespace) -> int:
    """Converts and says what the body is; returns the exit code.

    Raises:
        ConfigError: OUT exists, or its suffix is another one.
        DataError: IN is missing, unsafe, damaged, or no body of SMPL's family.
    """
    source, target = arguments.source, arguments.target
    if target.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"{target}: name a file that ends in {' or '.join(SUFFIXES)}.")
    if target.exists() and not arguments.force:
        raise ConfigError(f"{target}: exists; name another file, or add --force to replace it.")
    body = load_body_arrays(source)
    save_body_arrays(target, body)
    vertices, shapes = len(body.v_template), body.shapedirs.shape[2]
    height = float(np.ptp(body.v_template[:, 1]))
    like = "as SMPL" if vertices == SMPL_VERTICES else f"SMPL has {SMPL_VERTICES}"
    corrective = "with" if body.posedirs is not None else "without"
    print(
        f"{source}: {vertices} vertices ({like}), {shapes} shape components, {corrective} pose blend shapes,"
    )
    print(f"template {height:.2f} m tall; nothing in the file was executed")
    print(target)
    return 0
