"""Cell file with its checks, the descriptions built from it, and its frame of angles."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Final, Literal, TypeVar

import numpy as np
from pydantic import ValidationError

from drivers.drive_train import DriveTrain
from drivers.errors import DriverError
from drivers.guard import GuardLimits
from drivers.transports.base import TransportError, TransportSpec
from drivers.ur.expected import ExpectedArm
from drivers.ur.script import StreamProgram
from drivers.ur.wire import UrProtocol
from hil.base.arrays import Array
from hil.base.safe_input import parse_toml, read_text, remedy_for_missing
from hil.base.terminal_text import typed
from identification.model.joint_ranges import urdf_limits
from identification.model.robot import RobotModel
from identification.model.workspace import Box, Workspace
from planner.limits import JointLimits

from .errors import CellError, first_error, require_known
from .robot_model import robot_model
from .schema import (
    COMMON_FRICTION_ENTRIES,
    LINKS,
    CampaignTable,
    CellFile,
    ControllerTable,
    DriveTrainTable,
    FrictionTable,
    JointFrictionTable,
    NominalTable,
    SimulationTable,
    Table,
)
from .toml_edits import with_values

T = TypeVar("T")

UR_GAP_MS: Final = 8
"""Time of the `max_gap` of Universal Robots controllers without another: a set-point is used some
two cycles after it was sent, and a computer without a real-time system is late now and then. With
one cycle more their program stops the arm, in any case within 20 ms of silence."""
FLANGES: Final = ("tool0", "flange")
"""Links of URDFs that are the frame in which a controller states a payload."""
ASSUMED_PAYLOAD: Final = "robot.payload"
"""Entry of `[cell] assumed` in the cell of an arm with a payload that is to be weighed."""


@dataclass(frozen=True, eq=False, repr=False)
class Cell:
    """A cell: text of its file, text of its URDF, and their content.

    Angles are URDF angles, except in the file and in `controller_angles`.
    """

    path: Path
    text: str
    urdf: str
    file: CellFile

    @classmethod
    def load(cls, path: Path | str) -> Cell:
        """Read and check a cell file and its URDF.

        Raises:
            CellError: a field is invalid.
        """
        path = Path(path)
        text = _read(path, path, "", None, "give a TOML file")
        name = _parse(path, text).cell.urdf
        urdf_path = path.parent / name
        urdf = _read(urdf_path, path, "cell.urdf", name, f"put a URDF at {urdf_path}")
        return cls.from_texts(text, urdf, path)

    @classmethod
    def from_texts(cls, text: str, urdf: str, path: Path) -> Cell:
        """Create a cell from its texts (as in an archive); `path` is for errors.

        Equal texts give the same cell, with the model that was built for it.
        """
        return _checked_cell(text, urdf, path)

    @property
    def name(self) -> str:
        """Short name."""
        return self.file.cell.name

    @property
    def mesh_folders(self) -> tuple[str, ...]:
        """Folders that contain the packages of `package://` mesh paths."""
        return tuple(str(self.path.parent / name) for name in self.file.cell.mesh_folders)

    @property
    def stated(self) -> CellFile:
        """Content of the text, without changes such as :meth:`with_friction`."""
        return _parse(self.path, self.text)

    @cached_property
    def model(self) -> RobotModel:
        """Rigid body model with rotor inertias and friction law, from the URDF."""
        return robot_model(
            self.path,
            self.file.cell.urdf,
            self.urdf,
            self.file.robot,
            lambda: self.drive_train.motor_from_joint,
        )

    def with_friction(self, **changes: Any) -> Cell:
        """Return the cell with changed entries of `[robot.friction]` for all joints."""
        if not changes:
            return self
        table = self.file.robot.friction
        joints = {
            name: JointFrictionTable(
                **joint_table.model_dump(exclude_unset=True, exclude={*changes})
            )
            for name, joint_table in table.joints.items()
        }
        changed = self._with_robot(friction=table.model_copy(update={**changes, "joints": joints}))
        _ = changed.model
        return changed

    def with_friction_laws(self, laws: Sequence[Mapping[str, Any]]) -> Cell:
        """Return the cell with a table `[robot.friction]` for each joint, in their order.

        Further tables, of coupled motors, equal the tables of their joints.

        Raises:
            ValueError: a table is invalid.
        """
        tables = dict(zip(self.joint_names, laws, strict=False))
        common = FrictionTable.model_validate(dict(laws[0]))
        joints = {
            name: JointFrictionTable.model_validate(
                {k: v for k, v in law.items() if k not in COMMON_FRICTION_ENTRIES}
            )
            for name, law in tables.items()
        }
        changed = self._with_robot(friction=common.model_copy(update={"joints": joints}))
        if [law.table() for law in changed.model.friction.laws] != [dict(law) for law in laws]:
            raise ValueError("the friction laws belong to joints of another arm")
        return changed

    def without_payload(self) -> Cell:
        """Return the cell without `[robot.payload]`."""
        return self._with_robot(payload=None)

    def _with_robot(self, **changes: Any) -> Cell:
        robot = self.file.robot.model_copy(update=changes)
        return replace(self, file=self.file.model_copy(update={"robot": robot}))

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Joints in the order of the URDF."""
        return tuple(self.model.joint_names)

    @property
    def period(self) -> float:
        """Cycle of the controller, s."""
        return self.controller.cycle_ms / 1000

    @property
    def controller(self) -> ControllerTable:
        """`[controller]`, which a campaign needs."""
        return _required(self, self.file.controller, "controller")

    @property
    def campaign(self) -> CampaignTable:
        """`[campaign]`."""
        return _required(self, self.file.campaign, "campaign")

    @property
    def simulation(self) -> SimulationTable:
        """`[simulation]`: true parameters of a simulated cell."""
        return _required(self, self.file.simulation, "simulation")

    @cached_property
    def joint_limits(self) -> JointLimits:
        """Limits in URDF angles (rad, rad/s, rad/s², rad/s³)."""
        limits = _required(self, self.file.limits, "limits")
        ends = AngleFrame.of(self).urdf(np.array([limits.lower_deg, limits.upper_deg]))
        return JointLimits(
            lower=ends.min(axis=0),
            upper=ends.max(axis=0),
            velocity=np.radians(limits.velocity_deg),
            acceleration=np.radians(limits.acceleration_deg),
            jerk=np.radians(limits.jerk_deg),
        )

    @property
    def torque_limit(self) -> Array | None:
        """Largest torque of each joint (n,) [N·m]; None if not stated."""
        limits = self.file.limits
        return np.array(limits.torque) if limits is not None and limits.torque else None

    @cached_property
    def drive_train(self) -> DriveTrain:
        """Motors, gears and wrist coupling."""
        table = self.drive_table
        return DriveTrain(
            gear_ratio=np.array(table.gear_ratio),
            calibration=np.array(table.calibration),
            k54=table.k54,
            k64=table.k64,
            k65=table.k65,
            joint_sign=np.array(table.joint_sign, dtype=float),
            joint_offset=np.radians(table.joint_offset_deg),
            torque_constant=np.array(table.torque_constant),
            current_limit=np.array(table.current_limit),
        )

    @property
    def drive_table(self) -> DriveTrainTable:
        """`[drive_train]`."""
        return _required(self, self.file.drive_train, "drive_train")

    @property
    def guard_limits(self) -> GuardLimits:
        """Limits that the guard enforces on every set-point."""
        limits = self.joint_limits
        bounds = self.file.bounds
        return GuardLimits(
            lower=limits.lower,
            upper=limits.upper,
            velocity=limits.velocity,
            acceleration=limits.acceleration,
            jerk=limits.jerk,
            following_error=np.array(self.drive_table.following_error),
            current=self.drive_train.current_limit,
            override_acceleration=bounds.override.acceleration,
            override_jerk=bounds.override.jerk,
            stop_acceleration=bounds.stop.acceleration,
            stop_jerk=bounds.stop.jerk,
        )

    @property
    def link_spec(self) -> TransportSpec | None:
        """Settings of the link, not checked; None with transport "simulated"."""
        table = self.controller
        if table.transport == "simulated":
            return None
        return LINKS[table.transport].spec(table, len(self.joint_names))

    def transport_spec(self) -> TransportSpec:
        """Return the settings that open the link.

        Raises:
            CellError: the cell is simulated, or its link cannot carry the session.
        """
        table = self.controller
        spec = self.link_spec
        if spec is None:
            problem = "a simulated controller has no link"
            remedy = "write one of " + ", ".join(f'"{name}"' for name in LINKS)
            raise self.error("controller.transport", table.transport, problem, remedy)
        try:
            spec.check(table.mode)
        except TransportError as error:
            field = f"controller.{table.transport}"
            problem = f"{error.link}: {error.reason}"
            raise self.error(field, None, problem, error.remedy) from error
        return spec

    @property
    def assumes_payload(self) -> bool:
        """Whether `[robot.payload]` is assumed: the loaded side of a payload campaign."""
        return ASSUMED_PAYLOAD in self.file.cell.assumed

    @property
    def only_simulated(self) -> bool:
        """Whether the link can reach only a simulated controller."""
        return self.simulates(self.link_spec)

    def simulates(self, spec: TransportSpec | None) -> bool:
        """Whether a transport leads to a simulated controller: on this computer, by `[simulation]`.

        Without that table a program on this computer may be a bridge to a real controller.
        """
        return spec is None or (spec.is_local and self.file.simulation is not None)

    @property
    def is_ur(self) -> bool:
        """Whether the controller is one of Universal Robots, real or simulated."""
        table = self.controller
        return table.transport == "rtde" or "rtde" in table.model_fields_set

    @property
    def expected_arm(self) -> ExpectedArm:
        """The arm that must be at the other end of a link to Universal Robots."""
        table, payload = self.controller.rtde, self.file.robot.payload
        at_flange = payload is not None and payload.frame in FLANGES
        return ExpectedArm(
            serial_number=self.file.cell.serial_number,
            model=table.model,
            calibration=table.calibration,
            payload=0.0 if payload is None else payload.mass,
            centre=payload.centre if payload is not None and at_flange else None,
        )

    @property
    def ur_protocol(self) -> UrProtocol:
        """Protocol of a controller of Universal Robots, with the program that moves the arm."""
        limits = self.guard_limits
        ratio = np.abs(self.drive_train.gear_ratio)
        program = StreamProgram(
            token=1,
            period=self.period,
            patience=self.max_gap + 1,
            velocity=tuple(limits.velocity.tolist()),
            deviation=tuple((2.0 * np.pi * limits.following_error / ratio).tolist()),
            deceleration=float(limits.stop_acceleration * limits.acceleration.min()),
        )
        return UrProtocol(self.expected_arm, program)

    @property
    def max_gap(self) -> int:
        """Consecutive missed packets that a motion tolerates."""
        table = self.controller
        given = "max_gap" in table.model_fields_set
        return round(UR_GAP_MS / table.cycle_ms) if self.is_ur and not given else table.max_gap

    def session_settings(self, *, only_axis: int | None = None) -> dict[str, Any]:
        """Keyword arguments of `drivers.Session`."""
        table = self.controller
        campaign = self.file.campaign
        settings: dict[str, Any] = {
            "mode": table.mode,
            "arm": table.arm,
            "max_gap": self.max_gap,
            "other_axes": frozenset(table.other_axes),
        }
        if self.is_ur:
            settings["protocol"] = self.ur_protocol
        if only_axis is not None:
            settings["only_axis"] = only_axis
        if campaign is not None:
            settings["settle_cycles"] = max(1, round(campaign.settle_s / self.period))
        return settings

    @property
    def workspace(self) -> Workspace:
        """Floor, walls and clearance."""
        table = self.file.workspace
        return Workspace(
            floor=None if table.floor == "none" else table.floor,
            boxes=tuple(Box(lower=b.lower, upper=b.upper) for b in table.walls),
            margin=table.margin,
        )

    @property
    def home(self) -> Array:
        """Start posture of excitations (n,), URDF angles, rad."""
        return AngleFrame.of(self).urdf(np.array(self.campaign.home_deg))

    @property
    def initial(self) -> Array:
        """Initial posture of the simulated arm (n,), URDF angles, rad."""
        return AngleFrame.of(self).urdf(np.array(self.simulation.initial_deg))

    def with_values(self, values: Mapping[str, Any]) -> Cell:
        """Return the cell with changed values in its file, by dotted name; None changes nothing.

        Raises:
            CellError: a value is invalid.
            InputError: the layout of the file does not allow the change.
        """
        return Cell.from_texts(with_values(self.text, values), self.urdf, self.path)

    def with_campaign(
        self,
        *,
        repetitions: int | None = None,
        validation_runs: int | None = None,
        simulation_seed: int | None = None,
    ) -> Cell:
        """Return the cell with changed settings of a campaign; None changes nothing."""
        return self.with_values(
            {
                "campaign.repetitions": repetitions,
                "campaign.validation_runs": validation_runs,
                "simulation.seed": simulation_seed,
            }
        )

    def with_link(self, **controller: Any) -> Cell:
        """Return the cell with changed entries of `[controller]`; None changes nothing.

        Tables in it are given as such, or by the entries to change.
        """
        values: dict[str, Any] = {}
        for key, value in controller.items():
            entries = value.model_dump(exclude_none=True) if isinstance(value, Table) else value
            if isinstance(entries, Mapping):
                values |= {f"controller.{key}.{name}": entry for name, entry in entries.items()}
            else:
                values[f"controller.{key}"] = entries
        return self.with_values(values)

    def with_urdf(self, path: Path, name: str) -> Cell:
        """Return the cell for a file `path` with the URDF `name`; mesh folders are adapted."""
        moved = [
            folder if Path(folder).is_absolute() else os.path.relpath(place, path.parent)
            for folder, place in zip(self.file.cell.mesh_folders, self.mesh_folders, strict=True)
        ]
        values = {"cell.urdf": name, "cell.mesh_folders": moved or None}
        return Cell.from_texts(with_values(self.text, values), self.urdf, path)

    @property
    def nominal(self) -> NominalTable:
        """`[nominal]`."""
        return _required(self, self.file.nominal, "nominal")

    def nominal_values(self) -> Array:
        """Return the nominal parameter vector (p,): URDF inertias and `[nominal]`."""
        table = self.nominal
        return self.parameter_values(
            rotor_inertia=np.array(table.rotor_inertia),
            coulomb=np.array(table.coulomb),
            viscous=np.array(table.viscous),
            third=np.array(table.third or np.zeros(len(self.joint_names))),
        )

    def parameter_values(
        self,
        *,
        rotor_inertia: Array,
        coulomb: Array,
        viscous: Array,
        third: Array,
        inertia_scale: Array | None = None,
    ) -> Array:
        """Return the parameter vector (p,) of URDF inertias and joint-side values.

        Springs and balancers are as in the file; other parameters (coupling inertia, offset,
        Stribeck) are zero.

        Args:
            rotor_inertia: of each joint (n,).
            coulomb: friction (n,).
            viscous: friction (n,).
            third: friction (n,).
            inertia_scale: by which the inertias of links are multiplied (n,).
        """
        model = self.model
        standard = model.nominal
        if inertia_scale is not None:
            standard[model.layout.links] *= inertia_scale[:, None]
        if model.layout.rotor_inertia:
            standard[model.layout.rotors] = rotor_inertia
        joint_values = {"coulomb": coulomb, "viscous": viscous, "third": third}
        friction = [
            0.0 if motor or term.option not in joint_values else joint_values[term.option][owner]
            for _, term, owner, motor, _ in model.friction.terms
        ]
        return np.concatenate([model.base.grouping @ standard, friction, model.elements.nominal])

    def controller_angles(self, urdf_angles: Array) -> Array:
        """Convert URDF angles (n,) to teach pendant angles, rad."""
        frame = AngleFrame.pendant(self)
        return np.asarray(urdf_angles * frame.sign + frame.offset, dtype=np.float64)

    def error(self, field: str, value: object, problem: str, remedy: str) -> CellError:
        """Return an error of a field of this file.

        Args:
            field: its name.
            value: that it has.
            problem: what is wrong.
            remedy: what to do.
        """
        return CellError(self.path, field, value, problem, remedy)


