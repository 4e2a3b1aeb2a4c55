"""An arm on position servos, simulated by pinocchio and small steps: nothing of it is of `hil`."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

Array = NDArray[np.float64]

URDF = """<robot name="servo_arm">
 <link name="base"/>
 {links}
</robot>"""
_LINK = """
 <joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{name}_link"/>
  <origin xyz="{origin}"/><axis xyz="{axis}"/>
  <limit lower="-2.5" upper="2.5" effort="10" velocity="10"/></joint>
 <link name="{name}_link"><inertial><origin xyz="{centre}"/><mass value="{mass}"/>
  <inertia ixx="2e-4" iyy="2e-4" izz="2e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
NAMES = ("pan", "lift", "elbow")
STEP = 2e-3
RATE = 50.0
TIP = np.array([0.18, 0.0, 0.0])  # in the last link
STIFF = 3e3  # N/m, of a floor
DAMPED = 10.0  # N·s/m
COUNT = 2.0 * np.pi / 4096.0


def urdf() -> str:
    """Return the description of an arm of three joints."""
    rows = (
        ("pan", "base", "0 0 0.05", "0 0 1", "0 0 0.03", 0.15),
        ("lift", "pan_link", "0 0 0.06", "0 1 0", "0.08 0 0.01", 0.2),
        ("elbow", "lift_link", "0.15 0 0", "0 1 0", "0.09 0 0", 0.18),
    )
    keys = ("name", "parent", "origin", "axis", "centre", "mass")
    return URDF.format(
        links="".join(_LINK.format(**dict(zip(keys, row, strict=True))) for row in rows)
    )


@dataclass(frozen=True)
class Planted:
    """True parameters of each joint (3,), in SI units; `delay` of the bus [s].

    The `acceleration` of set-points is without limit unless it is given.
    """

    kp: Array
    kd: Array
    armature: Array
    viscous: Array
    coulomb: Array
    static: Array
    speed: Array
    load: Array
    limit: Array
    dead_band: Array
    delay: float
    acceleration: float = np.inf

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Planted:
        """Return parameters of hobby servos."""

        def about(value: float, spread: float = 0.3) -> Array:
            return value * np.exp(spread * rng.standard_normal(3))

        return cls(
            kp=about(15.0), kd=about(0.3), armature=about(0.02), viscous=about(0.5),
            coulomb=about(0.06), static=about(0.04), speed=about(0.1, 0.2), load=about(0.15),
            limit=about(3.0, 0.1), dead_band=about(0.003), delay=float(rng.uniform(0.01, 0.04)),
        )  # fmt: skip


def commands(rng: np.random.Generator, duration: float) -> tuple[Array, Array]:
    """Return times (m,) and commands (m, 3): slow and fast parts, and rests."""
    time = np.arange(0.0, duration, 1.0 / RATE)
    command = np.zeros((len(time), 3))
    for joint in range(3):
        for frequency in (0.05, 0.13, 0.4, 1.1, 2.1):
            size = min(0.5, 0.12 / frequency) * rng.uniform(0.4, 1.0)
            command[:, joint] += (
                size
                * np.sin(2.0 * np.pi * (frequency * time + rng.uniform()) * rng.uniform(0.8, 1.2))
                * (0.5 + 0.5 * np.tanh(20.0 * np.sin(2 * np.pi * time / rng.uniform(11.0, 23.0))))
            )
    command += np.array([0.0, -0.6, 0.8])
    smooth = np.minimum(1.0, time / 1.0)[:, None]
    return time, command[0] + (command - command[0]) * smooth


def poses(rng: np.random.Generator, duration: float) -> tuple[Array, Array]:
    """Return times (m,) and commands (m, 3) that stop at a pose for three of every four seconds."""
    time = np.arange(0.0, duration, 1.0 / RATE)
    count = int(np.ceil(duration / 4.0)) + 1
    targets = np.array([0.0, -0.6, 0.8]) + rng.uniform(-0.5, 0.5, (count, 3))
    place, moved = np.divmod(time / 4.0, 1.0)
    share = np.minimum(4.0 * moved, 1.0)[:, None]
    share = share**2 * (3.0 - 2.0 * share)
    before = place.astype(np.intp)
    return time, targets[before] + share * (targets[before + 1] - targets[before])


