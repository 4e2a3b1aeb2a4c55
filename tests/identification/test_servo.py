"""Servos identified from positions alone: simulation against other integrators, planted arms."""

from dataclasses import replace

import numpy as np
import pytest
import scipy

from benchmarks import servo_arm as arm
from identification import RobotModel
from identification.servo.choice import fit_servos
from identification.servo.contacts import contacts_of
from identification.servo.fit import ServoWindows
from identification.servo.intervals import intervals_of, sampled, widened_covariance
from identification.servo.parameters import ABSENT, NAMES, PLACE, TERMS, in_errors, in_units
from identification.servo.prediction import predicted
from identification.servo.pushes import pushes_of
from identification.servo.recorded_motion import Grid, motions_of
from identification.servo.servo_fit import Touch
from identification.servo.servo_simulation import JointInputs, simulate
from identification.servo.start import moving_joints, prior_of, with_moving_joints
from identification.servo.touches import windows_without
from identification.signals.recording import Recording

STEP = 5e-3


def alone(command, *, start=0.0, bias=0.0, step=STEP):
    """Return the inputs of one joint without bodies but a constant torque."""
    count = len(command)
    column = np.zeros((count, 1))
    lead = 20
    before = np.full((lead, 1), command[0])
    return JointInputs(
        step, np.concatenate([before, command[:, None]]), lead, column + bias, column, column,
        column, np.array([start]), np.zeros(1),
    )  # fmt: skip


def values(**given):
    """Return parameters of one joint in position errors (1, 1, P), by their values in SI units."""
    row = np.array([ABSENT.get(term.name, 0.0) for term in TERMS])
    for name, value in given.items():
        row[PLACE[name]] = value
    return in_errors(row)[None, None]


def test_units_and_position_errors_are_inverse():
    row = np.exp(np.random.default_rng(1).standard_normal((3, len(TERMS))))
    np.testing.assert_allclose(in_units(in_errors(row)), row)


def test_a_smooth_servo_follows_its_differential_equation():
    time = STEP * np.arange(600)
    command = 0.3 * np.sin(2.0 * np.pi * 0.9 * time)
    kp, kd, armature, viscous = 15.0, 0.3, 0.03, 0.4

    def slope(t, state):
        wanted = np.interp(t, time, command)
        rate = np.interp(t, time, np.gradient(command, STEP))
        torque = kp * (wanted - state[0]) + kd * (rate - state[1]) - viscous * state[1] - 0.2
        return state[1], torque / armature

    exact = scipy.integrate.solve_ivp(
        slope, (0.0, time[-1]), (0.0, 0.0), t_eval=time, rtol=1e-9, atol=1e-9, max_step=STEP
    ).y[0]
    given = values(kp=kp, kd=kd, armature=armature, viscous=viscous)
    simulated = simulate(alone(command, bias=0.2), given)[:, 0, 0]
    assert np.abs(simulated - exact)[20:].max() < 1e-3


@pytest.mark.parametrize("kp", [1.0, 1e2, 1e5])
def test_no_gain_is_unstable(kp):
    command = np.where(np.arange(400) < 20, 0.0, 0.5)
    simulated = simulate(alone(command), values(kp=kp, armature=1e-4, viscous=0.1))
    assert np.abs(simulated).max() < 1.1


def test_a_joint_rests_where_friction_holds_it():
    """It does not creep, and moves on once the error of the servo exceeds its friction."""
    command = np.minimum(np.arange(1000) * 2e-5, 0.0195)
    given = values(kp=10.0, armature=0.01, viscous=0.3, coulomb=0.1, static=0.1, speed=0.1)
    simulated = simulate(alone(command), given)[:, 0, 0]
    assert (simulated == 0.0).all()
    simulated = simulate(alone(command + 0.001), given)[:, 0, 0]
    assert simulated[-1] > 0.0


@pytest.mark.parametrize("step", [1e-2, 2.5e-3])
def test_a_set_point_is_behind_by_the_square_of_its_speed(step):
    """Braked by a limited acceleration it would stand at the command: v² / 2a behind a ramp.

    The servo that follows it is behind by its damping over its stiffness.
    """
    command = np.arange(0.0, 1.0, step)
    stiff = values(kp=100.0, armature=1e-3, viscous=0.6, acceleration=40.0)
    simulated = simulate(alone(command, step=step), stiff)[:, 0, 0]
    assert (command - simulated)[len(command) // 2 :] == pytest.approx(
        1.0 / 80.0 + 0.6 / 100.0, rel=0.01
    )


