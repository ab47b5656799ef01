"""What the verb measures, in full and with `--quick`."""

from __future__ import annotations

from dataclasses import dataclass

from occfusion.bench.scenes import SceneSize
from occfusion.splat import Limits

PARTS = ("speed", "accuracy", "precision", "scaling", "step")


@dataclass(frozen=True)
class ProfiledRun:
    """A training whose steps are profiled.

    Attributes:
        sizes: of the pictures, pixels; a training for each.
        frames: of the scene.
        gaussians: of the avatar.
        rounds: blocks of steps with probes, and as many without.
        block: steps of a block.
        scene: an embedded one, partly hidden; none of those that are held out.
    """

    sizes: tuple[int, ...] = (256, 512)
    frames: int = 24
    gaussians: int = 15_000
    rounds: int = 4
    block: int = 16
    scene: str = "003-hard"


@dataclass(frozen=True)
class BenchPlan:
    """Sizes and time.

    Attributes:
        speed: scenes on which contestants race.
        accuracy: scenes on which they meet the dense float64 reference.
        precision: the scene of the work-precision picture.
        scaling: scenes along each axis, by axis.
        step: Gaussians and picture side of the training step.
        run: the training whose steps are profiled.
        seconds: wall time for each call that is timed, at most.
        least_rounds: repetitions of each call even when that takes longer.
    """

    speed: tuple[SceneSize, ...]
    accuracy: tuple[SceneSize, ...]
    precision: SceneSize
    scaling: dict[str, tuple[SceneSize, ...]]
    step: tuple[int, int]
    run: ProfiledRun
    seconds: float
    least_rounds: int


FULL = BenchPlan(
    speed=(
        SceneSize(6890, 512),
        SceneSize(6890, 512, sh_degree=0),
        SceneSize(50_000, 512),
        SceneSize(6890, 1024),
    ),
    accuracy=(SceneSize(2000, 128), SceneSize(2000, 128, footprint=4.0), SceneSize(6890, 512)),
    precision=SceneSize(2000, 128),
    scaling={
        "gaussians": tuple(SceneSize(n, 512) for n in (2000, 6890, 20_000, 50_000, 200_000)),
        "size": tuple(SceneSize(6890, side) for side in (256, 512, 1024, 2048)),
        "footprint": tuple(SceneSize(6890, 512, footprint) for footprint in (0.5, 1.0, 2.0, 4.0)),
    },
    step=(6890, 512),
    run=ProfiledRun(),
    seconds=2.0,
    least_rounds=3,
)
QUICK = BenchPlan(
    speed=(SceneSize(500, 64),),
    accuracy=(SceneSize(300, 32),),
    precision=SceneSize(200, 24),
    scaling={
        "gaussians": (SceneSize(200, 64), SceneSize(500, 64)),
        "size": (SceneSize(300, 32), SceneSize(300, 64)),
        "footprint": (SceneSize(300, 64, 0.5), SceneSize(300, 64, 2.0)),
    },
    step=(500, 64),
    run=ProfiledRun((96,), 6, 0, rounds=1, block=2),
    seconds=0.0,
    least_rounds=1,
)

NO_CUTS = Limits(alpha_min=1e-9, stop=0.0)
"""What the work-precision picture takes as the truth: every splat blended, however faint."""
KNOBS: dict[str, tuple[tuple[str, Limits], ...]] = {
    "alpha floor": tuple((f"1/{d}", Limits(alpha_min=1 / d)) for d in (32, 100, 255, 1000, 10_000)),
    "transmittance stop": tuple((f"{s:g}", Limits(stop=s)) for s in (3e-2, 1e-2, 1e-3, 1e-4, 1e-6)),
    "both": tuple(
        (f"1/{d}, {s:g}", Limits(alpha_min=1 / d, stop=s))
        for d, s in ((64, 1e-2), (2550, 1e-5), (100_000, 1e-7))
    ),
}
"""The cut-offs that trade exactness for time; the defaults are a floor of 1/255 and a stop at 1e-4."""
TILE_KNOB = "tile"
TILES = (4, 8, 16, 32)
"""Edges in pixels of the `torch` backend's tiles: they trade time for time, the picture stays as it is."""