def planned(command: Array, acceleration: float) -> Array:
    """Return set-points (m, 3) that follow commands, and brake by an acceleration to meet them."""
    fine = 20
    step = STEP / fine
    position = command[0].copy()
    velocity = np.zeros(3)
    rows = [position.copy()]
    for before, after in pairwise(command):
        for k in range(fine):
            away = before + (after - before) * (k / fine) - position
            wanted = np.sign(away) * np.sqrt(2.0 * acceleration * np.abs(away))
            most = acceleration * step
            velocity = velocity + np.clip(wanted - velocity, -most, most)
            position = position + step * velocity
        rows.append(position.copy())
    return np.array(rows)


def _stepped(
    whole: list[list[float]], push: list[float], bound: list[float], velocity: list[float]
) -> list[float]:
    """Return velocities after a step with dry friction, by projected Gauss-Seidel."""
    new = list(velocity)
    for _ in range(6):
        before = list(new)
        for j, row in enumerate(whole):
            rest = push[j] - sum(a * b for a, b in zip(row, new, strict=True)) + row[j] * new[j]
            slip = max(abs(rest) - bound[j], 0.0)
            new[j] = (slip if rest > 0.0 else -slip) / row[j]
        if max(abs(a - b) for a, b in zip(new, before, strict=True)) < 1e-9:
            break
    return new


def tip_heights(positions: Array) -> Array:
    """Return the heights (m,) of the arm's end along positions (m, 3) [m]."""
    model = pin.buildModelFromXML(urdf())
    data = model.createData()
    return np.array([_tip(model, data, q)[0] for q in positions])


def _tip(model: pin.Model, data: pin.Data, q: Array) -> tuple[float, Array]:
    """Return the height of the arm's end and its slope by the joints (3,)."""
    pin.computeJointJacobians(model, data, q)
    placement = data.oMi[model.njoints - 1]
    jacobian = pin.getJointJacobian(model, data, model.njoints - 1, pin.ReferenceFrame.WORLD)
    linear, angular = jacobian[:3], jacobian[3:]
    place = placement.act(TIP)
    return float(place[2]), np.asarray(linear[2] + np.cross(angular.T, place)[:, 2])


def simulated(planted: Planted, time: Array, command: Array, floor: float = -np.inf) -> Array:
    """Return measured positions at the times (m, 3), in counts of the encoder.

    Args:
        planted: true parameters.
        time: (m,) [s].
        command: (m, 3).
        floor: height of a stiff, smooth floor under the arm's end [m].
    """
    model = pin.buildModelFromXML(urdf())
    data = model.createData()
    grid = np.arange(0.0, time[-1] + STEP, STEP)
    wanted = np.column_stack([np.interp(grid - planted.delay, time, each) for each in command.T])
    if np.isfinite(planted.acceleration):
        wanted = planned(wanted, planted.acceleration)
    rate = np.gradient(wanted, STEP, axis=0)
    q = command[0].copy()
    v = np.zeros(3)
    accelerated = np.zeros(3)
    positions = np.empty((len(grid), 3))
    for k in range(len(grid)):
        positions[k] = q
        error = wanted[k] - q
        error = np.sign(error) * np.maximum(np.abs(error) - planted.dead_band, 0.0)
        motor = planted.kp * error + planted.kd * (rate[k] - v)
        free = np.abs(motor) < planted.limit
        motor = np.clip(motor, -planted.limit, planted.limit)
        inertia = pin.crba(model, data, q)
        inertia = np.triu(inertia) + np.triu(inertia, 1).T
        bias = pin.nle(model, data, q, v)
        if np.isfinite(floor):
            height, slope = _tip(model, data, q)
            if height < floor:
                bias = bias - slope * max(0.0, STIFF * (floor - height) - DAMPED * float(slope @ v))
        # Damping acts on the mean of the velocities before and after a step: of second order.
        half = 0.5 * STEP * np.diag(planted.viscous + planted.kd * free)
        masses = inertia + np.diag(planted.armature)
        whole = masses + half
        push = (masses - half) @ v + STEP * (motor + planted.kd * free * v - bias)
        # Load of the gears: the torque of the bodies at the acceleration of the step before.
        load = np.abs(bias + inertia @ accelerated)
        bound = STEP * (
            planted.coulomb
            + planted.static * np.exp(-((v / planted.speed) ** 2))
            + planted.load * load
        )
        new = np.array(_stepped(whole.tolist(), push.tolist(), bound.tolist(), v.tolist()))
        accelerated = (new - v) / STEP
        v = new
        q = q + STEP * v
    measured = np.column_stack([np.interp(time, grid, each) for each in positions.T])
    return np.asarray(np.round(measured / COUNT) * COUNT)
