"""Files of the identified arm for simulators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Final, Literal

import numpy as np

from hil.base.arrays import Array
from hil.base.files import make_folder, write_files, write_into
from hil.pipeline.identification import Identification
from hil.pipeline.identified_model import IdentifiedModel, ensemble_of, model_of, remarks_of
from identification import Samples
from identification.estimators.ensemble import MIN_ARMS, Ensemble
from identification.export.simulators import (
    FORMATS,
    MISSING_SIMULATOR_ERRORS,
    RANDOM_STATES,
    ModelFormat,
    SimulatorComparison,
    compare,
    read_back,
)
from identification.model.motion import Motion

FormatName = Literal["mjcf", "urdf", "sdf", "pinocchio"]

_SPREAD_TOLERANCE: Final = 0.05  # of drawn arms, from that of the stated intervals
_ENSEMBLE_STATES: Final = 50  # random states at which each drawn arm is read back
_LEAST: Final = 1e-3  # of the torque of a joint, below which a part is not listed
_MAX_ROWS: Final = 2000  # of the recorded motion, enough for root mean squares


@dataclass(frozen=True, eq=False)
class Exported:
    """Summary of a written file."""

    path: Path
    joint_names: tuple[str, ...]
    units: tuple[str, ...]  # of torque per joint
    comparison: SimulatorComparison | str  # or why there is none
    verdict: str
    origin: str = ""  # of the parameters, where they were not identified for this file

    def lines(self) -> list[str]:
        """Return the summary as lines of text."""
        unit = " or ".join(sorted(set(self.units)))

        def row(torque: Array, whole: Array) -> str:
            pairs = zip(self.joint_names, torque, _LEAST * whole, strict=True)
            shown = [f"{name} {one:.3g}" for name, one, least in pairs if one >= least]
            if not shown:
                return "less than a thousandth of the torque of each joint"
            return f"{', '.join(shown)} {unit} rms"

        lines = [*([f"parameters: {self.origin}"] if self.origin else [])]
        lines.append(f"written: {self.path}")
        if isinstance(self.comparison, str):
            lines.append(f"warning: not read back: {self.comparison}")
        else:
            lines += [
                f"read back: torque error at most {self.comparison.difference:.1e} of the joint's"
                f" largest torque, at {RANDOM_STATES} random states",
                *(
                    f"left out: {k}: {row(v, self.comparison.torque)}"
                    for k, v in self.comparison.left_out.items()
                ),
                "whole torque of the recorded motion: "
                + row(self.comparison.torque, self.comparison.torque),
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
            "parameters_from": self.origin or None,
        }


def export_model(
    source: Identification | IdentifiedModel, output: Path, to: FormatName
) -> Exported:
    """Write an identified arm, read it back and compare.

    Raises:
        InputError: there are no physically consistent parameters.
        IdentificationError: the arm cannot be written, or reads back with other parameters.
    """
    model = source if isinstance(source, IdentifiedModel) else model_of(source)
    form = FORMATS[to]
    arm = model.arm
    make_folder(output.parent)
    text = form.write(arm, model.name, remarks_of(model))
    try:
        comparison: SimulatorComparison | str = compare(
            text, form, arm, _motion(model.prepared.held_out)
        )
    except MISSING_SIMULATOR_ERRORS as error:
        comparison = str(error)
    write_files(output.parent, {output.name: text})
    units = tuple("N·m" if turns else "N" for turns in arm.model.chain.revolute)
    return Exported(output, arm.model.joint_names, units, comparison, model.verdict, model.origin)


@dataclass(frozen=True, eq=False)
class ExportedEnsemble:
    """Summary of the written arms of an ensemble."""

    path: Path  #: of the folder, or of the .npz file
    ensemble: Ensemble
    seed: int
    joint_names: tuple[str, ...]
    difference: float | str  #: largest difference read back, or why it was not
    verdict: str

    def lines(self) -> list[str]:
        """Return the summary as lines of text."""
        arms = self.ensemble
        pairs = zip(self.joint_names, arms.spread, strict=True)
        spread = ", ".join(f"{name} {share:.2f}" for name, share in pairs)
        pooled = float(np.sqrt(np.nanmean(arms.spread**2)))
        lines = [
            f"written: {len(arms)} arms drawn with seed {self.seed} in {self.path}",
            f"moved to the nearest physically consistent arm: {np.count_nonzero(arms.moved)}",
            "spread of their torque on the fitted motion over the spread by the stated intervals:"
            f" {pooled:.2f} over all joints ({spread})",
        ]
        if abs(pooled - 1.0) > _SPREAD_TOLERANCE:
            lines.append(
                f"the spread of fewer than {MIN_ARMS} arms is mostly chance: draw more, such as"
                " --ensemble 20"
                if len(arms) < MIN_ARMS
                else "warning: the nearest physically consistent arms do not scatter as the "
                "intervals state: do not use them for randomisation"
            )
        if isinstance(self.difference, str):
            lines.append(f"warning: not read back: {self.difference}")
        else:
            lines.append(
                f"read back: torque error at most {self.difference:.1e} of the joint's largest"
                f" torque, at {_ENSEMBLE_STATES} random states of each arm"
            )
        return [*lines, self.verdict]

    def to_dict(self) -> dict[str, object]:
        """Return the summary for JSON."""
        read = not isinstance(self.difference, str)
        return {
            "path": str(self.path),
            "joints": [*self.joint_names],
            "arms": len(self.ensemble),
            "seed": self.seed,
            "moved": int(np.count_nonzero(self.ensemble.moved)),
            "widened": self.ensemble.widened,
            "spread": [
                None if np.isnan(spread) else float(spread) for spread in self.ensemble.spread
            ],
            "read_back": self.difference if read else None,
            "not_read_back": None if read else self.difference,
            "verdict": self.verdict,
        }


def export_ensemble(
    model: IdentifiedModel, output: Path, to: FormatName, count: int, seed: int
) -> ExportedEnsemble:
    """Write drawn arms as files in a folder, or as arrays if the output is an .npz file.

    Args:
        model: identified arm.
        output: folder or file.
        to: format of the files.
        count: of the arms.
        seed: of the random numbers.

    Raises:
        InputError: there are no physically consistent parameters, or no posterior.
        IdentificationError: an arm cannot be written, or reads back with other parameters.
    """
    ensemble = ensemble_of(model, count, seed)
    names = model.arm.model
    difference: float | str = 0.0
    if output.suffix == ".npz":
        difference = "arrays have no reader"
        content = BytesIO()
        np.savez_compressed(
            content,
            standard=ensemble.standard,
            standard_names=names.layout.names,
            parameters=ensemble.values,
            parameter_names=names.parameter_names,
            joint_names=names.joint_names,
            seed=seed,
        )
        write_into(output.parent, {output.name: content.getvalue()})
    else:
        texts, difference = _ensemble_texts(model, ensemble, FORMATS[to], seed)
        write_into(output, texts)
    return ExportedEnsemble(output, ensemble, seed, names.joint_names, difference, model.verdict)


def _ensemble_texts(
    model: IdentifiedModel, ensemble: Ensemble, form: ModelFormat, seed: int
) -> tuple[dict[str, str], float | str]:
    """Return the files of the arms, and their largest difference when read back."""
    texts = dict[str, str]()
    difference = 0.0
    missing = ""
    digits = len(str(len(ensemble)))
    for k, (standard, values) in enumerate(
        zip(ensemble.standard, ensemble.values, strict=True), start=1
    ):
        arm = replace(model.arm, standard=standard, values=values)
        remark = f"Arm {k} of {len(ensemble)} drawn from the posterior with seed {seed}."
        text = form.write(arm, model.name, (remark, *remarks_of(model)))
        texts[f"arm_{k:0{digits}}{form.suffix}"] = text
        if not missing:
            try:
                difference = max(difference, read_back(text, form, arm, _ENSEMBLE_STATES))
            except MISSING_SIMULATOR_ERRORS as error:
                missing = str(error)
    return texts, missing or difference


def _motion(held_out: Sequence[Samples]) -> Motion:
    """Return some rows of the predicted motion, from all its recordings."""
    parts = [samples.motion for samples in held_out]
    step = -(-sum(motion.n_samples for motion in parts) // _MAX_ROWS)
    some = [motion.rows(slice(None, None, step)) for motion in parts]
    return Motion.joined(some).without_load()
