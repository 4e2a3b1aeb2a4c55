"""Schema of the cell file, one class per TOML table.

The description of a field is printed as remedy in errors, so it states the valid values. Units
other than SI are in the name of the field.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    field_validator,
    model_validator,
)

from drivers.transports.base import TransportSpec
from drivers.transports.udp import UdpSpec
from drivers.ur.identity import DASHBOARD_PORT, PRIMARY_PORT
from drivers.ur.rtde import PORT as RTDE_PORT
from drivers.ur.transport import RtdeSpec
from hil.base.safe_input import parse_port
from hil.cell.field_error import FieldError

# Strict: TOML has types, so "yes" and "3" are errors.
Number = Annotated[FiniteFloat, Field(strict=True)]
Whole = Annotated[int, Field(strict=True)]
Choice = Annotated[bool, Field(strict=True)]
Positive = Annotated[Number, Field(gt=0)]
NonNegative = Annotated[Number, Field(ge=0)]
Vector = list[Number]
PositiveVector = list[Positive]
Point = tuple[Number, Number, Number]


def _turning(ratios: list[float]) -> list[float]:
    for joint, ratio in enumerate(ratios, 1):
        if ratio == 0:
            problem = f"gear_ratio of joint {joint} is 0"
            raise FieldError(problem, "give signed motor revolutions per joint revolution")
    return ratios


GearRatios = Annotated[Vector, AfterValidator(_turning)]


def field(description: str, default: Any = ..., **bounds: Any) -> Any:
    """Declare a field with its description; without a default it is required."""
    return Field(default, description=description, **bounds)


class Table(BaseModel):
    """A TOML table; unknown fields are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)


class SimulatedDriveTable(Table):
    """`[simulation.drive_train]`: gears of the simulated robot, independent of `[drive_train]`.

    Missing fields are as in `[drive_train]`, including mistakes there.
    """

    gear_ratio: GearRatios | None = field(
        "signed motor revolutions per joint revolution, none of them 0", None
    )
    joint_sign: list[Literal[-1, 1]] | None = field(
        "1 or -1: sense of the controller's angle against the URDF's", None
    )
    joint_offset_deg: Vector | None = field(
        "controller angle at URDF angle 0, in degrees, one per joint", None
    )
    k54: Number | None = field("wrist coupling of axis 4 into motor 5", None)
    k64: Number | None = field("wrist coupling of axis 4 into motor 6", None)
    k65: Number | None = field("wrist coupling of axis 5 into motor 6", None)


class PayloadTable(Table):
    """`[robot.payload]`: known payload, which is not identified."""

    mass: NonNegative = field("mass in kg")
    centre: Point = field("centre of mass in the frame, three values in m")
    inertia: Annotated[Vector, Field(min_length=6, max_length=6)] = field(
        "inertia about the centre of mass in the axes of the frame: xx, xy, xz, "
        "yy, yz, zz in kg·m²",
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    )
    frame: str = field(
        "link of the URDF that defines the frame; nothing for the frame of the last joint", ""
    )
    name: str = field("its name, which the header of each archive has", "")


class SimulationTable(Table):
    """`[simulation]`: true parameters of the simulated cell; ignored on hardware."""

    seed: Whole = field("seed; runs with the same seed are identical", 1, ge=0)
    initial_deg: Vector = field(
        "initial posture of the simulated arm, degrees, in the frame of [limits]"
    )
    inertia_scale: list[Positive] = field(
        "true value: factor on mass, first moment and inertia of each link of the URDF, or nothing",
        [],
    )
    rotor_inertia: list[NonNegative] = field("true value, kg·m² at the joint")
    coulomb: Vector = field("true value, N·m, one per joint")
    viscous: Vector = field("true value, N·m·s/rad, one per joint")
    third: Vector = field("true value of the third friction term, one per joint")
    current_noise: NonNegative = field("rms noise of each motor current, A")
    current_resolution: NonNegative = field("resolution of the target current, A")
    torque_ripple: NonNegative = field(
        "unmodelled torque ripple, fraction of the Coulomb torque", 0.0
    )
    friction_drift: Annotated[Number, Field(ge=0, lt=1)] = field(
        "unmodelled decrease of friction from cold to hot, fraction", 0.0
    )
    elasticity: list[NonNegative] = field(
        "unmodelled elasticity of each gear, rad/(N·m), or nothing", []
    )
    delay: NonNegative = field("unmodelled delay of the target current, s", 0.0)
    drive_train: SimulatedDriveTable = field(
        "a table of gears of the simulated robot",
        SimulatedDriveTable(),
    )


