"""The column map of a log, a TOML file: which columns or arrays hold which quantity.

`docs/logs.md` describes its entries.
"""

from __future__ import annotations

from importlib.resources import files
from os import PathLike
from pathlib import Path
from typing import Annotated, Final, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator

from hil.base.errors import SourceError
from hil.base.safe_input import parse_toml, path_exists, read_text, remedy_for_missing
from hil.cell.arms import Links
from hil.cell.errors import first_error
from hil.cell.field_error import FieldError
from hil.importers.units import RATED, UNITS, names_of_units, unit_of

KINEMATIC: Final = ("position", "velocity", "commanded_position")
"""Quantities of the motion."""
Vector = tuple[FiniteFloat, ...]
Column = Annotated[int, Field(ge=0)] | str
_Number = Annotated[int, Field(ge=1)]
DOCUMENTATION: Final = "the column map in docs/logs.md"
_ONE_OR_EACH = "a number, or a list of one per joint"
_Share = Annotated[FiniteFloat, Field(ge=0.0, lt=1.0)]
_PerJoint = Annotated[Vector | None, Field(description="a list of numbers, one per joint")]


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)


class TimeColumn(_Table):
    """The column of the time, in the file of the positions or in another `file`.

    If there is a file of positions per joint, all must have the same times. No unit is the one that
    the file states, or else the one that gives a rate at which robots are sampled. With a column of
    `nanoseconds` the first column is of whole seconds.
    """

    column: Column = Field(default=0, description="a name or an index from 0")
    array: str | None = None
    file: str | None = None
    unit: Literal["s", "ms", "us", "ns"] | None = Field(
        default=None, description='"s", "ms", "us" or "ns"'
    )
    nanoseconds: Column | None = Field(default=None, description="a name or an index from 0")


class Quantity(_Table):
    """Columns of a joint quantity.

    Attributes:
        columns: one per joint, by name or by index from 0; or one name with ``{}`` in place of the
            joint's number, from 1, or of its name. In files of arrays a name is that of an array.
            None: all columns of the file, one per joint.
        array: in files of arrays, the matrix that `columns` are columns of.
        file: relative to the log; None for the log itself.
        files: one per joint instead, as a list or one name with ``{}``. `columns` is then the one
            column or array of each; None if each has only one.
        joints_along: of a whole matrix; None: time is along the longer side.
        unit: a unit of the quantity; None for the one that the file states, or else the SI one.
        rated: value of each joint that is 100 %, in SI units, where the unit is per cent or per
            mille.
        sign_bit: of numbers that are a magnitude, the bit with their sign, as of servos: 10 where
            those from 1024 on are negative.
        offset: added to the recorded numbers, one for all joints or one each.
        scale: factor after that, one for all joints or one each.
        side: ``motor`` if it was measured before the gears.
        time: its own times, where they differ from `[time]`; by default in its own file.
        coupled: angles or velocities that contain other joints', as terms ``[joint, other,
            factor]``, numbered from 1: with ``[3, 2, 1.0]`` axis 3 is stated relative to the base.
    """

    columns: Annotated[tuple[Column, ...], Field(min_length=1)] | str | None = Field(
        default=None, description="a name, or a list of names or of indices from 0"
    )
    array: str | None = None
    file: str | None = None
    files: Annotated[tuple[str, ...], Field(min_length=1)] | str | None = Field(
        default=None,
        description='a name with {} for the joint, as in "q_{}.txt", or a list of names',
    )
    joints_along: Literal["columns", "rows"] | None = None
    unit: str | None = None
    rated: FiniteFloat | Vector | None = Field(default=None, description=_ONE_OR_EACH)
    sign_bit: Annotated[int, Field(ge=1, le=62)] | None = Field(
        default=None, description="the number of a bit, from 0"
    )
    offset: FiniteFloat | Vector = Field(default=0.0, description=_ONE_OR_EACH)
    scale: FiniteFloat | Vector = Field(default=1.0, description=_ONE_OR_EACH)
    side: Literal["joint", "motor"] = "joint"
    time: TimeColumn | None = None
    coupled: tuple[tuple[_Number, _Number, FiniteFloat], ...] = Field(
        default=(),
        description="a list of [joint, other joint, factor], numbered from 1",
    )


