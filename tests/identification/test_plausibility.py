"""Impossible parameters, by their signs and on held-out motion; jumps; nominal torque."""

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pinocchio as pin
import pytest

from identification.estimators.covariance import with_block_covariance
from identification.factor.factor import Estimate, Factor, estimate, joint_weights
from identification.model.coupling import Coupling
from identification.model.friction import FrictionLaw
from identification.model.robot import RobotModel
from identification.signals.recording import Recording
from identification.validation.plausibility import (
    Implausible,
    check_consistency,
    implausibilities,
    inertia_matrices,
    inertia_ratio,
    nominal_scale,
)
from identification.validation.position_jumps import position_jumps
from tests.hil.identified_arm import a_motion as sines
from tests.hil.identified_arm import packaged_urdf
from tests.identification.test_essential import NOISE, a_motion
from tests.identification.test_verdict import an_error, finding_of, judged
from tests.identification.two_link import MODEL, URDF, one_sine, simulated, values_of


def parameters(model=MODEL, **changes):
    """Parameters of the URDF with rotors and friction, and with changes by name."""
    standard = dict(zip(model.layout.names, model.nominal, strict=True))
    standard |= {"I1m": 0.4, "I2m": 0.1}
    names = model.parameter_names[model.base.rank :]
    friction = dict(zip(names, [4, 2, 1.5, 0.8, 1.0, 1.0], strict=False))
    for name, value in changes.items():
        (friction if name in friction else standard)[name] = value
    return np.concatenate([model.base.grouping @ list(standard.values()), list(friction.values())])


def known(values, model=MODEL, std=0.01):
    """Estimate with a relative standard deviation."""
    return Estimate(
        names=model.parameter_names, units=model.units, values=values,
        covariance=np.diag((std * np.maximum(np.abs(values), 0.1)) ** 2), noise_std=np.ones(2),
        samples=np.full(2, 1000), method="", condition=10.0,
    )  # fmt: skip


def with_value(name, value, std=0.01):
    """Estimate of the arm with another value of one parameter."""
    values = parameters()
    values[MODEL.parameter_names.index(name)] = value
    return replace(known(parameters(), std=std), values=values)


def signs(found, model=MODEL, *, error=0.1):
    motion = one_sine(np.arange(2000) * 2e-3)
    return implausibilities(
        model,
        found,
        Factor.from_samples(model, motion, np.zeros((2000, 2))),
        np.full(2, error),
        speed=np.abs(motion.velocity).max(axis=0),
    )


class TestSigns:
    @pytest.mark.parametrize(
        ("found", "words"),
        [
            (with_value("f0_1", -4.0), "Coulomb friction of shoulder is negative"),
            (with_value("f1_2", -1.0), "friction of elbow is"),
            (with_value("I2m", -0.1), "I2m is negative"),
        ],
    )
    def test_impossible_signs_are_named(self, found, words):
        assert any(words in one for one in signs(found).impossible)

    def test_signs_within_the_uncertainty_are_possible(self):
        """So are undetermined parameters, and friction that falls from 2 to 1.3 N·m."""
        unknown = with_value("I2m", -0.1)
        index = unknown.names.index("I2m")
        covariance = unknown.covariance.copy()
        covariance[index, index] = np.inf
        assert signs(replace(unknown, covariance=covariance)) == Implausible((), ())
        assert signs(with_value("I2m", -0.1, std=1.0)) == Implausible((), ())
        assert signs(with_value("f1_2", -0.15)).impossible == ()
        assert signs(known(parameters())) == Implausible((), ())

    def test_signs_of_a_torque_below_the_error_are_doubtful(self):
        found = signs(with_value("I2m", -0.01), error=5.0)
        assert found.impossible == ()
        assert any("I2m is negative" in words for words in found.doubtful)

    def test_negative_friction_of_a_coupled_motor_is_named(self):
        coupling = Coupling(np.array([[1.0, 0.0], [0.5, 1.0]]), inertia=False)
        coupled = RobotModel.from_urdf(URDF, friction=MODEL.friction.laws[0], coupling=coupling)
        arm = partial(parameters, coupled)
        (words,) = signs(known(arm(f1_m2=-1.0), coupled), coupled).impossible
        assert words.startswith("friction f1_m2 of motor 2 is negative: -1")
        assert signs(known(arm(), coupled), coupled) == Implausible((), ())


def runs(**changes):
    return [simulated(MODEL, parameters(**changes), a_motion(k), NOISE, k) for k in (1, 2)]


def checked(recordings):
    training, unseen = (Factor.by_time(MODEL, run) for run in recordings)
    weights = joint_weights(training)
    free = with_block_covariance(estimate(MODEL, training, weights), training, weights)
    return check_consistency(MODEL, training, unseen, free, weights=weights)