def test_a_set_point_reaches_a_step_by_half_and_half():
    """Accelerated and braked alike, at 2 sqrt(distance / acceleration), without overshoot."""
    step = 2.5e-3
    command = np.where(np.arange(400) < 20, 0.0, 0.4)
    stiff = values(kp=100.0, armature=1e-3, viscous=0.6, acceleration=10.0)
    simulated = simulate(alone(command, step=step), stiff)[:, 0, 0]
    reached = step * (np.argmax(simulated > 0.399) - 20)
    assert reached == pytest.approx(2.0 * np.sqrt(0.4 / 10.0), abs=0.02)
    assert simulated.max() < 0.401
    assert np.abs(np.diff(simulated, 2)).max() / step**2 < 1.2 * 10.0


def test_a_set_point_without_limit_is_the_command():
    command = 0.2 * np.sin(np.arange(400) * 0.05)
    given = {"kp": 15.0, "kd": 0.3, "armature": 0.03, "viscous": 0.4}
    free, fast = (values(**given, acceleration=a) for a in (np.inf, 1e6))
    # v² / 2a is 2e-6 rad
    np.testing.assert_allclose(
        simulate(alone(command), fast), simulate(alone(command), free), atol=3e-6
    )


def test_friction_grows_with_the_load():
    command = np.zeros(200)
    light = values(kp=10.0, armature=0.01, viscous=0.3, load=0.5)
    held = values(kp=10.0, armature=0.01, viscous=0.3, load=1.1)
    sags, stands = (simulate(alone(command, bias=1.0), each)[-1, 0, 0] for each in (light, held))
    assert -0.15 < sags < -0.05
    assert stands == 0.0


def fitted_arm(truth, rng, duration):
    """Return the fit of a simulated arm, and another motion of it with its prediction."""
    model, bodies = model_of_arm()
    recordings = []
    for seconds in (duration, 15.0):
        time, command = arm.commands(rng, seconds)
        position = arm.simulated(truth, time, command)
        recordings.append(
            Recording(
                time=time, position=position, joint_names=arm.NAMES, commanded_position=command
            )
        )
    fitted, other = recordings
    grid = Grid.of(fitted)
    fit = fit_servos(
        lambda on: motions_of(fitted, model, bodies, on),
        grid,
        np.full(3, arm.COUNT / np.sqrt(12.0)),
    )
    (unseen,) = motions_of(other, model, bodies, grid)
    (simulated,) = predicted(model, bodies, unseen, [intervals_of(fit).values])
    return fit, unseen, simulated


def model_of_arm():
    model = RobotModel.from_urdf(arm.urdf())
    standard = model.nominal.copy()
    if model.layout.rotor_inertia:
        standard[model.layout.rotors] = 0.0
    bodies = np.zeros(model.n_parameters)
    bodies[: model.base.rank] = model.base.grouping @ standard
    return model, bodies


@pytest.fixture(scope="module")
def planted():
    """Truth, fit and prediction of a simulated arm."""
    rng = np.random.default_rng(11)
    truth = arm.Planted.drawn(rng)
    fit, unseen, simulated = fitted_arm(truth, rng, 40.0)
    intervals = intervals_of(fit)
    return truth, fit, intervals, unseen, simulated


@pytest.mark.long
def test_a_planted_arm_is_predicted_within_encoder_steps(planted):
    *_, motion, simulated = planted
    error = np.sqrt(np.mean((simulated - motion.position) ** 2))
    command = np.sqrt(np.mean((motion.command - motion.position) ** 2))
    assert command > 0.02
    assert error < 2.0 * arm.COUNT


@pytest.mark.long
def test_planted_parameters_are_found(planted):
    truth, _, intervals, *_ = planted
    for name, most in (("kp", 0.1), ("armature", 0.2), ("viscous", 0.2), ("static", 0.4)):
        relative = np.abs(intervals.values[:, PLACE[name]] / getattr(truth, name) - 1.0)
        assert (relative < most).all(), name
    assert intervals.determined[:, PLACE["kp"]].all()


@pytest.mark.long
def test_a_limit_that_no_motion_reaches_is_not_determined(planted):
    truth, _, intervals, *_ = planted
    limit = PLACE["limit"]
    assert not intervals.determined[:, limit].any()
    assert (intervals.upper[:, limit] >= truth.limit).all()


