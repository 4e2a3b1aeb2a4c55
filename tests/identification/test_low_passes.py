"""A low-pass in the recorded torque is found for each shape."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter, sosfilt, sosfiltfilt

from identification.estimators.torque_channel import possible_low_passes
from identification.factor.factor import Factor, estimate
from identification.selection.inner_prediction import Question, Settings, choose_settings
from identification.signals.recording import Recording
from identification.signals.samples import Preprocessing, prepare
from identification.signals.smoothing import FORWARDS, WITHOUT_PHASE, LowPassShape, low_passed
from tests.identification.two_link import MODEL, NOISE, a_motion, truth

CUT = 2800  # of 4000 rows: what is fitted
RATE = 200.0  # Hz
BANDWIDTH = 3.0  # Hz
QUESTIONS = frozenset[Question]({"bandwidth", "presliding", "rows", "low-pass"})


def a_recording(shape, *, seed=0):
    """Simulate a motion with noisy torque through a Butterworth low-pass."""
    motion, rng = a_motion(4000 / RATE), np.random.default_rng(seed)
    torque = MODEL.torque(truth(), *motion[1:4])
    torque += 0.5 * NOISE * rng.standard_normal(torque.shape)
    if shape is not None:
        sections = butter(shape.order, BANDWIDTH, fs=RATE, output="sos")
        run = sosfilt if shape.causal else sosfiltfilt
        torque = run(sections, torque, axis=0)
    position = motion.position + 1e-6 * rng.standard_normal(torque.shape)
    return Recording(motion.time, position, MODEL.joint_names, torque)


def chosen(recording):
    """Choose settings on the rows before CUT."""
    fitted = recording.between(0, CUT)

    def ready(model, how):
        return [prepare(fitted, model, options=how)]

    def low_passes(model, how):
        return possible_low_passes(fitted, model, options=how)

    return choose_settings(ready, Settings(MODEL, Preprocessing()), QUESTIONS, low_passes)[0]


def held_out_error(recording, settings):
    """Return ||tau - tau_hat|| / ||tau|| after CUT."""
    model = settings.model
    fitted, rest = (
        prepare(recording.between(*part), model, options=settings.preprocessing)
        for part in ((0, CUT), (CUT, recording.n_samples))
    )
    values = estimate(model, Factor.of(model, fitted)).values
    error = rest.torque - rest.predicted_torque(model, values)
    return float(np.linalg.norm(error) / np.linalg.norm(rest.torque))


@pytest.fixture(scope="module")
def unfiltered_error():
    recording = a_recording(None)
    return held_out_error(recording, chosen(recording))


class TestPlantedLowPass:
    """The bandwidth is found within 20 %; the error rises by at most 30 %."""

    @pytest.mark.parametrize("causal", [False, True])
    @pytest.mark.parametrize("order", [1, 2, 4])
    def test_it_is_found(self, order, causal, unfiltered_error):
        recording = a_recording(LowPassShape(order, causal))
        settings = chosen(recording)
        assert settings.preprocessing.torque_bandwidth == pytest.approx(BANDWIDTH, rel=0.2)
        assert settings.preprocessing.torque_shape.causal == causal
        assert held_out_error(recording, settings) < 1.3 * unfiltered_error


class TestNoLowPass:
    """Unfiltered torque is used as it is."""

    @pytest.mark.parametrize("seed", range(3))
    def test_none_is_found(self, seed):
        assert chosen(a_recording(None, seed=seed)).preprocessing.torque_bandwidth is None


class TestLowPassShape:
    """Gain at the bandwidth: 1/2 without phase, 1/sqrt(2) if causal."""

    @pytest.mark.parametrize("shape", [*WITHOUT_PHASE, *FORWARDS], ids=str)
    def test_gain_at_the_bandwidth(self, shape):
        time = np.arange(4000) / RATE
        sine = np.sin(2.0 * np.pi * BANDWIDTH * time)[:, None]
        inner = low_passed(time, sine, BANDWIDTH, shape)[1000:3000]
        gain = inner.std() / sine[1000:3000].std()
        assert gain == pytest.approx(np.sqrt(0.5) if shape.causal else 0.5, rel=0.01)

    def test_uneven_times_are_interpolated(self):
        time = np.arange(4000) / RATE
        uneven = time + 0.3 / RATE * np.random.default_rng(3).uniform(-1.0, 1.0, len(time))
        shape = LowPassShape(order=2, causal=True)
        smooth = low_passed(time, np.sin(4.0 * time)[:, None], BANDWIDTH, shape)
        found = low_passed(uneven, np.sin(4.0 * uneven)[:, None], BANDWIDTH, shape)
        expected = np.interp(uneven, time, smooth[:, 0])
        assert found[500:-10, 0] == pytest.approx(expected[500:-10], abs=2e-3)

    def test_samples_filter_their_regressor_by_it(self):
        shape = LowPassShape(order=1, causal=True)
        how = Preprocessing(torque_bandwidth=BANDWIDTH, torque_shape=shape)
        samples = prepare(a_recording(None), MODEL, options=how)
        unfiltered = replace(samples, torque_bandwidth=None)
        expected = low_passed(
            samples.motion.time, unfiltered.predicted_torque(MODEL, truth()), BANDWIDTH, shape
        )
        assert samples.predicted_torque(MODEL, truth()) == pytest.approx(expected, abs=1e-9)
