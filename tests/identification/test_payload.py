"""Identification of a payload, and of torque constants from a known one."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from identification.errors import IdentificationError, ModelError
from identification.estimators.current_gains import GainProblem, identify_gains
from identification.estimators.payload_estimate import NAMES, PayloadError, identify_payload
from identification.estimators.payload_problem import Run
from identification.factor.columns import gain_factor
from identification.model.friction import FrictionLaw
from identification.model.known_payload import Load, Payload
from identification.model.motion import Motion
from identification.model.pseudo_inertia import inertial_parameters, margin
from identification.model.robot import RobotModel
from sim_fixtures.ns16 import urdf_text
from tests.identification.robots import joint, link, ns16_values, random_urdf, robot, robot_text
from tests.identification.two_link import (
    MODEL,
    URDF,
    a_motion,
    as_samples,
    four_sines,
    truth,
    values_of,
)

pytestmark = pytest.mark.long

TILTED = (2.0, -3.0, -9.0)
INERTIA = (0.05, 0.01, -0.02, 0.04, 0.005, 0.03)


def pinocchio_torque(urdf, payload, joint, where):
    """Return pinocchio's torques with a body added to a joint."""
    model = pin.buildModelFromXML(urdf)
    model.gravity.linear = np.array(TILTED)
    if payload is not None:
        xx, xy, xz, yy, yz, zz = payload.inertia
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        model.appendBodyToJoint(
            joint, pin.Inertia(payload.mass, np.array(payload.centre), tensor), where
        )
    data = model.createData()
    rows = [
        pin.rnea(model, data, pin.integrate(model, pin.neutral(model), a), b, c)
        for a, b, c in states(model.nv).states()
    ]
    return np.array(rows)


def states(n):
    return Motion.of_states(*np.random.default_rng(6).uniform(-2.0, 2.0, (3, 20, n)))


class TestPayload:
    @pytest.mark.parametrize("case", ["ns16", "ur10 at its tool", *range(6)])
    def test_its_torque_is_the_difference_in_pinocchio(self, case):
        frame = None
        where = pin.SE3.Identity()
        urdf = urdf_text()
        if isinstance(case, int):
            urdf = random_urdf(case)
        elif case.startswith("ur10"):
            urdf = robot_text("ur_description/urdf/ur10_robot.urdf")
            frame = "tool0"
            reader = pin.buildModelFromXML(urdf)
            where = reader.frames[reader.getFrameId("tool0", pin.FrameType.BODY)].placement
        payload = Payload(7.0, (0.05, -0.02, 0.11), INERTIA, frame)
        model = RobotModel.from_urdf(urdf, gravity=TILTED, payload=payload)
        expected = pinocchio_torque(urdf, payload, model.chain.last_joint + 1, where)
        expected -= pinocchio_torque(urdf, None, model.chain.last_joint + 1, where)
        np.testing.assert_allclose(model.load_torque(states(model.n_joints)), expected, atol=1e-9)

    def test_it_does_not_change_the_parameters(self):
        bare = RobotModel.from_urdf(urdf_text())
        loaded = RobotModel.from_urdf(urdf_text(), payload=Payload(16.0, (0.1, 0.0, 0.2)))
        assert loaded.parameter_names == bare.parameter_names
        values = np.arange(1.0, bare.n_parameters + 1)
        np.testing.assert_array_equal(
            loaded.torque(values, states(6)), bare.torque(values, states(6))
        )
        assert not bare.load_torque(states(6)).any()

    def test_an_unknown_frame_is_refused_with_the_known_ones(self):
        with pytest.raises(ModelError, match=r"'tool9' is not a link .* link_6"):
            RobotModel.from_urdf(urdf_text(), payload=Payload(1.0, (0.0, 0.0, 0.0), frame="tool9"))
        with pytest.raises(ModelError, match="fixed to the base"):
            RobotModel.from_urdf(
                urdf_text(), payload=Payload(1.0, (0.0, 0.0, 0.0), frame="base_link")
            )

    def test_invalid_masses_and_inertias_are_reported(self):
        at = (0.0, 0.0, 0.0)
        for mass in (-1.0, np.nan):
            with pytest.raises(ModelError, match="weighs"):
                Payload(mass, at)
        with pytest.raises(ModelError, match="not finite"):
            Payload(1.0, (np.inf, 0.0, 0.0))
        assert Payload(1.0, at).possible
        assert Payload(1.0, at, (0.1, 0.0, 0.0, 0.2, 0.0, 0.3)).possible, "a flat body"
        assert not Payload(1.0, at, (0.1, 0.0, 0.0, 0.1, 0.0, 0.3)).possible
        assert not Payload(1.0, at, (-0.1, 0.0, 0.0, 0.1, 0.0, 0.1)).possible