def _parse(path: Path, text: str) -> CellFile:
    try:
        raw = parse_toml(text)
    except ValueError as error:
        raise CellError(path, "", None, f"is not TOML ({error})", "correct that line") from error
    require_known(path, raw, CellFile)
    try:
        return CellFile.model_validate(raw)
    except ValidationError as error:
        raise first_error(path, error, CellFile) from error


def _read(file: Path, path: Path, field: str, value: object, remedy: str) -> str:
    """Read the cell file `path`, or a file named in one of its fields."""
    try:
        return read_text(file)
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        if isinstance(error, FileNotFoundError):
            remedy = remedy_for_missing(file, remedy)
        raise CellError(path, field, value, f"cannot be read ({why})", remedy) from error


def _required(cell: Cell, table: T | None, name: str) -> T:
    if table is None:
        remedy = f"add a table [{name}]"
        if sliding := _sliding(cell):
            urdf = typed(cell.path.parent / cell.file.cell.urdf)
            remedy = (
                f"{sliding} is prismatic, and motions are planned for other joints: write a cell "
                f"of those, `hil new --urdf {urdf} --fix {typed(sliding)}`"
            )
        raise CellError(cell.path, name, None, "is missing", remedy)
    return table


def _sliding(cell: Cell) -> str:
    """Return the first prismatic joint, "" if there is none."""
    kinds = zip(cell.joint_names, cell.model.chain.revolute, strict=True)
    return next((name for name, turns in kinds if not turns), "")


