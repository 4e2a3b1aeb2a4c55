"""A motion in three dimensions, in the browser, where `viser` is installed."""

from __future__ import annotations

import os
import sys
import webbrowser
from importlib.util import find_spec
from typing import TYPE_CHECKING

from hil.arm import Arm
from hil.cell import Cell
from hil.errors import InputError
from hil.version import install_command
from identification.excitation.excitation import Excitation
from planner import Trajectory

if TYPE_CHECKING:
    from hil.view.scene import View

_FIRST_PORT = 8080
"""Where it is in use, the next one that is free."""


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
        cell: the arm, and what stands around it.
        open_browser: open the page too, where there is a screen.
        host: address that the page is served on.
        port: port of the page; the next free one where it is in use.

    Raises:
        InputError: `viser` is not installed.
    """
    require_viewer()
    from hil.view.scene import View

    trajectory = motion.trajectory if isinstance(motion, Excitation) else motion
    arm = Arm.from_urdf(cell.urdf, mesh_folders=cell.mesh_folders)
    view = View(arm, trajectory, cell, host=host, port=port)
    if open_browser and _has_screen():
        webbrowser.open(view.address)
    return view


def _has_screen() -> bool:
    """Whether a browser can have a window; without one, a browser for terminals would start."""
    return sys.platform != "linux" or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )
