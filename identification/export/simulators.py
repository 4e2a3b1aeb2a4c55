"""The identified arm for simulators: MuJoCo's XML (MJCF), URDF, SDF and pinocchio's archive."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Final, NamedTuple
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from identification.arrays import Array, root_mean_square
from identification.errors import IdentificationError
from identification.export.actuators import Actuators
from identification.export.exported_arm import ExportedArm
from identification.export.friction_curve import load_remarks
from identification.export.sdf import MissingDrakeError, drake_torque, sdf
from identification.export.urdf import (
    WriteBackError,
    as_text,
    comment_text,
    other_gravity,
    rnea,
    write_urdf,
)
from identification.model.elements import (
    Element,
    ExtensionSpring,
    GasCylinder,
    PlacedElement,
    PositionTorque,
    TorqueRipple,
    TorsionSpring,
)
from identification.model.friction import (
    COULOMB,
    CUBIC,
    LOAD,
    QUADRATIC,
    TANH,
    VISCOUS,
    FrictionTerm,
)
from identification.model.kinematics import pinocchio_model
from identification.model.motion import Motion
from identification.model.regressor import RegressorPlan
from identification.model.robot import STANDARD_GRAVITY

Node = ElementTree.Element

RANDOM_STATES: Final = 1000
"""Number of random states at which a text is compared with the model."""
AGREEMENT_TOLERANCE: Final = 1e-6
"""Largest difference of a text that is read back, relative to the largest torque of a joint."""
_SEED: Final = 20140903
# Default ranges of random states: rad or m, rad/s or m/s, rad/s² or m/s².
_DEFAULT_POSITION_LIMIT = math.pi
_DEFAULT_SPEED_LIMIT = 2.0
_ACCELERATION_LIMIT = 10.0
_DRY_FRICTION_TERMS: Final = (COULOMB, TANH)
_DRY_LABELS: Final = tuple(term.label for term in _DRY_FRICTION_TERMS)
_SPEED_POWER_TERMS: Final = (QUADRATIC, CUBIC)
_TIMESTEP: Final = 1e-3  # s
_FRICTION_STEPS: Final = 2.0  # time constant of MuJoCo's dry friction, at least 2 steps
_REST_IMPEDANCE: Final = 0.9999  # impedance of MuJoCo's dry friction at which a joint rests
_CAPSULE_RADIUS: Final = 0.03  # m, radius of the capsules that show the arm
_MIN_CAPSULE_LENGTH: Final = 1e-3  # m, length of a capsule


class MissingMujocoError(IdentificationError):
    """MuJoCo is needed and not installed."""


def mjcf(
    arm: ExportedArm,
    name: str,
    remarks: Sequence[str] = (),
    *,
    step: float = _TIMESTEP,
    servos: Actuators | None = None,
) -> str:
    """Return the arm as MuJoCo's XML; motors are controlled by torque.

    Args:
        arm: bodies, rotors, friction and limits.
        name: of the model.
        remarks: lines of a comment.
        step: time step [s].
        servos: position servos in place of the motors.
    """
    model = arm.model
    rotors = arm.rotors
    coupled = np.array((rotors != np.diag(np.diag(rotors))).any(axis=1))
    root = Node("mujoco", model=name)
    _comment(root, [*remarks, *load_remarks(model, arm.written_load)])
    _add(root, "compiler", angle="radian", autolimits="true", inertiafromgeom="false",
         balanceinertia="true" if arm.balanced else None)  # fmt: skip
    _add(root, "option", gravity=as_text(model.gravity), timestep=as_text(step),
         integrator="implicitfast")  # fmt: skip
    places = {-1: _add(root, "worldbody")}
    motors = Node("actuator")
    for j, mass in enumerate(arm.bodies):
        parent = places[int(model.chain.parents[j])]
        rotation = model.chain.rotation[j]
        translation = model.chain.translation[j]
        if (
            np.linalg.norm(translation) > _MIN_CAPSULE_LENGTH
        ):  # shows the arm, without mass and contact
            line = as_text([0.0, 0.0, 0.0, *translation])
            _add(parent, "geom", type="capsule", fromto=line, size=as_text(_CAPSULE_RADIUS),
                 mass="0", contype="0", conaffinity="0")  # fmt: skip
        link = places[j] = _add(parent, "body", name=arm.link(j), **_pose(rotation, translation))
        six = mass.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        _add(link, "inertial", pos=as_text(mass.centre), mass=as_text(mass.mass),
             fullinertia=as_text(six))  # fmt: skip
        _joint(link, motors, arm, j, coupled=bool(coupled[j]), step=step, servos=servos)
        for frame, pose in arm.fixed(j).items():
            _add(link, "site", name=frame, **_pose(*pose))
    _tendons(root, arm, coupled, step)
    root.append(motors)
    return _text(root)


def _joint(
    link: Node,
    motors: Node,
    arm: ExportedArm,
    joint: int,
    *,
    coupled: bool,
    step: float,
    servos: Actuators | None,
) -> None:
    """Add a joint to a link, and what drives it."""
    model = arm.model
    ranges = arm.ranges
    name = model.joint_names[joint]
    friction = arm.friction[joint]
    stiffness, rest_angle = arm.spring(joint)
    third = {term.symbol: term for term in model.friction.laws[joint].terms}.get("f2")
    damping = [  # of v, v |v| and v³
        friction.get("f1", 0.0),
        # A negative one would accelerate a joint that is faster than the recorded motion.
        *(max(0.0, friction["f2"]) if third == kind else 0.0 for kind in _SPEED_POWER_TERMS),
    ]
    lower, upper, most = (bound[joint] for bound in (ranges.lower, ranges.upper, ranges.effort))
    limited = math.isfinite(lower) and math.isfinite(upper) and lower < upper
    effort = as_text([-most, most]) if math.isfinite(most) else None
    _add(
        link,
        "joint",
        name=name,
        type="hinge" if model.chain.revolute[joint] else "slide",
        axis=as_text(model.chain.axis[joint]),
        armature=as_text(0.0 if coupled else arm.rotors[joint, joint]),
        damping=as_text(damping),
        frictionloss=as_text(max(0.0, friction.get("f0", 0.0))),
        **(_dry_friction(step) if servos is None else still_friction(step)),
        stiffness=as_text(stiffness) if stiffness else None,
        springref=as_text(rest_angle) if stiffness else None,
        range=as_text([lower, upper]) if limited else None,
        actuatorfrcrange=effort if servos is None else None,
    )
    if servos is None:
        _add(motors, "motor", name=name, joint=name, ctrlrange=effort)
    else:
        figures = {"forcerange": effort, **position_attributes(servos, joint, step)}
        _add(motors, "position", name=name, joint=name, **figures)


def _dry_friction(step: float) -> dict[str, str]:
    """Return the attributes of dry friction as a constraint at a time step [s]."""
    return {"solreffriction": as_text([_FRICTION_STEPS * step, 1.0])}


def still_friction(step: float) -> dict[str, str]:
    """Return these of a joint that friction holds against gravity for minutes.

    With the default impedance (0.9 to 0.95) a held joint creeps by milliradians a second.
    """
    return {
        **_dry_friction(step),
        "solimpfriction": as_text([_REST_IMPEDANCE, _REST_IMPEDANCE, 0.001, 0.5, 2.0]),
    }


def position_attributes(servos: Actuators, joint: int, step: float) -> dict[str, str]:
    """Return the attributes of a position actuator at a time step [s].

    All braking is in the joint's damping. The command is delayed by MuJoCo's own history of
    controls, which holds one for each step.
    """
    limit = float(servos.value("limit")[joint])
    delay = float(servos.value("delay")[joint])
    attributes = {"kp": as_text(servos.value("stiffness")[joint]), "kv": "0"}
    if math.isfinite(limit):
        attributes["forcerange"] = as_text([-limit, limit])
    if delay >= 0.5 * step:
        samples = math.ceil(delay / step) + 2
        attributes |= {"delay": as_text(delay), "nsample": str(samples), "interp": "linear"}
    return attributes


def urdf(arm: ExportedArm, name: str, remarks: Sequence[str] = ()) -> str:
    """Return the URDF with the arm's bodies and friction; see `write_urdf`."""
    del name
    friction = arm.values[arm.model.friction_part]
    return write_urdf(arm.urdf, arm.model, arm.standard, friction, remarks, arm.load)


