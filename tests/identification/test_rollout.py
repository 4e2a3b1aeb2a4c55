"""Windows of a measured motion, simulated by MuJoCo and compared."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from identification.export.exported_arm import ExportedArm
from identification.export.simulators import FORMATS, compare, mjcf
from identification.model.friction import FrictionLaw
from identification.model.joint_ranges import JointRanges
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.rollout.mujoco_simulation import MAX_POSITION_ERROR, Feedback, RolloutArm
from identification.rollout.polish import Driven, polished
from identification.rollout.position_errors import (
    HORIZONS,
    RecordedMotion,
    coverage,
    errors_of,
    horizon_rows,
    joint_inertia,
    leading_joint,
    light_feedback,
    recorded_stretches,
    simulate,
)
from identification.rollout.servo_by_torque import (
    NoServoError,
    PositionServo,
    identify_servo,
    lead_of,
)
from identification.rollout.windows import (
    NoWindowError,
    mean_about,
    stretches_of,
    windows_of,
)
from identification.validation.prediction import driving_residual
from tests.identification.servo_arm import on_its_servo
from tests.identification.two_link import MODEL, URDF, as_samples, four_sines, simulated

mujoco = pytest.importorskip("mujoco", reason="the extra mujoco is not installed")

N = MODEL.n_joints
NO_LIMITS = JointRanges(*(np.full(N, limit) for limit in (-np.inf, np.inf, np.inf, np.inf)))
NOTHING = Feedback(np.zeros(N), np.zeros(N))


def an_arm(coulomb: float = 0.0) -> ExportedArm:
    standard = MODEL.nominal
    standard[MODEL.layout.rotors] = (0.4, 0.1)
    friction = [{"f0": coulomb, "f1": 2.0}.get(term.symbol, 0.0) for term in MODEL.friction.terms]
    values = np.concatenate([MODEL.base.grouping @ standard, friction])
    return ExportedArm(URDF, MODEL, standard, values, NO_LIMITS)


def a_recording(arm: ExportedArm, step: float, duration: float = 3.0):
    """Torque of an arm along sines, and its windows at a time step [s]."""
    motion = four_sines(np.arange(0.0, duration, 0.001), 0.5)
    samples = simulated(MODEL, arm.values, motion)
    stretches, owners = recorded_stretches(MODEL, [(samples, None)], step)
    return RecordedMotion(windows_of(stretches, step, 1.0, 0.2), tuple(owners))


def final_errors(arm: ExportedArm, motion: RecordedMotion, feedback: Feedback = NOTHING):
    measured = motion.windows.reached[:, horizon_rows(motion.windows)]
    return errors_of(simulate(arm, motion, feedback), measured, arm.model.chain)


def test_errors_of_the_true_arm_are_of_second_order() -> None:
    arm = an_arm()
    coarse, fine = (final_errors(arm, a_recording(arm, step)).joints for step in (0.01, 0.005))
    assert fine[:3].max() < 1e-3  # rad at 0.5 s, of a motion of one
    assert (coarse[2:] / fine[2:]).min() > 3.0


def test_other_masses_leave_the_motion() -> None:
    arm = an_arm()
    motion = a_recording(arm, 0.005)
    heavier = replace(arm, standard=1.3 * arm.standard, values=1.3 * arm.values)
    errors = final_errors(heavier, motion)
    assert (np.diff(errors.joints.max(axis=1)) > 0.0).all()
    assert errors.joints[2].max() > 20.0 * final_errors(arm, motion).joints[2].max()
    controlled = final_errors(heavier, motion, light_feedback(arm, 0.005, 3.0))
    assert controlled.joints[3].max() < errors.joints[3].max()


def test_an_unstable_arm_is_counted_and_silent(capfd) -> None:
    arm = an_arm()
    motion = a_recording(arm, 0.005)
    light = replace(arm, standard=1e-6 * arm.standard, values=1e-6 * arm.values)
    errors = final_errors(light, motion)
    assert errors.unstable == len(motion.windows)
    assert errors.unstable_joints.sum() == len(motion.windows)
    assert np.isfinite(errors.joints).all()
    assert errors.joints[-1].max() == pytest.approx(MAX_POSITION_ERROR)
    assert capfd.readouterr() == ("", "")


def test_the_solver_of_dry_friction_changes_no_position() -> None:
    arm = an_arm(coulomb=3.0)
    motion = a_recording(arm, 0.005)
    windows = motion.windows
    simulated = RolloutArm.of(arm, windows.step, NOTHING)
    force = motion.force(arm, simulated)
    run = partial(simulated.simulate, windows.position[:, 0], windows.start, force)
    positions = run(windows.position)
    simulated.model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    assert positions == pytest.approx(run(windows.position), abs=1e-6)  # rad, of a motion of one


def test_the_clock_of_mujoco_runs_after_a_rollout() -> None:
    """A rollout stops it, as reading it takes a fifth of a step."""
    arm = an_arm()
    final_errors(arm, a_recording(arm, 0.005))
    model = mujoco.MjModel.from_xml_string(mjcf(arm, "arm"))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    assert data.timer[mujoco.mjtTimer.mjTIMER_STEP].duration > 0.0


@pytest.mark.long
def test_a_polish_finds_friction_rotor_and_delay() -> None:
    true = an_arm(coulomb=3.0)
    motion = a_recording(an_arm(coulomb=3.0), 0.005)
    values = true.values.copy()
    values[MODEL.friction_part] *= 1.4
    start = Driven(replace(true, values=values), replace(motion, delay=0.004), NOTHING)
    best = polished(start)
    before, after = (np.sqrt(np.mean(driven.residuals() ** 2)) for driven in (start, best))
    assert after < 0.2 * before
    friction = best.arm.values[MODEL.friction_part] / true.values[MODEL.friction_part]
    assert friction[true.values[MODEL.friction_part] != 0.0] == pytest.approx(1.0, abs=0.15)
    assert best.motion.delay == pytest.approx(0.0, abs=1e-3)


@pytest.mark.long
def test_a_polish_finds_a_heavy_rotor() -> None:
    def with_rotor(inertia: float) -> ExportedArm:
        arm = an_arm()
        standard = arm.standard.copy()
        standard[MODEL.layout.rotors] = (0.4, inertia)
        values = np.concatenate([MODEL.base.grouping @ standard, arm.values[MODEL.friction_part]])
        return replace(arm, standard=standard, values=values)

    heavy = 4.0 * joint_inertia(with_rotor(0.0), 0.005)[1]
    best = polished(Driven(with_rotor(0.0), a_recording(with_rotor(heavy), 0.005), NOTHING))
    assert best.arm.rotors[1, 1] == pytest.approx(heavy, rel=0.15)


def test_friction_that_accelerates_acts_as_measured() -> None:
    """A negative coefficient of the speed squared is no damper of the simulated arm."""
    model = RobotModel.from_urdf(URDF, friction=FrictionLaw(third="quadratic"))
    standard = model.nominal
    standard[model.layout.rotors] = (0.4, 0.1)
    friction = [{"f0": 0.1, "f1": 0.1, "f2": -3.0}.get(t.symbol, 0.0) for t in model.friction.terms]
    values = np.concatenate([model.base.grouping @ standard, friction])
    arm = ExportedArm(URDF, model, standard, values, NO_LIMITS)
    motion = four_sines(np.arange(0.0, 3.0, 0.001), 0.5)
    stretches, owners = recorded_stretches(model, [(simulated(model, values, motion), None)], 0.005)
    recorded = RecordedMotion(windows_of(stretches, 0.005, 1.0, 0.2), tuple(owners))
    errors = final_errors(arm, recorded)
    assert errors.unstable == 0
    assert errors.joints[:3].max() < 5e-3
    text = mjcf(arm, "arm")
    assert 'damping="0.1 0.0 0.0"' in text
    left = compare(text, FORMATS["mjcf"], arm, motion).left_out
    assert [name for name in left if "would accelerate a joint" in name]


def test_the_joint_that_moves_the_tool_leads() -> None:
    tool = """<link name="tool"/><joint name="to_tool" type="fixed"><parent link="lower"/>
      <child link="tool"/><origin xyz="0.3 0 -0.3"/></joint></robot>"""
    arm = replace(an_arm(), urdf=URDF.replace("</robot>", tool))
    arm = replace(arm, model=RobotModel.from_urdf(arm.urdf, friction=FrictionLaw(third=None)))
    measured = np.zeros((4, N))
    off = measured + np.array([0.001, 0.2])
    assert leading_joint(off, measured, arm.model.chain) == 1
    assert leading_joint(off[:, ::-1], measured, arm.model.chain) == 0


def test_a_band_holds_its_share() -> None:
    rng = np.random.default_rng(1)
    shape = (2000, len(HORIZONS), 1)
    ensemble = rng.standard_normal((50, *shape))
    assert coverage(ensemble, rng.standard_normal(shape)) == pytest.approx(0.95, abs=0.02)
    ensemble[:, :, 0] = np.nan  # unstable: no band
    assert coverage(ensemble, np.zeros(shape))[0] == 0.0


def test_dry_friction_at_rest_is_no_torque_that_moves() -> None:
    """Half of it is held either way; beyond it, and where a joint moves, nothing is."""
    arm = an_arm(coulomb=5.0)
    time = np.arange(0.0, 1.0, 0.01)
    motion = four_sines(time)
    velocity = motion.velocity.copy()
    velocity[:, 1] = 0.0
    motion = replace(motion, velocity=velocity)
    predicted = MODEL.torque(arm.values, motion)
    for added, left in ((2.5, 0.0), (-2.5, 0.0), (7.0, 2.0), (-7.0, -2.0)):
        samples = as_samples(MODEL, motion, predicted + added)
        residual = driving_residual(MODEL, samples, arm.values)
        np.testing.assert_allclose(residual[:, 1], left, atol=1e-9)
        moving = MODEL.moving(velocity)[:, 0]
        np.testing.assert_allclose(residual[moving, 0], added, atol=1e-9)


def test_means_over_a_step_of_a_line_are_its_values() -> None:
    time = np.sort(np.random.default_rng(1).uniform(0.0, 1.0, 200))
    line = np.column_stack([2.0 * time, 1.0 - time])
    grid = 0.1 + 0.05 * np.arange(15)
    expected = np.column_stack([2.0 * grid, 1.0 - grid])
    assert mean_about(time, line, grid) == pytest.approx(expected, abs=1e-4)


def test_too_short_a_motion_has_no_window() -> None:
    arm = an_arm()
    with pytest.raises(NoWindowError, match=r"lasts 1 s; the longest lasts 0\.59"):
        a_recording(arm, 0.005, duration=0.6)


class TestServo:
    def stretches(self, kp, kd, delay):
        """A command that the arm follows late, and the torque of a servo, with gravity."""
        motion = four_sines(np.arange(0.0, 6.0, 0.001), 0.5)
        samples = simulated(MODEL, an_arm().values, motion)
        lag = 0.05
        commanded = motion.position + lag * motion.velocity

        def late(values):
            at = motion.time - delay
            return np.column_stack([np.interp(at, motion.time, column) for column in values.T])

        error = late(commanded) - motion.position
        rate = late(np.gradient(commanded, motion.time, axis=0)) - motion.velocity
        torque = kp * error + kd * rate + 30.0
        return stretches_of(
            replace(samples, torque=torque), np.zeros_like(torque), 0.005, commanded
        )

    def test_is_found_from_commanded_and_measured_positions(self) -> None:
        kp = np.array([2000.0, 500.0])
        kd = np.array([40.0, 10.0])
        servo = identify_servo(self.stretches(kp, kd, 0.010), 0.005, ("a", "b"))
        assert servo.delay == pytest.approx(0.010, abs=2e-4)
        assert servo.kp == pytest.approx(kp, rel=0.05)
        assert servo.kd == pytest.approx(kd, rel=0.2)

    def test_a_torque_opposing_the_error_names_its_joint(self) -> None:
        opposed = self.stretches(np.array([2000.0, -500.0]), np.array([40.0, 0.0]), 0.010)
        with pytest.raises(NoServoError, match="the torque of elbow does not grow with"):
            identify_servo(opposed, 0.005, ("shoulder", "elbow"))

    def test_needs_commanded_positions(self) -> None:
        stretches = [replace(stretch, commanded=None) for stretch in self.stretches(1.0, 1.0, 0.0)]
        with pytest.raises(NoServoError, match="no commanded positions"):
            identify_servo(stretches, 0.005, ("a", "b"))


class TestStepOnServo:
    """At 5 ms arms on servos of any stiffness move as at 0.2 ms."""

    def errors(self, arm: ExportedArm, servo: PositionServo, moved, step: float):
        """Errors of an arm on a servo, in windows of a motion on it.

        Only where the offset is not known does the torque count.
        """
        time, position, velocity, command = moved
        motion = Motion(time, position, velocity, np.gradient(velocity, time, axis=0))
        samples = as_samples(MODEL, motion, np.zeros_like(position))
        if servo.offset is None:
            torque = samples.predicted_torque(MODEL, an_arm(coulomb=1.0).values)
            samples = replace(samples, torque=torque)
        stretches, owners = recorded_stretches(MODEL, [(samples, command)], step)
        windows = windows_of(stretches, step, 1.0, 0.2, lead_of(servo))
        motion_on_servo = RecordedMotion(windows, tuple(owners), servo)
        return final_errors(arm, motion_on_servo, Feedback(servo.kp, servo.kd))

    @pytest.mark.parametrize("phase", [0.2, 1.0, 2.5])
    def test_is_small_enough(self, phase: float) -> None:
        """`phase` is that of an oscillation against the servo in a step of 5 ms [rad].

        Above 2 the spring alone would be unstable.
        """
        arm = an_arm(coulomb=1.0)
        inertia = joint_inertia(arm, 0.005)
        rate = phase / 0.005
        servo = PositionServo(rate**2 * inertia, 0.4 * rate * inertia, 0.012)
        moved = on_its_servo(arm, duration=3.5, step=2e-4, servo=servo)
        errors = self.errors(arm, servo, moved, 0.005)
        assert errors.unstable == 0
        assert errors.joints.max() < 1e-4  # rad, of a motion of one

    def test_a_known_offset_and_delays_of_the_joints(self) -> None:
        """A constant torque that holds each window would be that of a torque of zero here."""
        arm = an_arm(coulomb=1.0)
        inertia = joint_inertia(arm, 0.005)
        rate = 0.5 / 0.005
        servo = PositionServo(
            *(rate**2 * inertia, 0.4 * rate * inertia, 0.012),
            offset=np.array([0.02, -0.03]),
            lag=np.array([-0.008, 0.008]),
        )
        time, position, velocity, command = on_its_servo(arm, duration=3.5, step=2e-4, servo=servo)
        moved = time, position, velocity, command - servo.offset
        errors = self.errors(arm, servo, moved, 0.005)
        assert errors.unstable == 0
        assert errors.joints.max() < 1e-4  # rad, of a motion of one
        for changed in (servo._replace(lag=0.0), servo._replace(offset=np.zeros(2))):
            assert self.errors(arm, changed, moved, 0.005).joints[-1].min() > 5e-3

    def test_a_stiff_servo_makes_no_light_arm_unstable(self) -> None:
        """Such as a nominal arm without rotor inertias, on the servo of the real one."""
        arm = an_arm(coulomb=1.0)
        servo = PositionServo(np.array([2e6, 5e5]), np.array([0.0, 0.0]), 0.012)
        moved = on_its_servo(arm, duration=3.5, step=1e-4, servo=servo)
        light = replace(arm, standard=1e-3 * arm.standard, values=1e-3 * arm.values)
        errors = self.errors(light, servo, moved, 0.005)
        assert errors.unstable == 0
        assert errors.joints.max() < 1e-3


def test_windows_start_where_the_delayed_command_is_known() -> None:
    motion = four_sines(np.arange(0.0, 3.0, 0.001), 0.5)
    command = motion.position.copy()
    command[:500] = np.nan
    command[2600:2610] = np.nan
    parts, _ = recorded_stretches(MODEL, [(simulated(MODEL, an_arm().values, motion), command)],
                                  0.005)  # fmt: skip
    assert [part.part for part in parts] == [slice(500, 2600), slice(2610, 3000)]
    assert all(np.isfinite(part.commanded).all() for part in parts)
    windows = windows_of(parts, 0.005, 1.0, 0.2, lead=0.04)
    assert windows.first[0] == 8