class Drive(_Table):
    """Gears between motors and joints, for quantities of the motor side.

    Attributes:
        gear_ratio: motor turns per joint turn, with sign.
        coupling: further terms ``[motor, joint, motor turns per joint turn]``, numbered from 1:
            with ``[6, 5, 32.0]`` joint 5 turns motor 6.
        motor_from_joint: the whole matrix instead, motor turns per joint turn (n, n).
        joint_offset: angle of the URDF where the recorded angle is zero [rad].
        torque_constant: N·m/A on the motor side; converts motor currents to torques where the log
            has no torque.
        torque_uncertainty: relative standard deviation of the torque constants, or of the scale of
            recorded torques, one for all joints or one each; by default that of the robot's cell.
    """

    gear_ratio: _PerJoint = None
    coupling: tuple[tuple[_Number, _Number, FiniteFloat], ...] = Field(
        default=(),
        description="a list of [motor, joint, motor turns per joint turn], numbered from 1",
    )
    motor_from_joint: tuple[Vector, ...] | None = Field(
        default=None, description="a matrix of numbers, as a list of its rows"
    )
    joint_offset: _PerJoint = None
    torque_constant: _PerJoint = None
    torque_uncertainty: _Share | Annotated[tuple[_Share, ...], Field(min_length=1)] | None = Field(
        default=None,
        description="relative standard deviation from 0 to 1, such as 0.03 for 3 %: "
        f"{_ONE_OR_EACH}",
    )

    @property
    def geared(self) -> bool:
        """Whether gears are given."""
        return bool(self.gear_ratio or self.motor_from_joint)


HOLE: Final = (
    'correct it, or leave such rows out: --drop-missing, or with a map [format] missing = "drop"'
)
"""Remedy for a number that is missing."""


class Format(_Table):
    """Format of the text; None is detected.

    Attributes:
        thousands: the mark between groups of three digits, where the column does not prove it.
        sheet: of a spreadsheet, where two are about equally large; by default the largest.
        encoding: of the text, such as ``utf-16`` or ``cp1252``.
        skip_rows: lines before the header, or before the data.
        header: whether a line of column names comes first.
        transposed: whether the lines of the file are channels instead of samples.
        skip_empty: empty lines between the rows mean nothing. By default those of a log without
            times are refused, as rows may be missing there.
        missing: ``refuse`` a log with a number that is missing or not finite, ``drop`` such rows
            from all quantities, or ``interpolate`` quantities that were recorded in rows of their
            own, as of two topics in one table, to the times of the one with the fewest samples.
    """

    delimiter: Annotated[str, Field(min_length=1, max_length=1)] | None = Field(
        default=None, description="a single character"
    )
    decimal: Literal[".", ","] | None = None
    thousands: Annotated[str, Field(min_length=1, max_length=1)] | None = Field(
        default=None, description="a single character"
    )
    sheet: str | None = None
    encoding: str | None = None
    skip_rows: Annotated[int, Field(ge=0, description="a number of lines")] = 0
    header: bool | None = None
    transposed: bool = False
    skip_empty: bool = False
    missing: Literal["refuse", "drop", "interpolate"] = "refuse"


