"""URDFs of the arms that benchmarks simulate and time."""

from __future__ import annotations

import importlib.metadata
from pathlib import Path
from typing import Final

from sim_fixtures.ns16 import URDF_PATH

ARMS: Final[dict[str, str | Path]] = {
    "ns16": URDF_PATH,
    "ur10": "ur_description/urdf/ur10_robot.urdf",
    "panda": "panda_description/urdf/panda.urdf",
}
"""Files by arm; those of example-robot-data by their path in it."""


def urdf(where: str | Path) -> Path:
    """A file of ours, or one of the package example-robot-data.

    Raises:
        SystemExit: the package is not installed, or has no such file.
    """
    if isinstance(where, Path):
        return where
    try:
        files = importlib.metadata.files("example-robot-data") or ()
    except importlib.metadata.PackageNotFoundError:
        files = ()
    for file in files:
        if str(file).endswith(f"robots/{where}"):
            return Path(str(file.locate()))
    raise SystemExit(f"{where} is not in the package example-robot-data; is it installed?")