ArmAxis = tuple[Annotated[Whole, Field(ge=1, le=4)], Annotated[Whole, Field(ge=1, le=10)]]
Factor = Annotated[Number, Field(gt=1, le=5)]

ELEMENT_KINDS: Final = '"torsion_spring", "extension_spring", "gas_spring" or "hydraulic_balancer"'


class CellTable(Table):
    """`[cell]`: name, URDF and assumed values."""

    name: str = field("a short name of the cell", min_length=1, max_length=80)
    description: str = field("description, one or two sentences", "")
    urdf: str = field("the URDF file, relative to this cell file")
    operator: str = field("who operates the arm; printed in reports", "", max_length=200)
    serial_number: str = field("serial number of the arm; printed in reports", "", max_length=200)
    notes: str = field("remarks; printed in reports", "", max_length=4000)
    assumed: list[str] = field("dotted names of fields whose values are assumed, not measured", [])
    mesh_folders: list[str] = field(
        "folders with the packages of package:// mesh paths, relative to this file",
        [],
    )


class JointFrictionTable(Table):
    """`[robot.friction.joints.NAME]`: entries of `[robot.friction]` that differ for one joint.

    Only fields present in the file apply (`model_fields_set`).
    """

    coulomb: Choice = field("true or false: f0 sgn(qd)", True)
    viscous: Choice = field("true or false: f1 qd", True)
    third: Literal["quadratic", "cubic", "none"] = field(
        '"quadratic" (sgn(qd) qd²), "cubic" (qd³) or "none"', "quadratic"
    )
    offset: Choice = field("true or false: a constant torque per joint", False)
    stribeck: NonNegative = field("speed in rad/s of a Stribeck term, 0 for none", 0.0)
    tanh: NonNegative = field("speed vt in rad/s of f0 tanh(qd / vt), 0 for f0 sgn(qd)", 0.0)
    asymmetric: Choice = field("true or false: Coulomb and viscous friction by direction", False)
    load: Choice = field("true or false: fl sgn(qd) times the size of the gear's torque", False)
    standstill: NonNegative = field(
        "speed in rad/s (m/s) below which a joint counts as at rest", 0.02
    )
    zone: Literal["exclude", "linear"] = field(
        '"exclude" (rows below standstill are not used) or "linear" (used, with '
        "qd / standstill for the sign)",
        "exclude",
    )
    presliding: NonNegative = field(
        "displacement in rad (m) of presliding friction at a reversal (Dahl), 0 for none; "
        "chosen by identification unless given",
        0.0,
    )


class FrictionTable(JointFrictionTable):
    """`[robot.friction]`: friction law."""

    ripple: list[Annotated[Whole, Field(ge=1, le=24)]] = field(
        "periods per motor turn of an identified torque ripple, such as [1, 2], for joints with a "
        "gear ratio of 10 or more; nothing for automatic choice",
        [],
    )
    springs: list[str] = field(
        "names of joints with an identified torsion spring about URDF angle 0, such as a hose; "
        "nothing for automatic choice",
        [],
    )
    position_torque: list[str] = field(
        "names of joints with an identified torque that repeats two, three and four times per turn "
        "of the joint, such as by cables or the error of a torque sensor; nothing for automatic "
        "choice",
        [],
    )
    joints: dict[str, JointFrictionTable] = field(
        "tables of fields that differ for a joint, by its name", {}
    )


COMMON_FRICTION_ENTRIES: Final = FrictionTable.model_fields.keys() - JointFrictionTable.model_fields
"""Entries of `[robot.friction]` that the table of one joint does not have."""


class CouplingTable(Table):
    """`[robot.coupling]`: motors coupled to several joints."""

    motor_from_joint: list[Vector] | Literal["drive_train"] = field(
        "motor angle per joint angle, one row per motor, each with one value per "
        'joint; or "drive_train" as stated in [drive_train]'
    )
    inertia: Choice = field("true or false: an inertia for each pair of coupled joints", True)
    friction: Choice = field("true or false: friction of each coupled motor", True)


class JointElementTable(Table):
    """Fields common to all `[[robot.elements]]`."""

    joint: str = field("name of a revolute joint")
    identified: Choice = field("true (estimate a parameter) or false (use the given values)", False)


