"""Poses of a clip mended by its colours: a short training whose corrections are kept, and nothing else of it."""

from __future__ import annotations

import lightning as L

from occfusion.human.kernels import compile_meanwhile
from occfusion.human.pose_spline import PoseSpline
from occfusion.run.environment import quiet_lightning
from occfusion.run.folder import at_work
from occfusion.run.prepare import build, claim, decide, make_renderer, observe
from occfusion.settings.schema import Settings


def learned_corrections(settings: Settings) -> PoseSpline | None:
    """Trains, and returns the corrections of the poses that came of it; None where outlines say that poses fit.

    Args:
        settings: with a stage that trains an avatar; its run folder is written to.

    Raises:
        OccfusionError: anything that the user can mend.
        Interrupted: a signal stopped it.
    """
    quiet_lightning()
    L.seed_everything(settings.seed, verbose=False)
    compile_meanwhile(make_renderer(settings))
    observed = observe(settings)
    plan = decide(settings, observed)
    if not plan.settings.optim.pose_knots:
        return None
    folder = claim(settings, observed, plan, folder_chosen_by_user=True)
    with at_work(folder):
        return build(settings, observed, plan, folder).run_stages().pose_spline
