"""A motion in three dimensions, in the browser, where `viser` is installed."""

from __future__ import annotations

import io
import os
import sys
import threading
import time
import webbrowser
from contextlib import AbstractContextManager, redirect_stdout
from importlib.util import find_spec
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hil.arm import Arm, reach
from hil.cell import Cell
from hil.errors import InputError
from hil.version import install_command
from identification.excitation import Workspace
from identification.excitation.excitation import Excitation
from planner import Trajectory

Array = NDArray[np.float64]

_FIRST_PORT = 8080
"""Where it is in use, the next one that is free."""
_RATE = 30.0
"""Pictures a second."""
_STEP = 0.02
"""s between two points of the path that is drawn."""
_ARM, _LAST, _BASE = (224, 122, 40), (70, 80, 92), (130, 130, 130)
_FLOOR, _RULE, _OBSTACLE, _PATH = (238, 236, 230), (150,) * 3, (190, 175, 140), (0, 114, 178)
_OBSTACLE_OPACITY = 0.55
_FIELD_OF_VIEW = float(np.radians(45.0))


def require_viewer() -> None:
    """Refuse what could not be shown, before time is spent on it.

    Raises:
        InputError: `viser` is not installed.
    """
    if find_spec("viser") is None:
        raise InputError(
            None,
            "the 3D view needs the package viser, which is not installed",
            field="--view",
            remedy=f"install it with: {install_command('view')}",
        )


def show(
    motion: Excitation | Trajectory,
    cell: Cell,
    *,
    open_browser: bool = True,
    host: str = "127.0.0.1",
    port: int = _FIRST_PORT,
) -> View:
    """Open a view of a motion; `View.run` plays it until Ctrl-C, `View.close` ends it.

    Nothing leaves this computer: the page comes from it and is served to it alone, unless `host`
    says otherwise.

    Args:
        motion: what the arm does.
        cell: the arm, and what is around it.
        open_browser: open the page too, where there is a screen.
        host: address that the page is served on.
        port: port of the page; the next free one where it is in use.

    Raises:
        InputError: `viser` is not installed.
    """
    require_viewer()
    trajectory = motion.trajectory if isinstance(motion, Excitation) else motion
    view = View(trajectory, cell, host=host, port=port)
    # Without a screen, a browser for terminals would start.
    screen = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
    if open_browser and (screen or sys.platform != "linux"):
        webbrowser.open(view.address)
    return view


def quaternion(rotation: Array) -> Array:
    """The quaternion (w, x, y, z) of a rotation matrix (3, 3)."""
    return np.roll(Rotation.from_matrix(rotation).as_quat(), 1)


def _silently() -> AbstractContextManager[object]:
    """Drop what viser writes to standard output, which is the caller's."""
    return redirect_stdout(io.StringIO())


