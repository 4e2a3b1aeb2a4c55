"""Values of a new cell file that a Universal Robots arm states of itself."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DriverError
from drivers.ur.identity import ArmIdentity, DhParameters, ask_identity
from drivers.ur.outputs import GEAR_RATIO, N_JOINTS, TORQUES
from drivers.ur.reader import RtdeReader
from drivers.ur.torque_constants import RELATIVE_UNCERTAINTY, by_size, stated_constants
from drivers.ur.transport import RtdeSpec
from hil.base.arrays import Array
from hil.base.errors import ControllerError, InputError
from hil.cell.cell import FLANGES
from hil.cell.errors import UNKNOWN
from hil.cell.gripper_names import links_of
from hil.cell.schema import RtdeTable

from .cell_text import NewCell, cell_of_parameters
from .cell_values import ASSUMED, CellValues
from .notes import (
    CellNote,
    NotAsked,
    PayloadWithoutFrame,
    PlainNote,
)

JOINT_NAMES: Final = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
"""Of the URDF by the maker."""
CONVENTION: Final = "of every arm of this maker"
"""Origin of gears, signs and offsets: angles as in the URDF, torques scaled by the ratio."""
_LISTENING_SECONDS: Final = 1.0
"""Time of which outputs are used, s."""
REST_WAIT_SECONDS: Final = 20.0
"""Longest wait for an arm that moves to rest for so long, s: a pause of its program will do."""
_COULOMB_SHARE: Final = 0.05
"""Assumed Coulomb friction, as a share of the largest torque."""
_JERK_TIME: Final = 0.1
"""Assumed time of full acceleration, s."""
_SERVO_LAG: Final = 0.035
"""Time from a set-point to the arm that servoj takes at its shortest look-ahead [s]: measured by
users of the maker's client library and ROS 2 driver (issues 86 and 1311), 34 and 35 ms."""
_LAG_MARGIN: Final = 1.5
"""Largest distance from the set-point, as a multiple of what that lag is at full speed."""
_FULL_SPEED: Final = np.pi  # of a joint whose speed the arm does not state, rad/s
_ENCODER_COUNTS: Final = 65536


@dataclass(frozen=True, eq=False)
class UrArmStatements:
    """What an arm states of itself: who it is, and a second of its outputs (k,) by name.

    Attributes:
        address: of its controller.
        major: version of its software.
        cycle_ms: of its outputs.
    """

    address: RtdeSpec
    identity: ArmIdentity
    major: int
    cycle_ms: int
    outputs: NDArray[np.void]

    @property
    def model(self) -> str | None:
        """Name of its type, such as "UR5e"."""
        return self.identity.named(self.major)

    @property
    def dh(self) -> DhParameters | None:
        """Calibrated kinematics, else the kinematics of its type."""
        return self.identity.calibrated or self.identity.nominal


def ask_arm(
    spec: RtdeSpec, ports: RtdeTable, *, waits: Callable[[float], object] = float
) -> UrArmStatements:
    """Return what an arm states of itself; nothing moves, and nothing is claimed.

    Args:
        spec: of its RTDE.
        ports: of its other interfaces.
        waits: called with the longest wait [s] if it moves.

    Raises:
        ControllerError: it cannot be reached, or sends nothing.
    """
    identity = ask_identity(spec.host, primary=ports.primary_port, dashboard=ports.dashboard_port)
    try:
        with RtdeReader.connect(spec) as reader:
            reader.start()
            cycle_ms = round(1000.0 / reader.frequency)
            outputs = _at_rest(reader, waits)
            version = reader.version.major
    except DriverError as error:
        raise ControllerError(str(error)) from error
    return UrArmStatements(spec, identity, version, cycle_ms, outputs)


