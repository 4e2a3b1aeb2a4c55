"""Files for other tools: every number comes back, and no name or gap in the data breaks them."""

import csv
import json
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
from identification.export.parameters import parameters_csv, parameters_json
from identification.factor.factor import estimate
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

    def test_no_remark_is_a_formula_or_breaks_its_row(self, fit):
        model, found, _ = fit
        text = parameters_csv(model, found, provenance={"archives": "a,=1+1.mcap;@b, -3"})
        assert len(table(text)) == model.n_parameters
        assert "a,'=1+1.mcap;'@b, -3" in text