@pytest.mark.long
def test_what_unseen_motion_does_not_show_is_not_determined(planted):
    """Nor what such a term may stand for: Coulomb friction and a dead band look alike."""
    _, fit, intervals, *_ = planted
    dead, coulomb = PLACE["dead_band"], PLACE["coulomb"]
    assert intervals.determined[1, [dead, coulomb]].all()
    shown = fit.shown.copy()
    shown[1, dead] = False
    doubted = intervals_of(replace(fit, shown=shown))
    assert not doubted.determined[1, dead]
    assert doubted.lower[1, dead] == 0.0
    for k in range(len(NAMES)):
        assert doubted.upper[1, k] >= intervals.upper[1, k] * (1.0 - 1e-9)
    width, before = (
        np.log(each.upper[1, coulomb] / each.lower[1, coulomb]) for each in (doubted, intervals)
    )
    assert width > before
    assert (doubted.determined[[0, 2]] == intervals.determined[[0, 2]]).all()


@pytest.mark.long
def test_the_acceleration_of_set_points_is_found():
    rng = np.random.default_rng(4)
    truth = replace(arm.Planted.drawn(rng), acceleration=5.0)
    fit, unseen, simulated = fitted_arm(truth, rng, 30.0)
    intervals = intervals_of(fit)
    place = PLACE["acceleration"]
    assert intervals.values[:, place] == pytest.approx(5.0, rel=0.1)
    assert intervals.determined[:, place].all()
    assert np.sqrt(np.mean((simulated - unseen.position) ** 2)) < 2.0 * arm.COUNT


@pytest.mark.long
def test_draws_scatter_as_the_intervals_say(planted):
    _, fit, intervals, *_ = planted
    estimate = fit.estimate
    covariance = widened_covariance(fit)
    draws = sampled(estimate.coordinates, estimate.present, covariance, fit.windows - 1, 4000, 1)
    assert len(NAMES) == draws.shape[2]
    for name in ("kp", "armature", "viscous", "coulomb"):
        place = PLACE[name]
        lower, upper = np.quantile(draws[:, :, place], [0.025, 0.975], axis=0)
        # ends of logarithms, from quantiles of 4000 draws
        np.testing.assert_allclose(
            np.log(upper / lower),
            np.log(intervals.upper[:, place] / intervals.lower[:, place]),
            rtol=0.1,
        )


@pytest.mark.long
def test_intervals_are_as_wide_as_the_scatter_of_windows(planted):
    """In every direction of the parameters of a joint that are known better than before."""
    _, fit, *_ = planted
    estimate = fit.estimate
    covariance = widened_covariance(fit)
    count = len(NAMES)
    for joint in range(3):
        own = slice(joint * count, (joint + 1) * count)
        for least in (*estimate.between[:, joint], estimate.covariance[own, own]):
            present = np.outer(estimate.present[joint], estimate.present[joint])
            scale = np.sqrt(np.diag(covariance[own, own]))
            learnt = scale < (1.0 - 1e-9) * estimate.prior.spread[joint]
            present &= np.outer(learnt, learnt)
            excess = np.where(present, covariance[own, own] - least, 0.0)
            assert np.linalg.eigvalsh(excess / np.outer(scale, scale)).min() > -1e-6


@pytest.mark.long
def test_what_differs_between_motions_widens_its_interval():
    """Such as a zero of the encoder: windows of one motion all show the same."""
    rng = np.random.default_rng(4)
    truth = arm.Planted.drawn(rng)
    model, bodies = model_of_arm()
    difference = 0.008
    recordings = []
    for zero in (0.0, difference):
        time, command = arm.commands(rng, 24.0)
        position = arm.simulated(truth, time, command) + zero
        recordings.append(
            Recording(
                time=time, position=position, joint_names=arm.NAMES, commanded_position=command
            )
        )
    fit = fit_servos(
        lambda on: [part for each in recordings for part in motions_of(each, model, bodies, on)],
        Grid.of(recordings[0]),
        np.full(3, arm.COUNT / np.sqrt(12.0)),
    )
    intervals = intervals_of(fit)
    place = PLACE["offset"]
    assert (intervals.upper[:, place] - intervals.lower[:, place] > difference).all()


@pytest.mark.long
def test_intervals_hold_the_planted_values(planted):
    truth, _, intervals, *_ = planted
    names = [name for name in NAMES if hasattr(truth, name)]
    places = [PLACE[name] for name in names]
    true = np.stack([np.broadcast_to(getattr(truth, name), 3) for name in names], axis=1)
    lower, upper, value, known = (
        part[:, places]
        for part in (intervals.lower, intervals.upper, intervals.values, intervals.determined)
    )
    held = (lower <= true) & (true <= upper)
    assert held[known].mean() >= 0.85
    ratio = np.maximum(value, 1e-9)[known] / true[known]
    assert ((ratio > 0.5) & (ratio < 2.0)).all()