class ColumnMap(_Table):
    """The column map, with either a time column or a `sample_rate` [Hz].

    `joints` are the URDF's joint of each column, where the order differs from that of the URDF, or
    where the log has joints that the URDF does not have: their columns are not used. `arm` are the
    links between which the recorded arm of a robot with several lies. With `outside_limits`
    positions outside the limits of the URDF are accepted.
    """

    position: Quantity
    velocity: Quantity | None = None
    torque: Quantity | None = None
    motor_current: Quantity | None = None
    commanded_position: Quantity | None = None
    time: TimeColumn | None = None
    sample_rate: Annotated[FiniteFloat, Field(gt=0.0)] | None = Field(
        default=None, description="a number above 0, in Hz"
    )
    joints: tuple[str, ...] | None = Field(default=None, description="a list of names")
    outside_limits: bool = False
    arm: Links = Links()
    drive: Drive = Drive()
    format: Format = Format()

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if (self.time is None) == (self.sample_rate is None):
            raise ValueError("give either a time column or sample_rate")
        for name, quantity in self.quantities().items():
            unit = None if quantity.unit is None else unit_of(quantity.unit, name)
            if quantity.unit is not None and unit is None:
                problem = f"{quantity.unit!r} is not a unit of {name}"
                remedy = f"use {names_of_units(name)}, or a product such as kgf.cm or deg/min"
                raise FieldError(problem, remedy)
            if unit in RATED and quantity.rated is None:
                whole = "100 %" if unit == RATED[0] else "1000 ‰"
                problem = f"{name} is a fraction of a rated value"
                raise FieldError(problem, f"give {name}.rated, the value of {whole} in SI units")
            if quantity.side == "motor" and name != "motor_current" and not self.drive.geared:
                raise ValueError(f"{name} is on the motor side, so drive.gear_ratio is needed")
            if quantity.files is not None and (quantity.file or quantity.joints_along):
                raise ValueError(f"{name} has files, so it has neither file nor joints_along")
            if isinstance(quantity.files, str) and "{}" not in quantity.files:
                problem = f"{name}.files has no {{}} for the joint's number"
                raise FieldError(problem, 'write it there, as in "q_{}.txt"')
            if quantity.time is not None and self.time is None:
                problem = f"{name}.time is given, and the positions have a sample_rate"
                raise FieldError(problem, "give [time] of the positions instead of sample_rate")
            if quantity.coupled and name not in KINEMATIC:
                remedy = f"give {KINEMATIC[0]}.coupled"
                raise FieldError(f"{name} has no coupled angles", remedy)
            if any(joint == other for joint, other, _ in quantity.coupled):
                raise FieldError(
                    f"{name}.coupled names two joints in each entry", f"use {name}.scale"
                )
            if 0.0 in np.atleast_1d(quantity.scale):
                raise ValueError(f"{name}.scale is 0, which removes the recorded values")
        if any(motor == joint for motor, joint, _ in self.drive.coupling):
            problem = "drive.coupling is between a motor and another joint"
            raise FieldError(problem, "use gear_ratio")
        if self.drive.motor_from_joint and (self.drive.gear_ratio or self.drive.coupling):
            raise ValueError("give either drive.motor_from_joint or gear_ratio and coupling")
        return self

    def quantities(self) -> dict[str, Quantity]:
        """Return the quantities in the log, by name."""
        by_name = {name: getattr(self, name) for name in UNITS}
        return {name: quantity for name, quantity in by_name.items() if quantity is not None}

    @classmethod
    def load(cls, path: str | PathLike[str]) -> ColumnMap:
        """Read a map from a TOML file, or the ready one of this name (`ready_maps`).

        Raises:
            SourceError: the file cannot be read, or is not a valid map.
        """
        path = Path(path)
        try:
            return cls.model_validate(parse_toml(map_text(path)))
        except ValidationError as error:
            wrong = first_error(path, error, cls, documentation=DOCUMENTATION)
            problem = wrong.problem
            field = wrong.field
            remedy = wrong.remedy
            raise SourceError(path, problem, field=field, remedy=remedy) from error
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            problem = f"cannot be read ({reason})"
            remedy = f"give a TOML file, or a ready map: {', '.join(ready_maps())}"
            if isinstance(error, FileNotFoundError):
                remedy = remedy_for_missing(path, remedy)
            raise SourceError(path, problem, remedy=remedy) from error


def map_text(path: Path) -> str:
    """Return the text of a file with a map, or of the ready one of this name; OSError."""
    is_ready = str(path) in ready_maps() and not path_exists(path)
    return ready_map(str(path)) if is_ready else read_text(path)


def ready_maps() -> dict[str, str]:
    """Return the first comment of each ready map, by its name."""
    folder = files(f"{__package__}.maps")
    names = sorted(file.name for file in folder.iterdir() if file.name.endswith(".toml"))
    return {name.removesuffix(".toml"): _purpose(ready_map(name[:-5])) for name in names}


def ready_map(name: str) -> str:
    """Return the text of a ready map."""
    return (files(f"{__package__}.maps") / f"{name}.toml").read_text("utf-8")


def _purpose(text: str) -> str:
    return text.partition("\n")[0].removeprefix("# ").partition(". ")[0].partition(": a ")[0]
