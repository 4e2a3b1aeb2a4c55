"""Digests: of programs, arms, settings, and of what is kept under them."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import asdict
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import drivers
import hil
import identification
from hil.cell import Cell
from hil.identify.options import Options
from hil.identify.settings import Settings

from .types import ArchiveRef

# What stands between the bytes of an archive and all that is kept of it.
_PROGRAMS: Final = (
    (drivers, ("*.py",)),
    (identification, ("*.py",)),
    (hil, ("recordings.py", "archive/*.py", "cell/*.py", "identify/sources.py")),
    (hil, ("identify/deciding.py", "identify/options.py", "identify/settings.py")),
    (hil, ("importers/findings.py",)),
    (hil, ("batch/examining.py", "batch/factors.py", "batch/settling.py", "batch/kept_forms.py")),
    (hil, ("batch/keys.py", "batch/setup.py")),
)
_LIBRARIES: Final = ("numpy", "scipy", "pin")


@cache
def code_digest() -> str:
    """Digest of the programs that examine and reduce archives, and of the libraries they use.

    The programs' own text is read, so that a change counts even where nobody has raised a version.
    """
    found = hashlib.sha256()
    for package, patterns in _PROGRAMS:
        root = Path(os.fspath(package.__path__[0]))
        for path in sorted({path for pattern in patterns for path in root.glob(pattern)}):
            found.update(f"{package.__name__}/{path.relative_to(root).as_posix()}\0".encode())
            found.update(hashlib.sha256(path.read_bytes()).digest())
    for name in _LIBRARIES:
        found.update(f"{name} {version(name)}\0".encode())
    return found.hexdigest()


def arm_digest(cell: Cell, drive_train: bytes | None, *, simulated: bool = False) -> str:
    """Digest of what makes a robot the same one: links, joints, friction law, drives.

    Not of a payload or a delay (see :mod:`hil.batch.examining`): an arm with another payload is the
    same arm.

    Args:
        cell: as it travels in the archive.
        drive_train: the drive train in force, if the archive has one.
        simulated: whether it is no arm, but a model of one.
    """
    drives = cell.file.drive_train
    return _digest(
        {
            "urdf": hashlib.sha256(cell.urdf.encode()).hexdigest(),
            "simulated": simulated,
            "robot": cell.file.robot.model_dump(mode="json", exclude={"payload"}),
            "drives": drives.model_dump(mode="json") if drives is not None else None,
            "in force": None if drive_train is None else hashlib.sha256(drive_train).hexdigest(),
        }
    )


def belief_digest(cell: Cell) -> str:
    """Digest of what the maker's figures are, "" without any; the URDF counts to the arm."""
    nominal = cell.file.nominal
    return "" if nominal is None else _digest(nominal.model_dump(mode="json"))


def settings_digest(settings: Settings) -> str:
    """Digest of all that, beside its bytes, decides about the factor of an archive."""
    entries = asdict(settings)
    for later in ("shrinkage", "choices"):  # of the estimate
        del entries[later]
    return _digest([entries, code_digest()])


def decision_digest(options: Options, arms: Settings | None, refs: Sequence[ArchiveRef]) -> str:
    """Digest of what settings are settled from: options or the arm's settings, archives, programs.

    Of the estimators only the automatic one asks anything.
    """
    asked = asdict(options) | {"estimator": options.estimator == "auto"}
    known = None if arms is None else asdict(arms)
    return _digest([asked, known, [ref.sha256 for ref in refs], code_digest()])


def summary_key(ref: ArchiveRef, settings: str) -> str:
    """Name under which the summary of an archive is kept; settings by their digest."""
    return _digest(["summary", ref.sha256, settings])


def sum_key(refs: Sequence[ArchiveRef], settings: str) -> str:
    """Name under which the sum over archives, added from first to last, is kept."""
    return _digest(["sum", [ref.sha256 for ref in refs], settings])


def text_digest(*texts: str | bytes) -> str:
    """Digest of some texts, one after the other."""
    found = hashlib.sha256()
    for text in texts:
        data = text.encode() if isinstance(text, str) else text
        found.update(len(data).to_bytes(8, "little") + data)
    return found.hexdigest()


def _digest(value: Any) -> str:
    text = json.dumps(value, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
