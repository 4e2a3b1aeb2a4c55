"""The cell file, field by field: robot + drive train + controller link + limits.

One TOML table per class. The description of a field is also the remedy that an error prints,
so it says what the value must be, not what the code does with it. Units other than SI stand in
the field's name.
"""

from __future__ import annotations

from typing import Annotated, Final, Literal

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


class Table(BaseModel):
    """A TOML table that refuses what it does not know."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class SimulatedDriveTable(Table):
    """`[simulation.drive_train]`: gears of the simulated robot, known from elsewhere.

    What is left out is as in `[drive_train]`, which a mistake there then goes for as well.
    """

    gear_ratio: GearRatios | None = Field(
        default=None, description="signed motor revolutions per joint revolution, none of them 0"
    )
    joint_sign: list[Literal[-1, 1]] | None = Field(
        default=None, description="1 or -1: sense of the controller's angle against the URDF's"
    )
    joint_offset_deg: Vector | None = Field(
        default=None, description="controller angle at URDF angle 0, in degrees, one per joint"
    )
    k54: Number | None = Field(default=None, description="wrist coupling of axis 4 into motor 5")
    k64: Number | None = Field(default=None, description="wrist coupling of axis 4 into motor 6")
    k65: Number | None = Field(default=None, description="wrist coupling of axis 5 into motor 6")


class PayloadTable(Table):
    """`[robot.payload]`: a body of known mass that the arm carries; not identified."""

    mass: NonNegative = Field(description="its mass in kg")
    centre: Point = Field(description="its centre of mass in the frame, three figures in m")
    inertia: Annotated[Vector, Field(min_length=6, max_length=6)] = Field(
        default=[0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        description="its tensor about the centre of mass in the axes of the frame: xx, xy, xz, "
        "yy, yz, zz in kg·m²",
    )
    frame: str = Field(
        default="",
        description="a link of the URDF whose frame is meant, nothing for that of the last joint",
    )


class SimulationTable(Table):
    """`[simulation]`: what the simulated cell really is; ignored on hardware."""

    seed: Whole = Field(default=1, ge=0, description="one seed is one bit-identical run")
    initial_deg: Vector = Field(
        description="where the simulated arm stands at first, degrees, in the frame of [limits]"
    )
    inertia_scale: list[Positive] = Field(
        default_factory=list,
        description="planted truth: mass, first moment and inertia of the link that each joint "
        "moves over those of the URDF, or nothing where it is right",
    )
    rotor_inertia: list[NonNegative] = Field(description="planted truth, kg·m² at the joint")
    coulomb: Vector = Field(description="planted truth, N·m, one per joint")
    viscous: Vector = Field(description="planted truth, N·m·s/rad, one per joint")
    third: Vector = Field(description="planted truth of the third friction term, one per joint")
    current_noise: NonNegative = Field(description="A rms about the target current, each motor")
    current_resolution: NonNegative = Field(description="step of the target current, A")
    torque_ripple: NonNegative = Field(
        default=0.0, description="size of an unmodelled effect: share of the Coulomb torque"
    )
    friction_drift: Annotated[Number, Field(ge=0, lt=1)] = Field(
        default=0.0,
        description="size of an unmodelled effect: fall of the friction from cold to hot",
    )
    elasticity: list[NonNegative] = Field(
        default_factory=list,
        description="size of an unmodelled effect: rad/(N·m) of each gear, or nothing",
    )
    delay: NonNegative = Field(
        default=0.0,
        description="size of an unmodelled effect: later effect of the target current, s",
    )
    drive_train: SimulatedDriveTable = Field(
        default=SimulatedDriveTable(),
        description="a table of what is known of its gears independently of [drive_train]",
    )
    payload: PayloadTable | None = Field(
        default=None, description="a table of the body that `hil run --payload` mounts on it"
    )


ArmAxis = tuple[Annotated[Whole, Field(ge=1, le=4)], Annotated[Whole, Field(ge=1, le=10)]]
Factor = Annotated[Number, Field(gt=1, le=5)]

ELEMENT_KINDS: Final = '"torsion_spring", "extension_spring", "gas_spring" or "hydraulic_balancer"'


class CellTable(Table):
    """`[cell]`: what this cell is called and which of its figures are assumptions."""

    name: str = Field(min_length=1, max_length=80, description="a short name of the cell")
    description: str = Field(default="", description="one or two sentences for the reader")
    urdf: str = Field(description="the URDF file, relative to this cell file")
    assumed: list[str] = Field(
        default_factory=list,
        description="dotted names of fields whose values are assumed, not measured",
    )
    mesh_folders: list[str] = Field(
        default_factory=list,
        description="folders, relative to this cell file, in which package:// paths of the URDF's "
        "meshes begin",
    )


class JointFrictionTable(Table):
    """`[robot.friction.joints.NAME]`: entries of `[robot.friction]` that differ for one joint.

    Only those that were written count (`model_fields_set`).
    """

    coulomb: Choice = Field(default=True, description="true or false: f0 sgn(qd)")
    viscous: Choice = Field(default=True, description="true or false: f1 qd")
    third: Literal["quadratic", "cubic", "none"] = Field(
        default="quadratic", description='"quadratic" (sgn(qd) qd²), "cubic" (qd³) or "none"'
    )
    offset: Choice = Field(default=False, description="true or false: a constant torque per joint")
    stribeck: NonNegative = Field(
        default=0.0, description="speed in rad/s of a Stribeck term, 0 for none"
    )
    tanh: NonNegative = Field(
        default=0.0, description="speed vt in rad/s of f0 tanh(qd / vt), 0 for f0 sgn(qd)"
    )
    asymmetric: Choice = Field(
        default=False, description="true or false: Coulomb and viscous friction by direction"
    )
    standstill: NonNegative = Field(
        default=0.02, description="speed in rad/s (m/s) below which a joint counts as at rest"
    )
    zone: Literal["exclude", "linear"] = Field(
        default="exclude",
        description='"exclude" (rows below standstill are not used) or "linear" (they are, with '
        "qd / standstill for the sign)",
    )
    presliding: NonNegative = Field(
        default=0.0,
        description="displacement in rad (m) over which dry friction turns round at a reversal "
        "(Dahl), 0 for a jump; identification chooses its own unless one is given",
    )


class FrictionTable(JointFrictionTable):
    """`[robot] friction`: which friction columns each joint gets."""

    ripple: list[Annotated[Whole, Field(ge=1, le=24)]] = Field(
        default_factory=list,
        description="periods per motor turn of a torque ripple that is identified, such as [1, 2]; "
        "of every joint with a gear of 10 or more; nothing for none, unless identification finds "
        "one",
    )
    joints: dict[str, JointFrictionTable] = Field(
        default_factory=dict, description="tables of what is different for a joint, by its name"
    )


class CouplingTable(Table):
    """`[robot.coupling]`: motors that turn with several joints."""

    motor_from_joint: list[Vector] | Literal["drive_train"] = Field(
        description="motor angle per joint angle, one row per motor, each with one figure per "
        'joint; or "drive_train" for that of [drive_train]'
    )
    inertia: Choice = Field(
        default=True, description="true or false: an inertia for each pair of coupled joints"
    )
    friction: Choice = Field(
        default=True, description="true or false: friction of each coupled motor"
    )


class JointElementTable(Table):
    """What all entries of `[[robot.elements]]` have."""

    joint: str = Field(description="name of the joint it acts on, one that turns")
    identified: Choice = Field(
        default=False, description="true (a parameter is estimated) or false (its figures hold)"
    )


class TorsionSpringTable(JointElementTable):
    """An entry of `[[robot.elements]]`: a spring about the axis of a joint."""

    kind: Literal["torsion_spring"] = Field(description=ELEMENT_KINDS)
    rest_deg: Number = Field(description="URDF angle of the joint without torque, in degrees")
    stiffness: NonNegative | None = Field(
        default=None, description="its stiffness in N·m/rad; nothing if it is identified"
    )


class AnchoredTable(JointElementTable):
    """An element between two anchors in the plane of a joint."""

    base_distance: Positive = Field(
        description="distance in m of the anchor on the base side from the joint's axis"
    )
    link_distance: Positive = Field(
        description="distance in m of the anchor on the link side from the joint's axis"
    )
    angle_deg: Number = Field(
        description="angle in degrees from the anchor on the base side to the other, about the "
        "joint's axis, at URDF angle 0"
    )


class ExtensionSpringTable(AnchoredTable):
    """An entry of `[[robot.elements]]`: a spring between two anchors."""

    kind: Literal["extension_spring"] = Field(description=ELEMENT_KINDS)
    free_length: NonNegative = Field(description="its length in m without load")
    stiffness: NonNegative | None = Field(
        default=None, description="its stiffness in N/m; nothing if it is identified"
    )
    preload: Number | None = Field(
        default=None,
        description="its tension in N at the free length; nothing for 0, or to identify that too",
    )


class GasTable(AnchoredTable):
    """A cylinder in which gas is compressed."""

    length: Positive = Field(
        description="distance in m between the anchors at which pressure and volume are given"
    )
    area: Positive = Field(description="area in m² on which the gas acts")
    pressure: Positive = Field(description="pressure in Pa over that outside, at `length`")
    volume: Positive = Field(description="volume in m³ of the gas at `length`")


class GasSpringTable(GasTable):
    """An entry of `[[robot.elements]]`: a gas spring, which pushes its anchors apart."""

    kind: Literal["gas_spring"] = Field(description=ELEMENT_KINDS)


class HydraulicBalancerTable(GasTable):
    """An entry of `[[robot.elements]]`: a balancer with gas, which pulls its anchors together."""

    kind: Literal["hydraulic_balancer"] = Field(description=ELEMENT_KINDS)


ElementTable = Annotated[
    TorsionSpringTable | ExtensionSpringTable | GasSpringTable | HydraulicBalancerTable,
    Field(discriminator="kind"),
]


class RobotTable(Table):
    """`[robot]`: how the rigid body model is built from the URDF."""

    gravity: Annotated[Vector, Field(min_length=3, max_length=3)] = Field(
        default=[0.0, 0.0, -9.81], description="gravity in the base frame, three figures in m/s²"
    )
    rotor_inertia: Choice = Field(
        default=True, description="true or false: one rotor inertia per joint"
    )
    locked: dict[str, Number] = Field(
        default_factory=dict,
        description="joints held at a position, by name, in rad or m: { finger_joint = 0.02 }",
    )
    friction: FrictionTable = Field(
        default=FrictionTable(), description="a table of friction columns"
    )
    payload: PayloadTable | None = Field(
        default=None, description="a table of the body of known mass that the arm carries"
    )
    coupling: CouplingTable | None = Field(
        default=None, description="a table of motors that turn with several joints"
    )
    elements: list[ElementTable] = Field(
        default_factory=list,
        description=f"tables [[robot.elements]], each with a kind: {ELEMENT_KINDS}",
    )


class NominalTable(Table):
    """`[nominal]`: the manufacturer's figures beside the URDF's inertias (joint side)."""

    rotor_inertia: list[NonNegative] = Field(description="kg·m² at the joint, one per joint")
    coulomb: list[NonNegative] = Field(description="Coulomb friction in N·m, one per joint")
    viscous: list[NonNegative] = Field(description="viscous friction in N·m·s/rad, one per joint")
    third: Vector = Field(
        default_factory=list,
        description="third friction coefficient, one per joint; nothing for zeros",
    )
    uncertainty: NonNegative = Field(
        default=0.1, description="relative uncertainty of the nominal torque, e.g. 0.1 for 10 %"
    )


class LimitsTable(Table):
    """`[limits]`: what the arm may do; degrees, as data sheets give them."""

    frame: Literal["controller", "urdf"] = Field(
        description='"controller" (angles as on the teach pendant) or "urdf" (model angles)'
    )
    lower_deg: Vector = Field(description="lower position limits in degrees, one per joint")
    upper_deg: Vector = Field(description="upper position limits in degrees, one per joint")
    velocity_deg: PositiveVector = Field(description="maximum joint speeds in deg/s, all above 0")
    acceleration_deg: PositiveVector = Field(
        description="maximum joint accelerations in deg/s², all above 0"
    )
    jerk_deg: PositiveVector = Field(description="maximum joint jerks in deg/s³, all above 0")
    torque: PositiveVector = Field(
        default_factory=list,
        description="largest torques in N·m at the joint, one per joint; nothing for none",
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

    acceleration: Factor = Field(description="a factor above 1, at most 5")
    jerk: Factor = Field(description="a factor above 1, at most 5")


class BoundsTable(Table):
    """`[bounds]`: plan < override < stop."""

    override: FactorsTable = Field(
        default=FactorsTable(acceleration=1.3, jerk=1.7), description="a table {acceleration, jerk}"
    )
    stop: FactorsTable = Field(
        default=FactorsTable(acceleration=2.0, jerk=3.0), description="a table {acceleration, jerk}"
    )


class DriveTrainTable(Table):
    """`[drive_train]`: motors, gears and wrist coupling (see `drivers.DriveTrain`)."""

    gear_ratio: GearRatios = Field(
        description="signed motor revolutions per joint revolution, none of them 0"
    )
    calibration: Vector = Field(description="motor revolutions at controller angle 0")
    k54: Number = Field(default=0.0, description="wrist coupling of axis 4 into motor 5")
    k64: Number = Field(default=0.0, description="wrist coupling of axis 4 into motor 6")
    k65: Number = Field(default=0.0, description="wrist coupling of axis 5 into motor 6")
    joint_sign: list[Literal[-1, 1]] = Field(
        description="1 or -1: sense of the controller's angle against the URDF's"
    )
    joint_offset_deg: Vector = Field(
        description="controller angle at URDF angle 0, in degrees, one per joint"
    )
    torque_constant: PositiveVector = Field(description="N·m/A at the motor, all above 0")
    current_limit: PositiveVector = Field(description="A at the motor, one per joint")
    following_error: PositiveVector = Field(description="threshold in motor revolutions")
    encoder_counts_per_revolution: Whole = Field(gt=0, description="encoder counts per motor turn")


class CanTable(Table):
    """`[controller.can]`: the CAN adapter, where transport = "can" (`docs/can.md`)."""

    interface: str = Field(
        min_length=1, description='python-can\'s name of the adapter, e.g. "socketcan" or "slcan"'
    )
    channel: str = Field(min_length=1, description='channel of it, e.g. "can0" or "/dev/ttyACM0"')
    profile: Literal["fd", "classic"] = Field(default="fd", description='"fd" or "classic"')
    bitrate: Whole | None = Field(default=None, gt=0, description="bit/s, where we have to set it")
    data_bitrate: Whole | None = Field(
        default=None, gt=0, description="bit/s of the data phase, where we have to set it"
    )


class ControllerTable(Table):
    """`[controller]`: the link to the controller."""

    transport: Literal["simulated", "udp", "can"] = Field(description='"simulated", "udp" or "can"')
    cycle_ms: Literal[1, 2] = Field(description="the controller's cycle, 1 or 2 ms")
    mode: Literal[4] = Field(
        default=4, description="the open mode of campaigns: 4 (absolute position)"
    )
    host: str = Field(default="10.2.12.150", description="address of the controller")
    port: Whole = Field(default=1000, gt=0, lt=65536, description="UDP port, 1 to 65535")
    bind: str = Field(
        default="0.0.0.0", description="address of this PC to listen on, 0.0.0.0 for all of them"
    )
    can: CanTable | None = Field(default=None, description="a table that names the CAN adapter")
    arm: Whole = Field(default=1, ge=1, le=4, description="arm of the controller, 1 to 4")
    max_gap: Whole = Field(
        default=2,
        ge=0,
        le=5,
        description="packets missed in a row that a motion survives, 0 to 5",
    )
    other_axes: list[ArmAxis] = Field(
        default_factory=list,
        description="pairs [arm, axis], both from 1, of axes that may be open though they are no "
        "joints of this cell, e.g. [[1, 7]]",
    )
    current_delay_cycles: Number = Field(
        default=0.0,
        description="cycles by which the position of a packet is newer than its target current",
    )
    packets: bool = Field(
        default=False, description="whether archives keep the raw packets of both directions"
    )

    @model_validator(mode="after")
    def _adapter_named(self) -> ControllerTable:
        if self.transport == "can" and self.can is None:
            raise ValueError(
                'transport = "can" needs a table [controller.can]; add it, or write "udp"'
            )
        return self


class BoxTable(Table):
    """A box-shaped obstacle in the base frame."""

    lower: Point = Field(description="its lower corner, three figures in m")
    upper: Point = Field(description="its upper corner, three figures in m")


class WorkspaceTable(Table):
    """`[workspace]`: what the arm must not touch, in the base frame."""

    floor: Number | Literal["none"] = Field(
        default=0.0, description='height of the floor in m, or "none"'
    )
    walls: list[BoxTable] = Field(
        default_factory=list, description="boxes {lower = [x, y, z], upper = [x, y, z]} in m"
    )
    margin: NonNegative = Field(default=0.05, description="clearance to keep, in m")


class CampaignTable(Table):
    """`[campaign]`: how the excitation is designed and executed."""

    repetitions: Whole = Field(default=30, ge=1, le=1000, description="repetitions, 1 to 1000")
    validation_runs: Whole = Field(
        default=10, ge=1, le=1000, description="validation runs, 1 to 1000"
    )
    home_deg: Vector = Field(
        description="start posture of every excitation, in degrees, in the frame of [limits]"
    )
    approach_speed: Annotated[Number, Field(gt=0, le=1)] = Field(
        default=0.1,
        description="fraction of the joint speeds for moves to the start, above 0, at most 1",
    )
    settle_s: NonNegative = Field(
        default=0.5, description="seconds of rest recorded after each motion"
    )
    standstill_s: Positive = Field(
        default=5.0, description="seconds of standstill for the noise variance"
    )
    warmup_drift: Annotated[Number, Field(ge=0, lt=1)] | None = Field(
        default=None,
        description="change of a joint's friction from one motion to the next below which it is "
        "warm, as a share (0.002); 0 for no warm-up",
    )
    warmup_least: Whole = Field(
        default=4, ge=3, le=1000, description="motions that warm up at least, 3 to 1000"
    )
    warmup_most: Whole = Field(
        default=60, ge=3, le=1000, description="motions that warm up at most, 3 to 1000"
    )
    bad_repetitions: Whole = Field(
        default=3,
        ge=0,
        le=100,
        description="times a motion that fails its quality check is repeated, 0 to 100",
    )
    n_via: Whole = Field(
        default=6, ge=2, le=60, description="via points of the excitation, 2 to 60"
    )
    fly: Annotated[Number, Field(ge=0, le=1)] = Field(
        default=0.5, description="fly-by fraction, 0 (stop at every via point) to 1"
    )
    candidates: Whole = Field(
        default=300,
        ge=1,
        description="motions that the quick search of a campaign without a design may try",
    )
    seed: Whole = Field(
        default=1, ge=0, description="seed of the search and of the validation motions"
    )


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
