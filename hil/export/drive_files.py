"""Friction, rotors and limits of an identified arm for simulators, with ranges of them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

import numpy as np

from hil.base.arrays import Array
from hil.base.errors import InputError
from hil.base.files import write_files, write_into
from hil.base.safe_input import read_input
from hil.pipeline.identified_model import IdentifiedModel, ensemble_of, remarks_of
from identification.estimators.prior import DETERMINED_STD_RATIO
from identification.export.actuators import Actuators, FieldRange, Quantity, ranges_of
from identification.export.exported_arm import ExportedArm
from identification.export.patching import PatchError, patched
from identification.export.python_files import (
    GENESIS,
    ISAAC_LAB,
    genesis,
    isaac_lab,
    require_values,
)

DriveName = Literal["isaaclab", "genesis"]
MJCF: Final[Mapping[str, Quantity]] = {
    "forcerange": "limit",
    "frictionloss": "friction",
    "damping": "viscous",
    "armature": "armature",
}
URDF: Final[Mapping[str, Quantity]] = {"friction": "friction", "damping": "viscous"}
_FIELDS: Final[Mapping[str, Mapping[str, Quantity]]] = {
    "mjcf": MJCF,
    "urdf": URDF,
    "sdf": URDF,
    "pinocchio": {**URDF, "armature": "armature"},
    "isaaclab": ISAAC_LAB,
    "genesis": GENESIS,
}
PARSED: Final = "read back: parsed, its values agree with the ones written"
PATCHED: Final = "not read back: the bodies of the file stay, and are not known here"
OWN_FILE: Final = "give an MJCF or URDF with the joints of the arm by name"
"""Remedy for a file that cannot be changed."""
_MIN_SAMPLED_ARMS: Final = 100  # arms of which ranges are estimated


@dataclass(frozen=True)
class WhatToExport:
    """What is written.

    Attributes:
        output: file; None for one named `identified` in the folder of the results.
        ranges: whether a file of ranges is written next to it.
        count: of draws from the posterior, or None.
        seed: of the draws.
        into: MJCF or URDF that is changed, in place unless there is an output; None for a new file.
    """

    output: Path | None = None
    ranges: bool = False
    count: int | None = None
    seed: int = 1
    into: Path | None = None

    def checked(self, to: str) -> WhatToExport:
        """Return this if it goes together with a format, else raise InputError."""
        if self.into is not None and (to not in ("mjcf", "urdf") or self.count is not None):
            problem = "is changed as an MJCF or URDF"
            remedy = "use --to mjcf or --to urdf without --ensemble"
            raise InputError(self.into, problem, field="--into", remedy=remedy)
        return self


@dataclass(frozen=True)
class ExportedDrives:
    """Summary of the written files."""

    paths: tuple[Path, ...]
    read_back: str
    verdict: str
    origin: str = ""  #: of the parameters, where they were not identified for these files

    def lines(self) -> list[str]:
        """Return the summary as lines of text."""
        origin = [f"parameters: {self.origin}"] if self.origin else []
        written = f"written: {', '.join(map(str, self.paths))}"
        return [*origin, written, self.read_back, self.verdict]

    def to_dict(self) -> dict[str, object]:
        """Return the summary for JSON."""
        return {
            "paths": [*map(str, self.paths)],
            "read_back": self.read_back,
            "verdict": self.verdict,
            "parameters_from": self.origin or None,
        }


def export_drives(
    model: IdentifiedModel, output: Path, to: DriveName, what: WhatToExport
) -> ExportedDrives:
    """Write a Python file for Isaac Lab or Genesis, and ranges next to it.

    Args:
        model: the identified arm.
        output: the file.
        to: simulator.
        what: whether ranges are written, with how many draws.

    Raises:
        InputError: the estimator has no posterior.
        WriteBackError: the file reads back with other values.
    """
    actuators = drives_of(model, what.count or 0, what.seed)
    remarks = remarks_of(model)
    files = {output.name: python_text(actuators, model.name, remarks, to)}
    if what.ranges or what.count:
        files |= ranges_file(actuators, _FIELDS[to], remarks, output)
    paths = write_into(output.parent, files)
    return ExportedDrives(paths, PARSED, model.verdict, model.origin)


def patch_drives(model: IdentifiedModel, into: Path, what: WhatToExport) -> ExportedDrives:
    """Write friction and rotors into a user's own MJCF or URDF, whose bodies stay.

    Raises:
        InputError: the file cannot be patched, or the estimator has no posterior.
    """
    actuators = drives_of(model, 0, what.seed)
    target = what.output or into
    files = {target.name: patched_text(into, actuators, OWN_FILE)}
    if what.ranges:
        fields = _FIELDS["urdf" if into.suffix == ".urdf" else "mjcf"]
        files |= ranges_file(actuators, fields, remarks_of(model), target)
    paths = write_into(target.parent, files)
    return ExportedDrives(paths, PATCHED, model.verdict, model.origin)


def write_ranges(model: IdentifiedModel, beside: Path, to: str, what: WhatToExport) -> Path:
    """Write the ranges of a file's fields next to it, and return their path.

    Args:
        model: identified arm.
        beside: the file.
        to: its format.
        what: is exported.
    """
    actuators = drives_of(model, what.count or 0, what.seed)
    files = ranges_file(actuators, _FIELDS[to], remarks_of(model), beside)
    write_files(beside.parent, files)
    (name,) = files
    return beside.parent / name


def python_text(actuators: Actuators, name: str, remarks: Sequence[str], to: str) -> str:
    """Return a Python file for Isaac Lab or Genesis, read back.

    Args:
        actuators: of the arm.
        name: of the arm.
        remarks: comments at its head.
        to: simulator, see `DriveName`.

    Raises:
        WriteBackError: the file reads back with other values.
    """
    write = isaac_lab if to == "isaaclab" else genesis
    text = write(actuators, name, remarks)
    require_values(text, actuators, _FIELDS[to])
    return text


def patched_text(into: Path, actuators: Actuators, remedy: str) -> str:
    """Return the text of a user's own MJCF or URDF with friction, rotors and servos.

    Raises:
        InputError: the file cannot be patched; `remedy` says which can.
    """
    try:
        return patched(read_input(into, OWN_FILE), actuators)
    except PatchError as error:
        raise InputError(into, str(error), field="--into", remedy=remedy) from error


def ranges_file(
    actuators: Actuators, fields: Mapping[str, Quantity], remarks: Sequence[str], beside: Path
) -> dict[str, str]:
    """Return the file of ranges by its name.

    Args:
        actuators: of the arm.
        fields: quantities by the names that a simulator gives them.
        remarks: comments.
        beside: the file whose fields they are.
    """
    document = ranges_of(actuators, fields, remarks)
    return {f"{beside.stem}.ranges.json": json.dumps(document, indent=1) + "\n"}


def drives_of(model: IdentifiedModel, count: int, seed: int) -> Actuators:
    """Return friction, rotors and limits of an arm, with intervals and draws of the posterior.

    Raises:
        InputError: the estimator has no posterior.
    """
    arm = model.arm
    draws = _sampled_drives(model, max(count, _MIN_SAMPLED_ARMS), seed)
    known = _prior_deviations(model)
    reach = model.estimate.interval_factor
    fields: dict[Quantity, FieldRange] = {}
    for name, value in _quantities(arm).items():
        deviation = draws[name].std(axis=0)
        low = np.maximum(value - reach * deviation, 0.0)
        fields[name] = FieldRange(
            value, low, value + reach * deviation, deviation <= DETERMINED_STD_RATIO * known[name]
        )
    fields["limit"] = FieldRange.exact(np.asarray(arm.ranges.effort))
    turning = np.asarray(arm.model.chain.revolute, np.bool_)
    # Arms are drawn so that their mean is the estimate: fewer are others.
    some = _sampled_drives(model, count, seed) if count else {}
    return Actuators(arm.model.joint_names, turning, fields, some)


def _sampled_drives(model: IdentifiedModel, count: int, seed: int) -> dict[Quantity, Array]:
    """Return friction and rotors (count, n) of the arms that an ensemble of this size has."""
    ensemble = ensemble_of(model, count, seed)
    by_arm = [
        _quantities(replace(model.arm, standard=standard, values=values))
        for standard, values in zip(ensemble.standard, ensemble.values, strict=True)
    ]
    return {name: np.stack([each[name] for each in by_arm]) for name in by_arm[0]}


def _quantities(arm: ExportedArm) -> dict[Quantity, Array]:
    """Return friction and rotors (n,) of an arm, none negative."""
    rows = arm.friction[: arm.model.n_joints]

    def coefficients(symbol: str) -> Array:
        return np.maximum([row.get(symbol, 0.0) for row in rows], 0.0)

    friction = coefficients("f0")
    return {
        "friction": friction,
        "static": friction + coefficients("fs"),
        "viscous": coefficients("f1"),
        "armature": np.diag(arm.rotors).copy(),
    }


def _prior_deviations(model: IdentifiedModel) -> dict[Quantity, Array]:
    """Return standard deviations (n,) that the prior gives each quantity, infinite if none."""
    robot = model.arm.model
    deviations = model.posterior.prior.belief.std
    friction = deviations[robot.layout.size :][: len(robot.friction.terms)]
    by_symbol = robot.friction.table(friction)[: robot.n_joints]

    def of(symbol: str) -> Array:
        return np.array([row.get(symbol, 0.0) for row in by_symbol])

    rotors = np.zeros(robot.n_joints)
    if robot.layout.rotor_inertia:
        rotors = deviations[robot.layout.rotors]
    return {
        "friction": of("f0"),
        "static": np.hypot(of("f0"), of("fs")),
        "viscous": of("f1"),
        "armature": rotors,
    }