def test_a_joint_that_moves_while_its_command_rests_was_pushed():
    """Not one that follows late, nor one that the model moves as well."""
    step = 0.01
    time = step * np.arange(1000)
    command = np.zeros((1000, 3))
    command[:, 2] = np.clip(time - 2.0, 0.0, 0.3)
    measured = np.zeros((1000, 3))
    measured[:, 0] = -0.06 * np.clip(2.0 * (time - 6.0), 0.0, 1.0)
    measured[:, 1] = 0.05 * np.clip(time - 3.0, 0.0, 1.0)
    measured[:, 2] = np.clip(time - 2.1, 0.0, 0.3)
    simulated = measured.copy()
    simulated[:, 0] = 0.0
    (push,) = pushes_of(step, command, measured, simulated)
    assert push.joint == 0
    assert push.change == pytest.approx(-0.06, rel=0.01)
    assert push.time == pytest.approx(6.0, abs=0.6)
    assert push.end == pytest.approx(step * len(time), abs=step)  # no command moves again


def test_an_arm_may_be_held_until_its_commands_move_again():
    step = 0.01
    time = step * np.arange(1000)
    command = np.zeros((1000, 2))
    command[:, 0] = np.clip(time - 2.0, 0.0, 0.5)  # drives the arm into something
    command[:, 1] = np.clip(time - 8.0, 0.0, 0.5)
    measured = command.copy()
    measured[:, 1] -= 0.05 * np.clip(time - 2.2, 0.0, 1.0) * (time < 8.0)
    simulated = command.copy()
    (push,) = pushes_of(step, command, measured, simulated)
    assert push.joint == 1
    assert push.time == pytest.approx(2.2, abs=0.3)
    assert push.end == pytest.approx(8.0, abs=0.05)


def test_noise_pushes_nothing():
    """Of 2 mrad at 50 samples a second, of which single samples differ by 15 mrad."""
    rng = np.random.default_rng(2)
    command = np.zeros((6000, 6))
    measured = 2e-3 * rng.standard_normal(command.shape)
    assert np.ptp(measured) > 0.015
    assert pushes_of(0.02, command, measured, command) == []


def poses_of(truth, rng, floor=-np.inf):
    """Ten poses of an arm, with a floor under its end, as a motion."""
    model, bodies = model_of_arm()
    time, command = arm.poses(rng, 40.0)
    position = arm.simulated(truth, time, command, floor)
    recording = Recording(
        time=time, position=position, joint_names=arm.NAMES, commanded_position=command
    )
    (motion,) = motions_of(recording, model, bodies, Grid.of(recording))
    return motion


@pytest.mark.long
def test_a_floor_is_found_where_the_arm_stands_on_it(planted):
    truth, fit, *_ = planted
    resolution = np.full(3, arm.COUNT / np.sqrt(12.0))
    free = poses_of(truth, np.random.default_rng(3))
    assert contacts_of(free, fit, resolution) == []
    floor = np.quantile(arm.tip_heights(free.position), 0.3)
    touching = poses_of(truth, np.random.default_rng(3), floor)
    on = arm.tip_heights(touching.position) < floor + 1e-3
    contacts = contacts_of(touching, fit, resolution)
    assert contacts
    assert {arm.NAMES[contact.joint] for contact in contacts} <= {"lift", "elbow"}
    instants = touching.step * np.arange(len(on))
    for contact in contacts:
        assert contact.end - contact.start >= 1.0
        inside = (instants > contact.start + 0.1) & (instants < contact.end - 0.1)
        assert on[inside].mean() > 0.95
        assert contact.torque < 0.0  # the floor lifts the arm, against both axes


def test_windows_around_a_stretch_are_left_out():
    """Of its motion alone."""
    model, bodies = model_of_arm()
    parts = []
    for seconds in (30.0, 20.0):
        time, command = arm.commands(np.random.default_rng(1), seconds)
        recording = Recording(
            time=time, position=command, joint_names=arm.NAMES, commanded_position=command
        )
        parts += motions_of(recording, model, bodies, Grid.of(recording))
    windows = ServoWindows.of(parts)
    left = windows_without(windows, [Touch(1, 9.0, 10.5)])
    removed = {*zip(windows.motion, windows.start, strict=True)} - {
        *zip(left.motion, left.start, strict=True)
    }
    assert {motion for motion, _ in removed} == {1}
    assert {round(start) for _, start in removed} == {8}  # of 4 s each; 1 s before and after
    assert left.measured.shape[1] == left.count == windows.count - len(removed)


