"""Identification of a payload from archives recorded without and with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hil.errors import ArchiveError, InputError
from hil.progress import Reporter
from identification.estimators.payload import (
    NAMES,
    PayloadEstimate,
    Run,
    figures_of,
    identify_payload,
)
from identification.model.pseudo_inertia import Body
from identification.model.robot import RobotModel

from .options import Options
from .prepared import prepare_sources, samples_of
from .sources import aligned, archives_in, arm_differences, gather_sources, refuse_duplicates

Array = NDArray[np.float64]

_FLANGES: Final = ("tool0", "flange")  # flange frames of controllers, by their ROS-Industrial names
_UNITS: Final = dict(zip(NAMES, ["kg", *["m"] * 3, *["kg·m²"] * 6], strict=True))


@dataclass(frozen=True, eq=False)
class PayloadFound:
    """An identified payload."""

    estimate: PayloadEstimate
    body: Body
    frame: str  #: link in whose frame `body` is
    gravity: float  #: magnitude [m/s²]
    bare: tuple[str, ...]  #: names of the archives without payload
    loaded: tuple[str, ...]  #: names of the archives with payload
    warnings: tuple[str, ...]

    @property
    def figures(self) -> Array:
        """Values of `NAMES` (10,)."""
        return figures_of(self.body)

    @property
    def wrist_torque(self) -> tuple[float, float, float]:
        """Maximum torque of its weight about the frame's origin and its interval [N·m]."""
        value, low, high = (self.gravity * part for part in self.estimate.moment)
        return value, low, high

    def outside(self, expected: Mapping[str, float]) -> list[str]:
        """Return a sentence about each expected value outside its interval.

        Raises:
            InputError: a name is unknown.
        """
        found = []
        for name, value in expected.items():
            if name not in NAMES:
                problem = f"{name!r} is not a property of a payload"
                remedy = f"use one of {', '.join(NAMES)}, for example mass=4.0"
                raise InputError(None, problem, field="--check", remedy=remedy)
            low, high = self.estimate.intervals[NAMES.index(name)]
            if not low <= value <= high:
                unit = _UNITS[name]
                found.append(
                    f"{name} {value:g} {unit} is outside the 95 % interval {low:.4g} to"
                    f" {high:.4g} {unit}"
                )
        return found

    @property
    def sentences(self) -> list[str]:
        """Summary for the operator."""
        body, estimate, torque = self.body, self.estimate, self.wrist_torque
        low, high = estimate.intervals[0]
        centre = ", ".join(f"{1e3 * part:.1f}" for part in body.centre)
        lines = [
            f"The payload weighs {body.mass:.4g} kg (95 %: {low:.4g} to"
            f" {high:.4g} kg), its centre of mass is at {centre} mm in the frame {self.frame};"
            f" its weight loads the flange with up to {torque[0]:.3g} N·m"
            f" ({torque[1]:.3g} to {torque[2]:.3g})."
        ]
        if estimate.undetermined:
            lines.append(
                f"The motion does not determine {', '.join(estimate.undetermined)}: set to zero"
                " where the other figures allow it."
            )
        return lines

    @property
    def table(self) -> list[tuple[str, float, float, float, str]]:
        """Rows of name, value, interval and unit."""
        rows = zip(NAMES, self.figures.tolist(), self.estimate.intervals.tolist(), strict=True)
        return [(name, value, low, high, _UNITS[name]) for name, value, (low, high) in rows]

    @property
    def controllers(self) -> dict[str, str]:
        """Commands that set the payload, by controller; units and frames as in its manual."""
        mass, centre = f"{self.body.mass:.3f}", self.body.centre
        millimetres = ", ".join(f"{1e3 * part:.2f}" for part in centre)
        metres = ", ".join(f"{part:.5f}" for part in centre)
        xx, xy, xz, yy, yz, zz = (f"{part:.5f}" for part in self.figures[4:])
        six, nine = (xx, yy, zz, xy, xz, yz), (xx, xy, xz, xy, yy, yz, xz, yz, zz)
        comau = [
            f"$TOOL_MASS := {mass}",
            f"$TOOL_CNTR := POS({millimetres}, 0, 0, 0, '')",
            *(f"$TOOL_INERTIA[{k}] := {figure}" for k, figure in enumerate(six, 1)),
        ]
        return {
            "COMAU": "\n".join(comau),
            "UR": f"set_target_payload({mass}, [{metres}], [{', '.join(six)}])",
            "Franka": f"robot.setLoad({mass}, {{{metres}}}, {{{', '.join(nine)}}});",
        }

    def as_json(self) -> dict[str, Any]:
        """Return all values as JSON data; infinite ends of intervals are null."""
        torque, estimate = self.wrist_torque, self.estimate

        def figure(value: float, low: float, high: float, unit: str) -> dict[str, Any]:
            interval = [end if np.isfinite(end) else None for end in (low, high)]
            return {"value": value, "interval": interval, "unit": unit}

        return {
            "frame": self.frame,
            "figures": {
                name: figure(value, low, high, unit) for name, value, low, high, unit in self.table
            },
            "wrist_torque": figure(*torque, "N·m"),
            "undetermined": list(estimate.undetermined),
            "least_squares": estimate.parameters.tolist(),
            "method": estimate.method,
            "controllers": self.controllers,
            "bare": list(self.bare),
            "loaded": list(self.loaded),
            "warnings": list(self.warnings),
        }


