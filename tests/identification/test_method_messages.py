"""How an estimate was made: each way has words with its figures, and is read back from JSON."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import pytest

from identification.factor.estimation_method import (
    EstimationMethod,
    Instrumental,
    LeastSquares,
    PriorAndData,
    PriorOrigin,
    Reweighted,
    TimeBlocks,
)
from identification.factor.messages import WIDENINGS, method_words, prior_words
from identification.model.nominal_masses import MassFault

BLOCKS = TimeBlocks(40, 0.25)
ORIGIN = PriorOrigin(0.3)
WORDS: dict[EstimationMethod, str] = {
    EstimationMethod(): "not stated",
    EstimationMethod(
        LeastSquares()
    ): "weighted least squares, classical covariance (white residuals)",
    EstimationMethod(LeastSquares("ordinary", by_qr=True), BLOCKS): (
        "ordinary least squares by QR, cluster-robust covariance over 40 blocks of 0.25 s"
    ),
    EstimationMethod(LeastSquares(essential_only=True), BLOCKS): "essential parameters by weighted",
    EstimationMethod(Reweighted("huber", 1.345, 7, converged=True), BLOCKS): (
        "iteratively reweighted least squares, Huber's loss (k = 1.345), 7 passes, cluster-robust"
    ),
    EstimationMethod(
        Reweighted("tukey", 4.685, 30, converged=False), BLOCKS
    ): "Tukey's bisquare (c = 4.685), 30 passes, NOT converged, cluster-robust",
    EstimationMethod(Instrumental(), BLOCKS): "instrumental variables, cluster-robust",
    EstimationMethod(PriorAndData(None, 1.0)): "posterior of the prior (given), each row counts;",
    EstimationMethod(PriorAndData(ORIGIN, 3.25), BLOCKS): (
        "posterior of the prior (nominal bodies to within 30 %), 3.25 rows count as one;"
        " cluster-robust covariance over 40 blocks of 0.25 s"
    ),
    EstimationMethod(LeastSquares(), BLOCKS, is_consistent=True): (
        "physically consistent (pseudo-inertia, rotor inertia and friction); covariance of the"
        " unconstrained estimate: weighted least squares, cluster-robust"
    ),
    EstimationMethod(LeastSquares(), BLOCKS).widened("friction_drift").widened("torque_scale"): (
        "0.25 s, with friction drift, with the uncertain scale of torques"
    ),
}
PRIORS: dict[PriorOrigin, str] = {
    replace(ORIGIN, stated=2, weight=10.0): (
        "nominal bodies to within 30 %, 2 values given, with 10 times the weight"
    ),
    replace(ORIGIN, fault=MassFault.NONE): "as the description has no masses",
    replace(ORIGIN, fault=MassFault.EQUAL): "as all bodies of the description have the same mass",
    replace(ORIGIN, fault=MassFault.UNRELATED, scale=20.0): (
        "bodies scaled to the torque, as the torque is 20 times the torque of the described"
    ),
}


@pytest.mark.parametrize(("method", "words"), WORDS.items(), ids=list(WORDS.values()))
def test_each_method_has_words(method: EstimationMethod, words: str) -> None:
    assert words in method_words(method)


@pytest.mark.parametrize(("origin", "words"), PRIORS.items(), ids=list(PRIORS.values()))
def test_each_prior_has_words(origin: PriorOrigin, words: str) -> None:
    assert words in prior_words(origin)


@pytest.mark.parametrize(
    "method",
    [*WORDS, *(EstimationMethod(PriorAndData(origin, 2.0), BLOCKS) for origin in PRIORS)],
    ids=method_words,
)
def test_json_restores_it(method: EstimationMethod) -> None:
    assert EstimationMethod.of_json(json.loads(json.dumps(method.as_json()))) == method


@pytest.mark.parametrize("widening", WIDENINGS)
def test_each_widening_has_words(widening: Any) -> None:
    assert method_words(EstimationMethod(Instrumental()).widened(widening)).endswith(
        WIDENINGS[widening]
    )


@pytest.mark.parametrize(
    "content",
    [
        "weighted least squares",
        {"fit": "weighted least squares"},
        {"fit": {"kind": "least_cubes"}},
        {"widened_by": ["age"]},
        {"blocks": {"count": 40}},
    ],
)
def test_other_json_is_refused(content: Any) -> None:
    with pytest.raises(ValueError, match=r"EstimationMethod|fit|widened_by|blocks"):
        EstimationMethod.of_json(content)
