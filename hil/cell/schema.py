"""The cell file, field by field: robot + drive train + controller link + limits.

One TOML table per class. The description of a field is also the remedy that an error prints,
so it says what the value must be, not what the code does with it. Units other than SI stand in
the field's name.
"""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, FiniteFloat, model_validator

# Strict: TOML has numbers and truth values of its own, so "yes" and "3" are slips of the pen.
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
            raise ValueError(
                f"gear_ratio of joint {joint} is 0; "
                "give signed motor revolutions per joint revolution"
            )
    return ratios


GearRatios = Annotated[Vector, AfterValidator(_turning)]


def field(description: str, default: Any = ..., **bounds: Any) -> Any:
    """A field that says what its value must be; without a default it is required."""
    return Field(default, description=description, **bounds)


class Table(BaseModel):
    """A TOML table that refuses what it does not know."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class SimulatedDriveTable(Table):
    """`[simulation.drive_train]`: gears of the simulated robot, known from elsewhere.

    What is left out is as in `[drive_train]`, which a mistake there then goes for as well.
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
    """`[robot.payload]`: a body of known mass that the arm carries; not identified."""

    mass: NonNegative = field("its mass in kg")
    centre: Point = field("its centre of mass in the frame, three figures in m")
    inertia: Annotated[Vector, Field(min_length=6, max_length=6)] = field(
        "its tensor about the centre of mass in the axes of the frame: xx, xy, xz, "
        "yy, yz, zz in kg·m²",
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    )
    frame: str = field(
        "a link of the URDF whose frame is meant, nothing for that of the last joint", ""
    )


class SimulationTable(Table):
    """`[simulation]`: what the simulated cell really is; ignored on hardware."""

    seed: Whole = field("one seed is one bit-identical run", 1, ge=0)
    initial_deg: Vector = field(
        "where the simulated arm stands at first, degrees, in the frame of [limits]"
    )
    inertia_scale: list[Positive] = field(
        "planted truth: mass, first moment and inertia of the link that each joint "
        "moves over those of the URDF, or nothing where it is right",
        [],
    )
    rotor_inertia: list[NonNegative] = field("planted truth, kg·m² at the joint")
    coulomb: Vector = field("planted truth, N·m, one per joint")
    viscous: Vector = field("planted truth, N·m·s/rad, one per joint")
    third: Vector = field("planted truth of the third friction term, one per joint")
    current_noise: NonNegative = field("A rms about the target current, each motor")
    current_resolution: NonNegative = field("step of the target current, A")
    torque_ripple: NonNegative = field(
        "size of an unmodelled effect: share of the Coulomb torque", 0.0
    )
    friction_drift: Annotated[Number, Field(ge=0, lt=1)] = field(
        "size of an unmodelled effect: fall of the friction from cold to hot", 0.0
    )
    elasticity: list[NonNegative] = field(
        "size of an unmodelled effect: rad/(N·m) of each gear, or nothing", []
    )
    delay: NonNegative = field(
        "size of an unmodelled effect: later effect of the target current, s", 0.0
    )
    drive_train: SimulatedDriveTable = field(
        "a table of what is known of its gears independently of [drive_train]",
        SimulatedDriveTable(),
    )
    payload: PayloadTable | None = field(
        "a table of the body that `hil run --payload` mounts on it", None
    )


ArmAxis = tuple[Annotated[Whole, Field(ge=1, le=4)], Annotated[Whole, Field(ge=1, le=10)]]
Factor = Annotated[Number, Field(gt=1, le=5)]

ELEMENT_KINDS: Final = '"torsion_spring", "extension_spring", "gas_spring" or "hydraulic_balancer"'


class CellTable(Table):
    """`[cell]`: what this cell is called and which of its figures are assumptions."""

    name: str = field("a short name of the cell", min_length=1, max_length=80)
    description: str = field("one or two sentences for the reader", "")
    urdf: str = field("the URDF file, relative to this cell file")
    assumed: list[str] = field("dotted names of fields whose values are assumed, not measured", [])
    mesh_folders: list[str] = field(
        "folders, relative to this cell file, in which package:// paths of the URDF's meshes begin",
        [],
    )