def find_payload(
    bare: Sequence[Path],
    loaded: Sequence[Path],
    reporter: Reporter,
    *,
    frame: str | None = None,
    options: Options = Options(estimator="wls"),
) -> PayloadFound:
    """Identify the payload of the loaded recordings as their difference to the bare ones.

    Both are archives, folders of them, or campaign folders. Settings are chosen on the bare
    recordings; `[robot.payload]` of the cells is ignored. The payload is in the frame of a link, by
    default that of `flange_of`.

    Raises:
        InputError: archives cannot be used, are of two arms, or have no payload.
        IdentificationError: the recordings do not determine the mass.
    """
    sides = {False: list(archives_in(bare)), True: list(archives_in(loaded))}
    if not sides[False] or not sides[True]:
        problem = "recordings without and with the payload are needed"
        remedy = "give both: hil payload BARE... --loaded LOADED"
        raise InputError(None, problem, remedy=remedy)
    refuse_duplicates([*sides[False], *sides[True]])
    found = {
        kind: gather_sources(paths, Options().split, in_sample=True)
        for kind, paths in sides.items()
    }
    bare_cell, loaded_cell = found[False].cell, found[True].cell
    if differing := arm_differences(bare_cell, loaded_cell):
        problem = f"is of another arm than {bare_cell.path}: {' and '.join(differing)} differ"
        remedy = "give bare and loaded recordings of one arm"
        raise ArchiveError(sides[True][0], problem, field="--loaded", remedy=remedy)
    training = (*found[False].training, *found[True].training)
    for source in training:
        if source.recording.torque is None:
            problem = "contains no joint torques"
            remedy = "give drive.torque_constant in the column map"
            raise ArchiveError(source.path, problem, field="torque", remedy=remedy)
    cell = bare_cell.without_payload()
    if found[False].plan is None and found[True].plan is None:
        training, _ = aligned(training)
    first, last = training[: len(found[False].training)], training[len(found[False].training) :]
    sources = replace(found[False], cell=cell, training=first, held_out=first)
    prepared = prepare_sources(sources, options, reporter)
    cell, settings = prepared.sources.cell, prepared.settings
    frame = frame or flange_of(cell.model)
    runs = []
    with reporter.task("reducing recordings", len(training)) as task:
        for source, samples in zip(first, prepared.fitted, strict=True):
            runs.append(Run.of(source.name, cell.model, samples, frame, loaded=False))
            task.advance(1, source.name)
        for source in last:
            samples = samples_of(source, cell, settings)
            runs.append(Run.of(source.name, cell.model, samples, frame, loaded=True))
            task.advance(1, source.name)
    with reporter.task("weighing", 1) as task:
        estimate = identify_payload(cell.model, runs)
        task.advance(1)
    warnings = (*prepared.sources.warnings, *found[True].warnings)
    if estimate.body is None:
        low, high = estimate.intervals[0]
        raise InputError(
            None,
            f"the loaded archives show no payload: its mass is between {low:.3g} and {high:.3g} kg",
            field="--loaded",
            remedy="give recordings that were made with the payload",
        )
    return PayloadFound(
        estimate=estimate,
        body=estimate.body,
        frame=frame,
        gravity=float(np.linalg.norm(cell.model.gravity)),
        bare=tuple(source.name for source in first),
        loaded=tuple(source.name for source in last),
        warnings=tuple(dict.fromkeys(warnings)),
    )


def flange_of(model: RobotModel) -> str:
    """Return the flange link: `tool0`, `flange`, or the link of the last joint."""
    last = {
        name: pose for name, pose in model.chain.frames.items() if pose.joint == model.n_joints - 1
    }
    named = next((name for name in _FLANGES if name in last), None)
    return named or min(last, key=lambda name: float(np.abs(last[name].translation).sum()))
