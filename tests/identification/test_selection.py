"""Essential parameters, and settings chosen by predicting parts of the fitted data."""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfilt, sosfiltfilt

from identification.errors import IdentificationError
from identification.estimators.torque_channel import possible_low_passes
from identification.factor.estimate import estimate
from identification.factor.estimation_method import LeastSquares
from identification.factor.factor import Factor
from identification.model.elements import PositionTorque, TorqueRipple, TorsionSpring
from identification.model.friction import FrictionLaw
from identification.model.motion import Motion
from identification.model.regressor import RegressorPlan
from identification.model.robot import RobotModel
from identification.selection.essential import CutRule, choose_essential, eliminate
from identification.selection.folds import Errors, Folds
from identification.selection.messages import cut_words
from identification.selection.questions import (
    CONSISTENT,
    DELAY,
    LOAD,
    LOW_PASS,
    MIN_TERM_IMPROVEMENT,
    PRIOR_WEIGHTS,
    STRENGTH,
    Question,
    choose_settings,
)
from identification.selection.scores import (
    MIN_IMPOSSIBLE_IMPROVEMENT,
    MIN_IMPROVEMENT,
    SettingsTrial,
)
from identification.selection.settings import Settings, Strength
from identification.signals.recording import Recording
from identification.signals.samples import Preprocessing, prepare
from identification.signals.smoothing import FORWARDS, WITHOUT_PHASE, LowPassShape, low_passed
from sim_fixtures.ns16 import urdf_text
from tests.identification.robots import ns16_values
from tests.identification.three_sines import ARM_NOISE, three_sines
from tests.identification.two_link import (
    MODEL,
    NOISE,
    URDF,
    a_motion,
    simulated,
    sine_motion,
    truth,
)

pytestmark = pytest.mark.long


ARM = RobotModel.from_urdf(URDF, friction=FrictionLaw(third="quadratic", offset=True))
# Without offsets and without quadratic friction.
TRUTH = np.concatenate([truth(), np.zeros(4)])


def factors(model, values, seed=0):
    """Return factors of a fitted and of another motion."""
    runs = (simulated(model, values, three_sines(k), ARM_NOISE, seed + k) for k in (1, 2))
    return tuple(Factor.by_time(model, run) for run in runs)


