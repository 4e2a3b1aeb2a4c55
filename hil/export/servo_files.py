"""Files of an arm without torque for simulators: its servo, friction and ranges of both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, NamedTuple

import numpy as np

from hil.base.errors import InputError
from hil.base.files import write_into
from hil.cell import Cell
from hil.export.drive_files import (
    PARSED,
    PATCHED,
    URDF,
    WhatToExport,
    patched_text,
    python_text,
    ranges_file,
)
from hil.pipeline.sources import Source
from hil.pipeline.stored_servo import actuators_of, servo_arm, servo_sources
from hil.results.provenance import RESULTS
from hil.results.servo_result import ServoResults
from identification.export.actuators import Actuators, Quantity
from identification.export.playback import played_back
from identification.export.python_files import GENESIS, ISAAC_LAB
from identification.export.simulators import (
    FORMATS,
    MISSING_SIMULATOR_ERRORS,
    MissingMujocoError,
    mjcf,
    read_back,
)
from identification.export.urdf import WriteBackError

ServoFormatName = Literal["mjcf", "urdf", "isaaclab", "genesis"]

MJCF: Final[Mapping[str, Quantity]] = {
    "kp": "stiffness",
    "forcerange": "limit",
    "delay": "delay",
    "frictionloss": "friction",
    "damping": "viscous",
    "armature": "armature",
    "offset": "offset",
}
"""Quantities of the fields of an MJCF; the offset is no field of it: it is added to commands."""

_MILLI: Final = 1e3


class _Form(NamedTuple):
    """A format: suffix of its files, engine whose terms it has, quantities by field."""

    suffix: str
    engine: str
    names: Mapping[str, Quantity]


SERVO_FORMATS: Final[Mapping[str, _Form]] = {
    "mjcf": _Form(".xml", "mujoco", MJCF),
    "urdf": _Form(".urdf", "mujoco", URDF),
    "isaaclab": _Form("_isaaclab.py", "physx", ISAAC_LAB),
    "genesis": _Form("_genesis.py", "mujoco", GENESIS),
}


class PlayedBack(NamedTuple):
    """Errors of a held-out recording in MuJoCo, from its commands alone, in a unit."""

    archive: str
    error: float
    identified: float  #: of the model with all terms
    command: float
    unit: str  #: mrad, or mm


@dataclass(frozen=True)
class ExportedServo:
    """Summary of the written files."""

    paths: tuple[Path, ...]
    read_back: str  #: how, or why not
    played: tuple[PlayedBack, ...]
    verdict: str

    def lines(self) -> list[str]:
        """Return the summary as lines of text."""
        rows = [
            f"played back in MuJoCo, {each.archive}: {each.error:.3g} {each.unit} from its commands"
            f" with their offsets (identified model {each.identified:.3g}, command itself"
            f" {each.command:.3g})"
            for each in self.played
        ]
        written = f"written: {', '.join(map(str, self.paths))}"
        return [written, self.read_back, *rows, self.verdict]

    def to_dict(self) -> dict[str, object]:
        """Return the summary for JSON."""
        return {
            "paths": [*map(str, self.paths)],
            "read_back": self.read_back,
            "played_back": [each._asdict() for each in self.played],
            "verdict": self.verdict,
        }


def export_servo(folder: Path, to: str, export: WhatToExport) -> tuple[ExportedServo, bool]:
    """Write an arm without torque for a simulator; also return whether its verdict is good.

    Args:
        folder: of the results.
        to: format, one of `SERVO_FORMATS`.
        export: what is written.

    Raises:
        InputError: the format has no servos, archives of the results are missing, or a file cannot
            be patched.
        WriteBackError: a file reads back with other values.
    """
    results = ServoResults.load(folder / RESULTS)
    if to not in SERVO_FORMATS:
        problem = f"has servos, which --to {to} does not express"
        remedy = f"use one of {', '.join(SERVO_FORMATS)}"
        raise InputError(folder, problem, field="--to", remedy=remedy)
    form = SERVO_FORMATS[to]
    servo = results.simulators[form.engine]
    sources = servo_sources(folder, results)
    cell, held_out = sources.cell, sources.held_out
    actuators = actuators_of(servo, cell, results.windows, export.count or 0, export.seed)
    remarks = _remarks(results)
    target = export.output or export.into or folder / f"identified{form.suffix}"
    files: dict[str, str] = {}
    played: tuple[PlayedBack, ...] = ()
    if to in ("mjcf", "urdf"):
        text, checked = _description(cell, actuators, remarks, to, export.into)
        if to == "mjcf":
            place = None if export.into is None else export.into.parent
            played, checked = _played(text, actuators, held_out, results, place, checked)
        if export.into is None:
            files |= _sampled_arms(cell, actuators, remarks, to, export, target)
    else:
        text = python_text(actuators, results.cell, remarks, to)
        checked = PARSED
    files[target.name] = text
    if export.ranges or export.count is not None:
        files |= ranges_file(actuators, form.names, remarks, target)
    paths = write_into(target.parent, files)
    return ExportedServo(paths, checked, played, results.verdict.line), results.verdict.good


def _description(
    cell: Cell, actuators: Actuators, remarks: Sequence[str], to: str, into: Path | None
) -> tuple[str, str]:
    """Return the text of an MJCF or URDF, and how it was read back."""
    if into is not None:
        remedy = "give an MJCF or URDF with the joints of the results by name"
        return patched_text(into, actuators, remedy), PATCHED
    arm = servo_arm(cell, actuators)
    form = FORMATS[to]
    if to == "mjcf":
        text = mjcf(arm, cell.name, remarks, servos=actuators)
    else:
        text = form.write(arm, cell.name, remarks)
    try:
        difference = read_back(text, form, arm)
    except MISSING_SIMULATOR_ERRORS as error:
        return text, f"warning: not read back: {error}"
    said = "torque of bodies, armature and damping differs by"
    return text, f"read back: {said} {difference:.1e} of the largest at most"


def _sampled_arms(
    cell: Cell,
    actuators: Actuators,
    remarks: Sequence[str],
    to: str,
    export: WhatToExport,
    target: Path,
) -> dict[str, str]:
    """Return the files of the drawn arms by name."""
    count = export.count or 0
    digits = len(str(count))
    files = {}
    for k in range(count):
        remark = f"Arm {k + 1} of {count} drawn from the posterior with seed {export.seed}."
        text, _ = _description(cell, actuators.sample(k), (remark, *remarks), to, None)
        files[f"{target.stem}_{k + 1:0{digits}}{target.suffix}"] = text
    return files


def _played(
    text: str,
    actuators: Actuators,
    held_out: Sequence[Source],
    results: ServoResults,
    folder: Path | None,
    checked: str,
) -> tuple[tuple[PlayedBack, ...], str]:
    """Return errors of the held-out recordings in MuJoCo, and how the file was read back."""
    by_archive = {each.archive: each for each in results.validation}
    played = []
    for source in held_out:
        recording = source.recording
        commanded = recording.commanded_position
        if commanded is None or source.name not in by_archive:
            continue
        rows = np.isfinite(commanded).all(axis=1)
        time, command, measured = (
            part[rows] for part in (recording.time, commanded, recording.position)
        )
        wanted = command + actuators.value("offset")
        try:
            simulated = played_back(text, actuators.joint_names, time, wanted, measured[0], folder)
        except MissingMujocoError as missing:
            return (), f"warning: not read back: {missing}"
        except WriteBackError as problem:
            if folder is None:
                raise
            return (), f"warning: not read back: {problem}"
        stated = by_archive[source.name]
        error = _MILLI * float(np.sqrt(np.mean((simulated - measured) ** 2)))
        played.append(
            PlayedBack(
                source.name,
                error,
                stated.position_error_mrad,
                stated.command_error_mrad,
                results.error_unit,
            )
        )
    if folder is not None and played:
        checked = "read back: MuJoCo reads the file, its bodies stay"
    return tuple(played), checked


def _remarks(results: ServoResults) -> tuple[str, ...]:
    unknown = ", ".join(
        dict.fromkeys(
            value.joint for value in results.servo if value.name == "kp" and not value.determined
        )
    )
    planned = ", ".join(
        f"{value.joint} {value.value:.3g}"
        for value in results.servo
        if value.name == "acceleration" and value.determined
    )
    return (
        "Servo and friction identified by hil from commanded and measured positions; bodies are"
        " as in the URDF.",
        f"Verdict: {results.verdict.line}",
        *(
            [
                f"The torque scale of {unknown} is not determined: gains and friction are only"
                " valid together."
            ]
            if unknown
            else []
        ),
        *(
            [
                "The servo accelerates its set-point by a limited rate [rad/s² or m/s²],"
                f" which no simulator has: limit fast commands to this rate. {planned}."
            ]
            if planned
            else []
        ),
        *(
            []
            if results.delay_known
            else ["The delay is not known: commands and positions had different clocks."]
        ),
        "With these values this simulator's terms reproduce the motion best.",
        f"archives: {', '.join(results.archives)}",
    )
