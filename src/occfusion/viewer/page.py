"""The page of `view`: viser's server with an avatar, its motions, joints, stages, and the input with its camera."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from occfusion.errors import OccfusionError
from occfusion.evaluation.pictures import to_uint8
from occfusion.export.mesh import JOINTS
from occfusion.geometry.rotation import matrix_to_quaternion
from occfusion.human.rendering import Renderer
from occfusion.motion import EMBEDDED_CLIPS, USUAL_FPS
from occfusion.run.loaded import stages_with_avatar
from occfusion.run.showing import SEQUENCE, inputs_of, run_names
from occfusion.show.drawing import world_to_clip
from occfusion.show.paths import still
from occfusion.show.views import TRAIN
from occfusion.viewer.figure import NEWEST, Figure, Splats
from occfusion.viewer.room import EYE, UNITS

if TYPE_CHECKING:
    from viser import ViserServer

LOOKS = ("colours", "occupancy", "ellipsoids")
INPUTS = ("input", "avatar", "difference")
FOLLOW_SECONDS = 1.0
"""Between two looks for a newer checkpoint."""
_MOST_RATE = 30.0


def names_of(folders: Sequence[Path]) -> dict[str, Path]:
    """Returns runs by what tells their paths apart."""
    return dict(zip(run_names(folders), folders, strict=True))


class Page:
    """Shows runs on a server; `step` does all the work, and what visitors do only says what is due.

    Args:
        server: that viser has started, with what `room.furnish` puts up.
        folders: of the runs, by the names that they are chosen by.
        motion: that plays first.
    """

    def __init__(self, server: ViserServer, folders: dict[str, Path], motion: str = SEQUENCE) -> None:
        self.server = server
        self._folders = folders
        self.figure = Figure(next(iter(folders.values())), motion=motion)
        self._turns = np.zeros((len(JOINTS), 3))
        self._eye = np.array(EYE)
        self._is_due = True
        self._time, self._last, self._looked = 0.0, time.monotonic(), time.monotonic()
        self._shown, self._since = 0, time.monotonic()
        self._inputs: dict[int, NDArray[np.uint8]] = {}
        self._asked: dict[int, Callable[[], None]] = {}
        self._renderer = Renderer("auto")
        self._handles: dict[str, Any] = {}
        self._watch_cameras()
        self._make_controls(motion)

    # -- what the page has -----------------------------------------------------------------------------------

    def _watch_cameras(self) -> None:
        @self.server.on_client_connect
        def _(client: Any) -> None:
            @client.camera.on_update
            def _(_: Any) -> None:
                self._eye = np.asarray(client.camera.position) / UNITS
                self._is_due |= self.figure.run.avatar.active_sh_degree > 0

    def _make_controls(self, motion: str) -> None:
        gui = self.server.gui
        self.status = gui.add_markdown("")
        self.which = gui.add_dropdown("run", tuple(self._folders), visible=len(self._folders) > 1)
        self.stage = gui.add_dropdown("stage", self._stages())
        self.look = gui.add_dropdown("show", LOOKS)
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
            self.with_input = gui.add_checkbox("training camera", False)
            self.kind = gui.add_dropdown("picture", INPUTS)
        for handle, done in (
            (self.which, self._open), (self.stage, self._open), (self.motion, self._change_motion),
            (self.joint, self._show_joint), (self.straighten, self._straighten), (self.with_input, self._due),
            (self.kind, self._due), (self.look, self._due),
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

    def _open(self) -> None:
        self.figure = Figure(self._folders[self.which.value], self.stage.value, self.motion.value)
        self._inputs.clear()
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
                self._is_due |= self.figure.reload()
                if (stages := self._stages()) != self.stage.options:
                    self.stage.options = stages
        except OccfusionError as error:
            self.status.content = f"**{error}**"
            return False
        if self.playing.value:
            self._time += now - self._last
        self._last = now
        row = int(self._time * self._rate() + 1e-6) % len(self.figure.performance)
        if not self._is_due and row == self.frame.value:
            return False
        self._is_due = False
        self._send(row)
        self._count(now)
        return True

    def _count(self, now: float) -> None:
        self._shown += 1
        if now - self._since > 1.0:
            rate = (
                f", {self._shown / (now - self._since):.0f} pictures a second" if self.playing.value else ""
            )
            self.status.content = f"{self.figure.label}{rate}"
            self._shown, self._since = 0, now

    def _send(self, row: int) -> None:
        splats = self.figure.splats(row, self._turns, self._eye)
        with self.server.atomic():
            if row != self.frame.value:
                self.frame.value = row
            (self._send_ellipsoids if self.look.value == "ellipsoids" else self._send_splats)(splats)
            self._send_input(row)
        if not self.status.content:
            self.status.content = self.figure.label

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
        """Puts the training camera where it stood, with a picture of its frame that is nearest to this one."""
        if not self.with_input.value:
            self._hide("camera")
            return
        figure = self.figure
        views = figure.run.views(TRAIN)
        number = row if figure.performance.clip.numbers is None else figure.performance.clip.numbers[row]
        near = min(range(len(views)), key=lambda k: abs((views[k].frame or 0) - number))
        camera = views[near].camera
        pose = figure.own.upright @ torch.linalg.inv(camera.viewmat)
        self._handles["camera"] = self.server.scene.add_camera_frustum(
            "/camera", 2 * math.atan(0.5 * camera.height / float(camera.K[1, 1])), camera.width / camera.height,
            scale=0.3 * UNITS, image=self._picture(near), position=(pose[:3, 3] * UNITS).numpy(),
            wxyz=matrix_to_quaternion(pose[:3, :3]).numpy(),
        )  # fmt: skip

    def _picture(self, place: int) -> NDArray[np.uint8]:
        """Returns what the training camera saw of a view, our picture of it, or how they differ."""
        run, view = self.figure.run, self.figure.run.views(TRAIN)[place]
        if place not in self._inputs:
            self._inputs[place] = next(inputs_of(run, [view], None))
        seen = self._inputs[place]
        if self.kind.value == "input":
            return seen
        own = self.figure.own
        assert own.clip.numbers is not None
        row = int(np.abs(own.clip.numbers - (view.frame or 0)).argmin())
        (shot,) = still(own, [row], [view], world_to_clip(own, own), None)
        with torch.inference_mode():
            cloud = run.avatar(own.pose(row), shot.camera.centre)
            drawn = to_uint8(self._renderer.draw(cloud, shot.camera).rgb)
        return drawn if self.kind.value == "avatar" else np.abs(drawn.astype(int) - seen).astype(np.uint8)
