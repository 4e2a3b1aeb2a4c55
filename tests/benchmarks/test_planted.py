"""The study of planted faults: each changes what it says of a log and nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.coverage import ARM_TYPES, DEFAULTS, Logged, drawn_arm, logged
from benchmarks.planted import CASES, Outcome, Plant, figures, planted

pytestmark = pytest.mark.long

JOINT = 2
OTHERS = [0, 1, 3, 4, 5]
ARM = drawn_arm(ARM_TYPES["ns16"], 1)
DURATION = 6.0


def log_of(plant: Plant, part: int = 0) -> Logged:
    return planted(ARM, plant, 1, part, DURATION)


class TestFaults:
    def test_without_one_it_is_the_log_of_the_study_of_coverage(self) -> None:
        plain = logged(ARM, 1, 0, DURATION, 0.0, DEFAULTS)
        assert np.array_equal(log_of(Plant()).torque, plain.torque)
        assert np.array_equal(log_of(Plant()).position, plain.position)

    def test_an_encoder_zero_moves_one_position(self) -> None:
        plain, moved = log_of(Plant()), log_of(Plant(zero=0.05))
        assert moved.position[:, JOINT] == pytest.approx(plain.position[:, JOINT] + 0.05)
        assert np.array_equal(moved.position[:, OTHERS], plain.position[:, OTHERS])
        assert np.array_equal(moved.torque, plain.torque)

    @pytest.mark.parametrize(("part", "factor"), [(0, 1.0), (1, 1.5)])
    def test_a_constant_of_the_second_log_changes_that(self, part: int, factor: float) -> None:
        plain, changed = log_of(Plant(), part), log_of(Plant(gain_second=1.5), part)
        assert changed.torque[:, JOINT] == pytest.approx(factor * plain.torque[:, JOINT])
        assert np.array_equal(changed.torque[:, OTHERS], plain.torque[:, OTHERS])

    def test_friction_rises_in_the_second_half(self) -> None:
        plain, risen = log_of(Plant()), log_of(Plant(friction_later=0.3))
        more = risen.torque - plain.torque
        late = plain.time >= 0.5 * DURATION
        assert not more[~late].any()
        # At least that share of dry friction, but beside reversals and at rest.
        share = np.median(np.abs(more[late]) / ARM.friction.coulomb, axis=0)
        assert np.all(share > 0.3)

    def test_static_friction_opposes_slow_motion(self) -> None:
        plain, sticky = log_of(Plant()), log_of(Plant(stribeck=0.4))
        more = np.abs(sticky.torque - plain.torque)
        assert np.all(more <= 0.4 * ARM.friction.coulomb + 1e-9)
        assert more.max() > 0.0


SAID = Outcome(
    applied=0.0,
    half=3e-4,
    blamed=(),
    factor=None,
    factor_half=None,
    good=True,
    error=0.02,
    true_factor=1.0,
    seconds=3.0,
)


def test_figures_count_what_is_said() -> None:
    late = CASES["1.3 ms"]
    found = SAID._replace(applied=1.2e-3)
    wrong = SAID._replace(applied=1e-3, half=2e-3)
    scaled = SAID._replace(factor=1.52, factor_half=0.03, true_factor=1.5)
    counted = figures([(late, found), (late, SAID), (Plant(), wrong), (Plant(), scaled)])
    assert counted == {
        "runs": 4,
        "near": 2,
        "false": 1,
        "missed": 1,
        "doubtful": 1,
        "intervals": 4,
        "held": 3,
        "named": 1,
        "factor_held": 1,
    }
