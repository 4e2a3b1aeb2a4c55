from __future__ import annotations

import ast
import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identification import (
    Estimate,
    Factor,
    FrictionLaw,
    IdentificationError,
    Motion,
    RobotModel,
    ShapeError,
)
from identification.estimators.consistent import ConsistentEstimate, consistent_estimate
from identification.export.friction import friction_in_words, friction_source
from identification.export.parameters import parameters_csv, parameters_json, standard_csv
from identification.export.urdf import write_urdf
from identification.factor.factor import estimate
from identification.model.coupling import Coupling
from identification.model.friction import ThirdTerm

URDF = (Path(__file__).parent / "two_link.urdf").read_text()
PROVENANCE = {"recording": "run_1.mcap\nsha256 0a1b", "made by": "hil 0.1.0"}


@pytest.fixture(scope="module")
def fit() -> tuple[RobotModel, Estimate, ConsistentEstimate]:
    model = RobotModel.from_urdf(URDF, friction=FrictionLaw(third=None))
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.normal(size=(3, 300, 2))
    values = np.concatenate([model.base.grouping @ model.nominal, [4.0, 2.0, 1.5, 0.8]])
    torque = model.torque(values, q, qd, qdd) + rng.normal(size=(300, 2))
    factor = Factor.from_samples(model, Motion(np.arange(300.0), q, qd, qdd), torque)
    found = estimate(model, factor)
    return model, found, consistent_estimate(model, factor, found)


Fit = tuple[RobotModel, Estimate, ConsistentEstimate]


def test_json_gives_every_number_back(fit: Fit) -> None:
    model, found, consistent = fit
    read = json.loads(parameters_json(model, found, consistent=consistent, provenance=PROVENANCE))
    assert [p["value"] for p in read["parameters"]] == found.values.tolist()
    assert [p["std"] for p in read["parameters"]] == found.std.tolist()
    assert [p["unit"] for p in read["parameters"]] == list(found.units)
    np.testing.assert_array_equal(read["covariance"], found.covariance)
    assert read["provenance"] == PROVENANCE
    assert read["parameters"][0]["expression"] == "I1yy + I1m + 0.25 m2"
    links = read["standard"]["links"]
    assert [link["joint"] for link in links] == ["shoulder", "elbow"]
    assert [link["rotor_inertia"] for link in links] == consistent.standard[[10, 21]].tolist()
    assert links[1]["friction"] == {"f0": consistent.friction[1], "f1": consistent.friction[3]}


def test_from_the_json_alone_the_urdf_can_be_written(fit: Fit) -> None:
    model, found, consistent = fit
    read = json.loads(parameters_json(model, found, consistent=consistent))
    standard = [
        link[name] if name != "Im" else link["rotor_inertia"]
        for link in read["standard"]["links"]
        for name in ["Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz", "mcx", "mcy", "mcz", "m", "Im"]
    ]
    assert write_urdf(URDF, model, np.array(standard)) == write_urdf(
        URDF, model, consistent.standard
    )


def test_json_has_words_for_what_is_not_determined(fit: Fit) -> None:
    model, found, _ = fit
    covariance = found.covariance.copy()
    covariance[0, :] = covariance[:, 0] = 0.0
    covariance[0, 0] = np.inf
    unknown = replace(found, covariance=covariance, condition=np.inf, undetermined=("I1yy",))
    read = json.loads(parameters_json(model, unknown))
    assert read["parameters"][0]["std"] == "Infinity"
    assert read["condition"] == "Infinity"
    assert read["undetermined"] == ["I1yy"]
    assert read["standard"] is None


def test_csv_gives_values_and_covariance_back(fit: Fit) -> None:
    model, found, _ = fit
    lines = parameters_csv(model, found, provenance=PROVENANCE).splitlines()
    remarks = [line for line in lines if line.startswith("#")]
    assert "# recording: run_1.mcap sha256 0a1b" in remarks
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    assert [row["name"] for row in rows] == list(found.names)
    assert [row["unit"] for row in rows] == list(found.units)
    assert [float(row["value"]) for row in rows] == found.values.tolist()
    covariance = [[float(row[f"cov({name})"]) for name in found.names] for row in rows]
    np.testing.assert_array_equal(covariance, found.covariance)


def test_standard_parameters_are_a_table_of_joints(fit: Fit) -> None:
    model, _, consistent = fit
    lines = standard_csv(model, consistent, provenance=PROVENANCE).splitlines()
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    assert [row["joint"] for row in rows] == ["shoulder", "elbow"]
    assert float(rows[1]["m"]) == consistent.standard[20]
    assert float(rows[1]["Im"]) == consistent.standard[21]
    assert all(float(row["margin"]) > 0.0 for row in rows)