class TestConsistencyCheck:
    """Rise of the held-out error by physical consistency, and the active bounds."""

    def test_consistent_data_cost_nothing(self):
        found = checked(runs())
        assert abs(found.cost) < 0.001
        assert not found.costly and not found.impossible
        assert found.bounds == () and np.all(found.room > 0.5)
        assert "consistent parameters predict as well" in found.sentence

    def test_the_cost_is_the_rise_of_the_error(self):
        recordings = runs(I2m=-0.1)
        found, run = checked(recordings), recordings[1]
        torque = np.where(run.usable, run.torque, 0.0)
        both = found.consistent.estimate.values, found.consistent.unconstrained.values
        errors = [
            torque - np.where(run.usable, MODEL.torque(one, *run.motion[1:]), 0.0) for one in both
        ]
        ours, free = (np.linalg.norm(one) / np.linalg.norm(torque) for one in errors)
        assert found.cost == pytest.approx(ours - free, rel=1e-6)
        size = np.linalg.norm(torque, axis=0)
        ours, free = (np.linalg.norm(one, axis=0) / size for one in errors)
        np.testing.assert_allclose(found.held_out_rise, ours - free, rtol=1e-6)

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            ({"I2m": -0.6}, "elbow"),
            ({"f0_2": -2.0}, "Coulomb friction of elbow would be negative"),
            ({"f1_1": -1.5}, "viscous friction of shoulder would be negative"),
        ],
    )
    def test_active_bounds_are_named_with_their_joint(self, change, words):
        found = checked(runs(**change))
        assert found.costly and words in found.sentence
        assert any(words in bound for bound in found.bounds)

    def test_a_torque_of_the_wrong_sign_is_impossible(self):
        found = checked([replace(run, torque=run.torque * [-1.0, 1.0]) for run in runs()])
        assert found.impossible and "shoulder" in found.sentence
        assert found.sentence.startswith("no physically consistent parameters fit")

    def test_a_negative_second_moment_is_an_active_bound(self):
        """That of the elbow's link about its own centre."""
        found = checked(runs(I2yy=0.05, I2m=0.0))
        assert found.room[1] < 0.01
        assert any("link of elbow" in bound for bound in found.bounds)


def recording(rate, *, jitter=0.0, seed=0):
    rng = np.random.default_rng(seed)
    time = np.cumsum((1.0 + jitter * rng.uniform(-1.0, 1.0, int(12 * rate))) / rate)
    q = np.column_stack([0.8 * np.sin(w * time + w) + 0.3 * np.sin(3.1 * w * time) for w in (2, 3)])
    q += 2e-5 * rng.standard_normal(q.shape)
    return Recording(time, q, ("hip", "knee"), torque=np.zeros_like(q))


def with_jump(one, size, rows):
    position = one.position.copy()
    position[rows, 1] += size
    return replace(one, position=position)


def sudden_stop():
    """From 1 rad/s to rest within one sample."""
    time = np.arange(0.0, 8.0, 0.002)
    q = np.column_stack([np.minimum(time, 4.0), np.sin(time)])
    q += 1e-5 * np.random.default_rng(1).standard_normal(q.shape)
    return Recording(time, q, ("a", "b"), torque=np.zeros_like(q))


def jump_in_a_gap():
    one = with_jump(recording(500.0), 0.3, slice(2500, None))
    return replace(one, gap_before=np.arange(len(one.time)) == 2500)


class TestPositionJumps:
    @pytest.mark.parametrize("rate", [100.0, 125.0, 500.0, 1000.0])
    @pytest.mark.parametrize("size", [0.2, 0.02, -0.02])
    def test_a_lasting_jump_is_found(self, rate, size):
        one, at = recording(rate), int(5 * rate)
        (jump,) = position_jumps(with_jump(one, size, slice(at, None)), "log.mcap")
        assert (jump.recording, jump.joint) == ("log.mcap", "knee")
        assert jump.time == pytest.approx(one.time[at] - one.time[0])
        assert jump.size == pytest.approx(size, abs=2e-3)
        finding = finding_of("position jumps", ("hip", "knee"), jumps=(jump,))
        assert finding.level == "wrong" and "knee" in finding.words and "knee" in finding.next_step

    @pytest.mark.parametrize("rate", [100.0, 500.0, 5000.0])
    @pytest.mark.parametrize("jitter", [0.0, 0.3])
    def test_motion_with_an_uneven_clock_has_no_jump(self, rate, jitter):
        assert position_jumps(recording(rate, jitter=jitter, seed=3)) == []

    @pytest.mark.parametrize(
        "one",
        [sudden_stop(), jump_in_a_gap(), with_jump(recording(500.0), 0.2, slice(2500, 2501))],
        ids=["sudden stop", "gap", "glitch of one sample"],
    )
    def test_other_steps_are_no_jumps(self, one):
        assert position_jumps(one) == []


AXES = range(1, 4)  # of the UR5, whose rigid torque exceeds their friction


def findings(model, **context):
    """Findings of a verdict with this context."""
    error = an_error(0.05, joints=model.n_joints)
    known = judged(model.joint_names, held_out=error, training=error).findings
    found = judged(model.joint_names, held_out=error, training=error, **context).findings
    return [one for one in found if one not in known]


