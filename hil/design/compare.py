"""Earlier designs to draw beside a new one, as far as their numbers can be compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hil.cell import Cell
from hil.errors import InputError

from .result import DesignResult, fingerprint
from .settings import DesignSettings

_OPTION = "--compare"


@dataclass(frozen=True)
class References:
    """Designs to compare with.

    Attributes:
        measures: (log10 det, coupling index) of each, by name.
        kinematic: names of those that were searched without looking at everything.
    """

    measures: dict[str, tuple[float, float]]
    kinematic: frozenset[str]


def references(
    paths: Sequence[Path], cell: Cell, settings: DesignSettings, *, together: bool
) -> References:
    """Return earlier designs whose numbers mean what those of a new one are going to mean.

    Args:
        paths: their files or folders.
        cell: of the new design.
        settings: of the new design.
        together: whether it adds to earlier archives.

    Raises:
        InputError: a file cannot be read, or its numbers must not be compared.
    """
    if paths and together:
        raise InputError(
            None,
            "would be compared with what --earlier adds up, weighted, over all archives",
            field=_OPTION,
            remedy="leave out one of the two",
        )
    measures: dict[str, tuple[float, float]] = {}
    kinematic = set()
    for path in paths:
        result = DesignResult.load(path)
        _require_comparable(result, path, cell, settings)
        name = _name(result)
        name = f"{name} ({path})" if name in measures else name
        criteria = result.excitation.criteria
        measures[name] = criteria.log10_det, criteria.coupling_index
        if result.settings.unchecked:
            kinematic.add(name)
    return References(measures, frozenset(kinematic))


def _name(result: DesignResult) -> str:
    method = result.excitation.method
    return f"method {method.upper()}" if len(method) == 1 else method


def _require_comparable(
    result: DesignResult, path: Path, cell: Cell, settings: DesignSettings
) -> None:
    now = fingerprint(cell)
    different = [part for part in ("urdf", "robot") if now[part] != result.cell_parts.get(part)]
    if different:
        raise InputError(
            path,
            f"is of another robot: the {' and '.join(different)} of its cell {result.cell_name!r} "
            f"{'is' if len(different) == 1 else 'are'} not that of {cell.name!r}",
            field=_OPTION,
            remedy="compare motions of one robot, in one description",
        )
    if result.archives:
        raise InputError(
            path,
            "was designed with --earlier: its numbers are of all archives together, weighted, not "
            "of its motion alone",
            field=_OPTION,
            remedy="name designs made without --earlier",
        )
    every = set(cell.model.parameter_names)
    asked = settings.objective.parameters
    ours = every if isinstance(asked, str) else set(asked)
    theirs = every if result.parameters is None else set(result.parameters)
    others = result.settings.objective.parameters
    if "payload" in (asked, others):
        ours, theirs = ({"payload"} if name == "payload" else every for name in (asked, others))
    if ours != theirs:
        raise InputError(
            path,
            f"was judged by {len(theirs)} parameters, this design by {len(ours)}, of which "
            f"{len(ours & theirs)} are the same",
            field=_OPTION,
            remedy="name designs with the same [objective]",
        )
