"""What method A's open choices mean for the comparison, in sentences."""

from __future__ import annotations

from .designs import AP, SINES, B
from .results import AblationResult, StudyResults
from .wording import labels_of, lower, outcome, pair, ratios_of, under_each


def as_printed(results: StudyResults) -> list[str]:
    """B beside the sines with the frequencies of the paper's Table 1, if others were chosen."""
    told = [
        (condition, outcome(one, labels_of(condition)))
        for condition in results.conditions
        if (one := pair(condition, AP, B, "fly-by")) is not None
    ]
    if not told:
        return []
    return [
        "A is its best search here, beyond the frequencies that the paper prints. Beside A as"
        f" printed: {lower(under_each(told))}"
    ]


def beside_b(ablation: AblationResult) -> list[str]:
    """Each of method A's sines beside B on fly-by motions, without unmodelled effects."""
    pairs = [one for one in ablation.comparisons if one.first in SINES]
    if not pairs:
        return []
    told = ratios_of([(SINES[one.first][0], one) for one in pairs])
    return [f"Fly-by error with B over that with each of these sines: {told}"]
