"""What is said of torque ripple and of friction that changed: nothing, a word, or a doubt."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from identification.validation.findings.residual import over_motor_angle, over_time
from identification.validation.residual_blocks import BlockMean
from identification.validation.residual_checks import HARMONICS, FrictionDrift, Ripple
from identification.validation.thresholds import Thresholds

NAMES = ("shoulder", "elbow")
LIMIT = Thresholds()
TORQUE = np.array([10.0, 10.0])


def evidence(ripple=None, drift=None, friction_share=None) -> SimpleNamespace:
    checks = SimpleNamespace(
        ripple=ripple,
        drift=drift,
        friction_share=friction_share,
        rms=0.05 * TORQUE,
        torque_rms=TORQUE,
        share=lambda size: size / TORQUE,
    )
    return SimpleNamespace(residuals=checks)


def ripple(share: float) -> Ripple:
    """Of the elbow's torque, four times per motor turn."""
    mean = np.zeros((2, len(HARMONICS), 2))
    mean[1, HARMONICS.index(4), 0] = np.sqrt(2.0) * share * TORQUE[1]
    std = np.full_like(mean, 1e-6)
    return Ripple(BlockMean(mean, std, np.full(2, 1000.0), np.full(2, 50)))


def drift(*change: float) -> FrictionDrift:
    """From the first of ten pieces to the last; the scatter is small."""
    total = np.array(change)
    return FrictionDrift(np.linspace(0.0, 1.0, 10)[:, None] * total, total, np.full(2, 1e-4), 8)


@pytest.mark.parametrize("look", [over_motor_angle, over_time])
def test_what_was_not_looked_at_is_not_spoken_of(look):
    assert list(look(NAMES, evidence(), LIMIT)) == []
    assert list(look(NAMES, SimpleNamespace(residuals=None), LIMIT)) == []


class TestRipple:
    def found(self, share: float):
        [finding] = over_motor_angle(NAMES, evidence(ripple(share)), LIMIT)
        return finding

    def test_none_is_good(self):
        assert self.found(0.0).level == "good"

    def test_a_small_one_is_usual_and_a_large_one_a_doubt(self):
        assert self.found(0.9 * LIMIT.ripple).level == "information"
        large = self.found(1.1 * LIMIT.ripple)
        assert large.level == "doubtful"
        assert "elbow (4 per motor turn, 3.3% of its torque)" in large.words
        assert "shoulder" not in large.words


class TestDrift:
    def found(self, *change: float, share=None):
        [finding] = over_time(NAMES, evidence(drift=drift(*change), friction_share=share), LIMIT)
        return finding

    def test_none_that_stands_out_is_good(self):
        assert self.found(1e-5, -1e-5).level == "good"

    def test_one_that_is_little_torque_is_mentioned(self):
        little = self.found(0.02, 0.0)
        assert little.level == "information"
        assert "shoulder by 2.0% up; that is at most 2.0% of an axis's torque" in little.words
        weighted = self.found(0.1, 0.0, share=np.array([0.2, 1.0]))
        assert weighted.level == "information"
        assert "at most 2.0%" in weighted.words

    def test_a_large_one_is_a_doubt_and_named_with_its_direction(self):
        large = self.found(0.02, -0.2)
        assert (large.level, large.role) == ("doubtful", "cause")
        assert large.words.endswith("elbow by 20.0% down")
