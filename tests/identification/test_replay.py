"""Recorded torques through a model forwards in time."""

from __future__ import annotations

from dataclasses import replace as changed

import numpy as np
import pytest
from numpy.typing import NDArray

from identification import FrictionLaw, Motion, RobotModel
from identification.export.simulators import Arm, Ranges, load_mujoco, mjcf
from identification.model.coupling import Coupling
from identification.model.elements import TorsionSpring
from identification.signals.samples import Samples
from identification.validation.replay import FEEDBACK, Simulated, replay, slow_residual
from sim_fixtures.ns16 import urdf_text
from tests.identification.robots import some_bodies
from tests.identification.two_link import as_samples, sine_motion

Array = NDArray[np.float64]

WRIST = np.eye(6)
WRIST[5, 4] = 0.5


def an_arm(**options: object) -> Simulated:
    model = RobotModel.from_urdf(urdf_text(), **options)  # type: ignore[arg-type]
    standard = np.zeros(model.layout.size)
    standard[:66] = some_bodies(6)
    standard[model.layout.rotors] += 1.0
    others = np.random.default_rng(1).uniform(1.0, 3.0, model.n_parameters - model.base.rank)
    values = np.concatenate([model.base.grouping @ standard, others])
    return Simulated(model, standard[None], values[None])


def samples_of(arm: Simulated, step: float = 2e-3) -> Samples:
    """A motion of three seconds of sines, with the torque that it takes."""
    time = np.arange(0.0, 3.0, step)
    rng = np.random.default_rng(2)
    size, rate, phase = (rng.uniform(low, high, 6) for low, high in ((0.2, 0.5), (2, 4), (0, 6)))
    motion = sine_motion(time, size, rate, phase)
    return samples(arm.model, motion, arm.model.torque(arm.values[0], *motion[1:]))


def samples(model: RobotModel, motion: Motion, torque: Array) -> Samples:
    return as_samples(model, motion, torque, usable=np.ones(torque.shape, dtype=np.bool_))


OPTIONS = {
    "all friction": {"friction": FrictionLaw(asymmetric=True, stribeck=0.2, third="cubic")},
    "smooth sign": {"friction": FrictionLaw(tanh=0.05)},
    "coupled wrist": {"coupling": Coupling(WRIST)},
    "spring": {"elements": [TorsionSpring("joint_2", 0.3, identified=True)]},
}


class TestReplay:
    """The model that made the torques makes the motion; another one does not."""

    @pytest.mark.parametrize("name", OPTIONS)
    def test_the_true_arm_makes_the_motion(self, name: str) -> None:
        arm = an_arm(**OPTIONS[name])
        error = replay(arm, samples_of(arm))
        assert np.abs(error).max() < 2e-3  # rad, of a motion of about 0.7

    @pytest.mark.parametrize("name", OPTIONS)
    def test_arms_side_by_side_move_as_each_by_itself(self, name: str) -> None:
        arm = an_arm(**OPTIONS[name])
        given = samples_of(arm)
        short = samples(arm.model, given.motion.rows(slice(0, 300)), given.torque[:300])
        both = together(arm, changed_weight(arm, 1.2))
        back = together(changed_weight(arm, 1.2), arm)
        found, alone, heavy = (replay(one, short) for one in (both, arm, back))
        np.testing.assert_allclose(found[0], alone[0], atol=1e-12)
        assert not np.allclose(found[1], heavy[0], atol=1e-6)  # another inertia's feedback

    def test_an_arm_of_another_weight_goes_astray(self) -> None:
        arm = an_arm()
        good, bad = replay(together(arm, changed_weight(arm, 1.2)), samples_of(arm))
        assert np.all(np.sqrt(np.mean(bad**2, axis=0)) > 3.0 * np.sqrt(np.mean(good**2, axis=0)))

    def test_dry_friction_holds_an_arm_at_rest(self) -> None:
        """Gravity alone would let every joint fall."""
        arm = an_arm(friction=FrictionLaw(viscous=False, third=None))
        values = arm.values.copy()
        values[:, arm.model.friction_part] = 1e4
        time, still = np.arange(0.0, 0.2, 2e-3), np.full((100, 6), 0.5)
        motion = Motion(time, still, 0.0 * still, 0.0 * still)
        error = replay(arm._replace(values=values), samples(arm.model, motion, 0.0 * still))
        assert np.abs(error).max() < 1e-9

    def test_a_gap_begins_anew(self) -> None:
        arm = an_arm()
        given = samples_of(arm)
        parts = changed(given, segments=(slice(0, 600), slice(800, 1500)))
        error = replay(arm, parts)
        assert np.isnan(error[:, 600:800]).all()
        assert not error[:, [0, 800]].any()

    def test_mujoco_makes_the_same_motion(self) -> None:
        """From the same description, with the same feedback, half as heavy as the truth."""
        pytest.importorskip("mujoco", reason="the extra mujoco is not installed")
        truth = an_arm(coupling=Coupling(WRIST))
        given, arm = samples_of(truth, 1e-3), changed_weight(truth, 0.5)
        found = given.motion.position + replay(arm, given)[0]
        np.testing.assert_allclose(found, by_mujoco(arm, given), atol=5e-3)


def changed_weight(arm: Simulated, factor: float) -> Simulated:
    values = arm.values.copy()
    values[:, : arm.model.base.rank] *= factor
    return arm._replace(standard=factor * arm.standard, values=values)


def together(*arms: Simulated) -> Simulated:
    standard, values = (np.concatenate([one[k] for one in arms]) for k in (1, 2))
    return Simulated(arms[0].model, standard, values)


def by_mujoco(arm: Simulated, given: Samples) -> Array:
    mujoco = load_mujoco()
    infinite = np.full(6, np.inf)
    ranges = Ranges(-infinite, infinite, infinite, infinite)
    text = mjcf(Arm(urdf_text(), arm.model, arm.standard[0], arm.values[0], ranges), "arm")
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.timestep = 1e-3
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = given.motion.position[0], given.motion.velocity[0]
    mujoco.mj_forward(model, data)
    full = np.zeros((6, 6))
    for row, unit in zip(full, np.eye(6), strict=True):
        mujoco.mj_mulM(model, data, row, unit)
    rate = 2.0 * np.pi * FEEDBACK
    positions = []
    for q, v, torque in zip(*given.motion[1:3], given.torque, strict=True):
        positions.append(data.qpos.copy())
        wanted = rate**2 * (q - data.qpos) + 2.0 * rate * (v - data.qvel)
        data.ctrl[:] = torque + np.diag(full) * wanted
        mujoco.mj_step(model, data)
    return np.array(positions)


class TestSlowResidual:
    """What makes a replay drift is told apart by how it depends on the motion."""

    @pytest.mark.parametrize("joint", [0, 3])
    def test_an_offset_and_friction_are_told_apart(self, joint: int) -> None:
        arm = an_arm()
        right = samples_of(arm)
        velocity = right.motion.velocity[:, joint]
        for torque, shares in ((5.0, (1.0, 0.0)), (5.0 * np.sign(velocity), (0.0, 1.0))):
            wrong = right.torque.copy()
            wrong[:, joint] += torque
            found = slow_residual(arm, [changed(right, torque=wrong)])
            explained = found.constant[joint], found.friction[joint]
            others = np.delete(found.rms, joint)
            assert np.argmax(explained) == np.argmax(shares)
            assert explained[0] + explained[1] > 0.9
            assert others.max() < 1e-6 * found.rms[joint]