@dataclass(frozen=True, eq=False)
class AngleFrame:
    """Frame of displayed angles, as in `[limits]`: shown = sign x URDF angle + offset.

    Attributes:
        name: "controller" or "urdf".
        sign: 1 or -1 of each joint (n,).
        offset: offset of each joint (n,) [rad].
    """

    name: Literal["controller", "urdf"]
    sign: Array
    offset: Array

    @classmethod
    def of(cls, cell: Cell) -> AngleFrame:
        """Return the frame of the limits and postures of a cell."""
        limits = _required(cell, cell.file.limits, "limits")
        if limits.frame == "controller":
            return cls.pendant(cell)
        n = len(limits.lower_deg)
        return cls("urdf", np.ones(n), np.zeros(n))

    @classmethod
    def pendant(cls, cell: Cell) -> AngleFrame:
        """Return the frame of the teach pendant."""
        table = cell.drive_table
        sign = np.array(table.joint_sign, dtype=np.float64)
        return cls("controller", sign, np.radians(table.joint_offset_deg))

    def shown(self, q: Array) -> Array:
        """Convert URDF angles (..., n) [rad] to displayed angles [deg]."""
        return np.asarray(np.degrees(q * self.sign + self.offset), dtype=np.float64)

    def shown_rate(self, rate: Array) -> Array:
        """Convert rates of URDF angles (..., n) [rad] to displayed rates [deg/s, deg/s²]."""
        return np.asarray(np.degrees(rate * self.sign), dtype=np.float64)

    def text_of_angles(self, q: Array | Sequence[float]) -> str:
        """Format a posture of URDF angles (n,) [rad] in displayed angles."""
        shown = enumerate(self.shown(np.asarray(q)), 1)
        angles = ", ".join(f"J{joint} {angle:z.1f}" for joint, angle in shown)
        return f"{angles} deg, {self.whose}"

    @property
    def whose(self) -> str:
        """Name of the displayed angles."""
        return "teach pendant angles" if self.name == "controller" else "angles of the URDF"

    def urdf(self, shown: Array) -> Array:
        """Convert displayed angles (..., n) [deg] to URDF angles [rad]."""
        return np.asarray((np.radians(shown) - self.offset) * self.sign, dtype=np.float64)


