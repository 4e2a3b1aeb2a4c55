"""Files of a tier that is left out are not imported, and nothing else is left out with them."""

from __future__ import annotations

import pytest

from tests.conftest import excluded_tiers, tiers_of


@pytest.mark.parametrize(
    ("expression", "excluded"),
    [
        ("", set()),
        ("slow", set()),
        ("safety and not slow", {"slow"}),
        ("not slow and not safety and not long", {"slow", "safety", "long"}),
        ("not slow or safety", set()),
        ("not (slow and long)", set()),
    ],
)
def test_a_tier_is_excluded_where_no_test_of_it_can_run(
    expression: str, excluded: set[str]
) -> None:
    assert excluded_tiers(expression) == excluded


@pytest.mark.parametrize(
    ("module", "tiers"),
    [
        ("import pytest\n", set()),
        ("pytestmark = pytest.mark.long\n", {"long"}),
        ("pytestmark = [pytest.mark.long, pytest.mark.slow]\n", {"long", "slow"}),
        ("@pytest.mark.slow\ndef test_this() -> None: ...\n", set()),
        ("class TestThis:\n    pytestmark = pytest.mark.slow\n", set()),
    ],
)
def test_the_tier_of_a_file_is_that_of_all_its_tests(module: str, tiers: set[str]) -> None:
    assert tiers_of(module) == tiers
