"""What becomes of method B when one thing is changed and everything else kept."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hil.design import preset

from .bands import bands_of
from .comparing import Estimated, compared_on, corrected, torque_kernels
from .designs import SINES, SINES_LABELS, A, B, fly_key, via_key, weight_key
from .forms import ClassForms
from .plans import SINES_ABLATION, noise_key
from .records import FitRecord, ScoreRecord
from .results import AblationBand, AblationPoint, AblationResult
from .settings import StudySettings
from .summary import parameter_error

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Evidence:
    """What ablations are made from.

    Attributes:
        fits: of every executed excitation of the ablations, by key.
        main: of A and B with all repetitions.
        scores: of the held-out motions, by class.
        truth: planted parameters (p,), None for a real arm.
        missing: what could not be run, by ablation, in sentences.
        sines: key of the sines that method A is represented by.
    """

    fits: Mapping[str, FitRecord]
    main: Mapping[str, FitRecord]
    scores: Mapping[str, ScoreRecord]
    truth: Array | None
    missing: Mapping[str, Sequence[str]] = field(default_factory=dict)
    sines: str = ""

    @cached_property
    def forms(self) -> dict[str, ClassForms]:
        """Of the held-out motions, by class: the error of any estimate."""
        return {name: ClassForms.of(one.forms) for name, one in self.scores.items()}

    def executed(self, key: str) -> Array:
        """Estimates (r, p) of the repetitions of an ablation's own campaign."""
        return np.array(self.fits[key].values)


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
            bands=_bands(evidence, (A, B), few),
            missing=list(evidence.missing.get("noise", ())),
        ),
    ]


def _sines(evidence: Evidence, few: int) -> AblationResult:
    """What method A is left free to choose, each beside B."""
    keys = [key for key in SINES if key in evidence.fits]
    forms = evidence.forms["fly-by"]
    b = Estimated(B, evidence.executed(B))
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
                    "fly-by",
                    Estimated(key, evidence.executed(key)),
                    b,
                    torque_kernels(forms),
                    drifts=False,
                )
                for key in keys
            ]
        ),
        missing=list(evidence.missing.get(SINES_ABLATION, ())),
    )


def repetition_ablation(
    evidence: Evidence, sizes: Sequence[int], methods: Sequence[str]
) -> AblationResult:
    """Estimates from the first repetitions only, each size beside the last method's."""
    last = np.array(evidence.main[methods[-1]].values)
    points, bands = [], []
    for method in methods:
        record = evidence.main[method]
        values = np.array(record.values)
        for size in (one for one in sizes if one <= len(values)):
            reference = last[:size].mean(axis=0)
            base = size == len(values)
            points.append(
                _point(evidence, float(size), method, record, (values[:size], reference), base=base)
            )
            bands += bands_of(method, values, size, evidence.forms, evidence.truth, reference)
    return AblationResult(
        key="repetitions",
        title="Number of repetitions",
        variable="repetitions that are fitted",
        words="The first so many repetitions of the study itself; nothing is run again.",
        points=points,
        bands=bands,
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
        bands=_bands(evidence, (B,), len(evidence.executed(B))),
        missing=list(evidence.missing.get(key, ())),
    )


def _executed(
    evidence: Evidence, value: float, method: str, key: str, *, base: bool
) -> AblationPoint:
    """A setting that was run for the ablation, beside B run as often."""
    values = evidence.executed(key), evidence.executed(B).mean(axis=0)
    return _point(evidence, value, method, evidence.fits[key], values, base=base)


def _bands(evidence: Evidence, methods: Sequence[str], size: int) -> list[AblationBand]:
    """Where the figures lie for other repetitions of the study's own motions."""
    reference = evidence.executed(B).mean(axis=0)
    return [
        band
        for method in methods
        for band in bands_of(
            method,
            np.array(evidence.main[method].values),
            size,
            evidence.forms,
            evidence.truth,
            reference,
        )
    ]


def _point(
    evidence: Evidence,
    value: float,
    method: str,
    record: FitRecord,
    values: tuple[Array, Array],
    *,
    base: bool,
) -> AblationPoint:
    """One setting; `values` are its repetitions (r, p) and the estimate it is set beside (p,)."""
    repetitions, reference = values
    own, truth = repetitions.mean(axis=0), evidence.truth
    return AblationPoint(
        value=value,
        method=method,
        base=base,
        repetitions=len(repetitions),
        log10_det=record.log10_det,
        coupling_index=record.coupling_index,
        duration=record.duration,
        parameter_error=None if truth is None else parameter_error(own, reference, truth),
        error={name: float(np.median(one.overall(own))) for name, one in evidence.forms.items()},
        own={}
        if truth is None
        else {name: float(np.median(one.own(own, truth))) for name, one in evidence.forms.items()},
    )


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