def pinocchio_arm(arm: ExportedArm, name: str) -> pin.Model:
    """Return the arm as pinocchio's model, with armature, damping and dry friction.

    It is read from the arm's URDF, so that it has the limits and frames of the user's file.
    """
    model = pinocchio_model(urdf(arm, name), arm.model.locked)
    model.name = name
    model.gravity.linear = arm.model.gravity
    dry = np.array([max(0.0, row.get("f0", 0.0)) for row in arm.friction[: arm.model.n_joints]])
    model.armature[:] = np.diag(arm.rotors)
    model.damping[:] = [row.get("f1", 0.0) for row in arm.friction[: arm.model.n_joints]]
    model.friction[:] = dry
    model.upperDryFrictionLimit[:] = dry
    model.lowerDryFrictionLimit[:] = -dry
    return model


def pinocchio_archive(arm: ExportedArm, name: str, remarks: Sequence[str] = ()) -> str:
    """Return :func:`pinocchio_arm` as the text archive of a model, which has no place for remarks.

    ``model = pinocchio.Model(); model.loadFromString(text)`` reads it.
    """
    del remarks
    return str(pinocchio_arm(arm, name).saveToString())


_ELEMENT_NAMES: Final[Mapping[type[Element], str]] = {
    TorsionSpring: "torsion spring",
    ExtensionSpring: "extension spring",
    GasCylinder: "gas spring or balancer",
    TorqueRipple: "torque ripple",
    PositionTorque: "position-dependent torque",
}