@pytest.fixture(scope="module")
def model():
    return RobotModel.from_urdf(packaged_urdf("ur5_robot.urdf"), friction=FrictionLaw(offset=True))


def standard(model, wrong, seed):
    """Nominal parameters with every link off by its own share, and rotors."""
    values = model.nominal.copy()
    rng = np.random.default_rng(seed)
    for link in range(model.n_joints):
        rows = model.layout.links[link]
        values[rows] *= 1.0 + wrong * rng.uniform(-1.0, 1.0)
    values[model.layout.rotors] = 0.2
    return values


def runs_of(model, values, seed):
    friction = [{"f0": 3.0, "f1": 2.0, "fo": 0.2}.get(t.symbol, 0.3) for t in model.friction.terms]
    truth = np.concatenate([model.base.grouping @ values, friction])
    motions = [sines(model.n_joints, 10 * seed + number) for number in range(2)]
    noise = [0.02 * model.torque(truth, *motion[1:]).std(axis=0) for motion in motions]
    return [simulated(model, truth, *one, seed) for one in zip(motions, noise, strict=True)]


def nominal(model):
    return values_of(model, np.zeros(model.n_parameters - model.base.rank))


class TestNominalScale:
    @pytest.mark.parametrize("seed", range(10))
    def test_links_off_by_a_tenth_are_no_finding(self, model, seed):
        found = nominal_scale(
            model, nominal(model), runs_of(model, standard(model, 0.1, seed), seed)
        )
        assert np.isfinite(found.scale[2])
        assert findings(model, nominal_scale=found) == []

    @pytest.mark.parametrize("axis", AXES)
    @pytest.mark.parametrize("factor", [0.6, 1.5])
    def test_a_wrong_torque_constant_is_a_finding(self, model, axis, factor):
        scaled = []
        for run in runs_of(model, standard(model, 0.05, axis), axis):
            torque = run.torque.copy()
            torque[:, axis] *= factor
            scaled.append(replace(run, torque=torque))
        found = nominal_scale(model, nominal(model), scaled)
        assert np.flatnonzero(found.off).tolist() == [axis]
        assert found.scale[axis] == pytest.approx(factor, rel=0.1)
        (finding,) = findings(model, nominal_scale=found)
        name = model.joint_names[axis]
        assert finding.level == "doubtful" and name in finding.words and name in finding.next_step

    @pytest.mark.parametrize("factor", [0.01, 1000.0, -1.0])
    def test_torques_with_another_factor_are_wrong(self, model, factor):
        """Another unit, motor torques, or all of them negated; nothing is known without masses."""
        runs = runs_of(model, standard(model, 0.05, 1), 1)
        scaled = [replace(run, torque=factor * run.torque) for run in runs]
        (finding,) = findings(model, nominal_scale=nominal_scale(model, nominal(model), scaled))
        assert finding.level == "wrong"
        if factor > 0.0:
            assert "unit" in finding.next_step and "side" in finding.next_step
        else:
            assert finding.check == "direction of axes"
            assert "all torques have the opposite sign" in finding.words
        massless = nominal_scale(model, 0.0 * nominal(model), scaled)
        assert np.isnan(massless.scale).all() and findings(model, nominal_scale=massless) == []


@cache
def arm():
    """Model, parameters, postures, and the diagonal by pinocchio, rotors of 0.2 included."""
    urdf = packaged_urdf("ur5_robot.urdf")
    model = RobotModel.from_urdf(urdf)
    values = values_of(model, np.full(model.n_parameters - model.base.rank, 3.0), 0.2)
    position = np.random.default_rng(1).uniform(-2.0, 2.0, (20, 6))
    reference = pin.buildModelFromXML(urdf)
    data = reference.createData()
    diagonal = np.array([np.diag(pin.crba(reference, data, q)) for q in position]) + 0.2
    return model, values, position, diagonal


class TestInertia:
    def test_inertia_matrices_are_those_of_pinocchio(self):
        model, values, position, diagonal = arm()
        matrices = inertia_matrices(model, values, position)
        np.testing.assert_allclose(np.diagonal(matrices, axis1=1, axis2=2), diagonal, rtol=1e-9)

    def test_another_inertia_of_the_controller_is_a_finding(self):
        """A joint without one is not."""
        model, values, position, diagonal = arm()
        theirs = diagonal * np.array([1.0, 1.1, 0.9, 1.0, 0.0, 1.0 / 0.7])
        found = inertia_ratio(model, values, position, theirs)
        np.testing.assert_allclose(found.ratio, [1.0, 1.1, 0.9, 1.0, np.nan, 1.0 / 0.7], rtol=1e-9)
        np.testing.assert_allclose(found.spread[:4], 0.0, atol=1e-9)
        (finding,) = findings(model, controller_inertia=found)
        assert finding.level == "doubtful"
        assert "wrist_3_joint 1.43" in finding.words and "wrist_2_joint" not in finding.words
        assert inertia_ratio(model, values, position, 0.0 * diagonal) is None
