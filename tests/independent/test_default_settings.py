"""`hil identify` with default settings, on arms and logs simulated without code of the project.

See `benchmarks.coverage`, which prints the same figures for any number of seeds.
"""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.coverage import ARM_TYPES, DEFAULTS, DELAYS, Conditions, Run, figures, run

SEEDS = (1, 2, 3)
QUADRATIC = DEFAULTS._replace(quadratic=True)

pytestmark = [pytest.mark.long, pytest.mark.slow]


def figures_of(delays: tuple[float, ...], conditions: Conditions) -> dict[str, Any]:
    """Of all arms and seeds; the same seed at several delays [ms] is one sample."""
    draws: list[list[Run]] = [
        [run(name, 1e-3 * delay, seed, conditions) for delay in delays]
        for name in ARM_TYPES
        for seed in SEEDS
    ]
    return figures(draws)


@pytest.fixture(scope="module")
def usual() -> dict[str, Any]:
    """Coulomb, viscous and offset, torque 0 to 10 ms late."""
    return figures_of(DELAYS, DEFAULTS)


@pytest.fixture(scope="module")
def quadratic() -> dict[str, Any]:
    """A term with the speed squared, stated in the archive; torque 1.3 ms late."""
    return figures_of((1.3,), QUADRATIC)


@pytest.mark.parametrize("conditions", ["usual", "quadratic"])
class TestDefaultSettings:
    @pytest.fixture
    def study(self, request: pytest.FixtureRequest, conditions: str) -> dict[str, Any]:
        return request.getfixturevalue(conditions)

    @pytest.mark.parametrize("kind", ["inertial", "friction"])
    def test_intervals_hold_93_to_98_percent(self, study: dict[str, Any], kind: str) -> None:
        """Within two standard errors of the share."""
        share = study[kind]
        unsure = study[f"{kind}_unsure"]
        assert 0.93 - unsure < share < 0.98 + unsure

    def test_every_stated_coefficient_is_estimated(self, study: dict[str, Any]) -> None:
        assert study["dropped"] == 0

    def test_the_delay_is_found_within_0_3_ms(self, study: dict[str, Any]) -> None:
        assert study["delay_near"] >= 0.95 * study["runs"]

    def test_nothing_is_blamed_that_is_not_there(self, study: dict[str, Any]) -> None:
        assert study["false_causes"] == {}


@pytest.mark.parametrize("load", [0.02, 0.1])
def test_friction_that_grows_with_load_is_no_delay(load: float) -> None:
    """The law without it has a delay of some ms as its least error."""
    outcome = run("panda", 0.0, 1, DEFAULTS._replace(load=load))
    assert outcome.delay_error == [0.0] * 7 and not outcome.blamed
    assert outcome.good and outcome.dropped == 0
