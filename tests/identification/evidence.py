"""Evidence of two joints that is good, with changes, and what is found in it."""

from dataclasses import replace

import numpy as np

from identification.estimators.delay import DelayEstimate
from identification.factor.estimate import Estimate
from identification.factor.estimation_method import EstimationMethod
from identification.hypotheses.diagnosis import RigidTorque, TorqueDiagnosis
from identification.hypotheses.explanation import Explanation
from identification.hypotheses.joint_changes import Change
from identification.validation.evidence import CellContext, Evidence
from identification.validation.finding import Thresholds
from identification.validation.findings.table import find
from identification.validation.physical_signs import WrongSign
from identification.validation.prediction import PredictionError
from identification.validation.verdict import judge

AXES = ("one", "two")

RIGID = RigidTorque(1.0, 0.01, np.full(2, np.inf), 0.05)

NOTHING = TorqueDiagnosis(None, RIGID, None, ())
"""That of an arm as described, with nothing that explains an error."""

LATE = DelayEstimate(
    delay=0.003, std=1e-4, assumed=0.0, cycle=0.001, interval_factor=2.0, reason=None,
    significant=True,
)  # fmt: skip


def an_error(relative, joints=2):
    """Prediction error of given relative size in 1000 rows of torques of RMS 10."""
    rows = np.full(joints, 1000)
    zero = np.zeros(joints)
    torque = np.full(joints, 1e5)
    squared = torque * np.broadcast_to(relative, joints) ** 2
    return PredictionError(rows, np.sqrt(squared), zero, squared, zero, torque)


def an_estimate(**changes):
    fields = {
        "names": ("a", "b"), "units": ("kg", "kg"), "values": np.ones(2), "covariance": np.eye(2),
        "noise_std": np.ones(2), "samples": np.full(2, 1000), "method": EstimationMethod(),
        "condition": 10.0,
    }  # fmt: skip
    return Estimate(**(fields | changes))


def explained(change, ratio, size=0.01, std=0.001):
    """The diagnosis of an arm as described, with one change that explains an error."""
    return TorqueDiagnosis(None, RIGID, None, (Explanation(change, ratio, size, std),))


def caused(meaning, *joints, ratio=0.4, part=None):
    return explained(Change(meaning, joints, part=part), ratio)


def negative(name):
    """A parameter of -1 kg."""
    return WrongSign("negative parameter", name, {"value": -1.0, "std": 0.1}, "kg")


def evidence_with(**changes):
    """Return good evidence with changes; those of the context by name."""
    context_fields = CellContext.__dataclass_fields__.keys() & changes.keys()
    around = {name: changes.pop(name) for name in context_fields}
    evidence = Evidence(an_estimate(), held_out=an_error(0.05), training=an_error(0.04))
    return replace(evidence, context=CellContext(**around), **changes)


def found(**changes):
    """Return the findings on good evidence with changes, by key."""
    findings = find(evidence_with(**changes), Thresholds())
    by_key = {finding.key: finding for finding in findings}
    assert len(by_key) == len(findings)
    return by_key


def judged(names=AXES, **changes):
    """Return the verdict on good evidence with changes."""
    asked = {name: changes.pop(name) for name in ("purposes", "asked") if name in changes}
    return judge(names, evidence_with(**changes), **asked)
