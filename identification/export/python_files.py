"""Servo and friction as Python files: actuators of Isaac Lab, values of Genesis.

Both state values as dictionaries by joint, which can be read without the simulator.
"""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from identification.arrays import Array
from identification.export.actuators import UNITS, Actuators, Quantity, finite
from identification.export.urdf import WriteBackError

ISAAC_LAB: Final[Mapping[str, Quantity]] = {
    "STIFFNESS": "stiffness",
    "EFFORT_LIMIT": "limit",
    "FRICTION": "static",
    "DYNAMIC_FRICTION": "friction",
    "VISCOUS_FRICTION": "viscous",
    "ARMATURE": "armature",
    "DELAY": "delay",
    "OFFSET": "offset",
}
"""Quantities of the dictionaries in a file for Isaac Lab."""

GENESIS: Final[Mapping[str, Quantity]] = {
    "KP": "stiffness",
    "FORCE_LIMIT": "limit",
    "FRICTIONLOSS": "friction",
    "DAMPING": "viscous",
    "ARMATURE": "armature",
    "DELAY": "delay",
    "OFFSET": "offset",
}
"""Quantities of the dictionaries in a file for Genesis."""

_ISAAC_CONVENTIONS: Final = (
    "Units are SI with radians, as Isaac Lab's configuration has them. (USD files state stiffness,",
    "damping and viscous friction of joints that turn per degree.) Friction is an effort, static",
    "not below dynamic: PhysX 5.6, PxJointFrictionParams (staticFrictionEffort,",
    "dynamicFrictionEffort, viscousFrictionCoefficient), which Isaac Lab 2.2 and later set from",
    "`friction`, `dynamic_friction` and `viscous_friction`. With Isaac Sim before 5.0 `friction`",
    "is a coefficient without unit instead: do not use these values there.",
)
_ISAAC_SERVO: Final = '''
def actuators(physics_dt):
    """Return `ArticulationCfg.actuators` for a physics step [s].

    The delay is rounded to steps. Damping of the drive and viscous friction brake alike, which
    positions cannot tell apart: all of it is in `viscous_friction`.
    """
    from isaaclab.actuators import DelayedPDActuatorCfg

    def delayed(joint):
        steps = round(DELAY[joint] / physics_dt)
        return DelayedPDActuatorCfg(
            joint_names_expr=[joint],
            stiffness=STIFFNESS[joint],
            damping=0.0,
            armature=ARMATURE[joint],
            friction=FRICTION[joint],
            dynamic_friction=DYNAMIC_FRICTION[joint],
            viscous_friction=VISCOUS_FRICTION[joint],
            effort_limit=EFFORT_LIMIT[joint],
            min_delay=steps,
            max_delay=steps,
        )

    return {joint: delayed(joint) for joint in JOINTS}
'''
_ISAAC_TORQUE: Final = '''
def actuators(stiffness=0.0, damping=0.0):
    """Return `ArticulationCfg.actuators`, driven by torque unless a drive has gains."""
    from isaaclab.actuators import ImplicitActuatorCfg

    def drive(joint):
        return ImplicitActuatorCfg(
            joint_names_expr=[joint],
            stiffness=stiffness,
            damping=damping,
            armature=ARMATURE[joint],
            friction=FRICTION[joint],
            dynamic_friction=DYNAMIC_FRICTION[joint],
            viscous_friction=VISCOUS_FRICTION[joint],
            effort_limit_sim=EFFORT_LIMIT[joint],
        )

    return {joint: drive(joint) for joint in JOINTS}
'''
_GENESIS_CONVENTIONS: Final = (
    "Units are SI with radians. Genesis has `frictionloss`, `damping` and `armature` as MuJoCo has",
    "them. It has no delay: give each command DELAY seconds later.",
)
_GENESIS: Final = '''
def apply(entity):
    """Set the values of an entity of a built scene, whose joints have these names."""
    dofs = [entity.get_joint(joint).dofs_idx_local[0] for joint in JOINTS]

    def values(of):
        return [of[joint] for joint in JOINTS]

    limits = [INFINITE if limit is None else limit for limit in values(FORCE_LIMIT)]
{gains}    entity.set_dofs_force_range([-limit for limit in limits], limits, dofs)
    entity.set_dofs_armature(values(ARMATURE), dofs)
    entity.set_dofs_damping(values(DAMPING), dofs)
    entity.set_dofs_frictionloss(values(FRICTIONLOSS), dofs)
    return dofs
'''
_GENESIS_GAINS: Final = """    entity.set_dofs_kp(values(KP), dofs)
    entity.set_dofs_kv([0.0] * len(dofs), dofs)  # all damping is in the joint
"""