class ModelFormat(NamedTuple):
    """A file format and the parts of the model that it supports."""

    suffix: str  # of its files
    write: Callable[[ExportedArm, str, Sequence[str]], str]  # text of an arm, its name and remarks
    # torques (m, n) of bodies, rotors, springs and speed-dependent friction, from text, arm, motion
    read: Callable[[str, ExportedArm, Motion], Array]
    friction: tuple[FrictionTerm, ...] = (COULOMB, TANH, VISCOUS)
    # rotor inertias, inertia and friction of coupled motors, torsion springs, a stated payload
    drives: bool = False
    rotors: bool = False  # rotor inertias alone
    gravity: bool = False


class SimulatorComparison(NamedTuple):
    """Comparison of a text with the model."""

    # largest torque difference of the supported parts at `RANDOM_STATES` random states, relative to
    # the largest torque of the joint
    difference: float
    torque: Array  # root mean square of the whole torque over the motion (n,) [N·m or N]
    left_out: Mapping[str, Array]  # torque of each unsupported part (n,), by description


def compare(text: str, form: ModelFormat, arm: ExportedArm, motion: Motion) -> SimulatorComparison:
    """Read a text back, compare it with the arm, and compute the torque of parts left out.

    Args:
        text: of the model file.
        form: its format.
        arm: that was written.
        motion: on which torques are computed.

    Raises:
        WriteBackError: the torque differs at some random state.
        MissingMujocoError: the format needs MuJoCo, which is not installed.
        MissingDrakeError: likewise Drake.
    """
    difference = read_back(text, form, arm)
    omitted = {
        name: root_mean_square(torque) for name, torque in _left_out(form, arm, motion).items()
    }
    omitted[_REVERSALS] = root_mean_square(_dry(arm, motion) - _dry(arm, motion, jumps=True))
    if form.read is _mujoco_torque:
        dry = _mujoco_torque(text, arm, motion, friction=True) - _supported(form, arm, motion)
        omitted[_REVERSALS] = root_mean_square(dry - _dry(arm, motion))
    whole = arm.model.torque(arm.values, motion.without_load()) + arm.model.load_torque(motion)
    return SimulatorComparison(
        difference, root_mean_square(whole), {k: v for k, v in omitted.items() if v.any()}
    )


def read_back(text: str, form: ModelFormat, arm: ExportedArm, count: int = RANDOM_STATES) -> float:
    """Return the largest difference of a text's torque from the arm's, see :class:`Comparison`.

    Args:
        text: of the model file.
        form: its format.
        arm: that was written.
        count: of random states.

    Raises:
        WriteBackError: the torque differs at some random state.
        MissingMujocoError: the format needs MuJoCo, which is not installed.
        MissingDrakeError: likewise Drake.
    """
    states = random_states(arm, count)
    expected = _supported(form, arm, states)
    error = np.abs(form.read(text, arm, states) - expected).max(axis=0)
    largest = np.abs(expected).max(axis=0)
    difference = float((error / np.where(largest > 0.0, largest, 1.0)).max())
    if not difference <= AGREEMENT_TOLERANCE:
        joint = arm.model.joint_names[int(np.argmax(error))]
        raise WriteBackError(
            f"read back, the torque of joint {joint!r} differs by {difference:.2g} of its"
            " largest one"
        )
    return difference


MISSING_SIMULATOR_ERRORS: Final = (MissingMujocoError, MissingDrakeError)
"""Errors of formats whose reader is not installed."""