class TorsionSpringTable(JointElementTable):
    """An entry of `[[robot.elements]]`: a spring about the axis of a joint."""

    kind: Literal["torsion_spring"] = field(ELEMENT_KINDS)
    rest_deg: Number = field("URDF angle of the joint without torque, in degrees")
    stiffness: NonNegative | None = field("stiffness in N·m/rad; nothing if identified", None)


class AnchoredTable(JointElementTable):
    """An element between two anchors in the plane of a joint."""

    base_distance: Positive = field("distance of the base-side anchor from the joint axis in m")
    link_distance: Positive = field("distance of the link-side anchor from the joint axis in m")
    angle_deg: Number = field(
        "angle from the base-side to the link-side anchor about the joint axis at URDF angle 0, "
        "in degrees"
    )


class ExtensionSpringTable(AnchoredTable):
    """An entry of `[[robot.elements]]`: a spring between two anchors."""

    kind: Literal["extension_spring"] = field(ELEMENT_KINDS)
    free_length: NonNegative = field("unloaded length in m")
    stiffness: NonNegative | None = field("stiffness in N/m; nothing if identified", None)
    preload: Number | None = field(
        "tension in N at the free length; nothing for 0, or to identify it", None
    )


class GasTable(AnchoredTable):
    """An entry of `[[robot.elements]]`: a gas cylinder that pushes or pulls its anchors."""

    kind: Literal["gas_spring", "hydraulic_balancer"] = field(ELEMENT_KINDS)
    length: Positive = field(
        "distance between the anchors for which pressure and volume are given, in m"
    )
    area: Positive = field("piston area in m²")
    pressure: Positive = field("gauge pressure at `length` in Pa")
    volume: Positive = field("gas volume at `length` in m³")


ElementTable = Annotated[
    TorsionSpringTable | ExtensionSpringTable | GasTable,
    Field(discriminator="kind"),
]


Share = Annotated[Number, Field(ge=0, lt=1)]
TorqueUncertainty = Share | Annotated[list[Share], Field(min_length=1)]
_UNCERTAINTY: Final = (
    "relative standard deviation from 0 to 1, one for all joints or a list of one per joint, such "
    "as 0.03 for 3 %"
)


class RobotTable(Table):
    """`[robot]`: settings of the model built from the URDF."""

    gravity: Annotated[Vector, Field(min_length=3, max_length=3)] = field(
        "gravity in the base frame, three values in m/s²", [0.0, 0.0, -9.81]
    )
    rotor_inertia: Choice = field("true or false: one rotor inertia per joint", True)
    locked: dict[str, Number] = field(
        "joints fixed at a position, by name, in rad or m: { finger_joint = 0.02 }", {}
    )
    friction: FrictionTable = field("a table of the friction law", FrictionTable())
    payload: PayloadTable | None = field("a table of the known payload", None)
    torque_uncertainty: TorqueUncertainty | None = field(
        f"of the scale of imported torques: {_UNCERTAINTY}", None
    )
    coupling: CouplingTable | None = field("a table of coupled motors", None)
    elements: list[ElementTable] = field(
        f"tables [[robot.elements]], each with a kind: {ELEMENT_KINDS}", []
    )


class NominalTable(Table):
    """`[nominal]`: manufacturer's values that a URDF does not contain (joint side)."""

    rotor_inertia: list[NonNegative] = field("kg·m² at the joint, one per joint")
    coulomb: list[NonNegative] = field("Coulomb friction in N·m, one per joint")
    viscous: list[NonNegative] = field("viscous friction in N·m·s/rad, one per joint")
    third: Vector = field("third friction coefficient, one per joint; nothing for zeros", [])
    uncertainty: NonNegative = field(
        "relative uncertainty of the nominal torque, e.g. 0.1 for 10 %", 0.1
    )


