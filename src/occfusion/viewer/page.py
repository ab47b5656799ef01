"""The page of `view`: viser's server with an avatar, its motions, joints, stages, and the input with its camera."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from occfusion.errors import OccfusionError
from occfusion.export.mesh import JOINTS
from occfusion.geometry.rotation import matrix_to_quaternion
from occfusion.human.rendering import Renderer
from occfusion.motion import EMBEDDED_CLIPS, USUAL_FPS
from occfusion.run.loaded import stages_with_avatar
from occfusion.run.showing import SEQUENCE, run_names
from occfusion.viewer.figure import NEWEST, Figure, Splats
from occfusion.viewer.pictures import JPEG_QUALITY, camera_of, draw
from occfusion.viewer.room import EYE, FLOOR, UNITS
from occfusion.viewer.seen import KINDS, Seen

if TYPE_CHECKING:
    from viser import ViserServer

LOOKS = ("colours", "occupancy", "ellipsoids")
BROWSER, SERVER = "browser", "server"
"""Who draws: the visitor's browser, which needs a GPU to play a motion, or this process."""
FOLLOW_SECONDS = 1.0
"""Between two looks for a newer checkpoint."""
_MOST_RATE = 30.0
_SLIDER_SECONDS = 0.25
"""Between two places of the slider while a motion plays: a browser draws its whole page anew for each."""
_FRAME = (230, 200, 90)
"""Colour of a camera's outline."""


def names_of(folders: Sequence[Path]) -> dict[str, Path]:
    """Returns runs by what tells their paths apart."""
    return dict(zip(run_names(folders), folders, strict=True))


