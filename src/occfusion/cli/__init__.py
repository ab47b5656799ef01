"""Command line: one file a verb, each with `add_arguments` and `run`."""

from occfusion.cpu.threads import share_cores

share_cores()  # before any verb imports torch