class JointFrictionTable(Table):
    """`[robot.friction.joints.NAME]`: entries of `[robot.friction]` that differ for one joint.

    Only those that were written count (`model_fields_set`).
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
    standstill: NonNegative = field(
        "speed in rad/s (m/s) below which a joint counts as at rest", 0.02
    )
    zone: Literal["exclude", "linear"] = field(
        '"exclude" (rows below standstill are not used) or "linear" (they are, with '
        "qd / standstill for the sign)",
        "exclude",
    )
    presliding: NonNegative = field(
        "displacement in rad (m) over which dry friction turns round at a reversal "
        "(Dahl), 0 for a jump; identification chooses its own unless one is given",
        0.0,
    )


class FrictionTable(JointFrictionTable):
    """`[robot] friction`: which friction columns each joint gets."""

    ripple: list[Annotated[Whole, Field(ge=1, le=24)]] = field(
        "periods per motor turn of a torque ripple that is identified, such as [1, 2]; "
        "of every joint with a gear of 10 or more; nothing for none, unless identification finds "
        "one",
        [],
    )
    joints: dict[str, JointFrictionTable] = field(
        "tables of what is different for a joint, by its name", {}
    )


class CouplingTable(Table):
    """`[robot.coupling]`: motors that turn with several joints."""

    motor_from_joint: list[Vector] | Literal["drive_train"] = field(
        "motor angle per joint angle, one row per motor, each with one figure per "
        'joint; or "drive_train" for that of [drive_train]'
    )
    inertia: Choice = field("true or false: an inertia for each pair of coupled joints", True)
    friction: Choice = field("true or false: friction of each coupled motor", True)


class JointElementTable(Table):
    """What all entries of `[[robot.elements]]` have."""

    joint: str = field("name of the joint it acts on, one that turns")
    identified: Choice = field("true (a parameter is estimated) or false (its figures hold)", False)


class TorsionSpringTable(JointElementTable):
    """An entry of `[[robot.elements]]`: a spring about the axis of a joint."""

    kind: Literal["torsion_spring"] = field(ELEMENT_KINDS)
    rest_deg: Number = field("URDF angle of the joint without torque, in degrees")
    stiffness: NonNegative | None = field(
        "its stiffness in N·m/rad; nothing if it is identified", None
    )


class AnchoredTable(JointElementTable):
    """An element between two anchors in the plane of a joint."""

    base_distance: Positive = field(
        "distance in m of the anchor on the base side from the joint's axis"
    )
    link_distance: Positive = field(
        "distance in m of the anchor on the link side from the joint's axis"
    )
    angle_deg: Number = field(
        "angle in degrees from the anchor on the base side to the other, about the "
        "joint's axis, at URDF angle 0"
    )


class ExtensionSpringTable(AnchoredTable):
    """An entry of `[[robot.elements]]`: a spring between two anchors."""

    kind: Literal["extension_spring"] = field(ELEMENT_KINDS)
    free_length: NonNegative = field("its length in m without load")
    stiffness: NonNegative | None = field("its stiffness in N/m; nothing if it is identified", None)
    preload: Number | None = field(
        "its tension in N at the free length; nothing for 0, or to identify that too", None
    )


class GasTable(AnchoredTable):
    """An entry of `[[robot.elements]]`: a cylinder of gas that pushes or pulls its anchors."""

    kind: Literal["gas_spring", "hydraulic_balancer"] = field(ELEMENT_KINDS)
    length: Positive = field(
        "distance in m between the anchors at which pressure and volume are given"
    )
    area: Positive = field("area in m² on which the gas acts")
    pressure: Positive = field("pressure in Pa over that outside, at `length`")
    volume: Positive = field("volume in m³ of the gas at `length`")


ElementTable = Annotated[
    TorsionSpringTable | ExtensionSpringTable | GasTable,
    Field(discriminator="kind"),
]


class RobotTable(Table):
    """`[robot]`: how the rigid body model is built from the URDF."""

    gravity: Annotated[Vector, Field(min_length=3, max_length=3)] = field(
        "gravity in the base frame, three figures in m/s²", [0.0, 0.0, -9.81]
    )
    rotor_inertia: Choice = field("true or false: one rotor inertia per joint", True)
    locked: dict[str, Number] = field(
        "joints held at a position, by name, in rad or m: { finger_joint = 0.02 }", {}
    )
    friction: FrictionTable = field("a table of friction columns", FrictionTable())
    payload: PayloadTable | None = field(
        "a table of the body of known mass that the arm carries", None
    )
    coupling: CouplingTable | None = field("a table of motors that turn with several joints", None)
    elements: list[ElementTable] = field(
        f"tables [[robot.elements]], each with a kind: {ELEMENT_KINDS}", []
    )


class NominalTable(Table):
    """`[nominal]`: the manufacturer's figures beside the URDF's inertias (joint side)."""

    rotor_inertia: list[NonNegative] = field("kg·m² at the joint, one per joint")
    coulomb: list[NonNegative] = field("Coulomb friction in N·m, one per joint")
    viscous: list[NonNegative] = field("viscous friction in N·m·s/rad, one per joint")
    third: Vector = field("third friction coefficient, one per joint; nothing for zeros", [])
    uncertainty: NonNegative = field(
        "relative uncertainty of the nominal torque, e.g. 0.1 for 10 %", 0.1
    )


class LimitsTable(Table):
    """`[limits]`: what the arm may do; degrees, as data sheets give them."""

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
                raise ValueError(
                    f"joint {joint}: lower_deg {low:g} is not below upper_deg {high:g}; "
                    "correct one of them"
                )
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
    """`[drive_train]`: motors, gears and wrist coupling (see `drivers.DriveTrain`)."""

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
    current_limit: PositiveVector = field("A at the motor, one per joint")
    following_error: PositiveVector = field("threshold in motor revolutions")
    encoder_counts_per_revolution: Whole = field("encoder counts per motor turn", gt=0)


class CanTable(Table):
    """`[controller.can]`: the CAN adapter, where transport = "can" (`docs/can.md`)."""

    interface: str = field(
        'python-can\'s name of the adapter, e.g. "socketcan" or "slcan"', min_length=1
    )
    channel: str = field('channel of it, e.g. "can0" or "/dev/ttyACM0"', min_length=1)
    profile: Literal["fd", "classic"] = field('"fd" or "classic"', "fd")
    bitrate: Whole | None = field("bit/s, where we have to set it", None, gt=0)
    data_bitrate: Whole | None = field(
        "bit/s of the data phase, where we have to set it", None, gt=0
    )


class ControllerTable(Table):
    """`[controller]`: the link to the controller."""

    transport: Literal["simulated", "udp", "can"] = field('"simulated", "udp" or "can"')
    cycle_ms: Literal[1, 2] = field("the controller's cycle, 1 or 2 ms")
    mode: Literal[4] = field("the open mode of campaigns: 4 (absolute position)", 4)
    host: str = field("address of the controller", "10.2.12.150")
    port: Whole = field("UDP port, 1 to 65535", 1000, gt=0, lt=65536)
    bind: str = field("address of this PC to listen on, 0.0.0.0 for all of them", "0.0.0.0")
    can: CanTable | None = field("a table that names the CAN adapter", None)
    arm: Whole = field("arm of the controller, 1 to 4", 1, ge=1, le=4)
    max_gap: Whole = field("packets missed in a row that a motion survives, 0 to 5", 2, ge=0, le=5)
    other_axes: list[ArmAxis] = field(
        "pairs [arm, axis], both from 1, of axes that may be open though they are no "
        "joints of this cell, e.g. [[1, 7]]",
        [],
    )
    current_delay_cycles: Number = field(
        "cycles by which the position of a packet is newer than its target current", 0.0
    )
    packets: bool = field("whether archives keep the raw packets of both directions", False)

    @model_validator(mode="after")
    def _adapter_named(self) -> ControllerTable:
        if self.transport == "can" and self.can is None:
            raise ValueError(
                'transport = "can" needs a table [controller.can]; add it, or write "udp"'
            )
        return self


class BoxTable(Table):
    """A box-shaped obstacle in the base frame."""

    lower: Point = field("its lower corner, three figures in m")
    upper: Point = field("its upper corner, three figures in m")


class WorkspaceTable(Table):
    """`[workspace]`: what the arm must not touch, in the base frame."""

    floor: Number | Literal["none"] = field('height of the floor in m, or "none"', 0.0)
    walls: list[BoxTable] = field("boxes {lower = [x, y, z], upper = [x, y, z]} in m", [])
    margin: NonNegative = field("clearance to keep, in m", 0.05)


class CampaignTable(Table):
    """`[campaign]`: how the excitation is designed and executed."""

    repetitions: Whole = field("repetitions, 1 to 1000", 30, ge=1, le=1000)
    validation_runs: Whole = field("validation runs, 1 to 1000", 10, ge=1, le=1000)
    home_deg: Vector = field(
        "start posture of every excitation, in degrees, in the frame of [limits]"
    )
    approach_speed: Annotated[Number, Field(gt=0, le=1)] = field(
        "fraction of the joint speeds for moves to the start, above 0, at most 1", 0.1
    )
    settle_s: NonNegative = field("seconds of rest recorded after each motion", 0.5)
    standstill_s: Positive = field("seconds of standstill for the noise variance", 5.0)
    warmup_drift: Annotated[Number, Field(ge=0, lt=1)] | None = field(
        "change of a joint's friction from one motion to the next below which it is "
        "warm, as a share (0.002); 0 for no warm-up",
        None,
    )
    warmup_least: Whole = field("motions that warm up at least, 3 to 1000", 4, ge=3, le=1000)
    warmup_most: Whole = field("motions that warm up at most, 3 to 1000", 60, ge=3, le=1000)
    bad_repetitions: Whole = field(
        "times a motion that fails its quality check is repeated, 0 to 100", 3, ge=0, le=100
    )
    n_via: Whole = field("via points of the excitation, 2 to 60", 6, ge=2, le=60)
    fly: Annotated[Number, Field(ge=0, le=1)] = field(
        "fly-by fraction, 0 (stop at every via point) to 1", 0.5
    )
    candidates: Whole = field(
        "motions that the quick search of a campaign without a design may try", 300, ge=1
    )
    seed: Whole = field("seed of the search and of the validation motions", 1, ge=0)


class CellFile(Table):
    """The whole file. Tables that a use does not need may be left out."""

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