class LimitsTable(Table):
    """`[limits]`: limits of motions, in degrees."""

    frame: Literal["controller", "urdf"] = field(
        '"controller" (angles as on the teach pendant) or "urdf" (model angles)'
    )
    lower_deg: Vector = field("lower position limits in degrees, one per joint")
    upper_deg: Vector = field("upper position limits in degrees, one per joint")
    velocity_deg: PositiveVector = field("maximum joint speeds in deg/s, all above 0")
    acceleration_deg: PositiveVector = field("maximum joint accelerations in deg/s², all above 0")
    jerk_deg: PositiveVector = field("maximum joint jerks in deg/s³, all above 0")
    torque: PositiveVector = field(
        "largest torques in N·m at the joint, one per joint; nothing for none", []
    )

    @model_validator(mode="after")
    def _ordered(self) -> LimitsTable:
        for joint, (low, high) in enumerate(zip(self.lower_deg, self.upper_deg, strict=False), 1):
            if low >= high:
                problem = f"joint {joint}: lower_deg {low:g} is not below upper_deg {high:g}"
                raise FieldError(problem, "correct one of them")
        return self


class FactorsTable(Table):
    """Factors on the plan's acceleration and jerk limits."""

    acceleration: Factor = field("a factor above 1, at most 5")
    jerk: Factor = field("a factor above 1, at most 5")


class BoundsTable(Table):
    """`[bounds]`: plan < override < stop."""

    override: FactorsTable = field(
        "a table {acceleration, jerk}", FactorsTable(acceleration=1.3, jerk=1.7)
    )
    stop: FactorsTable = field(
        "a table {acceleration, jerk}", FactorsTable(acceleration=2.0, jerk=3.0)
    )


class DriveTrainTable(Table):
    """`[drive_train]`: motors, gears and wrist coupling (`drivers.DriveTrain`)."""

    gear_ratio: GearRatios = field("signed motor revolutions per joint revolution, none of them 0")
    calibration: Vector = field("motor revolutions at controller angle 0")
    k54: Number = field("wrist coupling of axis 4 into motor 5", 0.0)
    k64: Number = field("wrist coupling of axis 4 into motor 6", 0.0)
    k65: Number = field("wrist coupling of axis 5 into motor 6", 0.0)
    joint_sign: list[Literal[-1, 1]] = field(
        "1 or -1: sense of the controller's angle against the URDF's"
    )
    joint_offset_deg: Vector = field("controller angle at URDF angle 0, in degrees, one per joint")
    torque_constant: PositiveVector = field("N·m/A at the motor, all above 0")
    torque_uncertainty: TorqueUncertainty | None = field(
        f"of the torque constants: {_UNCERTAINTY}", None
    )
    current_limit: PositiveVector = field("A at the motor, one per joint")
    following_error: PositiveVector = field("threshold in motor revolutions")
    encoder_counts_per_revolution: Whole = field("encoder counts per motor turn", gt=0)


_NO_CLASSIC: Final = "classic CAN is no longer supported: its frames cannot hold a whole packet"


class CanTable(Table):
    """`[controller.can]`: CAN adapter for transport = "can" (`docs/connect.md`)."""

    interface: str = field(
        'adapter by its python-can name, e.g. "socketcan" or "slcan"', min_length=1
    )
    channel: str = field('channel of the adapter, e.g. "can0" or "/dev/ttyACM0"', min_length=1)
    profile: Literal["fd"] = field('"fd", the only one', "fd")
    bitrate: Whole | None = field("bit/s, if the adapter needs it", None, gt=0)
    data_bitrate: Whole | None = field(
        "bit/s of the data phase, if the adapter needs it", None, gt=0
    )

    @field_validator("profile", mode="before")
    @classmethod
    def _has_fd(cls, profile: object) -> object:
        if profile == "classic":
            remedy = 'write profile = "fd" if the adapter has CAN FD, else transport = "udp"'
            raise FieldError(_NO_CLASSIC, remedy)
        return profile


class RtdeTable(Table):
    """`[controller.rtde]`: a Universal Robots arm for transport = "rtde" (`docs/i-have-a-ur.md`).

    What it states of the arm is compared with what the arm states, where both do.
    """

    port: Whole = field("TCP port of RTDE", RTDE_PORT, gt=0, lt=65536)
    primary_port: Whole = field("TCP port of the primary interface", PRIMARY_PORT, gt=0, lt=65536)
    dashboard_port: Whole = field(
        "TCP port of the dashboard server", DASHBOARD_PORT, gt=0, lt=65536
    )
    model: str = field('type of the arm, such as "UR5e"; nothing for any', "", max_length=80)
    calibration: str = field(
        "checksum of the kinematic calibration, hexadecimal; nothing for any", "", max_length=80
    )


