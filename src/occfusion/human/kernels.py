"""The compiled kernels of a training: made ready before its clock starts, or by a second process before that."""

from __future__ import annotations

from occfusion.human.rendering import Renderer

PROGRAM = """
from occfusion.human.kernels import compile_kernels
from occfusion.human.rendering import Renderer
compile_kernels(Renderer("numba"))
from occfusion.perceptual import surround
surround.warm_up()  # of figures, the first of which are asked for within a second of the first step
"""


def compile_kernels(renderer: Renderer) -> None:
    """Compiles what the steps of a training call, or loads it from the cache; waits for a second process at it."""
    # numba is loaded where it is used
    from occfusion.geometry import rotation_kernels, skinning_kernels

    if renderer.backend != "numba":
        renderer.warm_up()
        for module in (rotation_kernels, skinning_kernels):  # joints are posed on the host for all devices
            module.warm_up()
        return
    from occfusion.geometry import box_kernels
    from occfusion.human import carry_kernels, color_kernels, surface_bounds_kernels
    from occfusion.quality import fused
    from occfusion.splat.backends.numba import ahead

    ahead.wait()
    renderer.warm_up()
    of_gaussians, of_joints = (
        (carry_kernels, color_kernels, surface_bounds_kernels),
        (rotation_kernels, skinning_kernels),
    )
    for module in (fused, *of_gaussians, *of_joints, box_kernels):
        module.warm_up()


def compile_meanwhile(renderer: Renderer) -> None:
    """Starts a second process that compiles the kernels, where nothing is cached and there is a core for it.

    On a machine's first run that takes half a minute, while the data are read and looked at.
    """
    if renderer.backend == "numba":
        from occfusion.splat.backends.numba import ahead

        ahead.start(PROGRAM)