def random_states(arm: ExportedArm, count: int = RANDOM_STATES) -> Motion:
    """Return random states within the limits of an arm."""
    ranges = arm.ranges
    n = arm.model.n_joints
    random = np.random.default_rng(_SEED)
    lower = np.maximum(ranges.lower, -_DEFAULT_POSITION_LIMIT)
    upper = np.minimum(ranges.upper, _DEFAULT_POSITION_LIMIT)
    speed = np.where(np.isfinite(ranges.velocity), ranges.velocity, _DEFAULT_SPEED_LIMIT)
    return Motion(
        np.arange(count, dtype=np.float64),
        random.uniform(lower, np.maximum(lower, upper), (count, n)),
        random.uniform(-speed, speed, (count, n)),
        random.uniform(-_ACCELERATION_LIMIT, _ACCELERATION_LIMIT, (count, n)),
    )


_BEYOND: Final = "where it differs from its value at the typical load, which is written"
_ACCELERATES: Final = "where its coefficient is negative and would accelerate a joint"
_REVERSALS: Final = "the transition of dry friction at velocity reversals and standstill"
_ROUNDED: Final = "effect of rounded angles of the URDF on the base parameters"
_MAX_COMPARED_ROWS: Final = 200  # rows that show whether there is one


Part = tuple[str, Callable[[], Array], bool]
"""Description of a part of the model, its torque (m, n), and whether a format supports it."""


def _parts(form: ModelFormat, arm: ExportedArm, motion: Motion) -> Iterator[Part]:
    """Yield the parts of the model along a motion."""
    model = arm.model
    q = motion.position
    qdd = motion.acceleration
    terms = arm.model.friction.terms
    yield "the links", lambda: rigid_torque(arm, motion), True
    brakes = _brakes(arm)
    for kind in model.friction.kinds:
        if kind not in _DRY_FRICTION_TERMS or kind not in form.friction:
            description = f"{kind.description}, {_BEYOND}" if kind.of_load else kind.description
            chosen = np.array([t.term.label == kind.label and not t.motor for t in terms], np.bool_)
            written = kind in form.friction
            left = chosen & ~brakes if written else np.zeros_like(chosen)
            torque = partial(_friction_of, arm, motion, kind)
            yield description, partial(torque, chosen & ~left), written
            if left.any():
                yield f"{kind.description}, {_ACCELERATES}", partial(torque, left), False
    diagonal = np.diag(np.diag(arm.rotors))
    coupled = arm.rotors - diagonal
    motors = [
        friction_term.motor and not (form.drives and friction_term.term.label in _DRY_LABELS)
        for friction_term in terms
    ]
    yield "rotor inertias", lambda: qdd @ diagonal, form.drives or form.rotors
    yield "inertia of coupled motors", lambda: qdd @ coupled, form.drives
    yield "friction of coupled motors", lambda: _friction(arm, motion, motors), form.drives
    yield (
        "the payload",
        lambda: model.load_torque(motion) - model.elements.known_torque(q),
        form.drives,
    )
    for placed in model.elements.placed:
        supported = form.drives and isinstance(placed.element, TorsionSpring)
        description = f"the {_ELEMENT_NAMES[type(placed.element)]} of {placed.element.joint}"
        yield description, partial(_element_torque, arm, motion, placed), supported


def _brakes(arm: ExportedArm) -> NDArray[np.bool_]:
    """Return whether each friction term is no power of the speed with a negative coefficient."""
    terms = arm.model.friction.terms
    values = arm.values[arm.model.friction_part]
    of_speed = np.array(
        [friction_term.term in _SPEED_POWER_TERMS for friction_term in terms], dtype=np.bool_
    )
    return np.asarray(~(of_speed & (values < 0.0)))


def _friction_of(
    arm: ExportedArm, motion: Motion, kind: FrictionTerm, chosen: NDArray[np.bool_]
) -> Array:
    """Return the torque (m, n) of friction terms of a kind, minus the part at the typical load."""
    torque = _friction(arm, motion, chosen.tolist())
    return torque - _at_load(arm, motion) if kind.of_load else torque


def _element_torque(arm: ExportedArm, motion: Motion, placed: PlacedElement) -> Array:
    """Return the torque (m, n) of a passive element."""
    torque = np.zeros(motion.position.shape)
    values = arm.values[arm.model.element_part][placed.part]
    torque[:, placed.joint] = placed.columns(motion.position) @ values + placed.known_torque(
        motion.position
    )
    return torque


