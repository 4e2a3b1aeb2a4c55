"""The study of coverage: its arms, motions and logs are what it says, and so are its figures."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg

from benchmarks import coverage, cramer_rao, plain_fit
from benchmarks.arms import urdf
from benchmarks.coverage import (
    ARM_TYPES,
    DEFAULTS,
    Conditions,
    Run,
    drawn_arm,
    drawn_body,
    drawn_motion,
    logged,
)
from hil.importers.imported_robot import IMPORTED_LAW
from identification.model.motion import Motion
from identification.model.robot import RobotModel

pytestmark = pytest.mark.long

SPEED = DEFAULTS.speed
ARMS = [pytest.param(name, id=name) for name in ARM_TYPES]


class TestArm:
    @pytest.mark.parametrize("name", ARMS)
    @pytest.mark.parametrize("quadratic", [False, True])
    def test_its_true_values_make_its_torque(self, name: str, quadratic: bool) -> None:
        """By the project's model: names, grouping and order of parameters are understood."""
        kind = ARM_TYPES[name]
        arm = drawn_arm(kind, 1, DEFAULTS._replace(quadratic=quadratic))
        law = coverage.QUADRATIC_LAW if quadratic else IMPORTED_LAW
        text = urdf(kind.urdf).read_text(encoding="utf-8")
        model = RobotModel.from_urdf(text, locked=kind.locked, friction=law)
        truth = coverage.true_values(arm, model)
        assert list(truth) == list(model.parameter_names)
        motion = drawn_motion(arm.robot, np.random.default_rng(2), 10.0, SPEED)
        states = motion.at(np.arange(1.0, 9.0, 0.05))
        fast = np.abs(states[1]).min(axis=1) > 0.01  # dry friction is that of the law there
        states = tuple(values[fast] for values in states)
        torque = arm.torque(*states)
        modelled = model.torque(np.array(list(truth.values())), Motion.of_states(*states))
        assert plain_fit.relative_error(torque, modelled) < 1e-9

    def test_bodies_are_consistent_and_ten_to_twenty_percent_off(self) -> None:
        body = plain_fit.robot_from_urdf(urdf(ARM_TYPES["ns16"].urdf).read_text()).inertias[3]
        drawn = [drawn_body(body, np.random.default_rng(seed)) for seed in range(300)]
        assert min(np.linalg.eigvalsh(d.toPseudoInertia().toMatrix()).min() for d in drawn) > 0.0
        scatter = np.std([np.log(d.mass / body.mass) for d in drawn])
        assert 0.1 < scatter < 0.2
        traces = [np.log(np.trace(d.inertia) / np.trace(body.inertia)) for d in drawn]
        assert 0.1 < np.std(traces) < 0.2

    def test_stribeck_friction_is_a_share_at_low_speed(self) -> None:
        usual, rising = (
            drawn_arm(ARM_TYPES["panda"], 1, DEFAULTS._replace(stribeck=share)).friction
            for share in (0.0, 0.3)
        )
        slow, fast = (np.full((1, 7), speed) for speed in (0.01, 1.0))
        still = np.zeros((1, 7))
        more = rising.torque(slow, still, 1.0) - usual.torque(slow, still, 1.0)
        np.testing.assert_allclose(more[0], 0.3 * usual.coulomb, rtol=0.02)
        np.testing.assert_allclose(rising.torque(fast, still, 1.0), usual.torque(fast, still, 1.0))

    def test_friction_that_drifts_leaves_offsets(self) -> None:
        friction = drawn_arm(ARM_TYPES["panda"], 1).friction
        moving, still = np.ones((2, 7)), np.zeros((2, 7))
        torque = friction.torque(moving, still, np.array([1.0, 0.9])) - friction.offset
        np.testing.assert_allclose(torque[1], 0.9 * torque[0])

    def test_a_seed_is_one_arm(self) -> None:
        first, same, other = (drawn_arm(ARM_TYPES["panda"], seed) for seed in (1, 1, 2))
        masses = [[body.mass for body in arm.robot.inertias] for arm in (first, same, other)]
        assert masses[0] == masses[1] != masses[2]
        assert np.array_equal(first.friction.offset, same.friction.offset)


