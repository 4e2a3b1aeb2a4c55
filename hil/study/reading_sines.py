"""What method A's open choices mean for the comparison, in sentences."""

from __future__ import annotations

from .designs import AS_PRINTED, SINES
from .results import AblationResult, StudyResults
from .wording import ratio_words


def as_printed(results: StudyResults) -> list[str]:
    """Beside B: the sines with the frequencies of the paper's Table 1, if others were chosen.

    Of those about different postures the one of larger determinant, method A's own criterion.
    """
    found = next((one for one in results.ablations if one.key == "sines"), None)
    searched = {one.key: one.log10_det for one in results.searches if one.key in AS_PRINTED}
    known = {key: value for key, value in searched.items() if value is not None}
    if (
        found is None
        or not known
        or any(one.chosen for one in results.searches if one.key in known)
    ):
        return []
    best = max(known, key=lambda key: known[key])
    words = next((text for text in beside_b(found) if text.startswith(_named(best))), None)
    if words is None:
        return []
    return [
        "A stands above for its best search, whose frequencies go up to the appendix's bound. The"
        f" paper prints lower ones. {words}"
    ]


def beside_b(ablation: AblationResult) -> list[str]:
    """Each of method A's sines beside B on fly-by motions, without unmodelled effects."""
    return [
        f"{_named(one.first)}, both run {_times(ablation)}, {ratio_words(one, 'these sines', 'B')}."
        for one in ablation.comparisons
    ]


def _named(key: str) -> str:
    words, _ = SINES[key]
    return f"With sines {words}"


def _times(ablation: AblationResult) -> str:
    count = ablation.points[0].repetitions
    return "once" if count == 1 else f"{count} times"