TIME = np.arange(2000) * 5e-3
LOAD = Payload(4.0, (0.2, 0.0, 0.1), (0.02, 0.0, 0.0, 0.03, 0.0, 0.04))
BEYOND = Payload(0.3, (3.0, 0.0, 0.5), (0.02, 0.0, 0.0, 0.03, 0.0, 0.04))
NOISE = np.array([3.0, 1.0])  # N·m
SEEDS = 24


def recordings(loads, *, noise=NOISE, drift=0.0, pace=1.0, seed=0):
    """Recordings of one motion of two links about y, with drifting friction."""
    rng = np.random.default_rng(seed)
    motion = four_sines(TIME, pace)
    runs = []
    for k, load in enumerate(loads):
        drifted = truth()
        drifted[-4:] *= 1.0 + drift * np.tile(rng.standard_normal(2), 2)
        torque = MODEL.torque(drifted, motion)
        if load is not None:
            torque += load_torque(MODEL, load, motion)
        torque += noise * rng.standard_normal(torque.shape)
        samples = as_samples(MODEL, motion, torque)
        runs.append(Run.of(f"run {k + 1}", MODEL, samples, None, loaded=load is not None))
    return MODEL, runs


def identified(loads, **options):
    return identify_payload(*recordings(loads, **options))


class TestMass:
    def test_without_noise_the_body_comes_back(self):
        estimate = identified([None, LOAD], noise=np.zeros(2))
        assert estimate.body.mass == pytest.approx(4.0, rel=1e-6)
        assert estimate.body.centre[[0, 2]] == pytest.approx([0.2, 0.1], abs=1e-6)
        assert estimate.body.inertia[1, 1] == pytest.approx(0.03, rel=1e-4)

    def test_no_load_is_no_body(self):
        """With the same load in all recordings."""
        model, runs = recordings([None, None])
        estimate = identify_payload(model, [runs[0], replace(runs[1], loaded=True)])
        assert estimate.body is None
        assert estimate.intervals[0, 0] == 0.0

    def test_exchanged_recordings_are_refused(self):
        model, runs = recordings([None, LOAD])
        exchanged = [replace(run, loaded=not run.loaded) for run in runs]
        with pytest.raises(PayloadError, match=r"carry 4\.\d* kg more .* interchanged"):
            identify_payload(model, exchanged)

    @pytest.mark.parametrize("is_exchanged", [False, True])
    def test_a_load_larger_than_its_mass_can_be_is_doubted(self, is_exchanged):
        """0.3 kg at 3 m is no load, and exchanged recordings of one are none either."""
        model, runs = recordings([None, BEYOND])
        if is_exchanged:
            exchanged = [replace(run, loaded=not run.loaded) for run in runs]
            with pytest.raises(PayloadError, match="not a load but a change of the arm"):
                identify_payload(model, exchanged)
            return
        assert identify_payload(model, runs).is_beyond_reach
        assert not identified([None, LOAD], noise=np.zeros(2)).is_beyond_reach


@pytest.fixture(scope="module")
def many():
    return [identified([None, LOAD], drift=0.04, seed=seed) for seed in range(SEEDS)]


class TestIntervals:
    def test_they_contain_the_truth_with_drifting_friction(self, many):
        """Of 24 draws at 95 % fewer than 19 inside have a probability of 0.1 %."""
        truth = {"mass": 4.0, "cx": 0.2, "cz": 0.1, "Iyy": 0.03}
        for name, value in truth.items():
            intervals = np.array([estimate.intervals[NAMES.index(name)] for estimate in many])
            inside = (intervals[:, 0] <= value) & (value <= intervals[:, 1])
            assert inside.sum() >= 19, name

    def test_they_are_not_wider_than_the_scatter(self, many):
        masses = np.array([estimate.parameters[9] for estimate in many])
        half = np.median([np.diff(estimate.intervals[0]) / 2.0 for estimate in many])
        assert half < 1.5 * 1.96 * masses.std(ddof=1)

    def test_changed_friction_does_not_bias_the_mass(self):
        """Drift of 30 % of the friction, three times that of the prior."""
        model, runs = recordings([None, LOAD])
        low, high = identify_payload(model, runs).intervals[0]
        drifting = identified([None, LOAD], drift=0.3, seed=3)
        assert drifting.intervals[0, 0] < 4.0 < drifting.intervals[0, 1]
        assert np.diff(drifting.intervals[0])[0] < 3.0 * (high - low)

    def test_the_moment_is_mass_times_distance(self):
        value, low, high = identify_payload(*recordings([None, LOAD], noise=0.1 * NOISE)).moment
        assert value == pytest.approx(4.0 * np.hypot(0.2, 0.1), rel=1e-2)
        assert low < value < high