class Page:
    """Shows runs on a server; `step` does all the work, and what visitors do only says what is due.

    Args:
        server: that viser has started, with what `room.furnish` puts up.
        folders: of the runs, by the names that they are chosen by.
        motion: that plays first.
        drawn_by: `BROWSER` or `SERVER`.
    """

    def __init__(
        self, server: ViserServer, folders: dict[str, Path], motion: str = SEQUENCE, drawn_by: str = BROWSER
    ) -> None:
        self.server = server
        self._folders = folders
        self.figure = Figure(next(iter(folders.values())), motion=motion)
        self._turns = np.zeros((len(JOINTS), 3))
        self._eye = np.array(EYE)
        self._is_due = True
        self._time, self._last, self._looked = 0.0, time.monotonic(), time.monotonic()
        self._shown, self._since = 0, time.monotonic()
        self._row, self._told = -1, 0.0
        self._seen = Seen(self.figure.run)
        self._asked: dict[int, Callable[[], None]] = {}
        self._handles: dict[str, Any] = {}
        self._renderer = Renderer("auto")
        self._has_pictures = False
        self._make_controls(motion, drawn_by)
        self._watch_cameras()

    # -- what the page has -----------------------------------------------------------------------------------

    def _watch_cameras(self) -> None:
        @self.server.on_client_connect
        def _(client: Any) -> None:
            self._is_due |= self._draws_here()

            @client.camera.on_update
            def _(_: Any) -> None:
                self._eye = np.asarray(client.camera.position) / UNITS
                self._is_due |= self._draws_here() or self.figure.run.avatar.active_sh_degree > 0

    def _make_controls(self, motion: str, drawn_by: str) -> None:
        gui = self.server.gui
        self.status = gui.add_markdown("")
        self.which = gui.add_dropdown("run", tuple(self._folders), visible=len(self._folders) > 1)
        self.stage = gui.add_dropdown("stage", self._stages())
        self.look = gui.add_dropdown("show", LOOKS)
        self.drawn_by = gui.add_dropdown("drawn by", (BROWSER, SERVER), initial_value=drawn_by)
        with gui.add_folder("motion"):
            own = () if motion in (SEQUENCE, *EMBEDDED_CLIPS) else (motion,)
            self.motion = gui.add_dropdown("motion", (*own, SEQUENCE, *EMBEDDED_CLIPS), initial_value=motion)
            self.playing = gui.add_checkbox("play", True)
            self.frame = gui.add_slider("frame", 0, max(len(self.figure.performance) - 1, 1), 1, 0)
        with gui.add_folder("joints", expand_by_default=False):
            self.joint = gui.add_dropdown("joint", JOINTS, initial_value="left_shoulder")
            self.angles = [gui.add_slider(f"turn {axis}", -180.0, 180.0, 1.0, 0.0) for axis in "xyz"]
            self.straighten = gui.add_button("as in the motion")
        with gui.add_folder("input", expand_by_default=False):
            self.with_input = gui.add_checkbox("show", False)
            self.camera = gui.add_dropdown("camera", self._seen.cameras)
            self.kind = gui.add_dropdown("picture", KINDS)
            self.beside = gui.add_image(np.zeros((8, 8, 3), np.uint8), visible=False)
            self.said = gui.add_markdown("")
        for handle, done in (
            (self.which, self._open), (self.stage, self._open), (self.motion, self._change_motion),
            (self.joint, self._show_joint), (self.straighten, self._straighten), (self.with_input, self._show_input),
            (self.kind, self._due), (self.camera, self._due), (self.look, self._due),
            (self.drawn_by, self._due),
        ):  # fmt: skip
            self._on(handle, done)
        for axis, slider in enumerate(self.angles):
            self._on(slider, partial(self._turn, axis))
        self._on(self.frame, self._seek)

    def _on(self, handle: Any, done: Callable[[], None]) -> None:
        """Keeps what a visitor asks for until the next `step`; what the page itself sets is not asked for."""

        def keep(event: Any) -> None:
            if event.client is not None:
                self._asked[id(handle)] = done

        (handle.on_click if hasattr(handle, "on_click") else handle.on_update)(keep)

    def _stages(self) -> tuple[str, ...]:
        return (NEWEST, *stages_with_avatar(self.figure.run.folder))

    # -- what visitors ask for -------------------------------------------------------------------------------

    def _due(self) -> None:
        self._is_due = True

    def _show_input(self) -> None:
        self.said.content, self._is_due = "", True

    def _open(self) -> None:
        self.figure = Figure(self._folders[self.which.value], self.stage.value, self.motion.value)
        self._seen = Seen(self.figure.run)
        if self._seen.cameras != self.camera.options:
            self.camera.options = self._seen.cameras
        self._set_length()

    def _change_motion(self) -> None:
        self.figure.play(self.motion.value)
        self._set_length()

    def _set_length(self) -> None:
        self._time, self._is_due = 0.0, True
        self.frame.max = max(len(self.figure.performance) - 1, 1)

    def _seek(self) -> None:
        self.playing.value = False
        self._time, self._is_due = self.frame.value / self._rate(), True

    def _turn(self, axis: int) -> None:
        self._turns[JOINTS.index(self.joint.value), axis] = math.radians(self.angles[axis].value)
        self._is_due = True

    def _show_joint(self) -> None:
        for slider, angle in zip(self.angles, self._turns[JOINTS.index(self.joint.value)], strict=True):
            slider.value = round(math.degrees(angle))

    def _straighten(self) -> None:
        self._turns[:] = 0.0
        self._show_joint()
        self._is_due = True

    # -- the work --------------------------------------------------------------------------------------------

    def _rate(self) -> float:
        return self.figure.performance.clip.fps or USUAL_FPS

    def run(self) -> None:
        """Works until it is interrupted."""
        while True:
            started = time.monotonic()
            self.step()
            time.sleep(max(1.0 / _MOST_RATE - (time.monotonic() - started), 0.001))

    def step(self) -> bool:
        """Does what is due; returns whether a picture was sent."""
        now = time.monotonic()
        asked, self._asked = self._asked, {}
        try:
            for done in asked.values():
                done()
            if now - self._looked > FOLLOW_SECONDS:
                self._looked = now
                # a browser that was busy with Gaussians has been seen to miss the first picture that it was sent
                self._is_due |= self.figure.reload() or self._draws_here()
                if (stages := self._stages()) != self.stage.options:
                    self.stage.options = stages
        except OccfusionError as error:
            self.status.content = f"**{error}**"
            return False
        if self.playing.value:
            self._time += now - self._last
        self._last = now
        row = int(self._time * self._rate() + 1e-6) % len(self.figure.performance)
        if not self._is_due and row == self._row:
            return False
        self._is_due = False
        self._send(row)
        self._count(now)
        return True

    def _count(self, now: float) -> None:
        self._shown += 1
        if now - self._since > 1.0:
            rate = f", {self._shown / (now - self._since):.0f} pictures a second sent"
            self.status.content = f"{self.figure.label}{rate if self.playing.value else ''}"
            self._shown, self._since = 0, now

    def _send(self, row: int) -> None:
        with self.server.atomic():
            self._row = row
            is_told = not self.playing.value or time.monotonic() - self._told > _SLIDER_SECONDS
            if row != self.frame.value and is_told:
                self.frame.value, self._told = row, time.monotonic()
            if self._draws_here():
                self._send_pictures(row)
            else:
                self._clear_pictures()
                splats = self.figure.splats(row, self._turns, self._eye)
                (self._send_ellipsoids if self.look.value == "ellipsoids" else self._send_splats)(splats)
            try:
                self._send_input(row)
            except OccfusionError as error:  # the avatar needs no data: it goes on without them
                self.with_input.value = False
                self._hide("camera")
                self.beside.visible, self.said.content = False, f"**{error}**"
        if not self.status.content:
            self.status.content = self.figure.label

    def _draws_here(self) -> bool:
        return bool(self.drawn_by.value == SERVER and self.look.value != "ellipsoids")

    def _send_pictures(self, row: int) -> None:
        """Gives each visitor a picture by its own camera, behind what the browser draws, with its depths."""
        for name in ("splats", "ellipsoids"):  # a browser without a GPU is busy with hidden ones too
            if name in self._handles:
                self._handles.pop(name).remove()
        self._has_pictures = True
        self._show_floor(False)  # it is in the pictures
        for client in self.server.get_clients().values():
            eye = np.asarray(client.camera.position) / UNITS
            cloud = self.figure.cloud(row, self._turns, eye)
            if self.look.value == "occupancy":
                cloud = replace(cloud, colors=torch.ones_like(cloud.colors))
            picture, depth = draw(cloud, self.figure, camera_of(client.camera), self._renderer)
            # depths cost a browser as much again, and only a camera's outline can stand before or behind
            depths = depth if self.with_input.value else None
            client.scene.set_background_image(picture, format="jpeg", jpeg_quality=JPEG_QUALITY, depth=depths)

    def _show_floor(self, is_shown: bool) -> None:
        handle = self.server.scene.get_handle_by_name(FLOOR)
        if handle is not None and handle.visible != is_shown:
            handle.visible = is_shown

    def _clear_pictures(self) -> None:
        if self._has_pictures:
            self._show_floor(True)
            for client in self.server.get_clients().values():
                client.scene.set_background_image(None)
        self._has_pictures = False

    def _send_splats(self, splats: Splats) -> None:
        self._hide("ellipsoids")
        colors = np.ones_like(splats.colors) if self.look.value == "occupancy" else splats.colors
        arrays = (splats.means * UNITS, splats.covariances * UNITS**2, colors, splats.opacities[:, None])
        if "splats" in self._handles:
            self._handles["splats"].set_gaussians(*arrays)
            self._handles["splats"].visible = True
        else:
            self._handles["splats"] = self.server.scene.add_gaussian_splats("/splats", *arrays)

    def _send_ellipsoids(self, splats: Splats) -> None:
        self._hide("splats")
        quats, scales = splats.ellipsoids()
        import trimesh  # with what it brings, half a second that the first picture need not wait for

        ball = trimesh.creation.icosphere(subdivisions=1)
        self._handles["ellipsoids"] = self.server.scene.add_batched_meshes_simple(
            "/ellipsoids", np.asarray(ball.vertices, np.float32), np.asarray(ball.faces, np.uint32), quats,
            splats.means * UNITS, batched_scales=scales * UNITS, lod="off", cast_shadow=False, receive_shadow=False,
            batched_colors=(255 * splats.colors).astype(np.uint8), batched_opacities=splats.opacities,
        )  # fmt: skip

    def _hide(self, name: str) -> None:
        if name in self._handles:
            self._handles[name].visible = False

    def _send_input(self, row: int) -> None:
        """Puts a camera of the data where it stood, with a picture of its frame that is nearest to this one."""
        is_shown: bool = self.with_input.value
        self.beside.visible = is_shown
        if not is_shown:
            self._hide("camera")
            return
        figure = self.figure
        number = row if figure.performance.clip.numbers is None else figure.performance.clip.numbers[row]
        view = self._seen.nearest(self.camera.value, number)
        shown = self._seen.picture(self.camera.value, view, self.kind.value, figure)
        self.beside.image, self.said.content = shown.picture, shown.text
        camera = view.camera
        pose = figure.own.upright @ torch.linalg.inv(camera.viewmat)
        self._handles["camera"] = self.server.scene.add_camera_frustum(
            "/camera", 2 * math.atan(0.5 * camera.height / float(camera.K[1, 1])), camera.width / camera.height,
            scale=0.3 * UNITS, color=_FRAME, image=shown.picture, position=(pose[:3, 3] * UNITS).numpy(),
            wxyz=matrix_to_quaternion(pose[:3, :3]).numpy(),
        )  # fmt: skip
