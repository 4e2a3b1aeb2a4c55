"""How the parameters were estimated, as rows of text."""

from __future__ import annotations

from hil.report import numbers
from hil.report.overview import Fact
from hil.results import Results


def facts(results: Results) -> list[Fact]:
    """Estimator, conditioning, bias by noise in the regressor, prior, and base parameters."""
    estimator = results.estimator
    condition = numbers.significant(estimator.condition, 3)
    found = [
        Fact("Estimator", f"{estimator.words} (--estimator {estimator.name})"),
        Fact("Values and std", results.uncertainty.method),
        Fact("Condition", f"{condition} with columns of unit length, weighted by joint"),
        Fact("Base parameters", estimator.grouping),
    ]
    bias = results.endogeneity.sentence if results.endogeneity else results.endogeneity_untested
    if bias:
        found.append(Fact("Noise in the regressor", bias))
    if estimator.prior:
        found.append(Fact("Known before the data", _prior(results, estimator.prior)))
    return found


def _prior(results: Results, words: str) -> str:
    """The prior, and how many parameters the data have said more about."""
    known = [p.learned for p in results.parameters if p.learned is not None]
    if not known:
        return f"Nothing: {words}."
    return (
        f"{words}. {sum(known)} of {len(known)} parameters were learned from the data: at least "
        "three quarters of what is now known of them comes from there."
    )