class ControllerTable(Table):
    """`[controller]`: the link to the controller."""

    transport: Literal["simulated", "udp", "can", "rtde"] = field(
        '"simulated", "udp", "can" or "rtde" (Universal Robots)'
    )
    cycle_ms: Literal[1, 2, 4, 8] = field(
        "the controller's cycle, 1, 2 or 4 ms; with rtde 2, or 8 of a CB3"
    )
    mode: Literal[4] = field("the open mode of campaigns: 4 (absolute position)", 4)
    host: str = field("address of the controller", "10.2.12.150")
    port: Whole = field("UDP port, 1 to 65535", 1000, gt=0, lt=65536)
    bind: str = field("local address to listen on, 0.0.0.0 for all", "0.0.0.0")
    can: CanTable | None = field("a table of the CAN adapter", None)
    rtde: RtdeTable = field("a table of the Universal Robots arm", RtdeTable())
    arm: Whole = field("arm of the controller, 1 to 4", 1, ge=1, le=4)
    max_gap: Whole = field(
        "consecutive missed packets that a motion tolerates, 0 to 5; with rtde by default 4, or 1 "
        "of a CB3",
        2,
        ge=0,
        le=5,
    )
    other_axes: list[ArmAxis] = field(
        "pairs [arm, axis], from 1, of axes that are not joints of this cell and may be open, "
        "e.g. [[1, 7]]",
        [],
    )
    current_delay_cycles: Number = field(
        "cycles by which the target current of a packet lags its position", 0.0
    )

    @model_validator(mode="after")
    def _adapter_named(self) -> ControllerTable:
        if self.transport == "can" and self.can is None:
            problem = 'transport = "can" needs a table [controller.can]'
            raise FieldError(problem, 'add it, or write "udp"')
        return self

    @model_validator(mode="after")
    def _possible_cycle(self) -> ControllerTable:
        is_ur = self.transport == "rtde" or "rtde" in self.model_fields_set
        possible = (2, 8) if is_ur else (1, 2, 4)
        if self.cycle_ms not in possible:
            problem = (
                f'cycle_ms = {self.cycle_ms} is not possible with transport = "{self.transport}"'
            )
            raise FieldError(problem, f"write {' or '.join(map(str, possible))}")
        return self


@dataclass(frozen=True)
class LinkType:
    """A transport that cell files and `hil simulate` can name.

    Attributes:
        spec: settings of the link from `[controller]` and the number of axes.
        parse: fields of `[controller]` from an address of `hil simulate`; None if it is none, and
            FieldError for one that is not supported any more.
        form: what such an address is, and how it is written with an example.
        controller: module whose `open_controller_link(spec, mode)` opens the controller's end; a
            name, because `sim_fixtures` is slow to load. "" for a link that carries no motions.
    """

    spec: Callable[[ControllerTable, int], TransportSpec]
    parse: Callable[[str], dict[str, Any] | None]
    form: tuple[str, str]
    controller: str


def _udp(table: ControllerTable, n_axes: int) -> TransportSpec:
    del n_axes
    return UdpSpec(peer_host=table.host, port=table.port, bind=table.bind)


def _udp_address(text: str) -> dict[str, Any] | None:
    host, _, port_text = text.rpartition(":")
    port = parse_port(port_text)
    return {"host": host, "port": port} if host and port is not None else None


def _can(table: ControllerTable, n_axes: int) -> TransportSpec:
    from drivers.transports.can.transport import CanSpec  # python-can is slow to load

    assert table.can is not None, "the table is checked"
    adapter = table.can.model_dump(exclude={"profile"})
    return CanSpec(**adapter, period=table.cycle_ms / 1000, n_axes=n_axes)


def _can_address(text: str) -> dict[str, Any] | None:
    interface, _, address = text.partition(":")
    channel, _, profile = address.rpartition(":") if ":" in address else (address, "", "fd")
    if profile == "classic":
        remedy = "leave :classic out if the adapter has CAN FD, else use --udp"
        raise FieldError(_NO_CLASSIC, remedy)
    if not (interface and channel) or profile != "fd":
        return None
    return {"can": {"interface": interface, "channel": channel}}


def _rtde(table: ControllerTable, n_axes: int) -> TransportSpec:
    del n_axes
    ports = table.rtde
    return RtdeSpec(table.host, ports.port, ports.primary_port, ports.dashboard_port)


