"""The optional part of MuJoCo that fits parameters."""

from __future__ import annotations

from importlib import import_module
from typing import Any


def load() -> Any:
    """Return `mujoco.sysid`; exit with what to install where its requirements are missing.

    MuJoCo 4.0 imports without a word, and without any of its names, when one of them is missing.
    """
    sysid: Any = import_module("mujoco.sysid")
    if not hasattr(sysid, "SignalType"):
        raise SystemExit("mujoco.sysid lacks what it imports: pip install 'mujoco[sysid]'")
    return sysid
