"""Settings are chosen by predicting parts of the fitted data from the rest."""

from dataclasses import replace

import numpy as np
import pytest

from identification.model.elements import TorqueRipple
from identification.selection.inner_prediction import (
    DELAY,
    LOW_PASS,
    Question,
    Settings,
    choose_settings,
)
from identification.signals.recording import Recording
from identification.signals.samples import Preprocessing, prepare
from identification.signals.smoothing import LowPassShape, low_passed
from tests.identification.two_link import MODEL, a_motion, truth

CAUSAL = LowPassShape(order=2, causal=True)
CUT = 1400  # of 2000 rows: what is fitted


def a_recording(model=MODEL, values=None):
    """Simulate a motion of the arm with noise on torque and position."""
    motion = a_motion()
    direction = model.friction.direction(*motion[:3])
    rng = np.random.default_rng(5)
    torque = model.torque(truth() if values is None else values, *motion[1:4], direction)
    return Recording(
        motion.time,
        motion.position + 1e-6 * rng.standard_normal(motion.position.shape),
        MODEL.joint_names,
        torque + 0.05 * rng.standard_normal(torque.shape),
    )


def chosen(recording, questions, *, leaks=False, ripple=(), low_passes=()):
    """Choose settings on the rows before CUT, or on all of them with a leak."""

    def ready(model, how):
        samples = prepare(recording, model, options=how)
        return [samples if leaks else samples.between(0, CUT)]

    start = Settings(MODEL, Preprocessing())
    return choose_settings(ready, start, questions, lambda *_: low_passes, ripples=[ripple])


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
        position[: CUT // 4, 0] = position[CUT // 4, 0]
        rested = replace(recording, position=position)
        _, choices = chosen(rested, {"presliding", "rows", "estimator"})
        assert [one.name for one in choices][-1] == "estimator"
        assert all(np.isfinite(one.errors).all() for one in choices)

    def test_other_settings_stay(self):
        start = Settings(MODEL, Preprocessing(rigid_bandwidth=33.0))
        settings, choices = choose_settings(lambda *_: [], start, set(), lambda *_: 1.0)
        assert settings == start
        assert not choices


class TestHeldOutRows:
    """The torque of held-out rows has no effect on any choice."""

    QUESTIONS = frozenset[Question]({"bandwidth", "presliding", "rows", "friction", "estimator"})

    @staticmethod
    def corrupted(recording):
        torque = recording.torque.copy()
        torque[CUT:] += 40.0 * np.sign(np.sin(7.0 * recording.time[CUT:, None]))
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