def _rtde_address(text: str) -> dict[str, Any] | None:
    host, separator, port_text = text.partition(":")
    port = parse_port(port_text) if separator else RTDE_PORT
    return {"host": host, "rtde": {"port": port}} if host and port is not None else None


ARM_HOST: Final = ("an address", "HOST or HOST:PORT, for instance 192.168.0.10")
HOST_PORT: Final = ("an address", "HOST:PORT, for instance 127.0.0.1:2001")
BUS: Final = ("a bus", "INTERFACE:CHANNEL or INTERFACE:CHANNEL:fd, for instance socketcan:can0")
LINKS: Final[Mapping[str, LinkType]] = {
    "udp": LinkType(_udp, _udp_address, HOST_PORT, "sim_fixtures.serve"),
    "can": LinkType(_can, _can_address, BUS, "sim_fixtures.can_link"),
    "rtde": LinkType(_rtde, _rtde_address, ARM_HOST, ""),
}
"""Every value of `controller.transport` but "simulated"."""


class BoxTable(Table):
    """A box-shaped obstacle in the base frame."""

    lower: Point = field("lower corner, three values in m")
    upper: Point = field("upper corner, three values in m")


class WorkspaceTable(Table):
    """`[workspace]`: obstacles in the base frame."""

    floor: Number | Literal["none"] = field('height of the floor in m, or "none"', 0.0)
    walls: list[BoxTable] = field("boxes {lower = [x, y, z], upper = [x, y, z]} in m", [])
    margin: NonNegative = field("clearance in m", 0.05)


class CampaignTable(Table):
    """`[campaign]`: design and execution of the excitation."""

    repetitions: Whole = field("repetitions, 1 to 1000", 30, ge=1, le=1000)
    validation_runs: Whole = field("validation runs, 1 to 1000", 10, ge=1, le=1000)
    home_deg: Vector = field(
        "start posture of every excitation, in degrees, in the frame of [limits]"
    )
    approach_speed: Annotated[Number, Field(gt=0, le=1)] = field(
        "speed of motions to the start, fraction of the joint speeds, above 0, at most 1", 0.1
    )
    settle_s: NonNegative = field("rest recorded after each motion, s", 0.5)
    standstill_s: Positive = field("standstill for the noise variance, s", 5.0)
    warmup_drift: Annotated[Number, Field(ge=0, lt=1)] | None = field(
        "relative change of friction between motions below which a joint is warm (0.002); 0 for "
        "no warm-up",
        None,
    )
    warmup_least: Whole = field("fewest motions of the warm-up, 3 to 1000", 4, ge=3, le=1000)
    warmup_most: Whole = field("most motions of the warm-up, 3 to 1000", 60, ge=3, le=1000)
    bad_repetitions: Whole = field(
        "repetitions of a motion that fails its quality check, 0 to 100", 3, ge=0, le=100
    )
    n_via: Whole = field("via points of the excitation, 2 to 60", 6, ge=2, le=60)
    fly: Annotated[Number, Field(ge=0, le=1)] = field(
        "fly-by fraction, 0 (stop at every via point) to 1", 0.5
    )
    range_share: Annotated[Number, Field(gt=0, le=1)] = field(
        "central fraction of each joint's range for via points, above 0, at most 1", 1.0
    )
    candidates: Whole = field(
        "motions of the quick search of a campaign without a design", 300, ge=1
    )
    seed: Whole = field("seed of the search and of the validation motions", 1, ge=0)


REMOVED: Final = {("simulation", "payload"), ("controller", "packets")}
"""Table and key of settings that earlier versions had."""


class CellFile(Table):
    """Cell file; tables that are not needed may be omitted."""

    cell: CellTable
    robot: RobotTable = RobotTable()
    nominal: NominalTable | None = None
    limits: LimitsTable | None = None
    bounds: BoundsTable = BoundsTable()
    drive_train: DriveTrainTable | None = None
    controller: ControllerTable | None = None
    workspace: WorkspaceTable = WorkspaceTable()
    campaign: CampaignTable | None = None
    simulation: SimulationTable | None = None

    @model_validator(mode="before")
    @classmethod
    def _without_removed(cls, data: Any) -> Any:
        """Ignore fields of cell files of earlier versions, also in archives."""
        if not isinstance(data, dict):
            return data
        return {
            name: {key: entry for key, entry in table.items() if (name, key) not in REMOVED}
            if isinstance(table, dict)
            else table
            for name, table in data.items()
        }