class TestElimination:
    """Parameters are removed while unseen motion is predicted as well."""

    def test_zero_parameters_are_removed(self):
        nothing = {"f2_1", "f2_2", "fo_1", "fo_2"}
        gone = []
        for seed in range(0, 40, 2):
            result = eliminate(ARM, *factors(ARM, TRUTH, seed))
            gone += result.removed
            assert not {"f0_1", "f0_2", "f1_1", "f1_2", "mc2z", "I2yy"} & set(result.removed)
        counts = {name: gone.count(name) for name in nothing}
        assert min(counts.values()) >= 17, counts  # of 20
        assert set(gone) <= nothing | {"mc2x", "mc1x"}  # small in the URDF: 0.12 and 0.03 kg m

    def test_a_step_is_the_least_squares_fit_of_the_columns_left(self):
        runs = [simulated(ARM, TRUTH, three_sines(k), ARM_NOISE, k) for k in (1, 2)]
        training, unseen = (Factor.by_time(ARM, run) for run in runs)
        weights = np.array([0.2, 3.0])
        result = eliminate(ARM, training, unseen, weights=weights)
        left = [ARM.parameter_names.index(name) for name in result.estimate.names]
        rows = []
        torque = []
        for run in runs:
            dense = ARM.regressor(run.motion).dense(ARM.n_parameters)
            rows.append(np.where(run.usable[..., None], dense, 0.0))
            torque.append(np.where(run.usable, run.torque, 0.0))
        scale = np.sqrt(weights)
        fitted = (rows[0] * scale[:, None])[:, :, left].reshape(-1, len(left))
        expected = np.linalg.lstsq(fitted, (torque[0] * scale).ravel(), rcond=None)[0]
        np.testing.assert_allclose(result.estimate.values, expected, rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(result.values[left], expected, rtol=1e-6, atol=1e-8)
        assert np.count_nonzero(result.values) == len(left)
        for step_error, part in ((result.chosen.in_sample, 0), (result.chosen.held_out, 1)):
            error = torque[part] - rows[part][:, :, left] @ expected
            assert step_error == pytest.approx(
                np.linalg.norm(error) / np.linalg.norm(torque[part]), rel=1e-6
            )
        length = np.linalg.norm(fitted, axis=0)
        assert result.estimate.condition == pytest.approx(np.linalg.cond(fitted / length), rel=1e-5)

    def test_the_path_removes_the_most_uncertain_parameter(self):
        training, unseen = factors(ARM, TRUTH)
        result = eliminate(ARM, training, unseen)
        full = estimate(ARM, training)
        relative = full.std / np.abs(full.values)
        assert result.steps[0].removed is None
        assert result.steps[0].spread == pytest.approx(relative.max() / relative.min(), rel=1e-9)
        assert result.steps[1].removed == full.names[int(relative.argmax())]
        assert result.steps[0].largest_relative_std == pytest.approx(relative.max(), rel=1e-9)
        assert [step.left for step in result.steps] == list(range(ARM.n_parameters, 0, -1))
        errors = [step.in_sample for step in result.steps]
        # Monotonic with weights; nearly so without.
        assert errors[-1] > 5.0 * errors[0]
        removed = [step.removed for step in result.steps[1:]]
        assert len(set(removed)) == len(removed)

    def test_a_parameter_needed_by_unseen_motion_stays(self):
        values = TRUTH.copy()
        values[ARM.parameter_names.index("fo_2")] = 1.0
        training, unseen = factors(ARM, values)
        blind = eliminate(ARM, training, unseen, rule=CutRule(spread=4.0, overall=9.0, axis=9.0))
        result = eliminate(ARM, training, unseen, rule=CutRule(spread=4.0))
        assert "f1_1" in blind.removed  # a friction of 1.5 N·m·s/rad, among a noise of 3 N·m
        assert "f1_1" in result.refused
        assert "f1_1" in cut_words(result)
        assert result.chosen.held_out < blind.chosen.held_out - 0.001

    @settings(max_examples=15)
    @given(st.integers(0, 2**16))
    def test_removals_up_to_the_cut_satisfy_the_rule(self, seed):
        model = RobotModel.from_urdf(URDF, friction=FrictionLaw(offset=True))
        values = np.random.default_rng(seed).normal(0.0, 2.0, model.n_parameters)
        result = eliminate(model, *factors(model, values, seed))
        rule = CutRule()
        best = min(step.held_out for step in result.steps[: result.cut + 1])
        assert result.chosen.held_out <= best + 2.0 * rule.overall
        assert set(result.refused).isdisjoint(result.removed)
        assert set(result.removed) | set(result.estimate.names) == set(model.parameter_names)
        if not result.refused:
            assert result.chosen.spread < rule.spread

    def test_undetermined_parameters_are_removed_first(self):
        motion = three_sines(1)
        held = motion.converted(lambda states: states * [1.0, 0.0])
        training = Factor.by_time(ARM, simulated(ARM, TRUTH, held, ARM_NOISE, 3))
        result = eliminate(ARM, training, training)
        full = estimate(ARM, training)
        lost = [
            after
            for before, after in pairwise(result.steps)
            if np.isinf(before.largest_relative_std)
        ]
        assert {"f0_2", "f1_2", "f2_2", "fo_2"} <= {step.removed for step in lost}
        assert len(lost) < len(full.undetermined)  # one parameter of a combination can stay
        assert result.estimate.undetermined == ()
        assert np.all(np.isfinite(result.estimate.std))

    def test_95_percent_intervals_cover_88_to_99_percent(self):
        covered = []
        for seed in range(0, 60, 2):
            result = eliminate(ARM, *factors(ARM, TRUTH, seed))
            estimated = result.estimate
            true = TRUTH[[ARM.parameter_names.index(name) for name in estimated.names]]
            covered.append(
                np.abs(estimated.values - true) < estimated.interval_factor * estimated.std
            )
        assert 0.88 <= np.mean(np.concatenate(covered)) <= 0.995
        assert estimated.units == tuple(
            ARM.units[ARM.parameter_names.index(name)] for name in estimated.names
        )
        assert estimated.method.fit == LeastSquares(essential_only=True)
        assert estimated.method.blocks is not None

    def test_the_ns16_predicts_equally_with_fewer_parameters(self):
        model = RobotModel.from_urdf(urdf_text())
        values = ns16_values(model)
        noise = np.array([20.0, 20.0, 12.0, 2.0, 2.0, 1.5])
        training, unseen = (
            Factor.by_time(model, simulated(model, values, three_sines(k, 6, step=0.01), noise, k))
            for k in (1, 2)
        )
        result = eliminate(model, training, unseen)
        assert {f"f2_{joint}" for joint in range(1, 7)} <= set(result.removed)
        assert {f"f{k}_{joint}" for joint in range(1, 7) for k in (0, 1)} <= set(
            result.estimate.names
        )
        assert result.chosen.left < 45
        assert result.chosen.held_out < result.steps[0].held_out + 0.001


def runs_of(model, truth, seed, count):
    seeds = range(seed, seed + count)
    return [simulated(model, truth, three_sines(k), ARM_NOISE, k) for k in seeds]


class TestChoice:
    def test_empty_factors_raise(self):
        training = Factor.by_time(ARM, runs_of(ARM, TRUTH, 1, 1)[0])
        with pytest.raises(IdentificationError, match="no usable held-out sample"):
            choose_essential(ARM, training, [Factor.zero(ARM)])
        with pytest.raises(IdentificationError, match="no usable fitted"):
            eliminate(ARM, Factor.zero(ARM), training)


CAUSAL = LowPassShape(order=2, causal=True)
RATE = 200.0  # Hz
BANDWIDTH = 3.0  # Hz
LONG = 25.0
"""Duration [s] of which the fitted part has all questions asked."""


def a_recording(
    model=MODEL, values=None, *, noise=0.05, duration=10.0, shape=None, seed=5, motion=None
):
    """Simulate a motion with noise on torque and position, through a Butterworth low-pass."""
    motion = a_motion(duration) if motion is None else motion
    sliding = replace(motion, direction=model.friction.direction(motion))
    rng = np.random.default_rng(seed)
    torque = model.torque(truth() if values is None else values, sliding)
    position = motion.position + 1e-6 * rng.standard_normal(torque.shape)
    torque += noise * rng.standard_normal(torque.shape)
    if shape is not None:
        sections = butter(shape.order, BANDWIDTH, fs=RATE, output="sos")
        torque = (sosfilt if shape.causal else sosfiltfilt)(sections, torque, axis=0)
    return Recording(motion.time, position, MODEL.joint_names, torque)


def cut(recording):
    """Return the number of rows that are fitted."""
    return round(0.7 * recording.n_samples)


def chosen(
    recording, questions, *, model=MODEL, leaks=False, ripple=(), low_passes=None, **candidates
):
    """Choose settings on the fitted rows, or on all of them with a leak."""
    fitted = recording if leaks else recording.between(0, cut(recording))

    def ready(model, how):
        return [prepare(fitted, model, options=how)]

    def possible(model, how):
        return possible_low_passes(fitted, model, options=how) if low_passes is None else low_passes

    start = Settings(Preprocessing())
    settings = choose_settings(
        model, ready, start, questions, possible, ripples=[ripple], **candidates
    )
    return settings, settings.choices


def a_motion_with_halts(duration):
    """The second joint halts for a second in every four; return the rows in which it stands."""
    motion = a_motion(duration)
    pace = np.clip(4.0 * np.sin(0.5 * np.pi * motion.time) + 3.0, 0.0, 1.0)
    pace = np.convolve(pace, np.hanning(41) / np.hanning(41).sum(), mode="same")
    step = motion.time[1] - motion.time[0]
    path = CubicSpline(motion.time, motion.position[:, 1])(step * (np.cumsum(pace) - pace[0]))
    second = CubicSpline(motion.time, path)
    position = np.column_stack([motion.position[:, 0], path])
    velocity = np.column_stack([motion.velocity[:, 0], second(motion.time, 1)])
    acceleration = np.column_stack([motion.acceleration[:, 0], second(motion.time, 2)])
    return Motion(motion.time, position, velocity, acceleration), pace < 1e-9


def a_slow_motion(amplitude):
    """Three sines of about half a rad/s; the speed is up to three times the amplitude."""
    speeds = np.array([[0.3, 0.5], [0.7, 0.4], [1.1, 0.9]])
    return sine_motion(np.arange(0.0, 30.0, 0.005), amplitude, speeds, speeds)


class TestChosenSettings:
    @pytest.mark.parametrize("distance", [1e-4, 1e-3])
    def test_the_true_presliding_is_found(self, distance):
        recording = a_recording(MODEL.with_friction(presliding=distance), duration=LONG)
        settings, _ = chosen(recording, {"presliding", "bandwidth"})
        assert settings.friction["presliding"] == distance

    @pytest.mark.parametrize(("noise", "source"), [(0.02, "measured"), (0.2, "position")])
    def test_a_measured_velocity_gives_way_to_a_clear_gain(self, noise, source):
        """Gains of 4 and 25 % in parts of this motion: another one may gain 7 % less."""
        recording = a_recording(duration=LONG, noise=1.0)
        velocity = a_motion(LONG).velocity
        velocity += noise * np.random.default_rng(7).standard_normal(velocity.shape)
        settings, (choice,) = chosen(replace(recording, velocity=velocity), {"velocity"})
        assert choice.errors[1] < 0.97 * choice.errors[0]
        assert settings.preprocessing.velocity == source

    @pytest.mark.parametrize(("swing", "bandwidths"), [(0.0, [14.0]), (2e-3, [3.5, 5.0])])
    def test_a_motor_that_swings_on_a_soft_drive_is_smoothed(self, swing, bandwidths):
        """At 6 Hz, which the link does not follow."""
        recording = a_recording(duration=LONG, motion=a_slow_motion(0.5))
        swings = swing * np.sin(2.0 * np.pi * 6.0 * recording.time)[:, None]
        swinging = replace(recording, position=recording.position + swings)
        settings, _ = chosen(swinging, {"bandwidth"})
        assert settings.preprocessing.rigid_bandwidth in bandwidths

    def test_the_true_friction_term_is_found(self):
        cubic = MODEL.with_friction(third="cubic")
        recording = a_recording(cubic, np.append(truth(), [0.5, 0.3]), duration=LONG)
        settings, _ = chosen(recording, {"friction"})
        assert settings.friction["third"] == "cubic"

    def test_a_stated_stribeck_speed_is_a_candidate(self):
        stated = MODEL.with_friction(stribeck=0.3)
        slow = np.array([[0.3, 0.5], [0.7, 0.4], [1.1, 0.9]])
        motion = sine_motion(np.arange(0.0, 30.0, 0.005), 0.4, slow, slow)
        recording = a_recording(stated, np.append(truth(), [5.0, 4.0]), motion=motion)
        settings, _ = chosen(recording, {"friction"}, model=stated)
        assert settings.friction["stribeck"] == 0.3

    def test_a_law_that_would_drive_faster_motion_is_refused(self):
        """It is true of the recorded speeds, up to 0.25 rad/s, and without friction at twice."""
        falling = MODEL.with_friction(third="quadratic")
        values = np.append(truth(), [-15.0, -8.0])
        recording = a_recording(falling, values, motion=a_slow_motion(0.12))
        settings, choices = chosen(recording, {"friction"})
        decision = next(choice for choice in choices if choice.name == "friction at speed")
        assert min(decision.errors) < (1.0 - MIN_TERM_IMPROVEMENT) * decision.errors[0]
        assert decision.chosen == 0
        assert settings.friction["third"] == "none"

    def test_a_power_of_the_speed_is_not_falling_dry_friction(self):
        """Such a sum is right up to the recorded 1.3 rad/s, and at twice far from the true law."""
        falling = MODEL.with_friction(stribeck=0.3)
        pace = np.array([[0.6, 1.0], [1.4, 0.8], [2.2, 1.8]])
        motion = sine_motion(np.arange(0.0, 30.0, 0.005), 0.3, pace, pace)
        recording = a_recording(falling, np.append(truth(), [3.0, 2.5]), motion=motion)
        settings, choices = chosen(recording, {"friction"})
        decision = next(choice for choice in choices if choice.name == "friction at speed")
        assert min(decision.errors) < (1.0 - MIN_TERM_IMPROVEMENT) * decision.errors[0]
        assert settings.friction["third"] == "none"

    def test_stribeck_friction_needs_motion_faster_than_it_reaches(self):
        """Slower than twice its speed it cannot be distinguished from viscous friction."""
        stribeck = MODEL.with_friction(stribeck=0.1)
        values = np.append(truth(), [2.0, 1.0])
        laws = []
        for amplitude in (0.06, 0.5):
            recording = a_recording(stribeck, values, motion=a_slow_motion(amplitude))
            laws.append(chosen(recording, {"friction"})[0].friction["stribeck"])
        assert laws == [0.0, 0.1]

    def test_no_friction_term_is_added_without_cause(self):
        settings, _ = chosen(a_recording(duration=LONG), {"friction"})
        assert settings.friction["third"] == "none"

    def test_torque_ripple_is_estimated_only_if_present(self):
        ripple = [TorqueRipple(name, (2,), ((name, 40.0),)) for name in MODEL.joint_names]
        rippled = MODEL.with_elements(ripple)
        strong = a_recording(rippled, np.append(truth(), [0.0, 0.4, 0.3, 0.0]))
        settings, _ = chosen(strong, {"ripple"}, ripple=ripple)
        assert settings.friction["ripple"] == (2,)
        settings, _ = chosen(a_recording(), {"ripple"}, ripple=ripple)
        assert "ripple" not in settings.friction

    @pytest.mark.parametrize("stiffness", [0.0, 20.0])
    def test_a_torsion_spring_is_estimated_only_where_one_is(self, stiffness):
        """A slow motion: without the spring its joint would have a negative inertia."""
        joint = MODEL.joint_names[1]
        sprung = MODEL.with_elements([TorsionSpring(joint, rest=0.0, identified=True)])
        slow = np.array([[0.3, 0.5], [0.7, 0.4], [1.1, 0.9]])
        motion = sine_motion(np.arange(0.0, LONG, 0.005), 0.4, slow, slow)
        recording = a_recording(sprung, np.append(truth(), stiffness), motion=motion)
        settings, choices = chosen(recording, {"springs"}, springs=MODEL.joint_names)
        assert settings.friction.get("springs") == ((joint,) if stiffness else None)
        assert not settings.strength.consistent  # nobody asked for it
        named = [choice.candidates[choice.chosen].springs for choice in choices]
        assert named == ([(joint,)] if stiffness else [])

    @pytest.mark.parametrize("amplitude", [0.0, 1.0])
    def test_a_position_torque_is_estimated_only_where_one_is(self, amplitude):
        joint = MODEL.joint_names[1]
        pulled = MODEL.with_elements([PositionTorque(joint)])
        torques = amplitude * np.array([1.0, 0.0, 0.0, -0.5, 0.3, 0.0])
        recording = a_recording(pulled, np.append(truth(), torques))
        settings, choices = chosen(
            recording, {"position torque"}, position_torques=MODEL.joint_names
        )
        assert settings.friction.get("position_torque") == ((joint,) if amplitude else None)
        named = [choice.candidates[choice.chosen].position_torques for choice in choices]
        assert named == ([(joint,)] if amplitude else [])

    def test_a_short_travel_shows_no_torque_of_the_position(self):
        """Beyond it, anything would fit."""
        joint = MODEL.joint_names[1]
        pulled = MODEL.with_elements([PositionTorque(joint)])
        pace = np.array([[0.7, 1.1], [1.9, 2.3], [3.1, 4.7]])
        motion = sine_motion(np.arange(0.0, LONG, 0.005), 0.1, pace, pace)
        torques = np.array([1.0, 0.0, 0.0, -0.5, 0.3, 0.0])
        recording = a_recording(pulled, np.append(truth(), torques), motion=motion)
        settings, _ = chosen(recording, {"position torque"}, position_torques=MODEL.joint_names)
        assert "position_torque" not in settings.friction

    @pytest.mark.parametrize(("shape", "name"), [(None, DELAY), (CAUSAL, LOW_PASS)])
    def test_a_delay_is_not_called_a_low_pass(self, shape, name):
        """Delay and low-pass of equal lag each predict best where they are the cause."""
        recording = a_recording()
        time = recording.time
        torque = recording.torque
        if shape is None:
            late = [np.interp(time - CAUSAL.lag(6.0), time, column) for column in torque.T]
            changed = replace(recording, torque=np.column_stack(late))
        else:
            changed = replace(recording, torque=low_passed(time, torque, 6.0, shape))
        filtered = Preprocessing(torque_bandwidth=6.0, torque_shape=CAUSAL)
        settings, choices = chosen(changed, {"low-pass"}, low_passes=(filtered,))
        assert name in [choice.name for choice in choices if choice.chosen]
        assert (settings.preprocessing.torque_bandwidth is None) == (name == DELAY)

    def test_the_stated_term_stays_unless_another_is_clearly_better(self):
        """Friction without a third term, and a statement that there is one."""
        stated = MODEL.with_friction(third="quadratic")
        settings, choices = chosen(a_recording(duration=LONG), {"friction"}, model=stated)
        assert settings.friction["third"] == "quadratic"
        errors = next(choice.errors for choice in choices if choice.name == "friction at speed")
        assert min(errors) > (1.0 - MIN_IMPROVEMENT) * errors[0]

    @pytest.mark.parametrize("shares", [(0.12, 0.06), (0.0, 0.0)])
    def test_load_friction_is_chosen_where_it_is(self, shares):
        loaded = MODEL.with_friction(load=True)
        recording = a_recording(loaded, np.append(truth(), shares), duration=LONG)
        settings, choices = chosen(recording, {"friction"})
        assert settings.friction["load"] == any(shares)
        assert LOAD in [choice.name for choice in choices]

    def test_a_negative_share_of_load_is_none(self):
        loaded = MODEL.with_friction(load=True)
        recording = a_recording(loaded, np.append(truth(), (-0.12, -0.06)), duration=LONG)
        settings, choices = chosen(recording, {"friction"})
        decision = next(choice for choice in choices if choice.name == LOAD)
        assert decision.errors[1] < 0.9 * decision.errors[0]
        assert not settings.friction["load"]

    def test_described_bodies_count_where_they_predict_no_worse(self):
        """White noise, and a description that is right."""
        settings, choices = chosen(a_recording(duration=LONG), {"estimator"})
        assert settings.strength.weight > 1.0
        # That bodies can exist is no question where they fit as well.
        assert [choice.name for choice in choices] == [STRENGTH]
        assert settings.strength.consistent

    @pytest.mark.parametrize(("mass", "described"), [("9", False), ("6", True)])
    def test_only_the_described_bodies_are_kept_as_they_are(self, mass, described):
        other = URDF.replace('<mass value="6"/>', f'<mass value="{mass}"/>')
        other = other.replace('<mass value="3"/>', f'<mass value="{0.5 * float(mass)}"/>')
        model = RobotModel.from_urdf(other, friction=FrictionLaw(third=None))
        settings, _ = chosen(a_recording(duration=LONG, noise=1.0), {"estimator"}, model=model)
        assert (settings.strength.weight == PRIOR_WEIGHTS[-1]) == described

    def test_a_negative_friction_is_not_made_possible(self):
        """Constraints that predict clearly worse are given up."""
        values = truth()
        values[MODEL.parameter_names.index("f1_1")] = -15.0
        settings, choices = chosen(a_recording(values=values), {"estimator"})
        assert not settings.strength.consistent
        decision = next(choice for choice in choices if choice.name == CONSISTENT)
        assert decision.errors[1] < (1.0 - MIN_IMPROVEMENT) * decision.errors[0]

    @pytest.mark.parametrize(("noise", "possible"), [(6.0, False), (9.0, True)])
    def test_four_per_cent_refuse_possible_bodies_and_two_do_not(self, noise, possible):
        """A negative friction that shows beside noise: impossible bodies gain as much."""
        values = truth()
        values[MODEL.parameter_names.index("f1_1")] = -2.0
        recording = a_recording(values=values, noise=noise, duration=LONG)
        settings, _ = chosen(recording, {"estimator"})
        assert settings.strength.consistent == possible

    @pytest.mark.parametrize(
        ("frequencies", "stiffness", "possible"),
        [(1, 2.0, True), (1, 15.0, False), (3, 15.0, False)],
    )
    def test_negative_inertia_needs_several_frequencies(self, frequencies, stiffness, possible):
        """Of one, position and acceleration are one column, and it is that of a spring.

        One that predicts far better is trusted.
        """
        joint = MODEL.joint_names[1]
        sprung = MODEL.with_elements([TorsionSpring(joint, rest=0.0, identified=True)])
        paces = np.array([[1.1, 0.9], [2.3, 3.1], [4.7, 5.3]])[:frequencies]
        motion = sine_motion(np.arange(0.0, 30.0, 0.005), 0.4, paces, paces)
        recording = a_recording(sprung, np.append(truth(), stiffness), motion=motion, noise=0.3)
        settings, choices = chosen(recording, {"estimator"})
        decision = next(choice for choice in choices if choice.name == CONSISTENT)
        assert decision.errors[1] < (1.0 - MIN_IMPOSSIBLE_IMPROVEMENT) * decision.errors[0]
        assert settings.strength.consistent == possible

    def test_a_short_recording_is_asked_the_same_questions(self):
        """Evidence decides, not how long a recording is."""
        asked = {"bandwidth", "presliding", "excluded rows", "friction", "estimator"}
        short, long = (
            [choice.name for choice in chosen(a_recording(duration=duration), asked)[1]]
            for duration in (8.0, LONG)
        )
        assert short == long

    @pytest.mark.parametrize(
        ("inertia", "noise", "wide"),
        [(0.4, 1.0, False), (400.0, 1.0, False), (400.0, 100.0, True)],
    )
    def test_rotors_heavier_than_the_links_are_found(self, inertia, noise, wide):
        """That of the first joint acts like the inertia of its link, which limits it otherwise.

        Where there is little noise, the rows say it in spite of the prior.
        """
        values = truth()
        column = int(np.flatnonzero(MODEL.base.grouping[:, MODEL.layout.rotors[0]])[0])
        values[column] += inertia
        recording = a_recording(values=values, duration=LONG, noise=noise)
        settings, choices = chosen(recording, {"estimator"})
        assert settings.strength.wide_rotors == wide
        assert min(choices[0].errors) < 0.03  # the torque of this rotor is nearly all

    @pytest.mark.parametrize(
        ("noise", "least", "most"), [(1.0, MIN_IMPROVEMENT, 1.0), (2.4, 0.0, 0.01)]
    )
    def test_rests_that_no_law_predicts_are_not_fitted(self, noise, least, most):
        """They decide the error over all rows, and say nothing of the friction in motion.

        A gain in motion above its standard error decides, be it as small as the second one.
        """
        motion, standing = a_motion_with_halts(LONG)
        recording = a_recording(motion=motion, noise=noise)
        held = np.zeros_like(recording.torque)
        held[standing, 1] = 5.0 * np.sign(np.sin(2.0 * motion.time[standing]))
        settings, choices = chosen(
            replace(recording, torque=recording.torque + held), {"excluded rows"}
        )
        by_all_rows, in_motion = choices
        assert by_all_rows.chosen == 0
        assert settings.preprocessing.exclude_rows == "halts"
        gain = 1.0 - in_motion.errors[1] / in_motion.errors[0]
        assert least < gain < most

    def test_a_joint_may_rest_in_some_segments(self):
        """Joints that move one after the other have segments without rows."""
        recording = a_recording(duration=LONG)
        position = recording.position.copy()
        position[:875, 0] = position[875, 0]
        rested = replace(recording, position=position)
        _, choices = chosen(rested, {"presliding", "excluded rows", "estimator"})
        assert [choice.name for choice in choices][-1] == STRENGTH
        assert all(np.isfinite(choice.errors).all() for choice in choices)


def decided(*errors):
    """Index of the candidate that is chosen by its errors in segments (k,) with one joint."""
    trial = SettingsTrial(MODEL, lambda *_: [])
    start = Settings(Preprocessing())
    candidates = [
        replace(start, preprocessing=Preprocessing(rigid_bandwidth=10.0 + k))
        for k in range(len(errors))
    ]
    scores = dict(zip(map(trial.key, candidates), errors, strict=True))
    trial.errors = lambda settings, _rows: Errors(
        np.square(scores[trial.key(settings)])[:, None], np.ones((len(errors[0]), 1))
    )
    return trial.decide("", candidates).choice


class TestClearlyBetter:
    """A candidate has to be better than the first by a share and its standard error."""

    FIRST = np.linspace(0.1, 0.4, 10)

    def test_by_less_than_the_share_it_is_not(self):
        assert decided(self.FIRST, 0.995 * self.FIRST).chosen == 0
        assert decided(self.FIRST, 0.98 * self.FIRST).chosen == 1

    # The standard error is 0.17.
    @pytest.mark.parametrize(("change", "chosen_one"), [(-0.1, 0), (-0.2, 1)])
    def test_by_less_than_its_standard_error_it_is_not(self, change, chosen_one):
        scatter = np.tile([0.5, -0.5], 5)
        other = self.FIRST * np.exp(change + scatter)
        assert decided(self.FIRST, other).chosen == chosen_one

    def test_a_hard_segment_does_not_decide_alone(self):
        """Means are geometric."""
        other = 0.9 * self.FIRST
        other[0] = 2.0 * self.FIRST[0]
        choice = decided(self.FIRST, other)
        expected = [
            np.exp(np.mean(np.log(segment_errors))) for segment_errors in (self.FIRST, other)
        ]
        assert choice.errors == pytest.approx(expected)
        assert choice.chosen == 0  # its standard error is that of the hard one

    def test_of_several_the_best_is_taken(self):
        assert decided(self.FIRST, 0.95 * self.FIRST, 0.8 * self.FIRST).chosen == 2
        assert decided(self.FIRST, 0.8 * self.FIRST, 0.95 * self.FIRST).chosen == 1

    def test_what_predicts_nothing_is_replaced(self):
        nothing = np.full(10, np.inf)
        assert decided(nothing, self.FIRST).chosen == 1
        assert decided(self.FIRST, nothing).chosen == 0


class TestImpossibleBodies:
    """They may be chosen unless possible ones clearly predict faster motion better."""

    FAST = np.linspace(0.1, 0.4, 10)

    @staticmethod
    def carry_over(errors, of_possible):
        """Whether they may, by errors of fast motion by segment (k,); inertias are positive."""
        trial = SettingsTrial(MODEL, lambda *_: [])
        possible = Settings(Preprocessing(), strength=Strength(consistent=True))
        impossible = replace(possible, strength=Strength())
        assert not impossible.strength.consistent
        trial.fast_errors = lambda settings: Errors(
            np.square(of_possible if settings.strength.consistent else errors)[:, None],
            np.ones((len(errors), 1)),
        )
        trial.errors = trial.fast_errors
        trial.has_inertia = lambda _: True
        return trial.carries_over(impossible, possible)

    # The standard error is 0.17.
    @pytest.mark.parametrize(("change", "may"), [(-0.2, True), (0.1, True), (0.2, False)])
    def test_faster_motion_refuses_by_its_standard_error(self, change, may):
        scatter = np.tile([0.5, -0.5], 5)
        assert self.carry_over(self.FAST * np.exp(change + scatter), self.FAST) == may

    def test_what_slower_motion_leaves_open_is_refused(self):
        assert not self.carry_over(np.full(10, np.inf), self.FAST)

    def test_without_faster_motion_they_may(self):
        assert self.carry_over(np.empty(0), np.empty(0))


class TestLast:
    @pytest.mark.parametrize(
        ("means", "chosen"),
        [
            ((0.1, 0.1, 0.09, 0.1), 3),
            ((0.1, 0.09, 0.11, 0.05), 1),
            ((0.1, 0.2), 0),
            ((2.0, 1.5), 0),
        ],
    )
    def test_none_behind_a_worse_one_is_chosen(self, means, chosen):
        trial = SettingsTrial(MODEL, lambda *_: [])
        weights = range(len(means))
        candidates = [Settings(Preprocessing(), strength=Strength(weight)) for weight in weights]
        trial.errors = lambda each: Errors(
            np.full((10, 1), means[each.strength.weight] ** 2), np.ones((10, 1))
        )
        decision = trial.decide_last("", candidates)
        assert decision.choice.chosen == chosen
        assert decision.settings is candidates[chosen]


class TestFolds:
    def test_a_segment_is_predicted_from_all_others(self):
        recording = a_recording()
        samples = prepare(recording, MODEL, options=Preprocessing(exclude_rows="slow"))
        folds = Folds.of(MODEL, [samples])
        values = truth()
        errors = folds.errors(lambda _: values, folds.predicted)
        edges = np.linspace(0, len(samples.torque), len(errors.squares) + 1).round().astype(int)
        error = samples.torque - samples.predicted_torque(MODEL, values)
        for k, part in enumerate(pairwise(edges)):
            expected = np.square(error[slice(*part)]).sum(axis=0)
            np.testing.assert_allclose(errors.squares[k], expected, rtol=1e-6)
            rows = samples.usable.copy()
            rows[slice(*part)] = False
            np.testing.assert_array_equal(folds.without(k).samples, rows.sum(axis=0))


class TestHeldOutRows:
    """The torque of held-out rows has no effect on any choice."""

    QUESTIONS = frozenset[Question](
        {"bandwidth", "presliding", "excluded rows", "friction", "estimator"}
    )

    @staticmethod
    def corrupted(recording):
        torque = recording.torque.copy()
        held_out = slice(cut(recording), None)
        torque[held_out] += 40.0 * np.sign(np.sin(7.0 * recording.time[held_out, None]))
        return replace(recording, torque=torque)

    def errors(self, recording, *, leaks):
        return [choice.errors for choice in chosen(recording, set(self.QUESTIONS), leaks=leaks)[1]]

    def test_changing_them_has_no_effect(self):
        recording = a_recording(duration=LONG)
        sound = self.errors(recording, leaks=False)
        assert sound == self.errors(self.corrupted(recording), leaks=False)

    def test_a_leak_would_be_detected(self):
        recording = a_recording(duration=LONG)
        sound = self.errors(recording, leaks=True)
        assert sound != self.errors(self.corrupted(recording), leaks=True)


def held_out_error(recording, settings):
    """Return ||tau - tau_hat|| / ||tau|| of the held-out rows."""
    model = MODEL.with_friction(**settings.friction)
    # Cut when filtered: a low-pass forwards that starts at the cut would not be that of the torque.
    samples = prepare(recording, model, options=settings.preprocessing)
    edges = 0, cut(recording), recording.n_samples
    fitted, held_out = (samples.between(*part) for part in pairwise(edges))
    values = estimate(model, Factor.of(model, fitted)).values
    error = held_out.torque - held_out.predicted_torque(model, values)
    return float(np.linalg.norm(error) / np.linalg.norm(held_out.torque))


def low_pass_of(shape, seed=0):
    """Return a filtered recording and the chosen settings."""
    questions = frozenset[Question]({"bandwidth", "presliding", "excluded rows", "low-pass"})
    recording = a_recording(noise=0.5 * NOISE, duration=LONG, shape=shape, seed=seed)
    return recording, chosen(recording, questions)[0]


@cache
def unfiltered_error():
    return held_out_error(*low_pass_of(None))


class TestLowPass:
    @pytest.mark.parametrize("causal", [False, True])
    @pytest.mark.parametrize("order", [1, 2, 4])
    def test_a_planted_one_is_found(self, order, causal):
        """Its bandwidth within 20 %; the error rises by at most 30 %."""
        recording, settings = low_pass_of(LowPassShape(order, causal))
        assert settings.preprocessing.torque_bandwidth == pytest.approx(BANDWIDTH, rel=0.2)
        assert settings.preprocessing.torque_shape.causal == causal
        assert held_out_error(recording, settings) < 1.3 * unfiltered_error()

    @pytest.mark.parametrize("shape", [LowPassShape(2), LowPassShape(2, causal=True)], ids=str)
    def test_a_filter_of_the_model_alone_is_none(self, shape, monkeypatch):
        """One that fits better for other reasons has no less torque above its bandwidth."""
        monkeypatch.setattr("identification.estimators.torque_channel._MIN_IMPROVEMENT", -np.inf)
        recording = a_recording(noise=0.5 * NOISE, duration=20.0)
        assert not possible_low_passes(recording, MODEL)
        filtered = a_recording(noise=0.5 * NOISE, duration=20.0, shape=shape)
        assert possible_low_passes(filtered, MODEL)

    @pytest.mark.parametrize("seed", range(3))
    def test_none_is_found_in_unfiltered_torque(self, seed):
        assert low_pass_of(None, seed)[1].preprocessing.torque_bandwidth is None


def late_by(recording, delay):
    """Return a recording whose torque is logged later [s]."""
    time = recording.time
    torque = [np.interp(time - delay, time, column) for column in recording.torque.T]
    return replace(recording, torque=np.column_stack(torque))


def with_pauses(shape):
    """Return three motions of 5 s with rests of 2 s between them, through a low-pass."""
    span = 5.0
    pause = 2.0
    count = 3
    time = np.arange(0.0, count * (span + pause), 1.0 / RATE)
    moving = time % (span + pause) < span
    # The time along the motion stands during a pause; the motion begins and ends at rest.
    along = np.cumsum(moving) / RATE
    rise = np.sin(np.pi * along / span) ** 4
    position = rise[:, None] * np.sin(along[:, None] * [5.0, 7.0] + np.array([0.0, 1.0]))
    velocity = np.gradient(position, time, axis=0)
    motion = Motion(time, position, velocity, np.gradient(velocity, time, axis=0))
    return a_recording(noise=0.5 * NOISE, shape=shape, motion=motion)


class TestPossibleLowPasses:
    """Filters that are found in the recording alone."""

    @staticmethod
    def of_kind(possible, causal):
        return [
            preprocessing
            for preprocessing in possible
            if preprocessing.torque_shape.causal == causal
        ]

    @pytest.mark.parametrize("shape", [*WITHOUT_PHASE[1:], *FORWARDS], ids=str)
    def test_bandwidth_and_poles_are_right(self, shape):
        recording = a_recording(noise=0.5 * NOISE, duration=20.0, shape=shape)
        (best,) = self.of_kind(possible_low_passes(recording, MODEL), shape.causal)
        assert best.torque_bandwidth == pytest.approx(BANDWIDTH, rel=0.03)
        assert best.torque_shape == shape

    @pytest.mark.parametrize("shape", [LowPassShape(2), LowPassShape(2, causal=True)], ids=str)
    def test_parts_of_a_recording_have_its_low_pass(self, shape, monkeypatch):
        """A table of the regressor is of one part at most."""
        monkeypatch.setattr("identification.estimators.torque_channel._MAX_SEGMENT_SECONDS", 6.0)
        rows = []
        evaluate = RegressorPlan.evaluate

        def counted(self, motion, *others):
            rows.append(motion.n_samples)
            return evaluate(self, motion, *others)

        monkeypatch.setattr(RegressorPlan, "evaluate", counted)
        recording = a_recording(noise=0.5 * NOISE, duration=20.0, shape=shape)
        (best,) = self.of_kind(possible_low_passes(recording, MODEL), shape.causal)
        assert best.torque_bandwidth == pytest.approx(BANDWIDTH, rel=0.05)
        assert max(rows) <= 6.0 * RATE

    @pytest.mark.parametrize("rate", [1000.0, 80.0])
    def test_the_rate_does_not_matter(self, rate):
        """At a higher rate rows are averaged."""
        shape = LowPassShape(order=2)
        motion = three_sines(2, duration=20.0, step=1.0 / rate)
        recording = a_recording(noise=0.5 * NOISE, motion=motion)
        sections = butter(2, BANDWIDTH, fs=rate, output="sos")
        filtered = replace(recording, torque=sosfiltfilt(sections, recording.torque, axis=0))
        (best,) = self.of_kind(possible_low_passes(filtered, MODEL), causal=False)
        assert best.torque_bandwidth == pytest.approx(BANDWIDTH, rel=0.05)
        assert best.torque_shape == shape

    def test_it_is_found_beside_a_delay(self):
        shape = LowPassShape(order=2)
        recording = late_by(a_recording(noise=0.5 * NOISE, duration=20.0, shape=shape), 0.03)
        how = Preprocessing(torque_delay=0.03)
        (best,) = self.of_kind(
            possible_low_passes(recording, MODEL, options=how, undelayed=0.0), causal=False
        )
        assert best.torque_delay == 0.03
        assert best.torque_bandwidth == pytest.approx(BANDWIDTH, rel=0.05)

    @pytest.mark.parametrize("delay", [0.0, 0.03])
    def test_a_delay_alone_is_none(self, delay):
        recording = late_by(a_recording(noise=0.5 * NOISE, duration=20.0), delay)
        how = Preprocessing(torque_delay=delay)
        assert not possible_low_passes(recording, MODEL, options=how, undelayed=0.0)

    @pytest.mark.parametrize("shape", [LowPassShape(2), LowPassShape(2, causal=True)], ids=str)
    def test_rests_and_gaps_do_not_matter(self, shape):
        paused = with_pauses(shape)
        whole = a_recording(noise=0.5 * NOISE, duration=20.0, shape=shape)
        gap = (whole.time > 9.0) & (whole.time < 10.0)
        for recording in (paused, whole.rows(~gap)):
            (best,) = self.of_kind(possible_low_passes(recording, MODEL), shape.causal)
            assert best.torque_bandwidth == pytest.approx(BANDWIDTH, rel=0.1)

    def test_times_may_be_uneven(self):
        shape = LowPassShape(order=2)
        recording = a_recording(noise=0.5 * NOISE, duration=20.0, shape=shape)
        rng = np.random.default_rng(7)
        time = recording.time + 0.3 / RATE * rng.uniform(-1.0, 1.0, recording.n_samples)
        uneven = replace(
            recording,
            time=time,
            position=CubicSpline(recording.time, recording.position)(time),
            torque=CubicSpline(recording.time, recording.torque)(time),
        )
        (best,) = self.of_kind(possible_low_passes(uneven, MODEL), causal=False)
        assert best.torque_bandwidth == pytest.approx(BANDWIDTH, rel=0.05)

    def test_an_arm_that_stands_shows_none(self):
        recording = a_recording()
        stands = replace(recording, position=np.zeros_like(recording.position))
        assert possible_low_passes(stands, MODEL) == ()


class TestLowPassShape:
    """Gain at the bandwidth: 1/2 without phase, 1/sqrt(2) if causal."""

    @pytest.mark.parametrize("shape", [*WITHOUT_PHASE, *FORWARDS], ids=str)
    def test_gain_at_the_bandwidth(self, shape):
        time = np.arange(4000) / RATE
        sine = np.sin(2.0 * np.pi * BANDWIDTH * time)[:, None]
        inner = low_passed(time, sine, BANDWIDTH, shape)[1000:3000]
        gain = inner.std() / sine[1000:3000].std()
        assert gain == pytest.approx(np.sqrt(0.5) if shape.causal else 0.5, rel=0.01)

    @pytest.mark.parametrize("shape", [*WITHOUT_PHASE, *FORWARDS], ids=str)
    @pytest.mark.parametrize("frequency", [1.0, 3.0, 5.0])
    def test_the_response_is_that_of_the_filter(self, shape, frequency):
        time = np.arange(8000) / (2.0 * RATE)
        turn = 2.0 * np.pi * frequency * time
        both = low_passed(time, np.column_stack([np.cos(turn), np.sin(turn)]), BANDWIDTH, shape)
        measured = ((both[:, 0] + 1j * both[:, 1]) * np.exp(-1j * turn))[3000:5000].mean()
        gain, _ = shape.response(np.array([frequency]), BANDWIDTH)
        assert gain[0] == pytest.approx(measured, abs=2e-3)

    @pytest.mark.parametrize("shape", [*WITHOUT_PHASE, *FORWARDS], ids=str)
    def test_its_lag_is_the_derivative_of_its_logarithm(self, shape):
        frequency = np.array([0.0, 1.0, 3.0, 20.0])
        step = 1e-4
        _, lag = shape.response(frequency, BANDWIDTH)
        before, after = (
            shape.response(frequency + sign * step, BANDWIDTH)[0] for sign in (-1.0, 1.0)
        )
        slope = np.log(after / before) / (4.0 * np.pi * step)
        assert lag == pytest.approx(1j * slope, abs=1e-6)
        if shape.causal:
            assert lag[0] == pytest.approx(shape.lag(BANDWIDTH))

    @pytest.mark.parametrize("order", [1, 2, 4])
    @pytest.mark.parametrize("count", [3, 40, 2407, 2408])
    def test_both_ways_is_the_filter_in_time(self, order, count):
        """Equal away from the ends, which it reflects over a whole length."""
        rng = np.random.default_rng(order)
        columns = np.cumsum(rng.standard_normal((count, 11)), axis=0)
        sections = butter(order, BANDWIDTH, fs=RATE, output="sos")
        reflected = np.concatenate([
            2.0 * columns[0] - columns[:0:-1], columns, 2.0 * columns[-1] - columns[-2::-1],
        ])  # fmt: skip
        expected = sosfiltfilt(sections, reflected, axis=0, padlen=0)[count - 1 : 2 * count - 1]
        filtered = low_passed(np.arange(count) / RATE, columns, BANDWIDTH, LowPassShape(order))
        inner = slice(count // 3, count - count // 3)
        size = np.abs(columns).max()
        if count > 1000:
            assert filtered == pytest.approx(expected, abs=1e-6 * size)
            assert filtered[inner] == pytest.approx(expected[inner], abs=1e-9 * size)
        # Reflected points stay; a reflection is cut where 1e-6 of the response is left.
        assert filtered[[0, -1]] == pytest.approx(columns[[0, -1]], abs=1e-6 * size)

    @pytest.mark.parametrize("order", [1, 2, 3, 4])
    @pytest.mark.parametrize("bandwidth", [0.2, 4.0, 60.0])
    def test_forwards_it_is_the_filter_of_scipy_from_rest(self, order, bandwidth):
        time = np.arange(600) / RATE
        columns = np.cumsum(np.random.default_rng(2).standard_normal((600, 3)), axis=0)
        sections = butter(order, bandwidth, fs=RATE, output="sos")
        expected = columns[0] + sosfilt(sections, columns - columns[0], axis=0)
        filtered = low_passed(time, columns, bandwidth, LowPassShape(order, causal=True))
        np.testing.assert_allclose(filtered, expected, rtol=0.0, atol=1e-9)

    @pytest.mark.parametrize("shape", WITHOUT_PHASE[1:], ids=str)
    def test_both_ways_leaves_a_line_as_it_is(self, shape):
        time = np.arange(500) / RATE
        line = (3.0 - 2.0 * time)[:, None]
        assert low_passed(time, line, BANDWIDTH, shape) == pytest.approx(line, abs=1e-12)

    def test_uneven_times_are_interpolated(self):
        time = np.arange(4000) / RATE
        uneven = time + 0.3 / RATE * np.random.default_rng(3).uniform(-1.0, 1.0, len(time))
        smooth, uneven_smooth = (
            low_passed(t, np.sin(4.0 * t)[:, None], BANDWIDTH, LowPassShape(2, causal=True))[:, 0]
            for t in (time, uneven)
        )
        expected = np.interp(uneven, time, smooth)
        assert uneven_smooth[500:-10] == pytest.approx(expected[500:-10], abs=2e-3)

    def test_samples_filter_their_regressor_by_it(self):
        shape = LowPassShape(order=1, causal=True)
        how = Preprocessing(torque_bandwidth=BANDWIDTH, torque_shape=shape)
        samples = prepare(a_recording(duration=20.0), MODEL, options=how)
        unfiltered = replace(samples, torque_bandwidth=None)
        expected = low_passed(
            samples.motion.time, unfiltered.predicted_torque(MODEL, truth()), BANDWIDTH, shape
        )
        assert samples.predicted_torque(MODEL, truth()) == pytest.approx(expected, abs=1e-9)
