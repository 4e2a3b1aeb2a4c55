"""A column map that states some entries only, completed by the proposal for its log.

``[format] skip_empty = true`` or ``[torque] rated = [...]`` alone is such a map: what it does not
state is concluded from names and units.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from hil.base.errors import SourceError
from hil.base.safe_input import parse_toml
from hil.cell.errors import first_error
from hil.cell.toml_edits import with_values
from hil.importers.column_map import DOCUMENTATION, ColumnMap, map_text
from hil.importers.proposed_map import Proposal
from hil.importers.units import UNITS


@dataclass(frozen=True)
class PartialMap:
    """Entries of a column map.

    Attributes:
        path: of its file.
        entries: its tables.
        stated: the same, with defaults in place of what is not stated.
    """

    path: Path
    entries: Mapping[str, Any]
    stated: ColumnMap

    @classmethod
    def load(cls, path: Path) -> PartialMap | None:
        """Read the entries of a file; None if it names positions and times, or is no map.

        Raises:
            SourceError: an entry is not valid.
        """
        try:
            entries = parse_toml(map_text(path))
        except (OSError, ValueError):
            return None  # the column map says what is wrong with the file
        is_timed = "time" in entries or "sample_rate" in entries
        if "position" in entries and is_timed:
            return None
        others = {} if is_timed else {"sample_rate": 1.0}
        try:
            stated = ColumnMap.model_validate({"position": {}, **others, **entries})
        except ValidationError as error:
            wrong = first_error(path, error, ColumnMap, documentation=DOCUMENTATION)
            field = wrong.field
            raise SourceError(path, wrong.problem, field=field, remedy=wrong.remedy) from error
        return cls(path, entries, stated)

    @property
    def channels(self) -> dict[str, str]:
        """Channels by quantity that it names, as ``--columns`` does."""
        named = {kind: each.columns for kind, each in self.stated.quantities().items()}
        if "time" in self.entries and self.stated.time is not None:
            named["time"] = str(self.stated.time.column)
        return {
            kind: columns if isinstance(columns, str) else ",".join(map(str, columns))
            for kind, columns in named.items()
            if columns is not None
        }

    @property
    def with_unit(self) -> frozenset[str]:
        """Quantities whose unit it states."""
        quantities = self.stated.quantities().items()
        return frozenset(kind for kind, each in quantities if each.unit is not None)

    @property
    def sample_rate(self) -> float | None:
        """Of a log without a time [Hz]."""
        return self.stated.sample_rate if "sample_rate" in self.entries else None

    def completed(self, proposal: Proposal) -> Proposal:
        """Return a proposal with these entries in place of its own.

        Raises:
            SourceError: they do not fit what was proposed.
        """
        text = with_values(proposal.text, dict(_flat(self.entries)))
        try:
            columns = ColumnMap.model_validate(parse_toml(text))
        except ValidationError as error:
            wrong = first_error(self.path, error, ColumnMap, documentation=DOCUMENTATION)
            field = wrong.field
            raise SourceError(self.path, wrong.problem, field=field, remedy=wrong.remedy) from error
        return replace(proposal, text=text, columns=columns)


def _flat(table: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the entries of tables by their dotted names, but no channels: they are proposed."""
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{above}{key}.")
        elif not (key == "columns" and above.rstrip(".") in UNITS):
            yield f"{above}{key}", value