URDF_ROUNDING = 1e-5  # Relative tolerance for the rounding of degrees and radians

_MAY_BE_EMPTY = {"nominal.third", "limits.torque"} | {
    f"simulation.{name}" for name in ("elasticity", "inertia_scale")
}
_TURNING_ONLY = ("limits", "drive_train", "campaign", "simulation")


@lru_cache(maxsize=16)  # every step from a log to its results asks for the cell of a recording
def _checked_cell(text: str, urdf: str, path: Path) -> Cell:
    cell = Cell(path, text, urdf, _parse(path, text))
    _ = cell.model
    _check(cell)
    return cell


def _check(cell: Cell) -> None:
    """Check fields against each other and against the URDF (CellError)."""
    file = cell.file
    _check_assumed(cell)
    tables = [name for name in _TURNING_ONLY if getattr(file, name) is not None]
    if tables and file.robot.locked:  # motions are checked with all joints of the URDF
        given = ", ".join(file.robot.locked)
        fixed = 'fix these joints in the URDF (type = "fixed")'
        problem = f"is for arms identified from recordings, but there is a table [{tables[0]}]"
        raise cell.error("robot.locked", given, problem, fixed)
    if tables and not all(cell.model.chain.revolute):
        sliding = cell.joint_names[[*cell.model.chain.revolute].index(False)]
        problem = f"is in degrees and revolutions, but joint {sliding} is prismatic"
        remedy = (
            'fix it in the URDF (type = "fixed"); arms with prismatic joints can be identified '
            "from recordings, but not moved"
        )
        raise cell.error(tables[0], None, problem, remedy)
    _check_lengths(cell)
    _check_uncertainty(cell)
    # Errors of derived objects are reported on loading.
    with_drives = file.drive_train is not None
    placed = file.limits is not None and (with_drives or file.limits.frame == "urdf")
    for table, attribute, wanted in (
        ("workspace", "workspace", True),
        ("drive_train", "drive_train", with_drives),
        ("limits", "joint_limits", placed),
        ("bounds", "guard_limits", placed and with_drives),
    ):
        try:
            _ = getattr(cell, attribute) if wanted else None
        except (ValueError, DriverError) as error:
            raise cell.error(table, None, str(error), "correct that table") from error
    if placed:
        _check_limits(cell)
        _check_postures(cell)


