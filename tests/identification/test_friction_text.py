from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identification import FrictionLaw, RobotModel, ShapeError
from identification.friction import ThirdTerm
from identification.friction_text import friction_in_words, friction_source

URDF = (Path(__file__).parent / "two_link.urdf").read_text()
LAWS = [
    FrictionLaw(coulomb, viscous, third, offset)
    for coulomb in (False, True)
    for viscous in (False, True)
    for third in (None, "quadratic", "cubic")
    for offset in (False, True)
]


@given(st.sampled_from(LAWS), st.integers(0, 2**16))
@settings(max_examples=30)
def test_the_source_computes_the_models_friction_above_standstill(
    law: FrictionLaw, seed: int
) -> None:
    model = RobotModel.from_urdf(URDF, friction=law)
    rng = np.random.default_rng(seed)
    coefficients = rng.normal(size=2 * len(law.symbols))
    namespace: dict[str, object] = {}
    exec(friction_source(model, coefficients), namespace)
    friction = namespace["friction"]
    assert callable(friction)
    still = np.zeros((1, 2))
    values = np.concatenate([np.zeros(model.base.rank), coefficients])
    for speed in rng.uniform(0.02, 3.0, 5) * rng.choice([-1.0, 1.0], 5):
        expected = model.torque(values, still, np.full((1, 2), speed), still)[0]
        assert [friction(j, float(speed)) for j in range(2)] == pytest.approx(list(expected))


def test_the_source_goes_through_standstill_without_a_jump() -> None:
    model = RobotModel.from_urdf(URDF, friction=FrictionLaw(third=None))
    namespace: dict[str, object] = {}
    exec(friction_source(model, np.array([4.0, 2.0, 1.5, 0.8])), namespace)
    friction = namespace["friction"]
    assert callable(friction)
    assert friction(0, 0.0) == 0.0
    assert friction(0, 0.005) == pytest.approx(2.0 + 0.0075)
    assert friction(0, 0.01 - 1e-12) == pytest.approx(friction(0, 0.01))


def test_the_source_imports_nothing_and_names_joints_and_units() -> None:
    model = RobotModel.from_urdf(URDF)
    source = friction_source(model, np.ones(6))
    nodes = list(ast.walk(ast.parse(source)))
    assert not any(isinstance(node, ast.Import | ast.ImportFrom) for node in nodes)
    assert "'shoulder', 'elbow'" in source
    assert "N·m·s/rad" in source


def test_a_standstill_of_zero_is_no_division() -> None:
    model = RobotModel.from_urdf(URDF, friction=FrictionLaw(standstill=0.0))
    namespace: dict[str, object] = {}
    exec(friction_source(model, np.ones(6)), namespace)
    friction = namespace["friction"]
    assert callable(friction)
    assert friction(1, 0.0) == 0.0


@pytest.mark.parametrize(("third", "formula"), [("quadratic", "f2 sgn(v) v²"), ("cubic", "f2 v³")])
def test_words_have_the_formula_and_each_joints_values(third: ThirdTerm, formula: str) -> None:
    model = RobotModel.from_urdf(URDF, friction=FrictionLaw(third=third))
    words = friction_in_words(model, np.array([4.0, 2.0, 1.5, 0.8, -0.1, 0.2]))
    assert f"f0 sgn(v) + f1 v + {formula}" in words
    assert "shoulder: f0 = 4 N·m, f1 = 1.5 N·m·s/rad, f2 = -0.1" in words
    assert "0.01 rad/s" in words


def test_without_friction_it_says_so() -> None:
    none = FrictionLaw(coulomb=False, viscous=False, third=None)
    model = RobotModel.from_urdf(URDF, friction=none)
    assert "no friction" in friction_in_words(model, np.empty(0))
    namespace: dict[str, object] = {}
    exec(friction_source(model, np.empty(0)), namespace)
    friction = namespace["friction"]
    assert callable(friction)
    assert friction(0, 1.0) == 0.0


def test_coefficients_of_another_law_are_refused() -> None:
    model = RobotModel.from_urdf(URDF)
    for function in (friction_in_words, friction_source):
        with pytest.raises(ShapeError):
            function(model, np.ones(4))
