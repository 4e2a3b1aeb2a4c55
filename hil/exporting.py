"""Files of the identified arm for simulators, and ensembles of variants."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.cell import Cell
from hil.cell.text import urdf_limits
from hil.errors import InputError
from hil.files import make_folder, write_files
from hil.identify import Identification
from hil.identify.cell_context import torque_limits
from hil.outcome import provenance_of
from identification.estimators.consistent import (
    ConsistentEstimate,
    Ensemble,
    sample_ensemble,
)
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

Array = NDArray[np.float64]
FormatName = Literal["mjcf", "sdf", "urdf"]

ENSEMBLE: Final = "ensemble.npz"
_MOST_ROWS: Final = 2000  # of the recorded motion, enough for root mean squares
_SPREAD_ROWS: Final = 200


class Spread(NamedTuple):
    """Standard deviation of torque per joint (n,) [N·m or N] over the recorded motion."""

    variants: Array  #: of the variants
    covariance: Array  #: predicted by the covariance of the parameters


@dataclass(frozen=True, eq=False)
class Exported:
    """Summary of a written file."""

    path: Path
    joint_names: tuple[str, ...]
    units: tuple[str, ...]  # of torque per joint
    comparison: Comparison | str  # or why there is none
    spread: Spread | None
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
        if self.spread is not None:
            lines.append(f"torque of the variants: ± {row(self.spread.variants)} (std)")
            lines.append(f"predicted by the covariance: ± {row(self.spread.covariance)} (std)")
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
            "spread": self.spread and {k: v.tolist() for k, v in self.spread._asdict().items()},
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


def arm_of(cell: Cell, consistent: ConsistentEstimate) -> Arm:
    """Return the identified arm with the limits of its cell, or of its URDF."""
    described, efforts = urdf_limits(cell.urdf, cell.joint_names), cell.torque_limit
    if efforts is None:
        found = torque_limits(cell)
        efforts = described.effort if found is None else np.nan_to_num(found, nan=np.inf)
    limits = described if cell.file.limits is None else cell.joint_limits
    ranges = Ranges(limits.lower, limits.upper, limits.velocity, efforts)
    return Arm(cell.urdf, cell.model, consistent.standard, consistent.estimate.values, ranges)


def export_model(
    found: Identification, output: Path, to: FormatName, *, ensemble: int = 0, seed: int = 0
) -> Exported:
    """Write an identified arm, read it back and compare; with `ensemble`, write variants too.

    The variants are `ensemble.npz` and files in ``NAME_ensemble``, NAME being `output` without
    suffix.

    Raises:
        InputError: there are no physically consistent parameters.
        IdentificationError: the arm cannot be written, or reads back with other parameters.
    """
    form, arm, motion = FORMATS[to], arm_of(found.cell, consistent_of(found)), _motion(found)
    pooled = found.estimate.pooled
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
    spread = None
    if ensemble:
        variants = sample_ensemble(arm.model, pooled, ensemble, seed)
        _write_variants(output, to, arm, variants, (*remarks, f"seed of the ensemble: {seed}"))
        spread = spread_of(arm, variants, pooled.covariance, motion)
    units = tuple("N·m" if turns else "N" for turns in arm.model.chain.revolute)
    return Exported(output, arm.model.joint_names, units, comparison, spread, found.verdict.line)


def default_output(sources: Sequence[Path], to: FormatName) -> Path:
    """Return the default path: in the campaign folder, or in the working directory."""
    folder = sources[0] if sources[0].is_dir() else Path()
    return folder / f"identified{FORMATS[to].suffix}"


def spread_of(arm: Arm, variants: Ensemble, covariance: Array, motion: Motion) -> Spread:
    """Return the torque deviation of variants, and that predicted by the covariance (p, p)."""
    part = motion.rows(_some(motion.n_samples, _SPREAD_ROWS))
    torque = np.array([arm.model.torque(values, *part[1:]) for values in variants.values])
    known = np.isfinite(np.diag(covariance))
    rows = arm.model.regressor(*part[1:]).dense(arm.model.n_parameters)
    rows = np.reshape(rows, (part.n_samples, arm.model.n_joints, -1))[:, :, known]
    predicted = np.einsum("mjp,pq,mjq->mj", rows, covariance[np.ix_(known, known)], rows)
    return Spread(
        np.sqrt(np.mean(np.var(torque, axis=0), axis=0)), np.sqrt(np.mean(predicted, axis=0))
    )


def _write_variants(
    output: Path, to: FormatName, arm: Arm, variants: Ensemble, remarks: tuple[str, ...]
) -> None:
    """Write a file for each variant, and one with the parameters of all."""
    folder, form = output.with_name(f"{output.stem}_ensemble"), FORMATS[to]
    make_folder(folder)
    width = len(str(len(variants.values) - 1))
    content = BytesIO()
    np.savez_compressed(
        content,
        standard=variants.standard,
        values=variants.values,
        standard_names=np.array(arm.model.layout.names),
        names=np.array(arm.model.parameter_names),
    )
    files: dict[str, str | bytes | None] = {ENSEMBLE: content.getvalue()}
    for k, (standard, values) in enumerate(zip(variants.standard, variants.values, strict=True)):
        variant = Arm(arm.urdf, arm.model, standard, values, arm.ranges)
        name = f"{k:0{width}d}"
        files[name + form.suffix] = form.write(variant, f"{output.stem}_{name}", remarks)
    write_files(folder, files)


def _motion(found: Identification) -> Motion:
    """Return some rows of the predicted motion, from all its recordings."""
    parts = [samples.motion for samples in found.prepared.held_out]
    share = _MOST_ROWS // len(parts)
    some = [motion.rows(_some(motion.n_samples, share)) for motion in parts]
    columns = [np.concatenate(column) for column in zip(*(one[:4] for one in some), strict=True)]
    directions = [one.direction for one in some if one.direction is not None]
    direction = np.concatenate(directions) if len(directions) == len(some) else None
    return Motion(*columns)._replace(direction=direction)


def _some(count: int, most: int) -> NDArray[np.intp]:
    return np.unique(np.linspace(0, count - 1, min(count, max(most, 1))).astype(np.intp))
