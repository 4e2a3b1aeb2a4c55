"""What becomes of method B when one thing is changed and everything else kept."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.design import preset

from .designs import SINES, SINES_LABELS, A, B, fly_key, via_key, weight_key
from .plans import SINES_ABLATION, noise_key
from .records import FitRecord, ScoreRecord
from .results import AblationPoint, AblationResult
from .settings import StudySettings
from .summary import compared_on, corrected, parameter_error

Array = NDArray[np.float64]

ABLATED: Final = "ablation "
"""Before the names of estimates from an ablation's own campaigns."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """What ablations are made from.

    Attributes:
        fits: of every executed excitation of the ablations, by key.
        main: of A and B with all repetitions.
        estimates: every estimate that was asked to predict, by name.
        scores: by class of motion.
        truth: planted parameters (p,), None for a real arm.
        missing: what could not be run, by ablation, in sentences.
        sines: key of the sines that method A is represented by.
    """

    fits: Mapping[str, FitRecord]
    main: Mapping[str, FitRecord]
    estimates: Mapping[str, Array]
    scores: Mapping[str, ScoreRecord]
    truth: Array | None
    missing: Mapping[str, Sequence[str]] = field(default_factory=dict)
    sines: str = ""


def subset_name(method: str, repetitions: int) -> str:
    """Name of the estimate from the first so many repetitions."""
    return f"{method}-first-{repetitions}"


def subsets_of(
    main: Mapping[str, FitRecord], sizes: Sequence[int], methods: Sequence[str]
) -> dict[str, Array]:
    """Estimates from the first repetitions only (p,), by name; sizes there are not are left out."""
    return {
        subset_name(method, size): np.mean(main[method].values[:size], axis=0)
        for method in methods
        for size in sizes
        if size <= len(main[method].values)
    }


def ablations(settings: StudySettings, evidence: Evidence) -> list[AblationResult]:
    """All of a simulated study."""
    base = preset("b")
    assert base.via_points is not None
    n_via, fly, weight = base.via_points.n_via, base.via_points.fly, base.search.weights[1]
    few = settings.ablation_repetitions
    return [
        _sines(evidence, few),
        _varied(
            evidence,
            "fly",
            "Fly-by share",
            "fly-by share of B's via points",
            "B's own via points and speeds, planned again with another fly-by share and run: the "
            "corners change, the search does not.",
            [(value, fly_key(value), value == fly) for value in settings.fly],
        ),
        _varied(
            evidence,
            "n_via",
            "Number of via points",
            "via points K",
            "A search like B's, as long as B's, for each number of via points; more of them make a "
            "longer motion.",
            [(float(value), via_key(value), value == n_via) for value in settings.n_via],
        ),
        _varied(
            evidence,
            "weight",
            "Weight of the coupling index",
            "λ2 of the coupling index in eq. 7",
            "A search like B's for each weight; λ1 = 1 − λ2 is that of log det.",
            [(value, weight_key(value), value == weight) for value in settings.coupling_weight],
        ),
        repetition_ablation(evidence, settings.subsets, (A, B)),
        AblationResult(
            key="noise",
            title="Noise of the currents",
            variable="multiple of the cell's current noise",
            words=f"A and B run {_times(few)} at each level; the held-out motions stay those of "
            "the study.",
            points=[
                _executed(evidence, factor, method, noise_key(method, factor), base=factor == 1.0)
                for method in (A, B)
                for factor in settings.noise
                if noise_key(method, factor) in evidence.fits
            ],
            missing=list(evidence.missing.get("noise", ())),
        ),
    ]


def _sines(evidence: Evidence, few: int) -> AblationResult:
    """What method A is left free to choose, each beside B."""
    keys = [key for key in SINES if key in evidence.fits]
    scores = evidence.scores["fly-by"].scores
    b = [one.overall for one in scores[ABLATED + B]]
    return AblationResult(
        key=SINES_ABLATION,
        title="What method A may choose",
        variable="sines of method A",
        words="What the paper leaves open of method A: a search each for sines about the middle of"
        " the ranges or about the home posture, with the frequencies of Table 1 or with those that"
        f" the appendix's bound allows. Each best motion was run {_times(few)}, and so was B.",
        points=[
            _executed(evidence, float(k), A, key, base=key == evidence.sines).model_copy(
                update={"label": SINES_LABELS[key]}
            )
            for k, key in enumerate(keys)
        ],
        comparisons=corrected(
            [
                compared_on(
                    "fly-by", None, key, B, [one.overall for one in scores[ABLATED + key]], b
                )
                for key in keys
            ]
        ),
        missing=list(evidence.missing.get(SINES_ABLATION, ())),
    )


def repetition_ablation(
    evidence: Evidence, sizes: Sequence[int], methods: Sequence[str]
) -> AblationResult:
    """Estimates from the first repetitions only."""
    points = []
    for method in methods:
        record = evidence.main[method]
        for size in sizes:
            names = subset_name(method, size), methods[-1]
            if names[0] in evidence.estimates:
                points.append(
                    _point(
                        evidence,
                        float(size),
                        method,
                        record,
                        names,
                        repetitions=size,
                        base=size == len(record.values),
                    )
                )
    return AblationResult(
        key="repetitions",
        title="Number of repetitions",
        variable="repetitions that are fitted",
        words="The first so many repetitions of the study itself; nothing is run again.",
        points=points,
        missing=[],
    )


def _varied(
    evidence: Evidence,
    key: str,
    title: str,
    variable: str,
    words: str,
    wanted: Sequence[tuple[float, str, bool]],
) -> AblationResult:
    return AblationResult(
        key=key,
        title=title,
        variable=variable,
        words=words,
        points=[
            _executed(evidence, value, B, name, base=base)
            for value, name, base in wanted
            if name in evidence.fits
        ],
        missing=list(evidence.missing.get(key, ())),
    )


def _executed(
    evidence: Evidence, value: float, method: str, key: str, *, base: bool
) -> AblationPoint:
    """A setting that was run for the ablation, beside B run as often."""
    record = evidence.fits[key]
    names = ABLATED + key, ABLATED + B
    return _point(evidence, value, method, record, names, repetitions=len(record.values), base=base)


def _point(
    evidence: Evidence,
    value: float,
    method: str,
    record: FitRecord,
    names: tuple[str, str],
    *,
    repetitions: int,
    base: bool,
) -> AblationPoint:
    """One setting; `names` are those of its estimate and of the one it is set beside."""
    own, reference = (evidence.estimates[name] for name in names)
    truth = evidence.truth
    return AblationPoint(
        value=value,
        method=method,
        base=base,
        repetitions=repetitions,
        log10_det=record.log10_det,
        coupling_index=record.coupling_index,
        duration=record.duration,
        parameter_error=None if truth is None else parameter_error(own, reference, truth),
        error={
            motion_class: float(np.median([one.overall for one in found.scores[names[0]]]))
            for motion_class, found in evidence.scores.items()
        },
        own={
            motion_class: float(np.median(known))
            for motion_class, found in evidence.scores.items()
            if (known := [one.own for one in found.scores[names[0]] if one.own is not None])
        }
        if truth is not None
        else {},
    )


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
