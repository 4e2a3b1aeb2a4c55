"""Files of the identified arm for simulators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from hil.cell import Cell
from hil.cell.text import urdf_limits
from hil.errors import InputError
from hil.files import make_folder, write_files
from hil.identify import Identification
from hil.identify.cell_context import torque_limits
from hil.outcome import provenance_of
from identification.estimators.consistent import ConsistentEstimate
from identification.export.friction import median_load
from identification.export.simulators import (
    FORMATS,
    STATES,
    Arm,
    Comparison,
    MissingMujocoError,
    Ranges,
    compare,
)
from identification.model.motion import Motion
from identification.signals.samples import Samples

Array = NDArray[np.float64]
FormatName = Literal["mjcf", "urdf"]

_MOST_ROWS: Final = 2000  # of the recorded motion, enough for root mean squares


@dataclass(frozen=True, eq=False)
class Exported:
    """Summary of a written file."""

    path: Path
    joint_names: tuple[str, ...]
    units: tuple[str, ...]  # of torque per joint
    comparison: Comparison | str  # or why there is none
    verdict: str

    def lines(self) -> list[str]:
        """Return the summary as lines of text."""
        unit = " or ".join(sorted(set(self.units)))

        def row(torque: Array) -> str:
            return f"{', '.join(f'{one:.3g}' for one in torque)} {unit}"

        lines = [f"written: {self.path}"]
        if isinstance(self.comparison, str):
            lines.append(f"warning: not read back: {self.comparison}")
        else:
            lines += [
                f"read back: torque error at most {self.comparison.difference:.1e} of the joint's"
                f" largest torque, at {STATES} random states",
                *(f"left out: {k}: {row(v)} rms" for k, v in self.comparison.left_out.items()),
                f"whole torque of the recorded motion: {row(self.comparison.torque)} rms",
            ]
        return [*lines, self.verdict]

    def to_dict(self) -> dict[str, object]:
        """Return the summary for JSON."""
        compared = None if isinstance(self.comparison, str) else self.comparison
        return {
            "path": str(self.path),
            "joints": [*self.joint_names],
            "read_back": compared and compared.difference,
            "not_read_back": self.comparison if compared is None else None,
            "left_out": {k: v.tolist() for k, v in compared.left_out.items()} if compared else {},
            "torque": compared and compared.torque.tolist(),
            "verdict": self.verdict,
        }


def consistent_of(found: Identification) -> ConsistentEstimate:
    """Return the physically consistent parameters of an identification, or raise InputError."""
    if isinstance(found.consistency, str):
        raise InputError(
            found.paths[0],
            f"there are no physically consistent parameters: {found.consistency}",
            remedy="see the verdict of `hil identify`",
        )
    return found.consistency.consistent


def arm_of(cell: Cell, consistent: ConsistentEstimate, fitted: Sequence[Samples]) -> Arm:
    """Return the identified arm with the limits of its cell, or of its URDF.

    Friction that grows with the load is that of the fitted motion.
    """
    described, efforts = urdf_limits(cell.urdf, cell.joint_names), cell.torque_limit
    if efforts is None:
        found = torque_limits(cell)
        efforts = described.effort if found is None else np.nan_to_num(found, nan=np.inf)
    limits = described if cell.file.limits is None else cell.joint_limits
    ranges = Ranges(limits.lower, limits.upper, limits.velocity, efforts)
    model, values = cell.model, consistent.estimate.values
    load = median_load(model, values, fitted)
    return Arm(cell.urdf, model, consistent.standard, values, ranges, load)


def export_model(found: Identification, output: Path, to: FormatName) -> Exported:
    """Write an identified arm, read it back and compare.

    Raises:
        InputError: there are no physically consistent parameters.
        IdentificationError: the arm cannot be written, or reads back with other parameters.
    """
    arm = arm_of(found.cell, consistent_of(found), found.prepared.fitted)
    form, motion = FORMATS[to], _motion(found)
    pooled = found.estimation.stated
    unknown = ", ".join(pooled.undetermined)
    remarks = (
        "Identified by hil; bodies are physically consistent parameters.",
        *([f"Not determined by the data: {unknown}."] if unknown else []),
        *(
            " ".join(f"{key}: {value}".split())
            for key, value in provenance_of(found.results, found.paths).items()
        ),
    )
    make_folder(output.parent)
    text = form.write(arm, found.cell.name, remarks)
    try:
        comparison: Comparison | str = compare(text, form, arm, motion)
    except MissingMujocoError as error:
        comparison = str(error)
    write_files(output.parent, {output.name: text})
    units = tuple("N·m" if turns else "N" for turns in arm.model.chain.revolute)
    return Exported(output, arm.model.joint_names, units, comparison, found.verdict.line)


def default_output(sources: Sequence[Path], to: FormatName) -> Path:
    """Return the default path: in the campaign folder, or in the working directory."""
    folder = sources[0] if sources[0].is_dir() else Path()
    return folder / f"identified{FORMATS[to].suffix}"


def _motion(found: Identification) -> Motion:
    """Return some rows of the predicted motion, from all its recordings."""
    parts = [samples.motion for samples in found.prepared.held_out]
    step = -(-sum(motion.n_samples for motion in parts) // _MOST_ROWS)
    some = [motion.rows(slice(None, None, step)) for motion in parts]
    columns = [np.concatenate(column) for column in zip(*(one[:4] for one in some), strict=True)]
    directions = [one.direction for one in some if one.direction is not None]
    direction = np.concatenate(directions) if len(directions) == len(some) else None
    return Motion(*columns)._replace(direction=direction)
