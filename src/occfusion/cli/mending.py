"""What `import` does with colours: a short training on all frames, of which the corrections of the poses are kept."""

from __future__ import annotations

import io
import sys
import tempfile
from collections.abc import Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from occfusion.errors import OccfusionError
from occfusion.fitting.pipeline import Fit
from occfusion.fitting.solver import Solution
from occfusion.human import Body
from occfusion.importing.aligning import moved
from occfusion.importing.folder import override, picture_size
from occfusion.importing.sources import Sources

INTERRUPTED = 130
"""The exit code that says SIGINT."""
FEWEST_FRAMES = 8
"""Fewer tell a wrong pose from another look by chance."""
STEPS, FEWEST_STEPS = 20, 600
"""Of training, for each frame, and at least."""
HEIGHT = 80
"""Pixels that a person is high in the pictures that are trained on: more mend no better (experiment 061)."""
KNOTS = 2
"""Frames from one knot of the corrections to the next."""
SMALLEST = 96
"""Pixels of the longer side of those pictures, at least."""
LOST = 0.01
"""Of the overlap of body and mask: corrections that cost more are not taken."""
OVERRIDES = (
    # visible pixels alone: what is hidden says nothing of a pose
    "variant=A", "stage=optim", "optim.lambda_lpips=0", "optim.gaussians=0",
    # corrections begin at nothing, since the fit is aligned with outlines, and free of the reach that these would give
    "optim.align_poses=false", "optim.refine_pose=false", "optim.learn_skinning=false", f"optim.pose_knots={KNOTS}",
    # fast at first, and dying away: at one rate corrections keep trembling, and the avatar is blurred by it
    "optim.rates.pose_turns=3e-3", "optim.rates.pose_places=6e-4", "optim.rates_at_end=0.01",
    "evaluation.curve=false", "evaluation.perceptual=false", "logger=csv",
)  # fmt: skip


def mended_by_colour(
    body: Body, sources: Sources, fit: Fit, folder: Path, overrides: Sequence[str], seed: int
) -> tuple[Fit, dict[str, Any]]:
    """Returns a fit with its poses where one look of the person explains all pictures best, and what became of it.

    Outlines tell nothing of what lies within them. An avatar that is trained on all frames has one colour at a place
    of the body; poses that disagree on where that place is are moved until they do not.

    Args:
        body: that was fitted.
        sources: what it was fitted to.
        fit: the body.
        folder: of the pictures, masks and poses.
        overrides: that name the folder to training.
        seed: of the training.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed while it trained.
        SystemExit: another signal stopped it.
    """
    count = len(sources.shot)
    if count < FEWEST_FRAMES:
        return fit, _told(False, f"{count} frames are too few to mend poses by")
    from hydra import compose, initialize_config_dir

    from occfusion.cli.train import find_config_dir
    from occfusion.run.mending import learned_corrections
    from occfusion.settings.schema import load_settings
    from occfusion.stages.interruption import Interrupted

    with (
        tempfile.TemporaryDirectory(prefix=".mending-", dir=folder.parent) as place,
        initialize_config_dir(str(find_config_dir()), version_base="1.3"),
    ):
        words = [
            *overrides, *OVERRIDES, f"dataset.image_size={picture_size(sources, HEIGHT, SMALLEST)}", f"seed={seed}",
            f"optim.steps={max(FEWEST_STEPS, STEPS * count)}", override("output_dir", f"{place}/run"),
            override("shared_dir", f"{place}/shared"),
            # every frame is learned from; one must be held out, and is not looked at
            "dataset.test_cameras=[0]", f"dataset.train_frames=[0,{count},1]",
            f"dataset.test_frames=[{count - 1},{count},1]",
        ]  # fmt: skip
        settings = load_settings(compose("config", words))
        try:
            with redirect_stdout(io.StringIO()):  # the plan of a training that nobody asked for
                spline = learned_corrections(settings)
        except Interrupted as error:  # nothing is there yet that the same command could continue
            if error.exit_code == INTERRUPTED:
                raise KeyboardInterrupt from None
            sys.exit(error.exit_code)
        except OccfusionError as error:
            return fit, _told(False, f"poses are not mended: {error}")
    if spline is None:
        return fit, _told(False, "poses fit the masks, nothing is mended")
    found = moved(body, sources, fit, spline.cpu().requires_grad_(False), range(count))
    before, after = (float(np.nanmedian(one.quality.iou)) for one in (fit, found))
    turn, place_off = _moved_by(fit.solution, found.solution)
    said = f"{turn:.1f} degrees a joint, {1e3 * place_off:.0f} mm of place (mean)"
    if after < before - LOST:
        return fit, _told(
            False, f"poses would move by {said}, but off the masks (IoU {before:.3f} to {after:.3f})"
        )
    return found, _told(True, f"poses mended by {said}", degrees=turn, metres=place_off)


def _moved_by(before: Solution, after: Solution) -> tuple[float, float]:
    """Returns the mean turn of a joint, degrees, and the mean shift, metres."""
    first, second = (
        Rotation.from_rotvec(np.concatenate([one.global_orient, one.body_pose], axis=1).reshape(-1, 3))
        for one in (before, after)
    )
    turn = np.degrees((first.inv() * second).magnitude()).mean()
    return float(turn), float(np.linalg.norm(after.transl - before.transl, axis=1).mean())


def _told(is_taken: bool, said: str, **figures: float) -> dict[str, Any]:
    return {"mended_by_colour": {"taken": is_taken, "said": said, **figures}}
