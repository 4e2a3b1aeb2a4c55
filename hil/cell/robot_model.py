"""Robot model of the table `[robot]`."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import numpy as np

from hil.base.arrays import Array
from hil.cell.urdf_unit_problem import unit_problem
from identification.errors import ModelError
from identification.model.coupling import Coupling
from identification.model.elements import (
    Anchors,
    Element,
    ElementError,
    ExtensionSpring,
    GasCylinder,
    JointElements,
    PositionTorque,
    TorqueRipple,
    TorsionSpring,
)
from identification.model.friction import FrictionLaw
from identification.model.kinematics import Chain, chain_from_urdf, pinocchio_model
from identification.model.known_payload import Payload
from identification.model.robot import RobotModel

from .errors import CellError
from .schema import (
    COMMON_FRICTION_ENTRIES,
    CouplingTable,
    ElementTable,
    ExtensionSpringTable,
    FrictionTable,
    PayloadTable,
    RobotTable,
    TorsionSpringTable,
)

_MIN_GEAR_RATIO: Final = 10.0  # turns of the motor per turn of the joint


def robot_model(
    path: Path, urdf_name: str, urdf: str, robot: RobotTable, drive_train: Callable[[], Array]
) -> RobotModel:
    """Build the model of a cell.

    Args:
        path: of the cell file, for errors.
        urdf_name: likewise.
        urdf: text.
        robot: table of the file.
        drive_train: returns the motor angles per joint angle (n, n) of `[drive_train]`.

    Raises:
        CellError: cell or URDF are invalid.
    """
    friction = robot.friction
    with _cell_errors(path, "cell.urdf", urdf_name, "correct the URDF"):
        if robot.locked:  # joints of any type
            _require(path, "robot.locked", robot.locked, tuple(pinocchio_model(urdf).names)[1:])
        chain = chain_from_urdf(urdf, robot.locked)
    if (units := unit_problem(urdf)) is not None:
        problem = f"{units.field}: {units.problem}"
        raise CellError(path, "cell.urdf", urdf_name, problem, units.remedy)
    _require(path, "robot.friction.joints", friction.joints, chain.joint_names)
    coupling = _coupling(path, robot.coupling, chain, drive_train)
    payload = _payload(path, robot.payload, chain)
    elements = [_element(path, index, table, chain) for index, table in enumerate(robot.elements)]
    if friction.ripple:
        elements += ripples(chain.joint_names, drive_train(), friction.ripple)
    _require(path, "robot.friction.springs", friction.springs, chain.joint_names)
    elements += springs(friction.springs)
    _require(path, "robot.friction.position_torque", friction.position_torque, chain.joint_names)
    elements += map(PositionTorque, friction.position_torque)
    laws = {}
    for name, joint_table in friction.joints.items():
        table = friction.model_copy(update=joint_table.model_dump(exclude_unset=True))
        laws[name] = _law(path, f"robot.friction.joints.{name}", table)
    common = _law(path, "robot.friction", friction)
    with (
        _cell_errors(path, "cell.urdf", urdf_name, "correct the URDF or [robot]"),
        _cell_errors(path, "robot.elements", None, "correct that table", ElementError),
    ):
        return RobotModel.from_urdf(
            urdf,
            gravity=tuple(robot.gravity),
            rotor_inertia=robot.rotor_inertia,
            friction=common,
            joint_friction=laws,
            locked=robot.locked,
            coupling=coupling,
            payload=payload,
            elements=elements,
        )


def ripples(
    joints: Sequence[str], motor_from_joint: Array, orders: Sequence[int]
) -> list[TorqueRipple]:
    """Return the torque ripple of geared joints; of others it resembles gravity."""
    return [
        TorqueRipple(name, tuple(orders), tuple(zip(joints, row, strict=True)))
        for k, (name, row) in enumerate(zip(joints, motor_from_joint.tolist(), strict=True))
        if abs(row[k]) >= _MIN_GEAR_RATIO
    ]


def springs(joints: Sequence[str]) -> list[TorsionSpring]:
    """Return identified torsion springs; an offset of the torque moves their rest angles."""
    return [TorsionSpring(name, rest=0.0, identified=True) for name in joints]


def _law(path: Path, field: str, table: FrictionTable) -> FrictionLaw:
    with _cell_errors(path, field, None, "correct that table"):
        return FrictionLaw.from_table(table.model_dump(exclude=COMMON_FRICTION_ENTRIES))


def _coupling(
    path: Path, table: CouplingTable | None, chain: Chain, drive_train: Callable[[], Array]
) -> Coupling | None:
    if table is None:
        return None
    field = "robot.coupling.motor_from_joint"
    given = table.motor_from_joint
    n = chain.n_joints
    if given == "drive_train":
        matrix = drive_train()
    elif {len(row) for row in given} | {len(given)} == {n}:
        matrix = np.array(given, dtype=np.float64)
    else:
        joints = ", ".join(chain.joint_names)
        remedy = f"give one row per motor with one value for each of {joints}"
        raise CellError(path, field, None, f"is not {n} rows of {n} values", remedy)
    with _cell_errors(path, field, None, "correct that matrix"):
        return Coupling(matrix, inertia=table.inertia, friction=table.friction)


def _payload(path: Path, table: PayloadTable | None, chain: Chain) -> Payload | None:
    if table is None:
        return None
    xx, xy, xz, yy, yz, zz = table.inertia
    with _cell_errors(path, "robot.payload", None, "correct that table"):
        payload = Payload(
            table.mass, table.centre, (xx, xy, xz, yy, yz, zz), frame=table.frame or None
        )
        payload.carried_by(chain)
        return payload


def _element(path: Path, index: int, table: ElementTable, chain: Chain) -> Element:
    field = f"robot.elements[{index}]"
    _require(path, f"{field}.joint", [table.joint], chain.joint_names)
    with _cell_errors(path, field, table.kind, "correct that table"):
        element = _built(table)
        JointElements.of([element], chain.joint_names, tuple(map(bool, chain.revolute)))
        return element


def _built(table: ElementTable) -> Element:
    """Create the element of a table (ModelError if invalid)."""
    if isinstance(table, TorsionSpringTable):
        rest_angle = math.radians(table.rest_deg)
        return TorsionSpring(table.joint, rest_angle, table.stiffness, table.identified)
    anchors = Anchors(table.base_distance, table.link_distance, math.radians(table.angle_deg))
    if isinstance(table, ExtensionSpringTable):
        return ExtensionSpring(
            table.joint,
            anchors,
            table.free_length,
            stiffness=table.stiffness,
            preload=table.preload,
            identified=table.identified,
        )
    return GasCylinder(
        table.joint,
        anchors,
        table.length,
        table.area,
        table.pressure,
        table.volume,
        pulls=table.kind == "hydraulic_balancer",
        identified=table.identified,
    )


def _require(path: Path, field: str, named: Iterable[str], joints: Sequence[str]) -> None:
    for name in named:
        if name not in joints:
            remedy = f"its joints are {', '.join(joints)}"
            raise CellError(path, field, name, "is not a moving joint of the URDF", remedy)


@contextmanager
def _cell_errors(
    path: Path, field: str, value: object, remedy: str, kind: type[ModelError] = ModelError
) -> Iterator[None]:
    try:
        yield
    except kind as error:
        raise CellError(path, field, value, str(error), remedy) from error