class TestPossibleBody:
    @pytest.mark.parametrize("seed", range(5))
    def test_a_poor_motion_gives_a_consistent_body(self, seed):
        estimate = identified([None, LOAD], noise=20.0 * NOISE, pace=0.4, seed=seed)
        parameters = inertial_parameters(estimate.body)
        assert margin(parameters) > -1e-9 * parameters[9]

    def test_undetermined_parameters_are_named(self):
        """Only mass, moments in the plane and Iyy act on two axes about y."""
        estimate = identified([None, LOAD])
        assert estimate.undetermined == ("cy", "Ixx", "Ixy", "Ixz", "Iyz", "Izz")
        assert estimate.body.centre[1] == pytest.approx(0.0, abs=1e-6)

    def test_undetermined_moments_are_zero(self):
        """In slow motion only the weight acts: a point mass."""
        estimate = identified([None, LOAD], pace=0.1, noise=3.0 * NOISE)
        assert {"Ixx", "Iyy", "Izz"} <= {*estimate.undetermined}
        np.testing.assert_array_equal(estimate.body.inertia, np.zeros((3, 3)))


class TestFrame:
    def test_results_are_in_the_requested_frame(self):
        """A body in the frame of a tool is identified in that frame."""
        tool = (
            '<link name="tool"/><joint name="mount" type="fixed"><parent link="lower"/>'
            '<child link="tool"/><origin xyz="0.1 0 0.3" rpy="0 0.5 0"/></joint></robot>'
        )
        urdf = URDF.replace("</robot>", tool)
        model = RobotModel.from_urdf(urdf, friction=FrictionLaw(third=None))
        motion = a_motion()
        bare = model.torque(truth(), motion)
        loaded = bare + load_torque(model, replace(LOAD, frame="tool"), motion)
        runs = [
            Run.of("run", model, as_samples(model, motion, torque), "tool", loaded=kind)
            for kind, torque in ((False, bare), (True, loaded))
        ]
        estimate = identify_payload(model, runs)
        assert estimate.body.centre[[0, 2]] == pytest.approx([0.2, 0.1], abs=1e-6)
        assert estimate.body.inertia[1, 1] == pytest.approx(0.03, rel=1e-4)


KNOWN = Payload(2.0, (0.03, 0.0, 0.45))
PLANTED = np.array([12.0, 5.0])  # N m / A
CURRENT_NOISE = np.array([0.3, 0.1])  # A

# Lifts along gravity, then turns about it: no payload loads the second axis.
LIFT_AND_TURN = robot(
    '<link name="base"/>',
    joint("lift", "base", "column", kind="prismatic"),
    link("column", mass=8, inertia=(0.2, 0.2, 0.05)),
    joint("turn", "column", "hand", ends=3),
    link("hand", mass=3, inertia=(0.02, 0.02, 0.03)),
)


def load_torque(model, payload, motion):
    return Load(model.chain, model.gravity, payload).torque(motion)


def factors_of(
    noise=CURRENT_NOISE, *, seed=0, model=MODEL, values=None, gains=PLANTED, load=KNOWN, **more
):
    """Reduce a recording without payload and one with it; noise is on the currents."""
    motion = more.get("motion")
    turns = more.get("turns")
    motion = four_sines(TIME, n=model.n_joints) if motion is None else motion
    samples = as_samples(model, motion, np.zeros_like(motion.position))
    rng = np.random.default_rng(seed)
    torque = model.torque(truth() if values is None else values, motion)
    factors = []
    for payload in (None, load):
        joint = torque if payload is None else torque + load_torque(model, payload, motion)
        motor = joint if turns is None else np.linalg.solve(turns.T, joint.T).T
        current = motor / gains + noise * rng.standard_normal(joint.shape)
        stated = payload and more.get("stated", payload)
        unknown = more.get("unknown_inertia", False)
        factors.append(
            gain_factor(
                model,
                samples,
                current,
                payload=stated,
                unknown_inertia=unknown,
                transmission=turns,
            )
        )
    return factors


def gains_of(factors, model=MODEL):
    return identify_gains(model, factors)


def lifted(payload):
    """Return gains of an arm that lifts along gravity and turns about it."""
    model = RobotModel.from_urdf(LIFT_AND_TURN, friction=FrictionLaw(third=None))
    values = values_of(model, [20.0, 3.0, 15.0, 1.0], (2.0, 0.05))
    return gains_of(factors_of(model=model, values=values, load=payload), model)


# Motors' angles per joint angle with a coupled wrist, as the NS 16 has it.
TURNS = np.diag([-116.0, 116.0, -106.0, -50.0, 51.5, -33.0]) @ (
    np.eye(6) + np.array([[0.0] * 6] * 4 + [[0, 0, 0, -0.03, 0, 0], [0, 0, 0, 0.021, -0.035, 0]])
)
CONSTANTS = np.array([1.10, 1.10, 0.75, 0.36, 0.42, 0.42])
NS16_LOAD = Payload(16.0, (0.10, 0.05, 0.25), (0.1, 0.0, 0.0, 0.1, 0.0, 0.05))