class TestBound:
    @pytest.mark.parametrize("keep", [0.0, 0.8])
    def test_innovations_have_the_information_of_the_noise(self, keep: float) -> None:
        rows = np.random.default_rng(4).standard_normal((2, 60, 3))
        noise = np.array([0.5, 2.0])
        inverse = np.linalg.inv(scipy.linalg.toeplitz(cramer_rao.correlation(60, keep)))
        information = sum(
            joint.T @ inverse @ joint / std**2 for joint, std in zip(rows, noise, strict=True)
        )
        expected = np.sqrt(np.diag(np.linalg.inv(information)))
        np.testing.assert_allclose(cramer_rao.bound(rows, noise, keep), expected)

    def test_least_squares_is_efficient_where_noise_is_white(self) -> None:
        rows = np.random.default_rng(5).standard_normal((2, 60, 3)).cumsum(axis=1)
        least, usual = (
            [figures(rows, np.ones(2), keep) for keep in (0.0, 0.9)]
            for figures in (cramer_rao.bound, cramer_rao.least_squares_deviations)
        )
        np.testing.assert_allclose(usual[0], least[0])
        assert np.all(usual[1] > least[1])

    @pytest.mark.parametrize("name", ARMS)
    def test_its_rows_make_the_torque_of_the_arm(self, name: str) -> None:
        arm = drawn_arm(ARM_TYPES[name], 1, DEFAULTS._replace(load=0.05))
        text = urdf(ARM_TYPES[name].urdf).read_text(encoding="utf-8")
        model = RobotModel.from_urdf(text, locked=ARM_TYPES[name].locked, friction=IMPORTED_LAW)
        truth = coverage.truth_of(arm, model, 1, 0.0, DEFAULTS._replace(rate=20.0))
        motion = drawn_motion(
            arm.robot, np.random.default_rng([1, 2, 0]), coverage.FITTED_TIME, SPEED
        )
        torque = arm.torque(*motion.at(np.arange(truth.rows.shape[1]) / 20.0))
        modelled = np.einsum("jmp,p->mj", truth.rows, np.array([*truth.values.values()]))
        np.testing.assert_allclose(modelled, torque, atol=1e-9 * np.abs(torque).max())
        exact = truth._replace(scale=np.ones(model.n_joints))
        assert exact.in_scale(truth.noise) == truth.values
        twice = truth._replace(scale=np.full(model.n_joints, 2.0)).in_scale(truth.noise)
        np.testing.assert_allclose([*twice.values()], 2.0 * np.array([*truth.values.values()]))

    @pytest.mark.parametrize(
        "conditions",
        [
            pytest.param(DEFAULTS._replace(stribeck=0.3), id="stribeck"),
            pytest.param(DEFAULTS._replace(drift=0.1), id="drift"),
        ],
    )
    def test_its_rows_are_of_the_law_of_the_arm(self, conditions: Conditions) -> None:
        """With a Stribeck term; and at the level of friction that drifts, half way 95 %."""
        kind = ARM_TYPES["panda"]
        arm = drawn_arm(kind, 1, conditions)
        text = urdf(kind.urdf).read_text(encoding="utf-8")
        model = RobotModel.from_urdf(text, locked=kind.locked, friction=IMPORTED_LAW)
        slow = conditions._replace(rate=20.0)
        truth = coverage.truth_of(arm, model, 1, 0.0, slow)
        exact = truth._replace(scale=np.ones(model.n_joints))
        level = 1.0 - 0.5 * conditions.drift
        motion = drawn_motion(
            arm.robot, np.random.default_rng([1, 2, 0]), coverage.FITTED_TIME, SPEED
        )
        torque = arm.torque(*motion.at(np.arange(truth.rows.shape[1]) / 20.0), level)
        values = np.array([*exact.in_scale(truth.noise, level).values()])
        modelled = np.einsum("jmp,p->mj", truth.rows, values)
        np.testing.assert_allclose(modelled, torque, atol=1e-9 * np.abs(torque).max())

    def test_a_term_without_a_true_coefficient_has_no_column(self) -> None:
        """Of Stribeck friction over another speed than the law's."""
        kind = ARM_TYPES["panda"]
        conditions = DEFAULTS._replace(stribeck=0.3, stribeck_speed=0.03, rate=20.0)
        arm = drawn_arm(kind, 1, conditions)
        text = urdf(kind.urdf).read_text(encoding="utf-8")
        model = RobotModel.from_urdf(text, locked=kind.locked, friction=IMPORTED_LAW)
        truth = coverage.truth_of(arm, model, 1, 0.0, conditions)
        assert np.isnan(truth.values["fs_1"])
        assert list(truth.bound) == list(model.parameter_names)
        assert list(truth.in_scale(truth.noise)) == list(model.parameter_names)
        assert truth.rows.shape[2] == model.n_parameters


class TestMotion:
    @pytest.mark.parametrize("name", ARMS)
    def test_it_is_within_limits_and_at_rest_at_both_ends(self, name: str) -> None:
        robot = drawn_arm(ARM_TYPES[name], 1).robot
        for seed in range(5):
            motion = drawn_motion(robot, np.random.default_rng(seed), 12.0, SPEED)
            position, velocity, _ = motion.at(np.arange(-0.1, 12.1, 0.004))
            assert np.all(position >= robot.lowerPositionLimit)
            assert np.all(position <= robot.upperPositionLimit)
            assert np.all(np.abs(velocity) <= SPEED * robot.velocityLimit + 1e-3)
            assert np.all(velocity[[0, 1, -2, -1]] == 0.0)
            # Every joint uses a good share of what it may.
            assert np.all(np.abs(velocity).max(axis=0) > 0.15 * robot.velocityLimit)

    def test_velocity_and_acceleration_are_derivatives(self) -> None:
        """In both ramps and between them, by central differences over 20 us."""
        robot = drawn_arm(ARM_TYPES["panda"], 1).robot
        motion = drawn_motion(robot, np.random.default_rng(3), 12.0, SPEED)
        time = np.array([0.3, 0.7, 2.0, 5.5, 8.1, 11.2, 11.9])
        step = 1e-5
        before, now, after = (motion.at(time + shift) for shift in (-step, 0.0, step))
        for order in (0, 1):
            difference = (after[order] - before[order]) / (2.0 * step)
            assert difference == pytest.approx(now[order + 1], abs=1e-6)