def _at_rest(reader: RtdeReader, waits: Callable[[float], object]) -> NDArray[np.void]:
    """Return the outputs of the first second at rest, else of the last one."""
    count = round(_LISTENING_SECONDS * reader.frequency)
    most = round(REST_WAIT_SECONDS * reader.frequency)
    deadline = time.monotonic() + REST_WAIT_SECONDS
    rows = reader.fetch(_LISTENING_SECONDS, count).values
    received = len(rows)
    while time.monotonic() < deadline:
        rows = rows[-count:]
        if len(rows) == count and (rows["target_qd"] == 0.0).all():
            break
        if received >= most:
            break
        if len(rows) == count:
            waits(REST_WAIT_SECONDS)
            waits = float
        more = reader.fetch(_LISTENING_SECONDS, count // 10).values
        received += len(more)
        rows = np.concatenate((rows, more))
    return rows


def cell_of_arm(arm: UrArmStatements, described: NewCell | None) -> NewCell:
    """Return the cell of an arm, `described` by a URDF, else by the kinematics that it states.

    Raises:
        InputError: it states no kinematics, or the URDF has another number of joints.
    """
    if described is None:
        dh = arm.dh
        if dh is None:
            problem = f"its primary interface cannot be asked ({arm.identity.unreachable[0]})"
            raise InputError(None, problem, remedy="give its URDF: --urdf")
        parameters = {"a": dh.a, "alpha": dh.alpha, "d": dh.d, "theta_offset": dh.theta}
        lists = {name: values.tolist() for name, values in parameters.items()}
        described = cell_of_parameters((arm.model or "ur").lower(), JOINT_NAMES, lists)
    if len(described.joint_names) != N_JOINTS:
        problem = f"has {len(described.joint_names)} moving joints, the arm {N_JOINTS}"
        raise InputError(described.urdf_path, problem, remedy="fix the others: --fix JOINT")
    return described.for_arm(from_arm(arm, described.urdf_text))


def from_arm(arm: UrArmStatements, urdf: str) -> CellValues:
    """Return the values that an arm states, and what is assumed of the rest.

    `urdf` is its URDF, with the controller's angles.
    """
    parts = {
        ASSUMED: _assumed(arm),
        CONVENTION: _of_every_arm(),
        f"of a {arm.model}": _of_model(arm),
        f"from the arm ({arm.model or 'of unknown type'})": _stated(arm, urdf),
    }
    values = CellValues(notes=tuple(_notes(arm, urdf)))
    for origin, fields in parts.items():
        values |= CellValues.of_origin(origin, dict(fields))
    return values


def _range_share(identity: ArmIdentity) -> float | None:
    """Return the share of the widest range that is one turn; None if all are at most that.

    Every posture is within one turn, and between two that are further apart an arm on a table
    sweeps through the table.
    """
    if identity.lower is None or identity.upper is None:
        return None
    turns = float(np.max(identity.upper - identity.lower)) / (2.0 * np.pi)
    return round(1.0 / turns, 3) if turns > 1.0 else None


def _stated(arm: UrArmStatements, urdf: str) -> Iterator[tuple[str, Any]]:
    identity = arm.identity
    name = " ".join(filter(None, (arm.model or "Universal Robots", identity.serial_number)))
    yield "cell.name", name
    if identity.serial_number:
        yield "cell.serial_number", identity.serial_number
    limits = {
        "lower_deg": identity.lower,
        "upper_deg": identity.upper,
        "velocity_deg": identity.velocity,
        "acceleration_deg": identity.acceleration,
    }
    yield "limits.frame", "urdf"
    for field, radians in limits.items():
        if radians is not None:
            yield f"limits.{field}", np.round(np.degrees(radians), 3).tolist()
    yield from _link(arm)
    yield from _payload(arm, urdf).items()


def _of_every_arm() -> Iterator[tuple[str, Any]]:
    ones = np.ones(N_JOINTS)
    yield "drive_train.gear_ratio", (GEAR_RATIO * ones).tolist()
    yield "drive_train.calibration", (0.0 * ones).tolist()
    yield "drive_train.joint_sign", ones.astype(int).tolist()
    yield "drive_train.joint_offset_deg", (0.0 * ones).tolist()
    yield from ((f"drive_train.{name}", 0.0) for name in ("k54", "k64", "k65"))


def _of_model(arm: UrArmStatements) -> Iterator[tuple[str, Any]]:
    torques = TORQUES.get(arm.model or "")
    if torques is not None:
        yield "limits.torque", [*torques]
        yield "drive_train.current_limit", _known(np.array(torques) / constants_of(arm))


def _link(arm: UrArmStatements) -> Iterator[tuple[str, Any]]:
    table = {
        "port": arm.address.port,
        "model": arm.model or "",
        "calibration": arm.identity.calibration or "",
    }
    yield "controller.transport", "rtde"
    yield "controller.host", arm.address.host
    yield "controller.cycle_ms", arm.cycle_ms
    yield "controller.rtde", {name: value for name, value in table.items() if value}


def constants_of(arm: UrArmStatements) -> Array:
    """Return torque per current of each joint (6,) [N·m/A], NaN where nothing says it."""
    names = ("target_moment", "target_current", "target_qd")
    constants = stated_constants(*(arm.outputs[name] for name in names))
    torques = TORQUES.get(arm.model or "")
    return constants if torques is None else by_size(constants, torques)


def _payload(arm: UrArmStatements, urdf: str) -> Mapping[str, Any]:
    """Return `[robot.payload]`, {} for none or where the URDF lacks its frame."""
    mass = _payload_mass(arm)
    frame = _flange(urdf)
    if mass == 0.0 or frame is None:
        return {}
    centre = arm.outputs["payload_cog"][-1] if "payload_cog" in _names(arm) else np.zeros(3)
    table = {"mass": mass, "centre": np.round(centre, 6).tolist(), "frame": frame}
    return {"robot.payload": table}


def _payload_mass(arm: UrArmStatements) -> float:
    return float(arm.outputs["payload"][-1]) if "payload" in _names(arm) else 0.0


def _names(arm: UrArmStatements) -> tuple[str, ...]:
    return arm.outputs.dtype.names or ()


def _flange(urdf: str) -> str | None:
    links = {link for pair in links_of(urdf).values() for link in pair}
    return next((name for name in FLANGES if name in links), None)


def _assumed(arm: UrArmStatements) -> Iterator[tuple[str, Any]]:
    # They are the arm's own, and doubtful until a payload was weighed.
    yield "drive_train.torque_constant", _known(constants_of(arm) / GEAR_RATIO)
    yield "drive_train.torque_uncertainty", RELATIVE_UNCERTAINTY
    yield "drive_train.following_error", _following_error(arm)
    yield "drive_train.encoder_counts_per_revolution", _ENCODER_COUNTS
    acceleration, velocity = arm.identity.acceleration, arm.identity.velocity
    if (share := _range_share(arm.identity)) is not None:
        yield "campaign.range_share", share
    if acceleration is not None:
        yield "limits.jerk_deg", np.round(np.degrees(acceleration) / _JERK_TIME, 1).tolist()
    torques = TORQUES.get(arm.model or "")
    if torques is not None and velocity is not None:
        coulomb = _COULOMB_SHARE * np.array(torques)
        yield "nominal.coulomb", np.round(coulomb, 3).tolist()
        yield "nominal.viscous", np.round(coulomb / velocity, 3).tolist()


def _following_error(arm: UrArmStatements) -> list[float]:
    """Return the largest distance of arm and set-point (6,) [motor revolutions]."""
    stated = arm.identity.velocity
    velocity = np.full(N_JOINTS, _FULL_SPEED) if stated is None else stated
    lag = _LAG_MARGIN * _SERVO_LAG * velocity * GEAR_RATIO / (2.0 * np.pi)
    return [round(float(turns), 2) for turns in lag]


def _notes(arm: UrArmStatements, urdf: str) -> Iterator[CellNote]:
    yield from map(NotAsked, arm.identity.unreachable)
    is_unknown = np.isnan(constants_of(arm)).any()
    yield PlainNote.UNKNOWN_TORQUE_CONSTANTS if is_unknown else PlainNote.TORQUE_CONSTANTS_OF_ARM
    mass = _payload_mass(arm)
    if mass and _flange(urdf) is None:
        yield PayloadWithoutFrame(mass)


def _known(values: Array) -> list[float | str]:
    return [float(f"{value:.6g}") if np.isfinite(value) else UNKNOWN for value in values]