def _left_out(form: ModelFormat, arm: ExportedArm, motion: Motion) -> dict[str, Array]:
    """Return the torque (m, n) of each part of the model that a format does not support.

    Without dry friction at reversals, which every simulator has in its own way.
    """
    omitted = dict[str, Array]()
    for name, torque, supported in _parts(form, arm, motion):
        if not supported:
            omitted[name] = omitted.get(name, 0.0) + torque()
    if not form.gravity and (gravity := other_gravity(arm.model)):
        usual = RegressorPlan.of_bodies(arm.model.chain, np.array(STANDARD_GRAVITY))
        omitted[gravity] = rigid_torque(arm, motion) - _link_torque(arm, usual, motion)
    some = motion.rows(slice(None, None, -(-motion.n_samples // _MAX_COMPARED_ROWS)))
    rounded, whole = _rounding(arm, some)
    if np.abs(rounded).max() > AGREEMENT_TOLERANCE * np.abs(whole).max():
        omitted[_ROUNDED] = _rounding(arm, motion)[0]
    return omitted


def _rounding(arm: ExportedArm, motion: Motion) -> tuple[Array, Array]:
    """Return the torque (m, n) by which links and rotors differ from the base parameters', and it.

    Base parameters are of a URDF with rounded angles.
    """
    model = arm.model
    base = np.where(np.arange(model.n_parameters) < model.base.rank, arm.values, 0.0)
    whole = model.torque(base, motion.without_load())
    return whole - rigid_torque(arm, motion) - motion.acceleration @ arm.rotors, whole


def unsupported_torque(arm: ExportedArm, motion: Motion) -> Array:
    """Return the torque (m, n) of all parts that MuJoCo does not simulate, along a motion.

    Without dry friction at reversals, which every simulator has in its own way.
    """
    parts = _left_out(FORMATS["mjcf"], arm, motion).values()
    return np.asarray(np.sum([np.zeros(motion.position.shape), *parts], axis=0))


def _supported(form: ModelFormat, arm: ExportedArm, motion: Motion) -> Array:
    """Return the torque (m, n) of the parts that a format supports, without dry friction."""
    parts = [torque() for _, torque, supported in _parts(form, arm, motion) if supported]
    return np.asarray(np.sum(parts, axis=0))


def rigid_torque(arm: ExportedArm, motion: Motion) -> Array:
    """Return the torque (m, n) of the links, without the payload."""
    model = arm.model
    return _link_torque(arm, RegressorPlan.of_bodies(model.chain, model.gravity), motion)


def _link_torque(arm: ExportedArm, plan: RegressorPlan, motion: Motion) -> Array:
    links = arm.standard[arm.model.layout.links]
    return plan.torque(links.reshape(-1), motion.kinematics())


def _friction(
    arm: ExportedArm, motion: Motion, chosen: Sequence[bool], load: Array | None = None
) -> Array:
    """Return the torque (m, n) of some friction terms, at a load (m, n), by default the arm's."""
    model = arm.model
    if load is None and model.friction.has_load:
        load = model.gear_torque(arm.values, motion)
    values = np.zeros(model.n_parameters)
    part = model.friction_part
    values[part] = np.where(chosen, arm.values[part], 0.0)
    return model.torque(values, replace(motion, load=load))


def _at_load(arm: ExportedArm, motion: Motion) -> Array:
    """Return the torque (m, n) of load-dependent friction at the load for which it is written."""
    shares = [friction_term.term.label == LOAD.label for friction_term in arm.model.friction.terms]
    return _friction(arm, motion, shares, np.tile(arm.written_load, (motion.n_samples, 1)))


def _dry(arm: ExportedArm, motion: Motion, *, jumps: bool = False) -> Array:
    """Return the torque (m, n) of dry friction of the model, or with a jump at zero speed."""
    if not jumps:
        terms = arm.model.friction.terms
        dry = _friction(
            arm, motion, [friction_term.term.label in _DRY_LABELS for friction_term in terms]
        )
        return dry + _at_load(arm, motion) if arm.model.friction.has_load else dry
    friction = arm.model.friction
    n = arm.model.n_joints
    f0 = np.array([row.get("f0", 0.0) for row in arm.friction])
    shares = friction.motor_speeds()
    torque = f0[:n] * np.sign(motion.velocity)
    return np.asarray(torque + (f0[n:] * np.sign(motion.velocity @ shares.T)) @ shares)


def _pinocchio_torque(text: str, arm: ExportedArm, motion: Motion) -> Array:
    """Return the torques of a URDF's bodies and damping."""
    model = pinocchio_model(text, arm.model.locked)
    model.gravity.linear = arm.model.gravity
    return rnea(model, motion) + np.asarray(model.damping) * motion.velocity


def _archive_torque(text: str, arm: ExportedArm, motion: Motion) -> Array:
    """Return the torques of bodies, armature and damping of a pinocchio archive."""
    del arm
    model = pin.Model()
    model.loadFromString(text)
    return rnea(model, motion) + np.asarray(model.damping) * motion.velocity


def _mujoco_torque(text: str, arm: ExportedArm, motion: Motion, *, friction: bool = False) -> Array:
    """Return the torques of MuJoCo's inverse dynamics."""
    mujoco = load_mujoco()
    try:
        model = mujoco.MjModel.from_xml_string(text)
    except ValueError as error:
        raise WriteBackError(f"MuJoCo does not read the text: {error}") from error
    off = mujoco.mjtDisableBit
    model.opt.disableflags |= off.mjDSBL_LIMIT if friction else off.mjDSBL_CONSTRAINT
    data = mujoco.MjData(model)
    order = [int(model.joint(name).dofadr[0]) for name in arm.model.joint_names]
    torque = np.empty(motion.position.shape)
    for k, (q, qd, qdd) in enumerate(motion.states()):
        data.qpos[order] = q
        data.qvel[order] = qd
        data.qacc[order] = qdd
        mujoco.mj_inverse(model, data)
        torque[k] = data.qfrc_inverse[order]
    return torque


def load_mujoco() -> Any:
    """Return the module `mujoco`.

    Raises:
        MissingMujocoError: it is not installed.
    """
    try:
        import mujoco  # optional dependency
    except ImportError as error:
        raise MissingMujocoError("MuJoCo is not installed: pip install mujoco") from error
    return mujoco


FORMATS: Final[Mapping[str, ModelFormat]] = {
    "mjcf": ModelFormat(
        ".xml",
        mjcf,
        _mujoco_torque,
        friction=(COULOMB, TANH, VISCOUS, QUADRATIC, CUBIC),
        drives=True,
        gravity=True,
    ),
    "urdf": ModelFormat(".urdf", urdf, _pinocchio_torque),
    "sdf": ModelFormat(".sdf", sdf, drake_torque),
    "pinocchio": ModelFormat(
        ".pinocchio", pinocchio_archive, _archive_torque, rotors=True, gravity=True
    ),
}
"""Formats by name."""


def _tendons(root: Node, arm: ExportedArm, coupled: NDArray[np.bool_], step: float) -> None:
    """Add inertia and friction of coupled motors as fixed tendons."""
    names = arm.model.joint_names
    friction = arm.model.friction
    tendons = Node("tendon")

    def add(name: str, share: Array, **figures: str) -> None:
        tendon = _add(tendons, "fixed", name=name, **figures)
        for joint in np.flatnonzero(share):
            _add(tendon, "joint", joint=names[joint], coef=as_text(share[joint]))

    if coupled.any():
        inertia, directions = np.linalg.eigh(arm.rotors[np.ix_(coupled, coupled)])
        shares = np.zeros((len(inertia), len(names)))
        shares[:, coupled] = directions.T
        for k, (value, share) in enumerate(zip(inertia, shares, strict=True)):
            add(f"rotors_{k + 1}", share, armature=as_text(max(0.0, float(value))))
    table = arm.friction[len(names) :]
    for motor, share, row in zip(friction.motors, friction.motor_speeds(), table, strict=True):
        add(
            f"motor_{motor + 1}",
            share,
            damping=as_text(row.get("f1", 0.0)),
            frictionloss=as_text(max(0.0, row.get("f0", 0.0))),
            solreffriction=as_text([_FRICTION_STEPS * step, 1.0]),
        )
    if len(tendons):
        root.append(tendons)


def _pose(rotation: Array, translation: Array) -> dict[str, str]:
    return {
        "pos": as_text(translation),
        "xyaxes": as_text([*rotation[:, 0], *rotation[:, 1]]),
    }


def _comment(node: Node, remarks: Sequence[str]) -> None:
    if remarks:
        lines = "".join(f"  {comment_text(line)}\n" for line in remarks)
        node.append(ElementTree.Comment(f"\n{lines}"))


def _add(parent: Node, tag: str, /, **attributes: str | None) -> Node:
    stated = {key: value for key, value in attributes.items() if value is not None}
    return ElementTree.SubElement(parent, tag, stated)


def _text(root: Node) -> str:
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"
