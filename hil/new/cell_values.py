"""Known values of a new cell file, and their origin."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, product
from os import PathLike
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from drivers.c4g_packets import N_ARMS, InitPacket
from drivers.drive_train import WRIST_AXES, DriveTrain
from drivers.errors import DriverError, PacketError
from drivers.exchange.process_handle import ExchangeProcess, ExchangeSettings
from drivers.guard import GuardLimits
from drivers.transports.base import TransportSpec
from hil.archive import open_archive
from hil.base.arrays import Array
from hil.base.errors import ArchiveError, ControllerError, OperatorStopError
from hil.base.safe_input import parse_toml
from hil.cell.errors import UNKNOWN
from hil.control.connection import Connection
from hil.control.link import SESSION_END_TIMEOUT
from hil.control.live_link import ExchangeMonitor
from hil.control.motion_watch import Stop
from identification.excitation import CollisionModelError, Workspace
from identification.model.joint_ranges import urdf_limits
from planner import JointLimits

from .found_shapes import check_by_found_shapes
from .notes import (
    CellNote,
    ClosedAxes,
    CollisionExceptions,
    FromSimulation,
    HomeNotChecked,
    PlainNote,
    ShapesNotFound,
    UnsupportedCycle,
)

_MAX_TURNED_JOINTS: Final = 3
"""Joints turned to find a clear home posture."""
_DECIMALS: Final = 3
"""Decimals of degrees; rounding is below the tolerance of URDF limits."""
_CYCLES_MS: Final = (1, 2)
ASSUMED: Final = "assumed"
"""Origin of assumed values."""


@dataclass(frozen=True)
class CellValues:
    """Values of a cell file by dotted field (`"?"` if unknown), their origins, and notes."""

    values: Mapping[str, Any] = field(default_factory=dict)
    origin: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[CellNote, ...] = ()

    @classmethod
    def of_origin(
        cls, origin: str, values: Mapping[str, Any], notes: Sequence[CellNote] = ()
    ) -> CellValues:
        """Create from values of one origin, without unknown fields."""
        nothing: list[Any] = [UNKNOWN]
        stated = {
            name: value
            for name, value in values.items()
            if value != UNKNOWN
            and not (isinstance(value, list) and value and value == nothing * len(value))
        }
        return cls(stated, dict.fromkeys(stated, origin), tuple(notes))

    def without(self, table: str) -> CellValues:
        """Return the values except one table."""
        remaining = {k: v for k, v in self.values.items() if not k.startswith(f"{table}.")}
        return replace(self, values=remaining, origin={k: self.origin[k] for k in remaining})

    def __or__(self, other: CellValues) -> CellValues:
        """Merge; `other` has precedence."""
        return CellValues(
            {**self.values, **other.values},
            {**self.origin, **other.origin},
            (*self.notes, *other.notes),
        )


def from_urdf(urdf: str, joint_names: Sequence[str]) -> CellValues:
    """Return the limits of a URDF in degrees, `"?"` if unknown; all torque limits or none."""
    limits = urdf_limits(urdf, joint_names)
    values: dict[str, Any] = {
        "limits.frame": "urdf",
        "limits.lower_deg": _degrees(limits.lower),
        "limits.upper_deg": _degrees(limits.upper),
        "limits.velocity_deg": _degrees(limits.velocity),
    }
    if np.isfinite(limits.effort).all():
        values["limits.torque"] = limits.effort.tolist()
    return CellValues.of_origin("from the URDF", values)


def assumed_for_design(cell_values: CellValues, n_joints: int) -> CellValues:
    """Return assumed values for a cell without controller.

    Home is zero, or the middle of a range without zero; continuous joints are limited to ±180°;
    full speed takes 0.3 s, full acceleration 0.1 s; no friction; floor at the base.
    """
    lower, upper, speed = (
        cell_values.values.get(f"limits.{name}_deg", [UNKNOWN] * n_joints)
        for name in ("lower", "upper", "velocity")
    )
    low = [-180.0 if bound == UNKNOWN else bound for bound in lower]
    high = [180.0 if bound == UNKNOWN else bound for bound in upper]

    def within(seconds: float) -> list[float | str]:
        return [
            UNKNOWN if limit == UNKNOWN else round(limit / seconds, _DECIMALS) for limit in speed
        ]

    zeros = [0.0] * n_joints
    values: dict[str, Any] = {
        "limits.acceleration_deg": within(0.3),
        "limits.jerk_deg": within(0.03),
        "campaign.home_deg": [
            0.0 if a < 0.0 < b else round(0.5 * (a + b), _DECIMALS)
            for a, b in zip(low, high, strict=True)
        ],
        "campaign.repetitions": 5,
        "campaign.validation_runs": 2,
        "workspace.floor": 0.0,
        "workspace.walls": [],
        "workspace.margin": 0.02,
        "nominal.rotor_inertia": zeros,
        "nominal.coulomb": zeros,
        "nominal.viscous": zeros,
    }
    if low != lower:
        values["limits.lower_deg"] = low
    if high != upper:
        values["limits.upper_deg"] = high
    return CellValues.of_origin(ASSUMED, values)


def clear_home(urdf: str, cell_values: CellValues, mesh_folders: Sequence[str]) -> CellValues:
    """Return the first clear posture with up to three joints turned by 90° from the home posture.

    Where none is clear of the floor, no floor is assumed. Of links without shapes, or with a mesh
    that is not found, only the height over the floor is checked. Notes report this, and pairs that
    are not checked or with less than the margin.
    """
    lower, upper = (
        np.radians(cell_values.values[f"limits.{end}_deg"]) for end in ("lower", "upper")
    )
    limits = JointLimits(lower, upper, *np.ones((3, len(lower))))  # rates do not matter
    postures = np.array([*_turned(np.radians(cell_values.values["campaign.home_deg"]), limits)])
    for floor in (cell_values.values["workspace.floor"], None):
        workspace = Workspace(floor, margin=cell_values.values["workspace.margin"])
        try:
            check = check_by_found_shapes(urdf, postures, workspace, limits, mesh_folders)
        except CollisionModelError as error:
            return CellValues(notes=(HomeNotChecked(str(error)),))
        clear = np.flatnonzero(check.clear)
        if len(clear) > 0:
            values: dict[str, Any] = {"campaign.home_deg": _degrees(postures[clear[0]])}
            notes = list[CellNote]()
            if any(check.exceptions):
                notes.append(CollisionExceptions(check.exceptions))
            if check.links:
                notes.append(ShapesNotFound(tuple(check.links)))
            if floor is None:
                values["workspace.floor"] = "none"
                notes.append(PlainNote.NO_FLOOR)
            return CellValues.of_origin(ASSUMED, values, notes)
    return CellValues(notes=(PlainNote.EVERY_POSTURE_IN_CONTACT,))


def _turned(home: Array, limits: JointLimits) -> Iterator[Array]:
    """Yield the home posture, and postures with joints turned by 90° within the limits."""
    for n in range(_MAX_TURNED_JOINTS + 1):
        for joints in combinations(range(len(home)), n):
            for turns in product((-0.5 * np.pi, 0.5 * np.pi), repeat=n):
                posture = home.copy()
                posture[[*joints]] += turns
                if np.all((posture > limits.lower) & (posture < limits.upper)):
                    yield posture


def from_init(init: InitPacket, n_joints: int, arm: int) -> CellValues:
    """Return the values of an init packet for the first `n_joints` axes of an arm (from 1)."""
    row = arm - 1
    n = n_joints
    wrist = dict(zip(("k54", "k64", "k65"), init.wrist_coupling(arm), strict=True))
    values: dict[str, Any] = {
        "drive_train.gear_ratio": _wire(init.gear_ratio[row, :n], zero=False),
        "drive_train.calibration": _wire(init.calibration[row, :n]),
        "drive_train.current_limit": _wire(init.current_limit[row, :n], positive=True),
        "drive_train.following_error": _wire(init.following_error[row, :n], positive=True),
        **{f"drive_train.{k}": _wire([v])[0] for k, v in wrist.items() if n >= WRIST_AXES},
        "controller.arm": arm,
    }
    notes = list[CellNote]()
    cycle = init.sample_time
    if cycle in _CYCLES_MS:
        values["controller.cycle_ms"] = cycle
    else:
        notes.append(UnsupportedCycle(cycle))
    opened = {axis.axis for axis in init.open_axes() if axis.arm == arm}
    if closed := tuple(axis + 1 for axis in range(n) if axis not in opened):
        notes.append(ClosedAxes(closed, arm))
    version = ".".join(map(str, init.version))
    return CellValues.of_origin(f"from the init packet (C4G {version})", values, notes)


def from_archive(path: str | PathLike[str], joint_names: Sequence[str]) -> CellValues:
    """Return the values of the cell and the init packet in an archive, or raise ArchiveError."""
    archive = open_archive(path, fields=())

    def refusal(problem: str, field: str = "", remedy: str = "") -> ArchiveError:
        remedy = remedy or "give an archive that hil wrote"
        return ArchiveError(archive.path, problem, field=field, remedy=remedy)

    if archive.joint_names != tuple(joint_names):
        raise refusal(
            f"belongs to an arm with joints {', '.join(archive.joint_names)}",
            remedy=f"the URDF has {', '.join(joint_names)}",
        )
    cell_values = CellValues()
    if "cell.toml" in archive.attachments:
        try:
            tables = parse_toml(archive.text("cell.toml"))
        except ValueError as error:
            raise refusal(f"is not TOML ({error})", "cell.toml") from error
        loose = [name for name, entries in tables.items() if not isinstance(entries, Mapping)]
        if loose:
            raise refusal(f"is not a cell file: {loose[0]!r} is not a table", "cell.toml")
        values = {f"{name}.{key}": value for name in tables for key, value in tables[name].items()}
        for name in ("cell.urdf", "cell.mesh_folders"):  # paths on the recording computer
            values.pop(name, None)
        cell_values = CellValues.of_origin(f"from {archive.path.name}", values)
    packet = archive.attachments.get("init_packet.bin")
    if packet is not None:
        arm = cell_values.values.get("controller.arm", 1)
        arm = arm if isinstance(arm, int) and 1 <= arm <= N_ARMS else 1
        try:
            cell_values |= from_init(InitPacket.decode(packet), len(joint_names), arm)
        except PacketError as error:
            raise refusal(f"is not an init packet ({error})", "init_packet.bin") from error
    if not cell_values.values:
        raise refusal("contains neither a cell nor an init packet")
    if archive.header.only_simulated:
        cell_values |= CellValues(notes=(FromSimulation(archive.path.name),))
    return cell_values


def _degrees(radians: ArrayLike) -> list[float | str]:
    return [
        round(float(value), _DECIMALS) + 0.0 if math.isfinite(value) else UNKNOWN
        for value in np.degrees(radians)
    ]


def _wire(values: ArrayLike, *, zero: bool = True, positive: bool = False) -> list[float | str]:
    """Return the shortest decimals of float32 values; `"?"` if invalid."""
    return [
        float(str(value))
        if math.isfinite(value) and (zero or value != 0.0) and not (positive and value <= 0.0)
        else UNKNOWN
        for value in np.asarray(values, dtype=np.float32)
    ]


_POLL_PERIOD = 0.05
_PLACEHOLDER_PERIOD = 0.002


def read_init(
    spec: TransportSpec, n_joints: int, *, arm: int, wait: float, stop: Stop
) -> InitPacket:
    """Wait for a controller to start a session, and return its init packet.

    Motion is impossible: the drive train of ones differs from any controller's, and there is no
    archive. Replies continue until the axes are closed.

    Args:
        spec: of the transport.
        n_joints: of the cell.
        arm: from 1.
        wait: longest time [s].
        stop: request of the operator.

    Raises:
        ControllerError: the link cannot be opened, or no session started in time.
        OperatorStopError: stopped before.
    """
    try:
        exchange = ExchangeProcess.start(_nothing_moves(spec, n_joints, arm))
    except (DriverError, OSError) as error:
        raise ControllerError(f"the link cannot be opened: {error}") from error
    try:
        return _waited_for(exchange, wait, stop)
    finally:
        exchange.finish()
        exchange.wait(SESSION_END_TIMEOUT)
        exchange.close()


def _waited_for(exchange: ExchangeProcess, wait: float, stop: Stop) -> InitPacket:
    deadline = time.monotonic() + wait
    connection = Connection()
    monitor = ExchangeMonitor(exchange)
    while not isinstance(connection.init, InitPacket):
        exchange.send_heartbeat()
        for event in monitor.poll():
            connection.update(event)
        if (failure := monitor.failure()) is not None:
            raise ControllerError(failure)
        if stop.requested:
            raise OperatorStopError(
                "stopped before a packet of the controller; no file was written."
            )
        if time.monotonic() > deadline:
            status = exchange.status()
            text = f"no init packet within {wait:g} s"
            if status.replied or status.malformed or status.stale:
                text += ", but other packets: a session was already running"
            text += f"; {connection.not_understood}" if connection.not_understood else ""
            text += "; start this command first, then the controller's Open program"
            text += f" ({status.foreign} packets from other addresses)" if status.foreign else ""
            raise ControllerError(text)
        time.sleep(_POLL_PERIOD)
    return connection.init


def _nothing_moves(spec: TransportSpec, n_joints: int, arm: int) -> ExchangeSettings:
    ones = np.ones(n_joints)
    zeros = np.zeros(n_joints)
    return ExchangeSettings(
        transport=spec,
        drive_train=DriveTrain(
            gear_ratio=ones, calibration=zeros, k54=0.0, k64=0.0, k65=0.0,
            joint_sign=ones, joint_offset=zeros, torque_constant=ones, current_limit=ones,
        ),
        guard_limits=GuardLimits(
            lower=-ones, upper=ones, velocity=ones, acceleration=ones, jerk=ones,
            following_error=ones, current=ones,
        ),
        period=_PLACEHOLDER_PERIOD,
        session={"arm": arm},
    )  # fmt: skip
