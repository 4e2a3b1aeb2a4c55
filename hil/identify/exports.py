"""The way back into a user's tools: the identified model as files beside `results.json`."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil.cell import Cell
from hil.io import file_digest
from hil.results import ExportResult, Results
from identification import Estimate, IdentificationError, RobotModel
from identification.estimators.consistent import ConsistentEstimate
from identification.export.friction import friction_in_words, friction_source
from identification.export.parameters import parameters_csv, parameters_json, standard_csv
from identification.export.urdf import write_urdf

Array = NDArray[np.float64]

URDF = "identified.urdf"
PARAMETERS_JSON, PARAMETERS_CSV = "parameters.json", "parameters.csv"
STANDARD_CSV = "standard.csv"
FRICTION_TEXT, FRICTION_SOURCE = "friction.txt", "friction.py"
FILES = (PARAMETERS_JSON, PARAMETERS_CSV, FRICTION_TEXT, FRICTION_SOURCE, STANDARD_CSV, URDF)
"""All that an identification can leave for other tools."""


@dataclass(frozen=True)
class Exports:
    """The files for other tools, and what is not among them.

    Attributes:
        contents: text of each file by name, in the order of writing; None for one that is to be
            removed if it is there: it would be of other parameters than its neighbours.
        withheld: why there is none, by the name of each such file.
    """

    contents: Mapping[str, str | None]
    withheld: Mapping[str, str]

    @property
    def written(self) -> tuple[str, ...]:
        """Names of the files that there are."""
        return tuple(name for name, text in self.contents.items() if text is not None)

    @property
    def result(self) -> ExportResult:
        """As it goes into `results.json`."""
        return ExportResult(written=list(self.written), withheld=dict(self.withheld))


def exports_of(
    cell: Cell,
    estimate: Estimate,
    consistent: ConsistentEstimate | str,
    *,
    essential: Collection[str] | None = None,
    provenance: Mapping[str, str] | None = None,
) -> Exports:
    """Return the identified model as files for other tools.

    Without a physically consistent estimate, but the reason, there is no URDF and no full standard
    parameters. `essential` are names; `provenance` see :func:`provenance_of`.

    Raises:
        IdentificationError: the estimate is not of the cell's model.
    """
    model = cell.model
    # Each fit for one line of any of the files: names of archives come from anywhere.
    origin = {
        key: " ".join("".join(c if c.isprintable() else " " for c in value).split())
        for key, value in (provenance or {}).items()
    }
    possible = None if isinstance(consistent, str) else consistent
    contents: dict[str, str | None] = {
        PARAMETERS_JSON: parameters_json(
            model, estimate, consistent=possible, essential=essential, provenance=origin
        ),
        PARAMETERS_CSV: parameters_csv(model, estimate, provenance=origin),
        **_friction(model, estimate, possible, origin),
    }
    withheld = {}
    if possible is None:
        why = f"there are no physically consistent parameters: {consistent}"
        withheld = {STANDARD_CSV: why, URDF: why}
    else:
        contents[STANDARD_CSV] = standard_csv(model, possible, provenance=origin)
        try:
            contents[URDF] = _urdf(cell, estimate, possible, origin)
        except IdentificationError as error:
            withheld[URDF] = str(error)
    return Exports({**contents, **dict.fromkeys(withheld)}, withheld)


def provenance_of(results: Results, archives: Sequence[Path]) -> dict[str, str]:
    """Where a result comes from: cell, archives with their digests, software and verdict."""
    digests = (f"{path.name} sha256 {file_digest(path)}" for path in archives)
    return {
        "robot": results.cell,
        "simulated": "yes" if results.simulated else "no",
        "archives": ", ".join(digests),
        "software": ", ".join(f"{name} {version}" for name, version in results.software.items()),
        "verdict": ("good" if results.verdict.good else "NOT GOOD") + f": {results.verdict.line}",
    }


def _friction(
    model: RobotModel,
    estimate: Estimate,
    consistent: ConsistentEstimate | None,
    origin: Mapping[str, str],
) -> dict[str, str | None]:
    """The friction law in words and as source: that of the URDF beside it, if there is one."""
    if consistent is None:
        values, whose = estimate.values[model.friction_part], "least squares"
    else:
        values, whose = consistent.friction, f"the physically consistent parameters of {URDF}"
    names = model.parameter_names[model.friction_part]
    remarks = [f"friction of {whose}"]
    if unknown := ", ".join(name for name in names if name in estimate.undetermined):
        remarks.append(f"NOT DETERMINED by the data, what stands for them is no figure: {unknown}")
    remarks += [f"{key}: {value}" for key, value in origin.items()]
    header = "".join(f"# {line}\n" for line in remarks)
    return {
        FRICTION_TEXT: header + "\n" + friction_in_words(model, values),
        FRICTION_SOURCE: header + friction_source(model, values),
    }


def _urdf(
    cell: Cell, estimate: Estimate, consistent: ConsistentEstimate, origin: Mapping[str, str]
) -> str:
    """The user's URDF with the consistent parameters, and a comment that says so."""
    model = cell.model
    names = model.parameter_names[model.friction_part]
    # A joint that never moved keeps the friction that its URDF gives it.
    unknown = np.array([name in estimate.undetermined for name in names], dtype=np.bool_)
    friction = np.where(unknown, np.nan, consistent.friction)
    lines = ["Inertia and joint friction were identified by hil; everything else is as it was."]
    if estimate.undetermined:
        lines.append(
            f"Not determined by the data, but nominal: {', '.join(estimate.undetermined)}."
        )
    lines += [f"{key}: {value}" for key, value in origin.items()]
    return write_urdf(cell.urdf, model, consistent.standard, friction, remarks=lines)
