"""Settings are chosen by predicting parts of the fitted data from the rest."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.signal import butter, sosfilt, sosfiltfilt

from identification import Factor, Preprocessing, Recording, estimate, prepare
from identification.estimators.torque_channel import possible_low_passes
from identification.model.elements import TorqueRipple
from identification.selection.inner_prediction import (
    DELAY,
    LOW_PASS,
    Question,
    Settings,
    choose_settings,
)
from identification.signals.smoothing import FORWARDS, WITHOUT_PHASE, LowPassShape, low_passed
from tests.identification.two_link import MODEL, NOISE, a_motion, truth

CAUSAL = LowPassShape(order=2, causal=True)
RATE = 200.0  # Hz
BANDWIDTH = 3.0  # Hz


def a_recording(model=MODEL, values=None, *, noise=0.05, duration=10.0, shape=None, seed=5):
    """Simulate a motion with noise on torque and position, through a Butterworth low-pass."""
    motion = a_motion(duration)
    direction = model.friction.direction(*motion[:3])
    rng = np.random.default_rng(seed)
    torque = model.torque(truth() if values is None else values, *motion[1:4], direction)
    position = motion.position + 1e-6 * rng.standard_normal(torque.shape)
    torque += noise * rng.standard_normal(torque.shape)
    if shape is not None:
        sections = butter(shape.order, BANDWIDTH, fs=RATE, output="sos")
        torque = (sosfilt if shape.causal else sosfiltfilt)(sections, torque, axis=0)
    return Recording(motion.time, position, MODEL.joint_names, torque)


def cut(recording):
    """Return the number of rows that are fitted."""
    return round(0.7 * recording.n_samples)


def chosen(recording, questions, *, leaks=False, ripple=(), low_passes=None):
    """Choose settings on the fitted rows, or on all of them with a leak."""
    fitted = recording if leaks else recording.between(0, cut(recording))

    def ready(model, how):
        return [prepare(fitted, model, options=how)]

    def possible(model, how):
        return possible_low_passes(fitted, model, options=how) if low_passes is None else low_passes

    start = Settings(MODEL, Preprocessing())
    return choose_settings(ready, start, questions, possible, ripples=[ripple])


class TestChosenSettings:
    @pytest.mark.parametrize("distance", [1e-4, 1e-3])
    def test_the_true_presliding_is_found(self, distance):
        recording = a_recording(MODEL.with_friction(presliding=distance))
        settings, _ = chosen(recording, {"presliding", "bandwidth"})
        assert settings.model.friction.laws[0].presliding == distance

    def test_the_true_friction_term_is_found(self):
        cubic = MODEL.with_friction(third="cubic")
        settings, _ = chosen(a_recording(cubic, np.append(truth(), [0.5, 0.3])), {"friction"})
        assert settings.model.friction.laws[0].third == "cubic"

    def test_no_friction_term_is_added_without_cause(self):
        settings, _ = chosen(a_recording(), {"friction"})
        assert settings.model.friction.laws[0].third is None

    def test_torque_ripple_is_estimated_only_if_present(self):
        ripple = [TorqueRipple(name, ((name, 40.0),), (2,)) for name in MODEL.joint_names]
        rippled = MODEL.with_elements(ripple)
        strong = a_recording(rippled, np.append(truth(), [0.0, 0.4, 0.3, 0.0]))
        settings, _ = chosen(strong, {"ripple"}, ripple=ripple)
        assert settings.model.parameter_names == rippled.parameter_names
        settings, _ = chosen(a_recording(), {"ripple"}, ripple=ripple)
        assert settings.model.parameter_names == MODEL.parameter_names

    @pytest.mark.parametrize(("shape", "name"), [(None, DELAY), (CAUSAL, LOW_PASS)])
    def test_a_delay_is_not_called_a_low_pass(self, shape, name):
        """Delay and low-pass of equal lag each predict best where they are the cause."""
        recording = a_recording()
        time, torque = recording.time, recording.torque
        if shape is None:
            late = [np.interp(time - CAUSAL.lag(6.0), time, one) for one in torque.T]
            changed = replace(recording, torque=np.column_stack(late))
        else:
            changed = replace(recording, torque=low_passed(time, torque, 6.0, shape))
        filtered = Preprocessing(torque_bandwidth=6.0, torque_shape=CAUSAL)
        settings, choices = chosen(changed, {"low-pass"}, low_passes=(filtered,))
        assert name in [one.name for one in choices if one.chosen]
        assert (settings.preprocessing.torque_bandwidth is None) == (name == DELAY)

    def test_least_squares_stays_if_it_predicts_equally(self):
        settings, choices = chosen(a_recording(), {"estimator"})
        assert settings.shrinkage.strength == 0.0
        assert choices[-1].candidates[choices[-1].chosen] == "least squares"

    def test_a_joint_may_rest_in_some_segments(self):
        """Joints that move one after the other have segments without rows."""
        recording = a_recording()
        position = recording.position.copy()
        position[:350, 0] = position[350, 0]
        rested = replace(recording, position=position)
        _, choices = chosen(rested, {"presliding", "rows", "estimator"})
        assert [one.name for one in choices][-1] == "estimator"
        assert all(np.isfinite(one.errors).all() for one in choices)


class TestHeldOutRows:
    """The torque of held-out rows has no effect on any choice."""

    QUESTIONS = frozenset[Question]({"bandwidth", "presliding", "rows", "friction", "estimator"})

    @staticmethod
    def corrupted(recording):
        torque = recording.torque.copy()
        rest = slice(cut(recording), None)
        torque[rest] += 40.0 * np.sign(np.sin(7.0 * recording.time[rest, None]))
        return replace(recording, torque=torque)

    def errors(self, recording, *, leaks):
        return [one.errors for one in chosen(recording, set(self.QUESTIONS), leaks=leaks)[1]]

    def test_changing_them_has_no_effect(self):
        recording = a_recording()
        sound = self.errors(recording, leaks=False)
        assert sound == self.errors(self.corrupted(recording), leaks=False)

    def test_a_leak_would_be_detected(self):
        recording = a_recording()
        sound = self.errors(recording, leaks=True)
        assert sound != self.errors(self.corrupted(recording), leaks=True)


def held_out_error(recording, settings):
    """Return ||tau - tau_hat|| / ||tau|| of the held-out rows."""
    model = settings.model
    fitted, rest = (
        prepare(recording.between(*part), model, options=settings.preprocessing)
        for part in ((0, cut(recording)), (cut(recording), recording.n_samples))
    )
    values = estimate(model, Factor.of(model, fitted)).values
    error = rest.torque - rest.predicted_torque(model, values)
    return float(np.linalg.norm(error) / np.linalg.norm(rest.torque))


def low_pass_of(shape, seed=0):
    """Return a filtered recording and the chosen settings."""
    questions = frozenset[Question]({"bandwidth", "presliding", "rows", "low-pass"})
    recording = a_recording(noise=0.5 * NOISE, duration=20.0, shape=shape, seed=seed)
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

    @pytest.mark.parametrize("seed", range(3))
    def test_none_is_found_in_unfiltered_torque(self, seed):
        assert low_pass_of(None, seed)[1].preprocessing.torque_bandwidth is None


class TestLowPassShape:
    """Gain at the bandwidth: 1/2 without phase, 1/sqrt(2) if causal."""

    @pytest.mark.parametrize("shape", [*WITHOUT_PHASE, *FORWARDS], ids=str)
    def test_gain_at_the_bandwidth(self, shape):
        time = np.arange(4000) / RATE
        sine = np.sin(2.0 * np.pi * BANDWIDTH * time)[:, None]
        inner = low_passed(time, sine, BANDWIDTH, shape)[1000:3000]
        gain = inner.std() / sine[1000:3000].std()
        assert gain == pytest.approx(np.sqrt(0.5) if shape.causal else 0.5, rel=0.01)

    def test_samples_filter_their_regressor_by_it(self):
        shape = LowPassShape(order=1, causal=True)
        how = Preprocessing(torque_bandwidth=BANDWIDTH, torque_shape=shape)
        samples = prepare(a_recording(duration=20.0), MODEL, options=how)
        unfiltered = replace(samples, torque_bandwidth=None)
        expected = low_passed(
            samples.motion.time, unfiltered.predicted_torque(MODEL, truth()), BANDWIDTH, shape
        )
        assert samples.predicted_torque(MODEL, truth()) == pytest.approx(expected, abs=1e-9)
