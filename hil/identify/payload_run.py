"""What an arm carries, from archives recorded without and with it."""

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
    Difference,
    PayloadEstimate,
    Run,
    figures_of,
    find_difference,
    identify_payload,
)
from identification.model.pseudo_inertia import Body
from identification.model.robot import RobotModel

from .options import Options
from .prepared import prepare_sources
from .settings import samples_of, signals_of
from .sources import aligned, apart, archives_in, gather_sources, refuse_duplicates

Array = NDArray[np.float64]

# Frames in which controllers count, as ROS-Industrial names them.
_FLANGES: Final = ("tool0", "flange")
_UNITS: Final = dict(zip(NAMES, ["kg", *["m"] * 3, *["kg·m²"] * 6], strict=True))


@dataclass(frozen=True, eq=False)
class PayloadFound:
    """A payload, and what it was found from."""

    estimate: PayloadEstimate  #: of the body
    body: Body  #: as it was found
    frame: str  #: link of the robot description in whose frame it is
    box: tuple[float, float, float] | None  #: edges of the reference body [m]; None for a point
    gravity: float  #: magnitude [m/s²]
    #: names of the archives without it and with it
    bare: tuple[str, ...]
    loaded: tuple[str, ...]
    warnings: tuple[str, ...]  #: what a reader must know

    @property
    def figures(self) -> Array:
        """Those of the body (10,), as `NAMES`."""
        return figures_of(self.body)

    @property
    def wrist_torque(self) -> tuple[float, float, float]:
        """Torque of its weight about the frame's origin in the worst pose [N·m], and interval."""
        value, low, high = (self.gravity * part for part in self.estimate.moment)
        return value, low, high

    def outside(self, wanted: Mapping[str, float]) -> list[str]:
        """Sentences about figures that do not lie in their intervals.

        Raises:
            InputError: there is no figure of that name.
        """
        found = []
        for name, value in wanted.items():
            if name not in NAMES:
                problem = f"{name!r} is no figure of a payload"
                remedy = f"use some of {', '.join(NAMES)}, such as mass=4.0"
                raise InputError(None, problem, field="--check", remedy=remedy)
            low, high = self.estimate.intervals[NAMES.index(name)]
            if not low <= value <= high:
                unit = _UNITS[name]
                found.append(
                    f"{name} {value:g} {unit} lies outside the 95 % interval {low:.4g} to"
                    f" {high:.4g} {unit}"
                )
        return found

    @property
    def sentences(self) -> list[str]:
        """What was found, in words."""
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
            shape = "a point mass" if self.box is None else "the box"
            lines.append(
                f"The motion does not determine {', '.join(estimate.undetermined)}: they are those"
                f" of the possible body closest to {shape}."
            )
        if estimate.contradicted:
            lines.append(
                "No possible body fits the recordings to their noise: torque constants, the"
                " geometry of the URDF or friction that depends on the load may be the cause, and"
                " the intervals do not contain it."
            )
        return lines

    @property
    def table(self) -> list[tuple[str, float, float, float, str]]:
        """Rows of name, value, interval and unit."""
        rows = zip(NAMES, self.figures.tolist(), self.estimate.intervals.tolist(), strict=True)
        return [(name, value, low, high, _UNITS[name]) for name, value, (low, high) in rows]

    @property
    def controllers(self) -> dict[str, str]:
        """By controller, the figures as they are typed; units and frames stand in the manual."""
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

    @property
    def urdf(self) -> str:
        """A description with the frame's link and the payload fixed to it."""
        xyz = " ".join(repr(float(part)) for part in self.body.centre)
        names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        tensor = " ".join(
            f'{name}="{float(part)!r}"' for name, part in zip(names, self.figures[4:], strict=True)
        )
        return f"""<?xml version="1.0"?>
<robot name="payload">
  <link name="{self.frame}"/>
  <joint name="payload_mount" type="fixed">
    <parent link="{self.frame}"/>
    <child link="payload"/>
  </joint>
  <link name="payload">
    <inertial>
      <origin xyz="{xyz}" rpy="0 0 0"/>
      <mass value="{float(self.body.mass)!r}"/>
      <inertia {tensor}/>
    </inertial>
  </link>
</robot>
"""

    def as_json(self) -> dict[str, Any]:
        """Everything, for other programs; infinite ends of intervals are null."""
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
            "contradicted": estimate.contradicted,
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
    box: tuple[float, float, float] | None = None,
    options: Options = Options(estimator="wls"),
) -> PayloadFound:
    """Weigh what the arm carries in some recordings and not in others.

    Settings are chosen on the bare recordings. What `[robot.payload]` of a cell states is left out
    of account: the payload is all that the loaded recordings carry and the bare ones do not.

    Either side is archives, folders of them, or campaign folders. The figures are in the `frame` of
    a link, see `flange_of` if left out; `box` has the edges [m] of the reference body along the
    axes of that frame, None for a point.

    Raises:
        InputError: archives cannot be used, are of two arms, carry two payloads or none.
        IdentificationError: the recordings do not determine the mass.
    """
    sides = {False: list(archives_in(bare)), True: list(archives_in(loaded))}
    if not sides[False] or not sides[True]:
        problem = "a payload is a difference of recordings without it and with it"
        remedy = "name both: hil payload BARE... --loaded LOADED"
        raise InputError(None, problem, remedy=remedy)
    refuse_duplicates([*sides[False], *sides[True]])
    found = {
        kind: gather_sources(paths, Options().split, in_sample=True)
        for kind, paths in sides.items()
    }
    bare_cell, loaded_cell = found[False].cell, found[True].cell
    if differing := apart(bare_cell, loaded_cell):
        problem = f"is of another arm than {bare_cell.path}: {' and '.join(differing)} differ"
        remedy = "name bare and loaded recordings of one arm"
        raise ArchiveError(sides[True][0], problem, field="--loaded", remedy=remedy)
    paths = {path.name: path for path in (*sides[False], *sides[True])}
    training = (*found[False].training, *found[True].training)
    for source in training:
        if source.recording.torque is None:
            problem = "holds no joint torques, and a payload is weighed in their unit"
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
            samples = samples_of(signals_of(source, settings), cell, settings)
            runs.append(Run.of(source.name, cell.model, samples, frame, loaded=True))
            task.advance(1, source.name)
    with reporter.task("weighing", 2) as task:
        if (difference := find_difference(cell.model, runs)) is not None:
            raise _mixed(difference, paths[difference.run.name])
        task.advance(1)
        estimate = identify_payload(cell.model, runs, box)
        task.advance(1)
    warnings = (*prepared.sources.warnings, *found[True].warnings)
    if estimate.body is None:
        low, high = estimate.intervals[0]
        raise InputError(
            None,
            f"the loaded archives show no payload: its mass is between {low:.3g} and {high:.3g} kg",
            field="--loaded",
            remedy="name recordings that were made with it",
        )
    return PayloadFound(
        estimate=estimate,
        body=estimate.body,
        frame=frame,
        box=box,
        gravity=float(np.linalg.norm(cell.model.gravity)),
        bare=tuple(source.name for source in first),
        loaded=tuple(source.name for source in last),
        warnings=tuple(dict.fromkeys(warnings)),
    )


def flange_of(model: RobotModel) -> str:
    """The link whose frame controllers count in: `tool0`, `flange`, or that of the last joint."""
    last = {
        name: pose for name, pose in model.chain.frames.items() if pose.joint == model.n_joints - 1
    }
    named = next((name for name in _FLANGES if name in last), None)
    return named or min(last, key=lambda name: float(np.abs(last[name].translation).sum()))


def _mixed(found: Difference, path: Path) -> InputError:
    """That not all bare recordings carry the same, or not all loaded ones."""
    more = "more" if found.mass > 0.0 else "less"
    amount = f"{abs(found.mass):.3g} kg {more} than {found.reference.name}, though both are named"
    if found.run.loaded:
        problem, remedy = "carries another payload", "weigh each payload by itself"
        return InputError(path, f"{problem}: {amount} as loaded", field="--loaded", remedy=remedy)
    problem = f"was recorded with another tool mounted: it carries {amount} as bare"
    return InputError(path, problem, remedy="name it with --loaded, or leave it out")
