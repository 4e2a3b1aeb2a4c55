from __future__ import annotations

import math

import numpy as np
import pytest

from identification.errors import ModelError
from identification.model.friction import TERMS, FrictionLaw, FrictionTerm, Stribeck

SPEED = np.array([-2.0, -1e-9, 0.0, 1e-9, 0.5])


def columns(law: FrictionLaw) -> np.ndarray:
    return law.columns(SPEED, law.sign(SPEED))


def test_the_default_law_is_coulomb_viscous_and_quadratic() -> None:
    law = FrictionLaw()
    assert law.symbols == ("f0", "f1", "f2")
    assert np.array_equal(columns(law)[0], [-1, -1, 0, 1, 1])
    assert np.array_equal(columns(law)[1], SPEED)
    assert np.allclose(columns(law)[2], [-4.0, -1e-18, 0.0, 1e-18, 0.25], rtol=1e-15)


def test_the_sign_has_no_dead_zone() -> None:
    # Standstill is left to the mask; a dead zone here would fit it silently.
    assert columns(FrictionLaw(standstill=1.0))[0][3] == 1.0


def test_the_cubic_third_term_and_the_offset() -> None:
    law = FrictionLaw(coulomb=False, viscous=False, third="cubic", offset=True)
    assert law.symbols == ("f2", "fo")
    assert np.allclose(columns(law)[0], SPEED**3, rtol=1e-15)
    assert np.array_equal(columns(law)[1], np.ones(5))


def test_a_law_without_any_term_has_no_columns() -> None:
    law = FrictionLaw(coulomb=False, viscous=False, third=None)
    assert law.symbols == ()


@pytest.mark.parametrize(
    ("third", "revolute", "unit"),
    [
        ("quadratic", True, "N·m·s²/rad²"),
        ("cubic", True, "N·m·s³/rad³"),
        ("quadratic", False, "N·s²/m²"),
    ],
)
def test_units_follow_the_term_and_the_joint(third: str, revolute: bool, unit: str) -> None:
    law = FrictionLaw(third=third)  # type: ignore[arg-type]
    assert law.terms[-1].unit(revolute=revolute) == unit


def test_a_joint_moves_above_the_standstill_speed_in_either_direction() -> None:
    law = FrictionLaw(standstill=0.01)
    speeds = np.array([[0.0, 0.01], [0.011, -0.02]])
    assert law.moving(speeds).tolist() == [[False, False], [True, True]]


@pytest.mark.parametrize("speed", [-1.0, np.nan, np.inf])
def test_a_senseless_standstill_speed_is_refused(speed: float) -> None:
    with pytest.raises(ModelError, match="standstill"):
        FrictionLaw(standstill=speed)


def test_an_unknown_third_term_is_refused_with_what_is_known() -> None:
    with pytest.raises(ModelError, match=r"quadratic.*cubic"):
        FrictionLaw(third="stribeck")  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", TERMS)
class TestFrictionTerms:
    """Each term is one column, in whatever form it is written."""

    SPEED = np.array([-2.0, -0.3, 0.1, 0.7])
    STEP = 1e-6

    def test_source_code_computes_the_column(self, kind: type[FrictionTerm]) -> None:
        term = kind(0.4)
        names = {f"{kind.label.upper()}_SPEED": [term.speed], "joint": 0}
        names |= {"E": math.e, "tanh": math.tanh}
        code = [eval("1.0" + kind.code, {"v": v, "sign": np.sign(v), **names}) for v in self.SPEED]
        np.testing.assert_allclose(code, term.column(self.SPEED, np.sign(self.SPEED)), rtol=1e-14)

    def test_slope_is_the_derivative_of_the_column(self, kind: type[FrictionTerm]) -> None:
        """At a speed that the direction has no part in; the fall of Stribeck's is left out."""
        if kind is Stribeck:
            return
        sign, term = np.sign(self.SPEED), kind(0.4)
        above, below = (term.column(self.SPEED + d, sign) for d in (self.STEP, -self.STEP))
        slope = term.slope(self.SPEED, np.zeros(4))
        np.testing.assert_allclose(slope, (above - below) / (2.0 * self.STEP), atol=1e-8)


class TestFrictionTable:
    """A law as `[robot.friction]` has it."""

    @pytest.mark.parametrize(
        "law", [FrictionLaw(), FrictionLaw(third=None, stribeck=0.1, zone="linear", offset=True)]
    )
    def test_laws_come_back_from_their_tables(self, law: FrictionLaw) -> None:
        assert None not in law.table().values()
        assert FrictionLaw.from_table(law.table()) == law

    def test_a_speed_of_zero_means_no_stribeck_term(self) -> None:
        assert FrictionLaw.from_table({"stribeck": 0.0}).stribeck is None
        with pytest.raises(ModelError, match="Stribeck speed"):
            FrictionLaw(stribeck=0.0)