@pytest.mark.long
def test_what_stood_on_a_floor_is_not_fitted(planted):
    truth, *_, unseen, _ = planted
    model, bodies = model_of_arm()
    resolution = np.full(3, arm.COUNT / np.sqrt(12.0))
    floor = np.quantile(arm.tip_heights(poses_of(truth, np.random.default_rng(3)).position), 0.2)
    recordings = []
    for height in (-np.inf, floor):
        rng = np.random.default_rng(3)
        time, command = arm.commands(rng, 30.0) if np.isinf(height) else arm.poses(rng, 40.0)
        position = arm.simulated(truth, time, command, height)
        recordings.append(
            Recording(
                time=time, position=position, joint_names=arm.NAMES, commanded_position=command
            )
        )
    grid = Grid.of(recordings[0])

    def both(on):
        return [part for each in recordings for part in motions_of(each, model, bodies, on)]

    fit = fit_servos(both, grid, resolution)
    assert fit.left_out
    assert {touch.motion for touch in fit.left_out} == {1}
    on = arm.tip_heights(recordings[1].position) < floor + 1e-3
    for touch in fit.left_out:
        assert on[(recordings[1].time > touch.start) & (recordings[1].time < touch.end)].any()
    assert fit.windows < ServoWindows.of(both(grid)).count
    (simulated,) = predicted(model, bodies, unseen, [intervals_of(fit).values])
    assert np.sqrt(np.mean((simulated - unseen.position) ** 2)) < 2.0 * arm.COUNT


@pytest.mark.long
def test_a_joint_that_stood_moves_like_the_others():
    """It moves about as far as it is commanded, and nothing of it is called determined."""
    model, bodies = model_of_arm()
    rng = np.random.default_rng(7)
    truth = arm.Planted.drawn(rng)
    grids, parts = [], []
    for stands in (True, False):
        time, command = arm.commands(rng, 15.0)
        if stands:
            command[:, 2] = command[0, 2]
        position = arm.simulated(truth, time, command)
        recording = Recording(
            time=time, position=position, joint_names=arm.NAMES, commanded_position=command
        )
        grids.append(Grid.of(recording))
        parts.append(recording)
    fit = fit_servos(
        lambda on: motions_of(parts[0], model, bodies, on),
        grids[0],
        np.full(3, arm.COUNT / np.sqrt(12.0)),
    )
    (unseen,) = motions_of(parts[1], model, bodies, grids[0])
    intervals = intervals_of(fit)
    (simulated,) = predicted(model, bodies, unseen, [intervals.values])
    error, late = (
        np.sqrt(np.mean((each - unseen.position) ** 2, axis=0))
        for each in (simulated, unseen.command)
    )
    assert error[2] < late[2]
    assert not intervals.determined[2, [PLACE[name] for name in ("kp", "armature", "limit")]].any()


def test_limits_are_sought_beyond_the_fitted_motion():
    """A slow motion says nothing of the largest torque and acceleration."""
    model, bodies = model_of_arm()
    time = np.arange(0.0, 6.0, 0.02)
    command = np.column_stack([0.1 * np.sin(time), 0.1 * np.cos(time), np.zeros_like(time)])
    recording = Recording(
        time=time, position=0.9 * command, joint_names=arm.NAMES, commanded_position=command
    )
    motions = motions_of(recording, model, bodies, Grid.of(recording))
    prior = prior_of(motions, np.full(3, 1e-4))
    natural = np.exp(prior.mean)
    assert (natural[:, PLACE["acceleration"]] > 10.0).all()
    assert (natural[:, PLACE["limit"]] > 2.0 * np.abs(0.1 * command).max()).all()
    assert np.ptp(natural[:, PLACE["kp"]]) == pytest.approx(0.0)
    stood = with_moving_joints(prior, prior.mean + 1.0, moving_joints(motions)).mean
    np.testing.assert_array_equal(stood[:2], prior.mean[:2])
    assert stood[2, PLACE["kp"]] == pytest.approx(prior.mean[0, PLACE["kp"]] + 1.0)
    assert stood[2, PLACE["offset"]] == prior.mean[2, PLACE["offset"]]
