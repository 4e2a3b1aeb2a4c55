"""Files for other tools: every number comes back, and no name or gap in the data breaks them."""

import csv
import json
import re
from dataclasses import replace

import numpy as np
import pytest

from identification import (
    Factor,
    FrictionLaw,
    Motion,
    RobotModel,
)
from identification.estimators.consistent import consistent_estimate
from identification.export.friction import friction_source
from identification.export.parameters import parameters_csv, parameters_json, standard_csv
from identification.factor.factor import estimate
from identification.model.coupling import Coupling
from tests.identification.two_link import URDF

PROVENANCE = {"recording": "run_1.mcap\nsha256 0a1b", "made by": "hil 0.1.0"}
DRY = FrictionLaw(third=None)


@pytest.fixture(scope="module")
def fit():
    model = RobotModel.from_urdf(URDF, friction=DRY)
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.normal(size=(3, 300, 2))
    values = np.concatenate([model.base.grouping @ model.nominal, [4.0, 2.0, 1.5, 0.8]])
    torque = model.torque(values, q, qd, qdd) + rng.normal(size=(300, 2))
    factor = Factor.from_samples(model, Motion(np.arange(300.0), q, qd, qdd), torque)
    found = estimate(model, factor)
    return model, found, consistent_estimate(model, factor, found)


def table(text):
    return list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))


class TestParameters:
    def test_json_restores_every_number(self, fit):
        model, found, consistent = fit
        text = parameters_json(model, found, consistent=consistent, provenance=PROVENANCE)
        read = json.loads(text)
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

    def test_json_has_texts_for_undetermined_values(self, fit):
        model, found, _ = fit
        covariance = found.covariance.copy()
        covariance[0, :] = covariance[:, 0] = 0.0
        covariance[0, 0] = np.inf
        unknown = replace(found, covariance=covariance, condition=np.inf, undetermined=("I1yy",))
        read = json.loads(parameters_json(model, unknown))
        assert read["parameters"][0]["std"] == read["condition"] == "Infinity"
        assert (read["undetermined"], read["standard"]) == (["I1yy"], None)

    def test_csv_restores_values_and_covariance(self, fit):
        model, found, _ = fit
        text = parameters_csv(model, found, provenance=PROVENANCE)
        assert "# recording: run_1.mcap sha256 0a1b" in text.splitlines()
        rows = table(text)
        assert [row["name"] for row in rows] == list(found.names)
        assert [float(row["value"]) for row in rows] == found.values.tolist()
        covariance = [[float(row[f"cov({name})"]) for name in found.names] for row in rows]
        np.testing.assert_array_equal(covariance, found.covariance)

    @pytest.mark.parametrize("evil", ["=LINK('a')", "@SUM(1)", "-1+1", "+1", " =1", "a;#b"])
    def test_no_name_is_a_formula_or_breaks_its_row(self, fit, evil):
        _, _, consistent = fit
        model = RobotModel.from_urdf(URDF.replace("shoulder", evil), friction=DRY)
        text = standard_csv(model, consistent, provenance={"archives": "a,=1+1.mcap;@b, -3"})
        rows = table(text)
        assert [row["joint"][-1] for row in rows] == [model.joint_names[0][-1], "w"]
        assert float(rows[1]["Im"]) == consistent.standard[21]
        cells = [cell for line in text.splitlines() for cell in re.split("[,;]", line)]
        formulas = [cell for cell in cells if cell.startswith(tuple("=@+-"))]
        assert all(isinstance(float(cell), float) for cell in formulas), formulas
        assert "a,'=1+1.mcap;'@b, -3" in text


def in_source(model, coefficients):
    """Names that the source of a model's friction defines."""
    namespace = {}
    exec(friction_source(model, coefficients), namespace)
    return namespace


def with_law(law=DRY, **options):
    return RobotModel.from_urdf(URDF, friction=law, **options)


class TestFrictionSource:
    @pytest.mark.parametrize("tanh", [None, 0.02])
    def test_it_has_every_term_and_coupled_motors(self, tanh):
        model = with_law(
            FrictionLaw(asymmetric=True, stribeck=0.4, zone="linear", standstill=0.1),
            joint_friction={"elbow": FrictionLaw(viscous=False, third="cubic", tanh=tanh)},
            coupling=Coupling(np.array([[1.0, 0.0], [0.5, -2.0]]), inertia=False),
        )
        rng, still = np.random.default_rng(3), np.zeros((1, 2))
        coefficients = rng.normal(size=len(model.friction.terms))
        torques = in_source(model, coefficients)["torques"]
        values = np.concatenate([np.zeros(model.base.rank), coefficients])
        for speeds in rng.choice([-1.5, -0.3, 0.3, 0.05, 0.005, 1.5], (20, 2)):
            expected = model.torque(values, still, speeds[None], still)[0]
            assert torques([float(v) for v in speeds]) == pytest.approx(list(expected))
            assert torques(speeds) == pytest.approx(list(expected))  # an array will do

    def test_smooth_friction_has_no_jump_at_zero_speed(self):
        friction = in_source(with_law(), np.array([4.0, 2.0, 1.5, 0.8]))["friction"]
        assert friction(0, 0.0) == 0.0
        assert friction(0, 0.005) == pytest.approx(4.0 + 0.0075)
        assert friction(0, 0.005, smooth=0.01) == pytest.approx(2.0 + 0.0075)
        assert friction(0, 0.01 - 1e-12, smooth=0.01) == pytest.approx(friction(0, 0.01))
        standstill = in_source(with_law(FrictionLaw(standstill=0.0)), np.ones(6))["friction"]
        assert standstill(1, 0.0) == 0.0

    def test_names_are_quoted(self):
        evil = "a'\\,); raise SystemExit #&quot;&quot;&quot;"
        model = RobotModel.from_urdf(URDF.replace("shoulder", evil), friction=DRY)
        values = np.array([1.0, 2.0, 3.0, 4.0])
        assert in_source(model, values)["JOINTS"] == model.joint_names
