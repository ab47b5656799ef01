"""Telling what stands before the person from background, and fitting once more with that known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from occfusion.fitting.occluders import found_occluders
from occfusion.fitting.pipeline import Fit
from occfusion.footage.people import ranges
from occfusion.human import Body
from occfusion.importing.sources import Sources


def told_apart(
    body: Body, sources: Sources, fit: Fit, refit: Callable[[Sources], Fit]
) -> tuple[Sources, Fit]:
    """Returns sources with what hides parts of the person, and the body fitted again with that known.

    Where `--occluder` has said it, or where nothing is found, both are returned as they are.

    Args:
        body: that was fitted.
        sources: what it was fitted to.
        fit: the first fit, which takes what is hidden for background.
        refit: fits to sources.
    """
    if sources.hidden is not None:
        return sources, fit
    hidden = found_occluders(body, fit.solution, sources.masks)
    if hidden is None:
        return sources, fit
    frames = [sources.shot.numbers[k] for k, mask in enumerate(hidden) if mask.any()]
    note = (
        f"something hides parts of the person in {len(frames)} frames ({ranges(frames)}): there the mask ends inside "
        "of the body. --occluder gives masks of it; --no-occluder takes it for background."
    )
    seen = replace(sources, hidden=hidden, notes=[*sources.notes, note])
    return seen, refit(seen)
