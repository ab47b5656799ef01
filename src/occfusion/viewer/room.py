"""The empty page of `view`: whoever opens it before the avatar is read sees a floor from the right place."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from viser import ViserServer

UNITS = 10.0
"""Of the scene in a metre: viser keeps covariances in half precision, which square millimetres are too small for."""
EYE = (0.0, 1.1, 3.2)
"""Where visitors' cameras begin, upright frame, metres."""
FLOOR = "/floor"
"""Name of the grid that people stand on."""
FLOOR_SIDE, FLOOR_CELL = 4.0, 0.25
"""Metres."""
BACKGROUND = (20, 20, 20)
"""What viser's dark pages have behind the scene, 8-bit RGB."""
_TARGET = (0.0, 0.95, 0.0)
_FIELD_OF_VIEW = math.radians(40)


def furnish(server: ViserServer) -> None:
    """Puts up the floor and the camera."""
    server.gui.configure_theme(dark_mode=True, show_share_button=False)
    server.scene.set_up_direction("+y")
    side = FLOOR_SIDE * UNITS
    server.scene.add_grid(FLOOR, width=side, height=side, plane="xz", cell_size=FLOOR_CELL * UNITS)
    camera = server.initial_camera
    camera.up, camera.fov = (0.0, 1.0, 0.0), _FIELD_OF_VIEW
    camera.look_at, camera.position = (tuple(UNITS * x for x in place) for place in (_TARGET, EYE))