def _check_assumed(cell: Cell) -> None:
    """Check that assumed fields exist."""
    for name in cell.file.cell.assumed:
        table, _, field = name.partition(".")
        entries = getattr(cell.file, table) if table in CellFile.model_fields else ()
        if entries is None:
            problem = f"is missing, but listed in cell.assumed as {name}"
            raise cell.error(table, None, problem, f"add a table [{table}], or remove the name")
        if field not in dict(entries):
            remedy = 'write fields as "table.field"'
            raise cell.error("cell.assumed", name, "names no field of this file", remedy)


def _check_lengths(cell: Cell) -> None:
    """Check that lists with one entry per joint have the length of the URDF."""
    n_joints = cell.model.n_joints
    names = ", ".join(cell.joint_names)
    tables = {name: getattr(cell.file, name) for name in ("nominal", *_TURNING_ONLY)}
    if cell.file.simulation is not None:
        tables["simulation.drive_train"] = cell.file.simulation.drive_train
    for table, entries in tables.items():
        for name, value in entries or ():
            field = f"{table}.{name}"
            allowed = {n_joints, 0} if field in _MAY_BE_EMPTY else {n_joints}
            if isinstance(value, list) and len(value) not in allowed:
                problem = f"has {len(value)} entries but the URDF has {n_joints} joints"
                remedy = f"give one entry for each of {names}{' or none' * (0 in allowed)}"
                raise cell.error(field, value, problem, remedy)