@pytest.mark.parametrize("evil", ["=HYPERLINK('http://a')", "@SUM(1)", "-1+1", "+1", " =1", "a;#b"])
def test_no_name_is_a_formula_to_a_spreadsheet_or_breaks_its_row(fit: Fit, evil: str) -> None:
    _, _, consistent = fit
    model = RobotModel.from_urdf(URDF.replace("shoulder", evil), friction=FrictionLaw(third=None))
    text = standard_csv(model, consistent, provenance={"archives": "a,=1+1.mcap;@b, -3"})
    lines = text.splitlines()
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    assert [row["joint"][-1] for row in rows] == [model.joint_names[0][-1], "w"]
    cells = [cell for line in lines for cell in re.split("[,;]", line)]
    formulas = [cell for cell in cells if cell.startswith(tuple("=@+-"))]
    assert all(isinstance(float(cell), float) for cell in formulas), formulas
    assert "a,'=1+1.mcap;'@b, -3" in text


def test_parameters_of_another_model_are_refused(fit: Fit) -> None:
    _, found, _ = fit
    other = RobotModel.from_urdf(URDF)
    with pytest.raises(IdentificationError):
        parameters_json(other, found)
    with pytest.raises(IdentificationError):
        parameters_csv(other, found)


FRICTION_TEXT_URDF = (Path(__file__).parent / "two_link.urdf").read_text()
LAWS = [
    FrictionLaw(coulomb, viscous, third, offset)
    for coulomb in (False, True)
    for viscous in (False, True)
    for third in (None, "quadratic", "cubic")
    for offset in (False, True)
]


@given(st.sampled_from(LAWS), st.integers(0, 2**16))
@settings(max_examples=30)
def test_the_source_computes_the_models_friction_at_any_speed(law: FrictionLaw, seed: int) -> None:
    model = RobotModel.from_urdf(FRICTION_TEXT_URDF, friction=law)
    rng = np.random.default_rng(seed)
    coefficients = rng.normal(size=2 * len(law.symbols))
    namespace: dict[str, object] = {}
    exec(friction_source(model, coefficients), namespace)
    friction = namespace["friction"]
    assert callable(friction)
    still = np.zeros((1, 2))
    values = np.concatenate([np.zeros(model.base.rank), coefficients])
    for speed in [0.0, 0.003, -0.003, *(rng.uniform(0.02, 3.0, 5) * rng.choice([-1.0, 1.0], 5))]:
        expected = model.torque(values, still, np.full((1, 2), speed), still)[0]
        assert [friction(j, float(speed)) for j in range(2)] == pytest.approx(list(expected))


def test_on_demand_the_source_goes_through_zero_speed_without_a_jump() -> None:
    model = RobotModel.from_urdf(FRICTION_TEXT_URDF, friction=FrictionLaw(third=None))
    namespace: dict[str, object] = {}
    exec(friction_source(model, np.array([4.0, 2.0, 1.5, 0.8])), namespace)
    friction = namespace["friction"]
    assert callable(friction)
    assert friction(0, 0.0) == 0.0
    assert friction(0, 0.005) == pytest.approx(4.0 + 0.0075)
    assert friction(0, 0.005, smooth=0.01) == pytest.approx(2.0 + 0.0075)
    assert friction(0, 0.01 - 1e-12, smooth=0.01) == pytest.approx(friction(0, 0.01))


def test_the_source_imports_nothing_and_names_joints_and_units() -> None:
    model = RobotModel.from_urdf(FRICTION_TEXT_URDF)
    source = friction_source(model, np.ones(6))
    nodes = list(ast.walk(ast.parse(source)))
    assert not any(isinstance(node, ast.Import | ast.ImportFrom) for node in nodes)
    assert "'shoulder', 'elbow'" in source
    assert "N·m·s/rad" in source


def test_a_standstill_of_zero_is_no_division() -> None:
    model = RobotModel.from_urdf(FRICTION_TEXT_URDF, friction=FrictionLaw(standstill=0.0))
    namespace: dict[str, object] = {}
    exec(friction_source(model, np.ones(6)), namespace)
    friction = namespace["friction"]
    assert callable(friction)
    assert friction(1, 0.0) == 0.0