def ns16(motion=None):
    """Return gains of the coupled NS 16."""
    model = RobotModel.from_urdf(urdf_text(), friction=FrictionLaw(third=None))
    factors = factors_of(
        np.full(6, 0.05),
        model=model,
        values=ns16_values(model),
        gains=CONSTANTS,
        load=NS16_LOAD,
        motion=motion,
        turns=TURNS,
    )
    return gains_of(factors, model)


class TestGains:
    def test_without_noise_the_true_gains_are_found(self):
        assert gains_of(factors_of(np.zeros(2))).values == pytest.approx(PLANTED, rel=1e-6)

    def test_95_percent_intervals_cover_without_bias(self):
        """Unlike least squares of the equation linear in gains and parameters."""
        draws = [gains_of(factors_of(seed=seed)) for seed in range(100)]
        values = np.array([draw.values for draw in draws])
        half = np.array([draw.interval_factor * draw.std for draw in draws])
        # Fewer than 89 of 100 have a probability of 0.5 %.
        assert np.all(np.sum(np.abs(values - PLANTED) <= half, axis=0) >= 89)
        scatter = values.std(axis=0, ddof=1)
        claimed = np.sqrt(np.mean([draw.std**2 for draw in draws], axis=0))
        # The standard deviation of 100 samples has an error of 7 %.
        assert np.all(np.abs(np.log(claimed / scatter)) < 3 * 0.07)
        assert np.all(np.abs(values.mean(axis=0) - PLANTED) < 3.0 * scatter / 10.0)

    def test_an_unknown_inertia_of_the_load_biases_nothing(self):
        """Taken for zero, it makes constants too small, by many of their standard deviations."""
        load = replace(KNOWN, inertia=(0.05, 0.0, 0.0, 0.08, 0.0, 0.05))
        errors = []
        for seed in range(20):
            one = {"seed": seed, "load": load, "stated": KNOWN}
            gains = identify_gains(MODEL, factors_of(**one, unknown_inertia=True), 0.4)
            errors.append((gains.values - PLANTED) / gains.std)
            point = gains_of(factors_of(**one))
            assert point.values[1] < PLANTED[1] - 4.0 * point.std[1]
        # Two standard deviations hold 95 %; fewer than 16 of 20 have a probability of 0.3 %.
        assert np.all(np.sum(np.abs(errors) < 2.1, axis=0) >= 16)

    def test_a_gain_that_only_inertia_shows_is_undetermined(self):
        """About a vertical axis the torque of a load is that of its moment of inertia."""
        model = RobotModel.from_urdf(LIFT_AND_TURN, friction=FrictionLaw(third=None))
        values = values_of(model, [20.0, 3.0, 15.0, 1.0], (2.0, 0.05))
        load = Payload(4.0, (0.2, 0.0, 0.1))
        factors = factors_of(model=model, values=values, load=load, unknown_inertia=True)
        gains = identify_gains(model, factors, 0.2)
        assert gains.determined.tolist() == [True, False]

    def test_an_unloaded_axis_is_undetermined(self):
        """An eccentric payload determines it."""
        gains = lifted(Payload(4.0, (0.0, 0.0, 0.1)))
        assert gains.values[0] == pytest.approx(PLANTED[0], abs=4.0 * gains.std[0])
        assert gains.determined.tolist() == [True, False]
        assert np.isnan(gains.values[1])
        assert np.isinf(gains.std[1])
        assert [reason and reason.problem for reason in gains.reasons] == [
            None, GainProblem.NOT_LOADED,
        ]  # fmt: skip
        gains = lifted(Payload(4.0, (0.2, 0.0, 0.1)))
        assert np.all(np.abs(gains.values - PLANTED) < 4.0 * gains.std)

    def test_the_torque_constants_of_a_coupled_ns16(self):
        gains = ns16()
        assert gains.determined.all()
        assert np.all(np.abs(gains.values - CONSTANTS) < 4.0 * gains.std)
        assert np.all(gains.std < 0.02 * CONSTANTS)

    def test_on_a_slow_ns16_only_loaded_axes_are_determined(self):
        gains = ns16(four_sines(np.arange(6000) * 0.02, 0.03, n=6))
        assert not gains.determined[0]
        assert gains.determined[[1, 2]].all()
        assert np.all(np.abs(gains.values - CONSTANTS)[1:3] < 4.0 * gains.std[1:3])

    def test_missing_payload_raises(self):
        with pytest.raises(IdentificationError, match="no recording has a known payload"):
            gains_of(factors_of(load=None))
