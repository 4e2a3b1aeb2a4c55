"""Which limits a guard can be made of."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import Guard, GuardLimits
from tests.drivers.rig import N, limits


class TestLimits:
    @pytest.mark.parametrize(
        "name",
        ["lower", "upper", "velocity", "acceleration", "jerk", "following_error", "current"],
    )
    def test_each_has_one_finite_number_per_joint(self, name):
        wrongs = (np.full(N - 1, 1.0), np.full((N, 1), 1.0), np.append(np.ones(N - 1), np.inf))
        for wrong in wrongs:
            if name == "lower" and wrong.shape == (N - 1,):
                continue  # it says how many joints there are
            with pytest.raises(ValueError, match=f"{name} must be {N} finite numbers"):
                limits(**{name: wrong})

    @pytest.mark.parametrize(
        "name", ["velocity", "acceleration", "jerk", "following_error", "current"]
    )
    def test_magnitudes_are_positive_in_every_joint(self, name):
        for value in (0.0, -1.0):
            wrong = np.full(N, 1.0)
            wrong[3] = value
            with pytest.raises(ValueError, match=f"{name} must be positive"):
                limits(**{name: wrong})

    def test_a_range_is_not_empty_in_any_joint(self):
        upper = np.full(N, 2.0)
        upper[4] = -2.0
        with pytest.raises(ValueError, match="is not below"):
            limits(upper=upper)

    @pytest.mark.parametrize("name", ["standstill", "current_rise"])
    def test_other_figures_are_positive(self, name):
        for value in (0.0, -1.0, np.nan):
            with pytest.raises(ValueError, match=f"{name} {value} is not positive"):
                limits(**{name: value})
        limits(**{name: 1e-9})

    @pytest.mark.parametrize("what", ["acceleration", "jerk"])
    def test_the_sets_of_bounds_widen_from_plan_to_override_to_stop(self, what):
        ordered = limits(**{f"override_{what}": 1.0, f"stop_{what}": 1.0})
        assert getattr(ordered, f"override_{what}") == 1.0
        for override, stop in ((0.99, 1.5), (1.5, 1.49), (np.nan, 2.0), (1.2, np.nan)):
            with pytest.raises(ValueError, match="factors 1 <="):
                limits(**{f"override_{what}": override, f"stop_{what}": stop})

    def test_they_are_taken_as_they_are_and_cannot_be_changed_from_outside(self):
        velocity = np.full(N, 2.0)
        taken = limits(velocity=velocity, jerk=[100] * N)
        velocity[:] = 9.0
        np.testing.assert_array_equal(taken.velocity, np.full(N, 2.0))
        assert taken.jerk.dtype == np.float64
        assert taken.n_joints == N

    def test_one_joint_is_enough(self):
        one = np.ones(1)
        assert GuardLimits(-one, one, one, one, one, one, one).n_joints == 1

    @pytest.mark.parametrize("period", [0.0, -0.002, np.nan])
    def test_a_period_has_to_be_positive(self, period):
        with pytest.raises(ValueError, match="is not positive"):
            Guard(limits(), period)