def _server(host: str, port: int, label: str) -> Any:
    """A server that nobody opens to the outside, whoever asks in the browser."""
    import viser  # an extra

    class Server(viser.ViserServer):  # type: ignore[misc]
        def request_share_url(self, verbose: bool = True) -> None:  # noqa: ARG002
            return None

    with _silently():
        server = Server(host=host, port=port, label=label, verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    return server


class View:
    """A page in the browser on which an arm moves. Ends with `close` or as a context.

    Args:
        trajectory: what it does.
        cell: the arm, and what is around it.
        host, port: where the page is served.

    Attributes:
        address: of the page.
        time: of the motion that is shown [s].
        playing: whether it goes on, from the end to the beginning again.
    """

    def __init__(self, trajectory: Trajectory, cell: Cell, *, host: str, port: int) -> None:
        self._arm = Arm.from_urdf(cell.urdf, mesh_folders=cell.mesh_folders)
        self._trajectory = trajectory
        self.time, self.playing = 0.0, True
        self._lock = threading.Lock()  # the controls call from threads of their own
        self._server = _server(host, port, cell.name)
        self.address = f"http://{host}:{self._server.get_port()}"
        steps = int(np.ceil(trajectory.duration / _STEP))
        q = trajectory.sample(np.linspace(0.0, trajectory.duration, steps + 1))[0]
        low, high = reach(self._arm.corners(q))
        self._add_surroundings(cell.workspace, low, high)
        self._frames = self._add_bodies()
        tips = self._arm.tips(q)
        path = self._server.scene.add_line_segments(
            "/path",
            np.stack((tips[:-1], tips[1:]), axis=1),
            colors=_PATH,
            thickness=2.0,
            thickness_units="screen",
        )
        gui = self._server.gui
        gui.add_button("Play / pause").on_click(self._toggle)
        end = max(round(trajectory.duration, 3), _STEP)
        self._slider = gui.add_slider("time [s]", min=0.0, max=end, step=0.001, initial_value=0.0)
        self._slider.on_update(self._moved)
        self._speed = gui.add_slider("speed", min=0.1, max=2.0, step=0.1, initial_value=1.0)
        shown = gui.add_checkbox("path of the end", initial_value=True)
        shown.on_update(lambda _: setattr(path, "visible", shown.value))
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
            if not self.playing:
                return
            later = self.time + seconds * float(self._speed.value)
            self.time = later % max(self._trajectory.duration, _STEP)
        self._draw()

    def close(self) -> None:
        """End the page's server."""
        with _silently():
            self._server.stop()

    def _draw(self) -> None:
        at = self.time
        rotations, translations = self._arm.poses(self._trajectory.sample(np.array([at]))[0])
        with self._server.atomic():
            for k, frame in enumerate(self._frames, 1):
                frame.wxyz = quaternion(rotations[k, 0])
                frame.position = translations[k, 0]
            self._slider.value = round(at, 3)

    def _toggle(self, _event: Any) -> None:
        with self._lock:
            self.playing = not self.playing

    def _moved(self, event: Any) -> None:
        if event.client is None:  # set by the clock, not by a person
            return
        with self._lock:
            self.playing, self.time = False, float(self._slider.value)
        self._draw()

    def _add_bodies(self) -> list[Any]:
        """Add the bodies, each below the frame of its joint; return the frames."""
        scene, n = self._server.scene, self._arm.chain.n_joints
        frames = [scene.add_frame(f"/arm/{k}", show_axes=False) for k in range(n)]
        for k, solid in enumerate(self._arm.solids):
            base = solid.joint < 0
            scene.add_mesh_simple(
                f"/arm/{'base' if base else solid.joint}/body_{k}",
                solid.vertices,
                solid.faces,
                color=_BASE if base else _LAST if solid.joint == n - 1 else _ARM,
                flat_shading=True,
            )
        return frames

    def _add_surroundings(self, workspace: Workspace, low: Array, high: Array) -> None:
        """Floor, obstacles and walls, and a camera that sees all that the arm reaches."""
        scene, camera = self._server.scene, self._server.initial_camera
        size = 2.0 * float(np.max(np.abs([low[:2], high[:2]]))) + 2.0
        obstacle: dict[str, Any] = {"color": _OBSTACLE, "opacity": _OBSTACLE_OPACITY}
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
                dimensions=tuple(upper - lower),
                position=tuple((lower + upper) / 2.0),
                **obstacle,
            )
        for k, wall in enumerate(workspace.walls):
            normal = np.array(wall.normal) / np.linalg.norm(wall.normal)
            across = np.linalg.svd(normal[None])[2][1]
            scene.add_box(
                f"/obstacles/wall_{k}",
                dimensions=(1e-3, size, size),
                position=tuple(normal * wall.offset),
                wxyz=quaternion(np.column_stack((normal, across, np.cross(normal, across)))),
                **obstacle,
            )
        away = float(np.linalg.norm(high - low))
        camera.look_at = tuple((low + high) / 2.0)
        camera.fov = _FIELD_OF_VIEW
        camera.position = tuple((low + high) / 2.0 + away * np.array([0.65, -0.9, 0.4]))
