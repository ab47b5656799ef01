"""Telling what stands before the person from background, and fitting once more with that known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from occfusion.fitting.occluders import found_occluders
from occfusion.fitting.pipeline import Fit
from occfusion.fitting.quality import covered_share
from occfusion.footage.people import ranges
from occfusion.human import Body
from occfusion.importing.sources import Sources

SUSPECT = 0.8
"""Share of the body that the masks cover, median, below which something is taken to hide it, to be looked for."""


def told_apart(
    body: Body, sources: Sources, fit: Fit, refit: Callable[[Sources], Fit]
) -> tuple[Sources, Fit]:
    """Returns sources with what hides parts of the person, and the body fitted again with that known.

    Where `--occluder` has said it, or where nothing is found, both are returned as they are.

    Args:
        body: that was fitted.
        sources: what it was fitted to.
        fit: the first fit, which takes what is hidden for background.
        refit: fits to sources; to key points alone where there are no masks.
    """
    if sources.hidden is not None:
        return sources, fit
    hidden = found_occluders(body, fit.solution, sources.masks)
    covered = covered_share(fit.quality)
    if hidden is None and (covered is None or covered > SUSPECT):
        return sources, fit
    # the first fit was pushed out of what hides the person: key points alone say where the body goes on
    free = refit(replace(sources, masks=[]))
    hidden = found_occluders(body, free.solution, sources.masks)
    if hidden is None:
        return sources, fit
    frames = [sources.shot.numbers[k] for k, mask in enumerate(hidden) if mask.any()]
    note = (
        f"something hides parts of the person in {len(frames)} frames ({ranges(frames)}): there the mask ends inside "
        "of the body. --occluder gives masks of it; --no-occluder takes it for background."
    )
    seen = replace(sources, hidden=hidden, notes=[*sources.notes, note])
    return seen, refit(seen)
