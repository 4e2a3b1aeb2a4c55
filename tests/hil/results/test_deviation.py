"""How far an estimate is from the truth of a simulated arm."""

from __future__ import annotations

import pytest

from hil.results.results import ParameterResult


def parameter(absolute_std: float | None) -> ParameterResult:
    return ParameterResult(
        name="m1", expression="m1", unit="kg", table2_id=None, estimate=0.95, std=0.003,
        repetition_mean=0.95, repetition_std=None, truth=1.0, absolute_std=absolute_std,
    )  # fmt: skip


@pytest.mark.parametrize("absolute_std", [None, 0.003])
def test_without_an_uncertain_torque_scale_it_is_in_std(absolute_std: float | None) -> None:
    found = parameter(absolute_std)
    assert found.deviation == pytest.approx(-0.05 / 0.003)
    assert found.outside == "out3"


def test_an_uncertain_torque_scale_is_allowed_for() -> None:
    """Torque constants that are 5 % off, known to 5 %: masses are 5 % off, and no surprise."""
    found = parameter(0.05)
    assert found.deviation == pytest.approx(-1.0)
    assert not found.outside


def test_of_another_estimate_the_scale_is_the_same() -> None:
    found = parameter(0.05)
    assert found.deviation_of(0.95, 0.003) == found.deviation
    assert found.deviation_of(0.95, 0.1) == pytest.approx(-0.05 / (0.1**2 + 0.05**2) ** 0.5, 1e-3)