class TestLog:
    def test_the_torque_is_late_and_has_the_stated_noise(self) -> None:
        """Without noise it is RNEA of the motion a delay earlier; the noise keeps its memory."""
        arm = drawn_arm(ARM_TYPES["panda"], 1)
        in_scale = DEFAULTS._replace(scale=0.0)
        late = logged(arm, 5, 0, 20.0, 0.004, in_scale)
        # At 250 Hz the delay is a row.
        prompt = logged(arm, 5, 0, 20.0, 0.0, in_scale)
        noise_free = arm.torque(
            *drawn_motion(arm.robot, np.random.default_rng([5, 2, 0]), 20.0, SPEED).at(prompt.time)
        )
        noise = prompt.torque - noise_free
        assert noise.std(axis=0) == pytest.approx(0.014 * noise_free.std(axis=0), rel=0.15)
        moved = late.torque[1:] - noise[1:] - noise_free[:-1]
        assert np.abs(moved).max() < 1e-3 * np.abs(noise_free).max()
        # Of half the power: exp(-4 ms / 50 ms) of it a row later.
        neighbours = np.mean(noise[1:] * noise[:-1]) / np.mean(noise**2)
        assert neighbours == pytest.approx(0.5 * np.exp(-0.08), abs=0.08)
        assert (prompt.position - late.position == 0.0).all()


CLEAN = Run(
    inertial=[True] * 19 + [False],
    friction=[True, True],
    inertial_absolute=[True] * 20,
    friction_absolute=[True, False],
    inertial_over_bound=[1.0, 1.2],
    friction_over_bound=[1.1, 1.3],
    friction_least_squares=[1.1, 1.1],
    undetermined=0,
    dropped=0,
    width=[0.1, 0.3],
    delay_error=[0.0, 0.0],
    delay_half=[1e-4],
    spread=[0.02, 0.01],
    spread_error=[0.01, 0.02],
    blamed=[],
    good=True,
    inside=0.9,
    error=0.02,
    seconds=10.0,
)


class TestFigures:
    def test_they_are_shares_of_all_intervals_and_runs(self) -> None:
        late = CLEAN._replace(
            inertial=[True] * 20, delay_error=[4e-4, 0.0], blamed=["friction"], good=False
        )
        figures = coverage.figures([[CLEAN], [late]])
        assert figures["inertial"] == pytest.approx(39 / 40)
        assert figures["inertial_unsure"] == pytest.approx(0.05)  # 2 x 0.0354 / sqrt(2)
        assert figures["friction"] == 1.0
        assert (figures["inertial_absolute"], figures["friction_absolute"]) == (1.0, 0.5)
        assert figures["inertial_over_bound"] == pytest.approx(1.1)
        assert figures["friction_over_bound"] == pytest.approx(1.2)
        assert figures["ensemble"] == pytest.approx(1.0)
        assert figures["delay_near"] == 1  # a run with a late axis is not near
        assert figures["delay_bias_ms"] == pytest.approx(0.1)
        assert (figures["delay_held"], figures["delay_intervals"]) == (1, 2)
        assert figures["false_causes"] == {"friction": 1}
        assert (figures["good"], figures["inside"], figures["seconds"]) == (1, 0.9, 10.0)

    def test_runs_of_one_draw_are_one_sample(self) -> None:
        """Of the same noise at two delays nothing can be said about other noise."""
        assert coverage.figures([[CLEAN, CLEAN]])["inertial"] == pytest.approx(0.95)
        assert coverage.figures([[CLEAN, CLEAN]])["inertial_unsure"] is None

    def test_the_standard_error_of_a_single_run_is_not_known(self) -> None:
        assert coverage.figures([[CLEAN]])["inertial_unsure"] is None


def test_a_run_is_read_from_the_results(monkeypatch: pytest.MonkeyPatch) -> None:
    """All parameters of the arm are counted; the error is that of the noise of the torque."""
    monkeypatch.setattr(coverage, "FITTED_TIME", 10.0)
    monkeypatch.setattr(coverage, "HELD_OUT_TIME", 5.0)
    run = coverage.run("ns16", 0.0, 1, Conditions(white=True))
    n_base = 40
    n_friction = 18
    counted = len(run.inertial) + len(run.friction) + run.undetermined
    assert counted + run.dropped >= n_base + n_friction
    assert len(run.delay_error) == 6
    assert 0.005 < run.error < 0.05
    assert run.seconds > 0.0