def _check_uncertainty(cell: Cell) -> None:
    """Check that the uncertainty of torques is stated once, with an entry for each joint."""
    stated = cell.file.robot.torque_uncertainty
    drives = cell.file.drive_train
    field = "robot.torque_uncertainty"
    if stated is not None and drives is not None and drives.torque_uncertainty is not None:
        problem = "is stated in [drive_train], too"
        raise cell.error(field, stated, problem, "remove it from [robot]")
    if isinstance(stated, list) and len(stated) != cell.model.n_joints:
        problem = f"has {len(stated)} entries but the URDF has {cell.model.n_joints} joints"
        remedy = f"give a number for all joints, or one for each of {', '.join(cell.joint_names)}"
        raise cell.error(field, stated, problem, remedy)


def _check_postures(cell: Cell) -> None:
    """Check that the postures of the file lie inside its limits."""
    limits = cell.joint_limits
    file = cell.file
    remedy = "choose a posture inside the limits, which are in degrees"
    postures = {} if file.campaign is None else {"campaign.home_deg": cell.home}
    postures |= {} if file.simulation is None else {"simulation.initial_deg": cell.initial}
    for field, posture in postures.items():
        for joint in np.flatnonzero(~((posture >= limits.lower) & (posture <= limits.upper))):
            problem = f"{cell.joint_names[joint]} is outside [limits]"
            raise cell.error(field, None, problem, remedy)


def _check_limits(cell: Cell) -> None:
    """Check that limits are not wider than the URDF's."""
    limits = cell.joint_limits
    allowed = urdf_limits(cell.urdf, cell.joint_names)
    for field, values, bounds, beyond in (
        ("lower_deg", limits.lower, allowed.lower, -1.0),
        ("upper_deg", limits.upper, allowed.upper, 1.0),
        ("velocity_deg", limits.velocity, allowed.velocity, 1.0),
    ):
        wider = beyond * (values - bounds) > URDF_ROUNDING * np.maximum(1.0, np.abs(bounds))
        for joint in np.flatnonzero(wider):
            cell_limit, theirs = np.degrees([values[joint], bounds[joint]])
            problem = (
                f"{cell_limit:.6g}° of {cell.joint_names[joint]} (URDF angle or speed) exceeds the "
                f"{theirs:.6g}° of the URDF"
            )
            raise cell.error(f"limits.{field}", None, problem, "narrow it, or correct the URDF")
