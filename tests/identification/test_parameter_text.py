from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from identification import Estimate, Factor, FrictionLaw, IdentificationError, Motion, RobotModel
from identification.estimators.consistent import ConsistentEstimate, consistent_estimate
from identification.export.parameters import parameters_csv, parameters_json, standard_csv
from identification.export.urdf import write_urdf
from identification.factor.factor import estimate

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
