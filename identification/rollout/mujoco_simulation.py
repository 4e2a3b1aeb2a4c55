"""Forward simulation of all windows together by MuJoCo."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.errors import IdentificationError
from identification.export.exported_arm import ExportedArm
from identification.export.simulators import load_mujoco, mjcf

MAX_POSITION_ERROR: Final = np.pi
"""Position error [rad or m] from which on a simulation counts as unstable."""


class NotSimulatedError(IdentificationError):
    """MuJoCo does not accept the arm."""


class Feedback(NamedTuple):
    """Joint torque ``stiffness (q_ref - q) + damping (v_ref - v)``, each (n,)."""

    stiffness: Array  # N·m/rad or N/m
    damping: Array  # N·m·s/rad or N·s/m

    def inertia(self, step: float) -> Array:
        """Return what the stiffness adds to the inertia of the joints in a time step (n,)."""
        return np.asarray(0.5 * step**2 * self.stiffness)


@dataclass(frozen=True, eq=False)
class RolloutArm:
    r"""An arm in MuJoCo without limits, contacts and motors; torques act on its joints.

    The stiffness k of the feedback acts on the mean of the positions before and after a step,
    :math:`(q_{i-1} + q_{i+1}) / 2 = q_i + h^2 \ddot q_i / 2`: this is of second order, and no
    gain makes it unstable or lets an oscillation grow. To a step it is an inertia
    :math:`k h^2 / 2`, of which the reference has its share.
    """

    model: Any  #: `mujoco.MjModel`
    order: NDArray[np.intp]  #: MuJoCo's coordinate of each joint (n,)
    rest: Array  #: angle of the springs (n,) [rad or m]
    viscous: Array  #: friction of the joints (n,) [N·m·s/rad or N·s/m]
    step: float  #: s
    feedback: Feedback

    @classmethod
    def of(cls, arm: ExportedArm, step: float, feedback: Feedback) -> RolloutArm:
        """Compile an arm.

        Raises:
            NotSimulatedError: MuJoCo does not accept it.
            MissingMujocoError: MuJoCo is not installed.
        """
        mujoco = load_mujoco()
        try:
            spec = mujoco.MjSpec.from_string(mjcf(arm, "arm", step=step))
            for part in (*spec.actuators, *spec.geoms, *spec.sites):
                spec.delete(part)
            model = spec.compile()
        except ValueError as error:
            message = " ".join(str(error).split())
            raise NotSimulatedError(f"MuJoCo does not accept the arm: {message}") from error
        off = mujoco.mjtDisableBit
        model.opt.disableflags |= (
            off.mjDSBL_LIMIT | off.mjDSBL_CONTACT | off.mjDSBL_ACTUATION | off.mjDSBL_AUTORESET
        )
        # Parts without effect on this arm: a step takes a quarter less time without them.
        model.opt.disableflags |= off.mjDSBL_SENSOR | off.mjDSBL_EQUALITY | off.mjDSBL_ISLAND
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        # Of dry friction alone this is the fastest solver; positions agree within a microradian.
        model.opt.solver = mujoco.mjtSolver.mjSOL_CG
        order = [int(model.joint(name).dofadr[0]) for name in arm.model.joint_names]
        places = np.array(order, dtype=np.intp)
        # A spring and a damper to zero are the part of the feedback that depends on the state.
        viscous = model.dof_damping[places].copy()
        model.jnt_stiffness[places] += feedback.stiffness
        model.dof_damping[places] += feedback.damping
        model.dof_armature[places] += feedback.inertia(step)
        return cls(model, places, model.qpos_spring[places].copy(), viscous, step, feedback)

    def force(self, torque: Array, position: Array, velocity: Array, change: Array) -> Array:
        """Return what acts on the joints in addition to friction and springs of the state (m, n).

        Args:
            torque: measured (m, n).
            position: reference of the feedback before each step (m, n).
            velocity: half a step later (m, n).
            change: of the measured velocity in half a step (m, n).
        """
        # The viscous friction of a step is that of the velocity after it, half a step late.
        force = torque + self.feedback.damping * velocity + self.viscous * change
        earlier = np.concatenate([2.0 * velocity[:1] - velocity[1:2], velocity[:-1]])
        mean = position + 0.5 * self.step * (velocity - earlier)
        return np.asarray(force + self.feedback.stiffness * (mean - self.rest))

    def simulate(self, start: Array, velocity: Array, force: Array, reference: Array) -> Array:
        """Return the positions after each step (w, K, n), not finite where they are unstable.

        Args:
            start: positions (w, n).
            velocity: half a step before (w, n).
            force: on the joints (w, K, n).
            reference: positions (w, K, n) from which unstable ones are far.
        """
        mujoco = load_mujoco()
        from mujoco import rollout  # optional dependency

        n = len(self.order)
        size = mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        state = np.zeros((len(start), size))
        state[:, 1 + self.order] = start
        state[:, 1 + n + self.order] = velocity
        applied = np.empty_like(force)
        applied[:, :, self.order] = force
        data = [mujoco.MjData(self.model) for _ in range(os.cpu_count() or 1)]
        with _without_messages(mujoco), _without_timers():
            states, _ = rollout.rollout(
                self.model,
                data,
                state,
                applied,
                control_spec=mujoco.mjtState.mjSTATE_QFRC_APPLIED,
            )
        return _without_unstable(states[:, :, 1 + self.order], reference)


@contextmanager
def _without_messages(mujoco: Any) -> Iterator[None]:
    """Keep MuJoCo from printing and logging what is counted: unstable simulations."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


@contextmanager
def _without_timers() -> Iterator[None]:
    """Keep MuJoCo from reading the clock in each part of a step, a fifth of its time.

    The wheel installs a clock, which its `set_mjcb_time` replaces and does not remove. In a build
    that does not show it (Windows) it stays.
    """
    try:
        library = ctypes.CDLL(import_module("mujoco._callbacks").__file__)
        clock = ctypes.c_void_p.in_dll(library, "mjcb_time")
    except (ImportError, OSError, ValueError):
        clock = ctypes.c_void_p()
    before = clock.value
    clock.value = None
    try:
        yield
    finally:
        clock.value = before


def _without_unstable(position: Array, reference: Array) -> Array:
    """Return positions that are not finite from the first on that is far from the reference.

    Positions of the joint that becomes unstable first are infinite, all others NaN.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        near = np.abs(position - reference) < MAX_POSITION_ERROR
    for window in np.flatnonzero(~np.all(near, axis=(1, 2))):
        first = int(np.argmin(np.all(near[window], axis=1)))
        joint = int(np.argmin(near[window, first]))
        position[window, first:] = np.nan
        position[window, first:, joint] = np.inf
    return position
