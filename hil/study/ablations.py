"""Method B, and where it matters A, with one thing changed and everything else unchanged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from .campaigns import noise_key
from .records import ClassForms, FitRecord, ScoreRecord
from .results import AblationBand, AblationPoint, AblationResult
from .searches import SINES, A, B, fly_key, via_key, weight_key
from .settings import StudySettings
from .statistics import (
    Estimated,
    bands_of,
    compared_on,
    corrected,
    parameter_error,
    torque_kernels,
)

Array = NDArray[np.float64]
Setting = tuple[float, str, str, bool]
"""Value, method, key of its fit, and whether it is the setting of the study itself."""

_SINES_LABELS: Final = ("middle, printed", "home, printed", "middle, fast", "home, fast")
_LABELS: Final = dict(zip(SINES, _SINES_LABELS, strict=True))


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

    def point(
        self,
        value: float,
        record: FitRecord,
        values: Array,
        reference: Array,
        *,
        method: str,
        base: bool,
        label: str = "",
        forms: Mapping[str, ClassForms] | None = None,
    ) -> AblationPoint:
        """One setting: estimates (r, p) of its repetitions beside a reference (p,).

        `forms` are the motions that are predicted, by class, if not those of the study.
        """
        own, truth = values.mean(axis=0), self.truth
        predicted = self.forms if forms is None else forms
        return AblationPoint(
            value=value,
            label=label,
            method=method,
            base=base,
            repetitions=len(values),
            log10_det=record.log10_det,
            coupling_index=record.coupling_index,
            duration=record.duration,
            parameter_error=None if truth is None else parameter_error(own, reference, truth),
            error={name: float(np.median(one.overall(own))) for name, one in predicted.items()},
            own={}
            if truth is None
            else {name: float(np.median(one.own(own, truth))) for name, one in self.forms.items()},
        )

    def bands(self, methods: Sequence[str], size: int, reference: Array) -> list[AblationBand]:
        """Where the figures lie for other repetitions of the study's own motions."""
        main = {method: np.array(self.main[method].values) for method in methods}
        return [
            band
            for method, values in main.items()
            for band in bands_of(method, values, size, self.forms, self.truth, reference)
        ]


def ablations(settings: StudySettings, evidence: Evidence) -> list[AblationResult]:
    """All of a simulated study but for the effects one at a time."""
    few = settings.ablation_repetitions
    times = "once" if few == 1 else f"{few} times"

    def one(
        key: str,
        title: str,
        variable: str,
        words: str,
        wanted: Sequence[Setting],
        methods: Sequence[str] = (B,),
    ) -> AblationResult:
        reference = evidence.executed(B).mean(axis=0)
        return AblationResult(
            key=key,
            title=title,
            variable=variable,
            words=words,
            points=[
                evidence.point(
                    value,
                    evidence.fits[fit],
                    evidence.executed(fit),
                    reference,
                    method=method,
                    base=base,
                    label=_LABELS[fit] if key == "sines" else "",
                )
                for value, method, fit, base in wanted
                if fit in evidence.fits
            ],
            bands=evidence.bands(methods, len(evidence.executed(B)), reference),
            missing=list(evidence.missing.get(key, ())),
        )

    def of_b(keys: Mapping[float, str]) -> list[Setting]:
        return [(float(value), B, key, key == B) for value, key in keys.items()]

    sines = [key for key in SINES if key in evidence.fits]
    b, fly_by = Estimated(B, evidence.executed(B)), torque_kernels(evidence.forms["fly-by"])
    beside_b = corrected(
        [
            compared_on("fly-by", Estimated(key, evidence.executed(key)), b, fly_by, drifts=False)
            for key in sines
        ]
    )
    return [
        one(
            "sines",
            "What method A may choose",
            "sines of method A",
            "What the paper leaves open of method A, a search each: sines about the middle of the"
            " ranges or about the home posture, with the frequencies of Table 1 or with those that"
            f" the appendix's bound allows. Each best motion was run {times}, and so was B.",
            [(float(k), A, key, key == evidence.sines) for k, key in enumerate(sines)],
            (),
        ).model_copy(update={"comparisons": beside_b}),
        one(
            "fly",
            "Fly-by share",
            "fly-by share of B's via points",
            "B's own via points and speeds, planned again with another fly-by share and run: the "
            "corners change, the search does not.",
            of_b({value: fly_key(value) for value in settings.fly}),
        ),
        one(
            "n_via",
            "Number of via points",
            "via points K",
            "A search like B's, as long as B's, for each number of via points; more of them make a "
            "longer motion.",
            of_b({value: via_key(value) for value in settings.n_via}),
        ),
        one(
            "weight",
            "Weight of the coupling index",
            "λ2 of the coupling index in eq. 7",
            "A search like B's for each weight; λ1 = 1 − λ2 is that of log det.",
            of_b({value: weight_key(value) for value in settings.coupling_weight}),
        ),
        repetition_ablation(evidence, settings.subsets, (A, B)),
        one(
            "noise",
            "Noise of the currents",
            "multiple of the cell's current noise",
            f"A and B run {times} at each level; the held-out motions stay those of the study.",
            [
                (factor, method, noise_key(method, factor), factor == 1.0)
                for method in (A, B)
                for factor in settings.noise
            ],
            (A, B),
        ),
    ]


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
            reference, base = last[:size].mean(axis=0), size == len(values)
            some = values[:size]
            points.append(
                evidence.point(float(size), record, some, reference, method=method, base=base)
            )
            bands += evidence.bands((method,), size, reference)
    return AblationResult(
        key="repetitions",
        title="Number of repetitions",
        variable="repetitions that are fitted",
        words="The first repetitions of the study itself; nothing is run again.",
        points=points,
        bands=bands,
        missing=[],
    )


@dataclass(frozen=True, eq=False)
class EffectSetting:
    """Fits of A and B with some of the effects on, and fly-by motions of an arm with the same.

    `base` marks a condition of the study itself.
    """

    label: str
    fits: Mapping[str, FitRecord]
    forms: ClassForms
    base: bool = False


def effect_ablation(
    evidence: Evidence, settings: Sequence[EffectSetting], repetitions: int
) -> AblationResult:
    """A and B with one effect at a time, on fly-by motions of an arm with the same effect.

    The first of the settings is that without effects; of each fit so many repetitions are used.
    """

    def values(one: EffectSetting, method: str) -> Array:
        return np.array(one.fits[method].values[:repetitions])

    reference = values(settings[0], B).mean(axis=0)
    return AblationResult(
        key="effects",
        title="One effect at a time",
        variable="effects that are on",
        words=f"A and B run {repetitions} times on an arm with only one of the unmodelled effects,"
        " and fly-by motions of the same arm predicted.",
        points=[
            evidence.point(
                float(k),
                one.fits[method],
                values(one, method),
                reference,
                method=method,
                base=one.base,
                label=one.label,
                forms={"fly-by": one.forms},
            )
            for method in (A, B)
            for k, one in enumerate(settings)
        ],
        comparisons=corrected(
            [
                compared_on(
                    "fly-by",
                    Estimated(A, values(one, A)),
                    Estimated(B, values(one, B)),
                    torque_kernels(one.forms),
                    drifts=True,
                ).model_copy(update={"setting": one.label})
                for one in settings
            ]
        ),
        bands=[
            band
            for band in evidence.bands((A, B), repetitions, reference)
            if band.quantity != "error"
        ],
        missing=[],
    )