def isaac_lab(actuators: Actuators, name: str, remarks: Sequence[str] = ()) -> str:
    """Return a Python file with the actuators of an arm for Isaac Lab."""
    use = _ISAAC_SERVO if actuators.is_servo else _ISAAC_TORQUE
    title = f"Joint drives of {name} for Isaac Lab: `actuators` returns the actuators of an arm."
    return _file(title, (*remarks, *_ISAAC_CONVENTIONS), actuators, ISAAC_LAB) + "\n" + use


def genesis(actuators: Actuators, name: str, remarks: Sequence[str] = ()) -> str:
    """Return a Python file that sets the values of an arm in Genesis."""
    title = f"Joint drives of {name} for Genesis: `apply` sets the actuators of an entity."
    text = _file(title, (*remarks, *_GENESIS_CONVENTIONS), actuators, GENESIS)
    gains = _GENESIS_GAINS if actuators.is_servo else ""
    return f'{text}INFINITE = float("inf")\n\n' + _GENESIS.replace("{gains}", gains)


def require_values(text: str, actuators: Actuators, names: Mapping[str, Quantity]) -> None:
    """Parse a file again, and compare its values.

    Raises:
        WriteBackError: it is no Python, or states other values.
    """
    try:
        body = ast.parse(text).body
    except SyntaxError as error:
        raise WriteBackError(f"the file is not Python: {error}") from error
    stated = {
        node.targets[0].id: node.value
        for node in body
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
    }
    for constant, quantity in _present(actuators, names).items():
        values = ast.literal_eval(stated[constant])
        if values != _by_joint(actuators, actuators.value(quantity)):
            raise WriteBackError(f"read back, {constant} has other values")


def _file(
    title: str, remarks: Sequence[str], actuators: Actuators, names: Mapping[str, Quantity]
) -> str:
    """Return documentation and dictionaries of a file."""
    said = "\n".join(remark.replace("\\", "/").replace('"', "'") for remark in remarks)
    lines = [f'"""{title}\n\n{said}\n"""\n', f"JOINTS = {list(actuators.joint_names)!r}"]
    for constant, quantity in _present(actuators, names).items():
        field = actuators.fields[quantity]
        units = " or ".join(
            sorted({UNITS[quantity].turning if turns else UNITS[quantity].sliding
                    for turns in actuators.turning})
        )  # fmt: skip
        rows = zip(
            _by_joint(actuators, field.value).items(),
            field.lower,
            field.upper,
            field.from_data,
            strict=True,
        )
        lines.append(f"{constant} = {{  # {_NOTES[quantity]} [{units}]")
        for (joint, value), low, high, data in rows:
            said = f"95 %: {low:.3g} to {high:.3g}, from {'data' if data else 'prior'}"
            lines.append(f"    {joint!r}: {value!r},  # {said}")
        lines.append("}")
    return "\n".join(lines) + "\n"


_NOTES: Final[Mapping[Quantity, str]] = {
    "stiffness": "torque by error of the position",
    "limit": "largest torque of the motor; None: not known",
    "friction": "dry friction of a moving joint",
    "static": "dry friction of a joint at rest",
    "viscous": "friction by speed",
    "armature": "inertia of the rotor at the joint",
    "delay": "of commands",
    "offset": "to be added to commands: zero of the servo",
}


def _present(actuators: Actuators, names: Mapping[str, Quantity]) -> dict[str, Quantity]:
    return {name: quantity for name, quantity in names.items() if quantity in actuators.fields}


def _by_joint(actuators: Actuators, values: Array) -> dict[str, float | None]:
    return dict(zip(actuators.joint_names, map(finite, np.asarray(values)), strict=True))
