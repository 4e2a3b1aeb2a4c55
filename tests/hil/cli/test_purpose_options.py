"""Options of what a model has to be good for."""

import pytest

from hil.base.errors import InputError
from hil.cli.purpose_options import Required, quantity


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [("50N", "N", 50.0), ("50", "N", 50.0), ("500 g", "kg", 0.5), ("2mm", "m", 2e-3)],
)
def test_quantities_have_units(text: str, unit: str, value: float) -> None:
    assert quantity(text, unit, "--contact") == pytest.approx(value)


@pytest.mark.parametrize("text", ["50 kg", "N", "-3N", "0", "nan", "1e999N", "", "5..N"])
def test_what_is_no_force_is_refused_with_the_option(text: str) -> None:
    with pytest.raises(InputError, match="--contact"):
        quantity(text, "N", "--contact")


def test_purposes_and_limits_become_options() -> None:
    options = Required(["gravity", "contact"], contact="40N", flange_error="2mm").options()
    assert options["purposes"] == ("gravity", "contact")
    assert options["required"].contact == 40.0
    assert options["required"].distance == pytest.approx(2e-3)


@pytest.mark.parametrize("names", [["gravitation"], ["contact"], ["payload"], ["parameters"]])
def test_a_purpose_that_cannot_be_judged_is_refused(names: list[str]) -> None:
    with pytest.raises(InputError, match="--for"):
        Required(names).options()
