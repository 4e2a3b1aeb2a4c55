"""How an estimate was made, in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from identification.factor.estimation_method import (
    EstimationMethod,
    Instrumental,
    LeastSquares,
    LossName,
    PriorAndData,
    PriorOrigin,
    Reweighted,
    TimeBlocks,
    Widening,
)
from identification.model.messages import mass_fault_words
from identification.model.nominal_masses import MassFault
from identification.text import number

WIDENINGS: Final[Mapping[Widening, str]] = {
    "torque_scale": "with the uncertain scale of torques",
    "friction_form": "with an uncertain friction law",
    "friction_drift": "with friction drift",
    "elastic_gears": "with elastic gears",
    "siblings": "with a prior shared by all arms of its type",
}
_LOSSES: Final[Mapping[LossName, str]] = {
    "squares": "squares",
    "huber": "Huber's loss (k = {:g})",
    "tukey": "Tukey's bisquare (c = {:g})",
}


def method_words(method: EstimationMethod) -> str:
    """Return estimator and covariance of an estimate."""
    if method.fit is None:
        return "not stated"
    link = "; " if isinstance(method.fit, PriorAndData) else ", "
    text = f"{_fit_words(method.fit)}{link}{blocks_words(method.blocks)}"
    if method.is_consistent:
        text = (
            "physically consistent (pseudo-inertia, rotor inertia and friction); covariance of the"
            f" unconstrained estimate: {text}"
        )
    return ", ".join([text, *(WIDENINGS[by] for by in method.widened_by)])


def blocks_words(blocks: TimeBlocks | None) -> str:
    """Return how a covariance was computed."""
    if blocks is None:
        return "classical covariance (white residuals)"
    return f"cluster-robust covariance over {blocks.count} blocks of {blocks.duration:g} s"


def prior_words(origin: PriorOrigin | None) -> str:
    """Return what a prior is made from."""
    if origin is None:
        return "given"
    if origin.fault is None:
        text = f"nominal bodies to within {100.0 * origin.share:g} %"
    elif origin.fault is MassFault.UNRELATED:
        ratio = number(origin.scale, 2)
        text = (
            "bodies scaled to the torque, as the torque is"
            f" {ratio} times the torque of the described bodies"
        )
    else:
        text = f"bodies scaled to the torque, as {mass_fault_words(origin.fault)}"
    if origin.stated:
        text += f", {origin.stated} values given"
    return text if origin.weight == 1.0 else f"{text}, with {origin.weight:g} times the weight"


def status_words(fits: bool) -> str:
    """Return the outcome of a physically consistent fit."""
    return "optimal" if fits else "optimal (no consistent parameters fit the data within noise)"


def _fit_words(fit: LeastSquares | Reweighted | Instrumental | PriorAndData) -> str:
    match fit:
        case LeastSquares(weighting, by_qr, essential_only):
            start = "essential parameters by " if essential_only else ""
            return f"{start}{weighting} least squares{_by_qr(by_qr)}"
        case Reweighted(loss, tuning, passes, converged, by_qr):
            ended = "" if converged else ", NOT converged"
            return (
                f"iteratively reweighted least squares{_by_qr(by_qr)}, "
                f"{_LOSSES[loss].format(tuning)}, {passes} passes{ended}"
            )
        case Instrumental():
            return "instrumental variables"
        case PriorAndData(prior, design_effect):
            size = number(design_effect)
            rows = "each row counts" if size == "1" else f"{size} rows count as one"
            return f"posterior of the prior ({prior_words(prior)}), {rows}"


def _by_qr(by_qr: bool) -> str:
    return " by QR" if by_qr else ""
