"""The scene in the browser: arm, floor, obstacles, the way of the arm's end, and the controls."""

from __future__ import annotations

import io
import threading
import time
from contextlib import AbstractContextManager, redirect_stdout
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import viser
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hil.arm import Arm, reach
from hil.cell import Cell
from identification.excitation import Workspace
from planner import Trajectory

Array = NDArray[np.float64]


def quaternion(rotation: Array) -> Array:
    """Return the quaternion (w, x, y, z) of a rotation matrix (3, 3)."""
    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return np.array([w, x, y, z])


@dataclass
class Playback:
    """A clock that runs around from the end of a motion to its beginning.

    Attributes:
        duration: of the motion [s].
        time: where it stands [s].
        speed: seconds of the motion in a second.
        playing: whether the clock runs.
        pause: how long the end is shown before it begins again [s].
    """

    duration: float
    time: float = 0.0
    speed: float = 1.0
    playing: bool = True
    pause: float = 1.0
    _rested: float = 0.0

    def advance(self, seconds: float) -> None:
        """Let so much real time pass [s]."""
        if not self.playing:
            return
        if self.time >= self.duration:
            self._rested += seconds
            if self._rested >= self.pause:
                self.seek(0.0)
            return
        self.time = min(self.time + seconds * self.speed, self.duration)

    def seek(self, time: float) -> None:
        """Go to a time, the nearest there is [s]."""
        self.time = min(max(time, 0.0), self.duration)
        self._rested = 0.0


_RATE = 30.0
"""Pictures a second."""
_STEP = 0.02
"""s between two points of the way that is drawn, and between two stops of the slider."""
_ARM, _LAST, _BASE = (224, 122, 40), (70, 80, 92), (130, 130, 130)
_FLOOR, _RULE, _OBSTACLE, _WAY = (238, 236, 230), (150,) * 3, (190, 175, 140), (0, 114, 178)
_OBSTACLE_OPACITY = 0.55
_FIELD_OF_VIEW = float(np.radians(45.0))


def _silently() -> AbstractContextManager[object]:
    """Keep viser's greetings from standard output, which is the caller's."""
    return redirect_stdout(io.StringIO())


class _Server(viser.ViserServer):  # type: ignore[misc]
    """A server that never opens a way into it from outside, whoever asks in the browser."""

    def request_share_url(self, verbose: bool = True) -> None:  # noqa: ARG002
        return None


