"""Loads on a simulated NS 16, friction drifting by 4 % between the recordings."""

from __future__ import annotations

import pytest

from benchmarks.payload import Coverage, arm_model, coverage, load_of, runs_of
from identification.estimators.payload import find_difference


def worst_and_least(found: Coverage) -> tuple[float, float]:
    return found.worst, min(*found.covered.values(), found.moment_covered)


class TestLoads:
    def test_a_few_loads_are_weighed_within_two_percent(self) -> None:
        """Of 8 with 95 %, fewer than 5 inside come once in some hundred times, of one figure."""
        worst, least = worst_and_least(coverage(range(1000, 1008)))
        assert worst < 0.02
        assert least >= 0.5

    @pytest.mark.slow
    def test_of_200_loads_intervals_hold_90_to_99_percent(self) -> None:
        found = coverage(range(200))
        assert found.mass_error < 0.01
        assert found.within_one_percent > 0.9
        for figure, share in {**found.covered, "moment": found.moment_covered}.items():
            assert 0.90 <= share <= 0.99, figure

    def test_pairs_of_one_load_do_not_differ(self) -> None:
        """A, B, B, A: nothing is refused that is one load."""
        model, load = arm_model(), load_of(3)
        runs = runs_of(3, model, loads=(None, load, load, None))
        assert find_difference(model, runs) is None
