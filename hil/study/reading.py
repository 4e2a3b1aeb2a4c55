"""What the numbers of a study say, in sentences that are made from them and from nothing else."""

from __future__ import annotations

from typing import Any

from .reading_ablations import ablation_paragraph
from .reading_classes import classes_paragraph
from .reading_effects import effects_paragraph
from .reading_limits import limits_paragraph
from .reading_prediction import prediction_paragraph
from .reading_tables import criteria_paragraph, parameters_paragraph
from .results import Paragraph, StudyResults
from .wording import labels_of


def reading_of(results: StudyResults) -> list[Paragraph]:
    """All paragraphs, the answer to the paper's question first."""
    labels = labels_of(results.conditions[0])
    paragraphs = [
        prediction_paragraph(results),
        classes_paragraph(results),
        effects_paragraph(results),
        criteria_paragraph(results),
        parameters_paragraph(results),
        *(ablation_paragraph(one, labels) for one in results.ablations),
        limits_paragraph(results),
    ]
    return [one for one in paragraphs if one.sentences]


def answer_of(results: StudyResults) -> dict[str, Any]:
    """The answer for a script, and in one line: `line`, and the ratios that it rests on."""
    ratios = [
        {
            "condition": condition.key,
            "motion_class": one.motion_class,
            "first": one.first,
            "second": one.second,
            "ratio": one.ratio,
            "interval": None if one.low is None else [one.low, one.high],
            "level": one.level,
            "verdict": one.verdict,
            "differs": one.differs,
            "p_corrected": one.p_corrected,
        }
        for condition in results.conditions
        for one in condition.comparisons
    ]
    told = [f"{one.heading} {one.verdict}" for one in results.reading if one.verdict]
    cells = [one for condition in results.conditions for one in condition.cross]
    return {
        "name": results.name,
        "simulated": results.simulated,
        "quick": results.quick,
        "line": " ".join(told) or f"{results.name}: one excitation, nothing to compare it with.",
        "ratios": ratios,
        "cross": [one.model_dump() for one in cells],
        "missing": results.missing,
    }