class View:
    """A page in the browser on which an arm moves. Ends with `close` or as a context.

    Args:
        arm: its bodies.
        trajectory: what it does.
        cell: its name, and what stands around it.
        host, port: where the page is served.
    """

    def __init__(
        self, arm: Arm, trajectory: Trajectory, cell: Cell, *, host: str, port: int
    ) -> None:
        self._arm, self._trajectory = arm, trajectory
        self.playback = Playback(trajectory.duration)
        self._lock = threading.Lock()  # the controls call from threads of their own
        with _silently():
            self._server = _Server(host=host, port=port, label=cell.name, verbose=False)
        self.address = f"http://{host}:{self._server.get_port()}"
        self._server.gui.configure_theme(show_logo=False, show_share_button=False)
        steps = int(np.ceil(trajectory.duration / _STEP))
        times = np.linspace(0.0, trajectory.duration, steps + 1)
        q = trajectory.sample(times)[0]
        low, high = reach(arm.corners(q))
        self._surroundings(cell.workspace, low, high)
        self._camera(low, high)
        self._way(arm.tips(q))
        self._frames = self._bodies()
        self._controls()
        self._draw()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def run(self) -> None:
        """Play until Ctrl-C."""
        before = time.monotonic()
        try:
            while True:
                time.sleep(1.0 / _RATE)
                now = time.monotonic()
                self.advance(now - before)
                before = now
        except KeyboardInterrupt:
            return

    def advance(self, seconds: float) -> None:
        """Let so much time pass [s]."""
        with self._lock:
            self.playback.advance(seconds)
            moves = self.playback.playing
        if moves:
            self._draw()

    def close(self) -> None:
        """End the page's server."""
        with _silently():
            self._server.stop()

    def _draw(self) -> None:
        at = self.playback.time
        rotations, translations = self._arm.poses(self._trajectory.sample(np.array([at]))[0])
        with self._server.atomic():
            for k, frame in enumerate(self._frames):
                frame.wxyz = quaternion(rotations[k + 1, 0])
                frame.position = translations[k + 1, 0]
            self._slider.value = round(at, 3)

    def _bodies(self) -> list[Any]:
        """Add the bodies, each below the frame of its joint; return the frames."""
        scene = self._server.scene
        n = self._arm.chain.n_joints
        frames = [scene.add_frame(f"/arm/{k}", show_axes=False) for k in range(n)]
        for k, solid in enumerate(self._arm.solids):
            parent = "/arm/base" if solid.joint < 0 else f"/arm/{solid.joint}"
            colour = _BASE if solid.joint < 0 else _LAST if solid.joint == n - 1 else _ARM
            scene.add_mesh_simple(
                f"{parent}/body_{k}",
                solid.vertices,
                solid.faces,
                color=colour,
                flat_shading=True,
            )
        return frames

    def _surroundings(self, workspace: Workspace, low: Array, high: Array) -> None:
        scene = self._server.scene
        size = 2.0 * float(np.max(np.abs([low[:2], high[:2]]))) + 2.0
        if workspace.floor is not None:
            scene.add_grid(
                "/floor",
                width=size,
                height=size,
                cell_size=0.1,
                section_size=1.0,
                section_color=_RULE,
                plane_color=_FLOOR,
                plane_opacity=1.0,
                position=(0.0, 0.0, workspace.floor - 1e-3),
            )
        for k, box in enumerate(workspace.boxes):
            lower, upper = np.array(box.lower), np.array(box.upper)
            scene.add_box(
                f"/obstacles/box_{k}",
                color=_OBSTACLE,
                dimensions=tuple(upper - lower),
                opacity=_OBSTACLE_OPACITY,
                position=tuple((lower + upper) / 2.0),
            )
        for k, wall in enumerate(workspace.walls):
            normal = np.array(wall.normal) / np.linalg.norm(wall.normal)
            across = np.linalg.svd(normal[None])[2][1:]
            scene.add_box(
                f"/obstacles/wall_{k}",
                color=_OBSTACLE,
                dimensions=(1e-3, size, size),
                opacity=_OBSTACLE_OPACITY,
                position=tuple(normal * wall.offset),
                wxyz=quaternion(np.column_stack((normal, across[0], np.cross(normal, across[0])))),
            )

    def _camera(self, low: Array, high: Array) -> None:
        middle = (low + high) / 2.0
        away = float(np.linalg.norm(high - low))
        camera = self._server.initial_camera
        camera.look_at = tuple(middle)
        camera.fov = _FIELD_OF_VIEW
        camera.position = tuple(middle + away * np.array([0.65, -0.9, 0.4]))

    def _way(self, tips: Array) -> None:
        self._line = self._server.scene.add_line_segments(
            "/way",
            np.stack((tips[:-1], tips[1:]), axis=1),
            colors=_WAY,
            thickness=2.0,
            thickness_units="screen",
        )

    def _controls(self) -> None:
        gui, playback = self._server.gui, self.playback
        gui.add_button("Play / pause").on_click(self._toggle)
        self._slider = gui.add_slider(
            "time [s]",
            min=0.0,
            max=max(round(playback.duration, 3), _STEP),
            step=0.001,
            initial_value=0.0,
        )
        self._speed = gui.add_slider("speed", min=0.1, max=2.0, step=0.1, initial_value=1.0)
        self._way_shown = gui.add_checkbox("path of the end", initial_value=True)
        self._slider.on_update(self._pulled)
        self._speed.on_update(self._paced)
        self._way_shown.on_update(self._show_way)

    def _toggle(self, _event: Any) -> None:
        with self._lock:
            self.playback.playing = not self.playback.playing

    def _pulled(self, event: Any) -> None:
        if event.client is None:  # set by the clock, not by a person
            return
        with self._lock:
            self.playback.playing = False
            self.playback.seek(float(self._slider.value))
        self._draw()

    def _paced(self, _event: Any) -> None:
        with self._lock:
            self.playback.speed = float(self._speed.value)

    def _show_way(self, _event: Any) -> None:
        self._line.visible = self._way_shown.value
