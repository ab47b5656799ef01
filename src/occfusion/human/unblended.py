"""The same body without its pose blend shapes, for parameters that were fitted without them."""

from __future__ import annotations

from copy import copy

from occfusion.human.body import Body


def without_pose_blend_shapes(body: Body) -> Body:
    """Returns a body that shares all arrays but the pose blend shapes; the given one stays as it is."""
    plain = copy(body)
    plain._buffers = {**body._buffers, "posedirs": None}
    return plain