@pytest.mark.parametrize(("third", "formula"), [("quadratic", "f2 sgn(v) v²"), ("cubic", "f2 v³")])
def test_words_have_the_formula_and_each_joints_values(third: ThirdTerm, formula: str) -> None:
    model = RobotModel.from_urdf(FRICTION_TEXT_URDF, friction=FrictionLaw(third=third))
    words = friction_in_words(model, np.array([4.0, 2.0, 1.5, 0.8, -0.1, 0.2]))
    assert f"f0 sgn(v) + f1 v + {formula}" in words
    assert "shoulder: f0 = 4 N·m, f1 = 1.5 N·m·s/rad, f2 = -0.1" in words
    assert "0.01 rad/s" in words


def test_without_friction_it_says_so() -> None:
    none = FrictionLaw(coulomb=False, viscous=False, third=None)
    model = RobotModel.from_urdf(FRICTION_TEXT_URDF, friction=none)
    assert "no friction" in friction_in_words(model, np.empty(0))
    namespace: dict[str, object] = {}
    exec(friction_source(model, np.empty(0)), namespace)
    friction = namespace["friction"]
    assert callable(friction)
    assert friction(0, 1.0) == 0.0


def test_coefficients_of_another_law_are_refused() -> None:
    model = RobotModel.from_urdf(FRICTION_TEXT_URDF)
    for function in (friction_in_words, friction_source):
        with pytest.raises(ShapeError):
            function(model, np.ones(4))


def in_source(model: RobotModel, coefficients: np.ndarray) -> dict[str, object]:
    namespace: dict[str, object] = {}
    exec(friction_source(model, coefficients), namespace)
    return namespace


@pytest.mark.parametrize("tanh", [None, 0.02])
def test_the_source_knows_every_term_and_coupled_motors(tanh: float | None) -> None:
    model = RobotModel.from_urdf(
        FRICTION_TEXT_URDF,
        friction=FrictionLaw(asymmetric=True, stribeck=0.4, zone="linear", standstill=0.1),
        joint_friction={"elbow": FrictionLaw(viscous=False, third="cubic", tanh=tanh)},
        coupling=Coupling(np.array([[1.0, 0.0], [0.5, -2.0]]), inertia=False),
    )
    rng = np.random.default_rng(3)
    coefficients = rng.normal(size=len(model.friction.terms))
    torques = in_source(model, coefficients)["torques"]
    assert callable(torques)
    values = np.concatenate([np.zeros(model.base.rank), coefficients])
    still = np.zeros((1, 2))
    for speeds in rng.choice([-1.5, -0.3, 0.3, 0.05, 0.005, 1.5], (20, 2)):
        expected = model.torque(values, still, speeds[None], still)[0]
        assert torques([float(v) for v in speeds]) == pytest.approx(list(expected))
        assert torques(speeds) == pytest.approx(list(expected))  # an array will do


def test_words_name_what_is_special_about_a_joint_or_motor() -> None:
    model = RobotModel.from_urdf(
        FRICTION_TEXT_URDF,
        friction=FrictionLaw(third=None, asymmetric=True, zone="linear", standstill=0.1),
        joint_friction={"elbow": FrictionLaw(third=None, stribeck=0.4)},
        coupling=Coupling(np.array([[1.0, 0.0], [0.5, 1.0]]), inertia=False),
    )
    text = friction_in_words(model, np.arange(len(model.friction.terms), dtype=float))
    assert "Slower than 0.1 rad/s (m/s) shoulder: sgn(v) is v / standstill" in text
    assert "Slower than 0.01 rad/s (m/s) elbow: nothing was fitted" in text
    assert "vs = 0.4 rad/s" in text
    assert "its asymmetry cannot be distinguished from the zero error of a sensor" in text
    assert "motor 2, at v = 0.5 v(shoulder) + v(elbow): f0 = 7 N·m, f1 = 8 N·m·s/rad" in text


def test_what_is_not_known_stays_valid_source() -> None:
    model = RobotModel.from_urdf(FRICTION_TEXT_URDF, friction=FrictionLaw(third=None))
    friction = in_source(model, np.array([1.0, np.nan, 1.0, np.inf]))["friction"]
    assert callable(friction)
    assert friction(0, 1.0) == 2.0
    assert np.isnan(friction(1, 1.0))


def test_names_are_data_in_the_source_and_one_line_in_words() -> None:
    evil = "a'\\,); raise SystemExit #&quot;&quot;&quot;"
    law = FrictionLaw(third=None)
    model = RobotModel.from_urdf(FRICTION_TEXT_URDF.replace("shoulder", evil), friction=law)
    values = np.array([1.0, 2.0, 3.0, 4.0])
    assert in_source(model, values)["JOINTS"] == model.joint_names
    plain = friction_in_words(RobotModel.from_urdf(FRICTION_TEXT_URDF, friction=law), values)
    assert len(friction_in_words(model, values).splitlines()) == len(plain.splitlines())
