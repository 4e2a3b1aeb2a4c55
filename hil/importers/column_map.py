"""Which columns or arrays of a log hold what: the map that makes any log of numbers readable.

It is a small TOML file, or the same built in Python. `docs/archive-format.md` describes it,
`docs/bring-your-own-robot.md` shows it at work.
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator

from hil.errors import SourceError
from hil.reading import parse_toml, read_text

ANGLES = {
    "rad": 1.0,
    "mrad": 1e-3,
    "deg": 0.017453292519943295,
    "rev": 6.283185307179586,
    "m": 1.0,
    "mm": 1e-3,
}
RATES = {
    "rad/s": 1.0,
    "deg/s": ANGLES["deg"],
    "rev/s": ANGLES["rev"],
    "rpm": ANGLES["rev"] / 60.0,
    "m/s": 1.0,
    "mm/s": 1e-3,
}
TORQUES = {"N.m": 1.0, "N·m": 1.0, "Nm": 1.0, "mN.m": 1e-3, "kN.m": 1e3, "N": 1.0}
CURRENTS = {"A": 1.0, "mA": 1e-3}
UNITS = {"position": ANGLES, "velocity": RATES, "torque": TORQUES, "motor_current": CURRENTS}
QUANTITIES = tuple(UNITS)
TIMES = {"s": 0, "ms": 3, "us": 6, "ns": 9}  # decimal places to shift

Vector = tuple[FiniteFloat, ...]
Column = Annotated[int, Field(ge=0)] | str


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Quantity(_Table):
    """Where a joint quantity stands.

    Attributes:
        columns: one per joint, by name or by index from 0; or one name with ``{}`` in the place of
            the joint's number, from 1. In files of arrays a name is that of an array. None: all
            columns, one per joint.
        array: in files of arrays, the matrix that `columns` are columns of.
        file: the file, relative to the log that is imported; None for that log itself.
        files: one file per joint instead, as a list or as one name with ``{}`` in the place of the
            joint's number. `columns` is then the one column or array wanted of each; None where a
            file holds nothing else.
        joints_along: whether the joints of a whole matrix lie along its ``columns`` or ``rows``;
            None: time lies along the longer side.
        unit: a unit of the quantity; None for the SI one.
        offset: added to the numbers in the file, one for all joints or one each: a sensor's zero.
        scale: factor after that, one for all joints or one each; a sign, or a sensor's gain.
        side: ``joint``, or ``motor`` when it was measured before the gears.
    """

    columns: Annotated[tuple[Column, ...], Field(min_length=1)] | str | None = None
    array: str | None = None
    file: str | None = None
    files: Annotated[tuple[str, ...], Field(min_length=1)] | str | None = None
    joints_along: Literal["columns", "rows"] | None = None
    unit: str | None = None
    offset: FiniteFloat | Vector = 0.0
    scale: FiniteFloat | Vector = 1.0
    side: Literal["joint", "motor"] = "joint"


class TimeColumn(_Table):
    """Where the time stands, in s, ms, us or ns.

    Attributes:
        column: by name or index from 0; in files of arrays the name of an array.
        array: in files of arrays, the matrix that `column` is a column of.
        file: the file, relative to the log that is imported; None for that of the positions. Where
            these have one per joint, the times of all of them have to be the same.
        unit: of the numbers.
    """

    column: Column = 0
    array: str | None = None
    file: str | None = None
    unit: Literal["s", "ms", "us", "ns"] = "s"


class Drive(_Table):
    """What lies between motors and joints, for quantities of the motor side.

    Attributes:
        gear_ratio: motor turns per joint turn, with sign.
        coupling: further influences ``[motor, joint, motor turns per joint turn]``, numbered from
            1: ``[6, 5, 32.0]`` says that joint 5 turns motor 6.
        motor_from_joint: all of that as one matrix, motor turns per joint turn (n, n), instead.
        joint_offset: angle of the URDF where the recorded angle is zero [rad].
        torque_constant: N·m/A on the motor side; makes torques of motor currents where the log
            has no torque.
    """

    gear_ratio: Vector | None = None
    coupling: tuple[
        tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)], FiniteFloat], ...
    ] = ()
    motor_from_joint: tuple[Vector, ...] | None = None
    joint_offset: Vector | None = None
    torque_constant: Vector | None = None

    @property
    def geared(self) -> bool:
        """Whether anything is known of the gears."""
        return bool(self.gear_ratio or self.motor_from_joint)


class Format(_Table):
    """How the text is written; what is None is found out.

    Attributes:
        delimiter: between columns.
        decimal: the decimal mark.
        skip_rows: lines before the header, or before the data.
        header: whether a line of column names comes first.
        transposed: whether the channels lie along the lines of the file instead of its columns.
        skip_empty: leave out empty lines between the rows, which are refused otherwise.
        missing: what a row with a number missing or not finite is: ``refuse`` the log, or ``drop``
            the row from all quantities.
    """

    delimiter: Annotated[str, Field(min_length=1, max_length=1)] | None = None
    decimal: Literal[".", ","] | None = None
    skip_rows: Annotated[int, Field(ge=0)] = 0
    header: bool | None = None
    transposed: bool = False
    skip_empty: bool = False
    missing: Literal["refuse", "drop"] = "refuse"


class ColumnMap(_Table):
    """The whole map.

    Attributes:
        position: always needed.
        velocity, torque, motor_current: as far as they were recorded.
        time: the time column; either it or `sample_rate`.
        sample_rate: samples per second of a log without time column [Hz].
        joints: the URDF's joint of each column, where their order is not that of the URDF, or
            where the log has joints that the URDF has not: their columns are not used.
        drive: gears, for quantities of the motor side.
        format: delimiter and the like.
    """

    position: Quantity
    velocity: Quantity | None = None
    torque: Quantity | None = None
    motor_current: Quantity | None = None
    time: TimeColumn | None = None
    sample_rate: Annotated[FiniteFloat, Field(gt=0.0)] | None = None
    joints: tuple[str, ...] | None = None
    drive: Drive = Drive()
    format: Format = Format()

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if (self.time is None) == (self.sample_rate is None):
            raise ValueError("give either a time column or sample_rate")
        for name, quantity in self.quantities().items():
            if quantity.unit not in (None, *UNITS[name]):
                raise ValueError(
                    f"{quantity.unit!r} is no unit of {name}; known are {', '.join(UNITS[name])}"
                )
            if quantity.side == "motor" and name != "motor_current" and not self.drive.geared:
                raise ValueError(f"{name} is of the motor side, so drive.gear_ratio is needed")
            if quantity.files is not None and (quantity.file or quantity.joints_along):
                raise ValueError(f"{name} has files, so it has neither file nor joints_along")
            if isinstance(quantity.files, str) and "{}" not in quantity.files:
                raise ValueError(
                    f"{name}.files has no place for the joint's number; write {{}} there, as in "
                    '"q_{}.txt"'
                )
            if 0.0 in np.atleast_1d(quantity.scale):
                raise ValueError(
                    f"{name}.scale holds a 0, which leaves nothing of what was measured"
                )
        if any(motor == joint for motor, joint, _ in self.drive.coupling):
            raise ValueError(
                "drive.coupling is of a motor with another joint; its own is gear_ratio"
            )
        if self.drive.motor_from_joint and (self.drive.gear_ratio or self.drive.coupling):
            raise ValueError("give either drive.motor_from_joint or gear_ratio and coupling")
        return self

    def quantities(self) -> dict[str, Quantity]:
        """The quantities in the log, by name."""
        found = {name: getattr(self, name) for name in QUANTITIES}
        return {name: quantity for name, quantity in found.items() if quantity is not None}

    @classmethod
    def load(cls, path: str | PathLike[str]) -> ColumnMap:
        """Read a map from a TOML file.

        Raises:
            SourceError: the file cannot be read, or says something a map cannot say.
        """
        path = Path(path)
        try:
            return cls.model_validate(parse_toml(read_text(path)))
        except ValidationError as error:
            place, problem = _complaint(error)
            raise SourceError(
                path, problem, field=place, remedy="see the column map in docs/archive-format.md"
            ) from error
        except (OSError, ValueError) as error:
            raise SourceError(
                path, f"cannot be read ({error})", remedy="name a TOML file"
            ) from error


_PER_JOINT = "must be a list of numbers, one per joint"
_ONE_OR_EACH = "must be a number, or a list of one per joint"
_MUST_BE = {
    "sample_rate": "must be a number above 0, in Hz",
    "joints": "must be a list of names",
    "columns": "must be a name, or a list of names or of indices from 0",
    "column": "must be a name or an index from 0",
    "files": 'must be a name with {} for the joint, as in "q_{}.txt", or a list of names',
    "offset": _ONE_OR_EACH,
    "scale": _ONE_OR_EACH,
    "gear_ratio": _PER_JOINT,
    "joint_offset": _PER_JOINT,
    "torque_constant": _PER_JOINT,
    "coupling": "must be a list of [motor, joint, motor turns per joint turn], numbered from 1",
    "motor_from_joint": "must be a matrix of numbers, as a list of its rows",
    "delimiter": "must be a single character",
    "skip_rows": "must be a number of lines",
}
_OF_ANY = {
    "missing": "is missing",
    "extra_forbidden": "is not an entry of a column map",
    "model_type": "must be a table",
    "string_type": "must be a text",
}
_KINDS_OF_A_UNION = frozenset({"float", "str", "int"})


def _complaint(error: ValidationError) -> tuple[str, str]:
    """The entry that pydantic complains of first, and what is wrong with it, in our words."""
    detail = error.errors(include_url=False)[0]
    entries = [part for part in detail["loc"] if isinstance(part, str) and part.isidentifier()]
    entries = [part for part in entries if part not in _KINDS_OF_A_UNION]
    problem = _OF_ANY.get(detail["type"])
    if problem is None and entries:
        problem = _MUST_BE.get(entries[-1])
    if problem is None:
        problem = detail["msg"].removeprefix("Value error, ").replace("Input should", "must")
    return ".".join(entries), problem
