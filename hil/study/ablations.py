"""Method B, and where it matters A, with one thing changed and everything else unchanged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from .campaigns import noise_key
from .records import CLASSES, ClassForms, FitRecord, ScoreRecord
from .results import AblationBand, AblationPoint, AblationResult
from .searches import SINES, A, B, fly_key, via_key, weight_key
from .settings import StudySettings
from .statistics import bands_of, compared_on, corrected, parameter_error

Array = NDArray[np.float64]
_TEXTS: Final = {
    "sines": (
        "What method A may choose",
        "sines of method A",
        "What the paper leaves open of method A, a search each: sines about the middle of the"
        " ranges or about the home posture, with the frequencies of Table 1 or with those that the"
        " appendix's bound allows; each beside B.",
    ),
    "fly": (
        "Fly-by share",
        "fly-by share of B's via points",
        "B's own via points and speeds, planned again with another fly-by share and run: the"
        " corners change, the search does not.",
    ),
    "n_via": (
        "Number of via points",
        "via points K",
        "A search like B's, as long as B's, for each number; more of them make a longer motion.",
    ),
    "weight": (
        "Weight of the coupling index",
        "λ2 of the coupling index in eq. 7",
        "A search like B's for each weight; λ1 = 1 − λ2 is that of log det.",
    ),
    "repetitions": (
        "Number of repetitions",
        "repetitions that are fitted",
        "The first repetitions of the study itself; nothing is run again.",
    ),
    "noise": (
        "Noise of the currents",
        "multiple of the cell's current noise",
        "A and B run at each level; the held-out motions stay those of the study.",
    ),
}
"""Title, name of the setting, and what is done, by key of the ablation."""
_SINES_LABELS: Final = ("middle, printed", "home, printed", "middle, fast", "home, fast")
_LABELS: Final = dict(zip(SINES, _SINES_LABELS, strict=True))


@dataclass(frozen=True, eq=False)
class Evidence:
    """What ablations are made from.

    Attributes:
        fits: of every executed excitation of the ablations, by key.
        main: of A and B with all repetitions.
        scores: of the held-out motions, by class, of one or several campaigns.
        truth: planted parameters (p,), None for a real arm.
        sines: key of the sines that method A is represented by.
    """

    fits: Mapping[str, FitRecord]
    main: Mapping[str, FitRecord]
    scores: Sequence[Mapping[str, ScoreRecord]]
    truth: Array | None
    sines: str = ""

    @cached_property
    def forms(self) -> dict[str, ClassForms]:
        """Of the held-out motions, by class: the error of any estimate."""
        return {
            name: ClassForms.of(
                [form for own in self.scores if name in own for form in own[name].forms]
            )
            for name in CLASSES
            if any(name in own for own in self.scores)
        }

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
    ) -> AblationPoint:
        """One setting: estimates (r, p) of its repetitions beside a reference (p,)."""
        own, truth = values.mean(axis=0), self.truth
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
            error={name: float(np.median(one.overall(own))) for name, one in self.forms.items()},
            own={}
            if truth is None
            else {name: float(np.median(one.own(own, truth))) for name, one in self.forms.items()},
        )

    def bands(self, methods: Sequence[str], size: int, reference: Array) -> list[AblationBand]:
        """Where the figures lie for other repetitions of the study's own motions."""
        return [
            band
            for method in methods
            for band in bands_of(
                method, np.array(self.main[method].values), size, self.forms, self.truth, reference
            )
        ]


def ablations(settings: StudySettings, evidence: Evidence) -> list[AblationResult]:
    """All of a simulated study."""
    reference = evidence.executed(B).mean(axis=0)

    def varied(
        key: str, wanted: Sequence[tuple[float, str, str]], base: object, methods: Sequence[str]
    ) -> AblationResult:
        """By value, method and key of the fit; the setting of the study itself is `base`."""
        points = [
            evidence.point(
                float(value),
                evidence.fits[fit],
                evidence.executed(fit),
                reference,
                method=method,
                base=base in (value, fit),
                label=_LABELS.get(fit, ""),
            )
            for value, method, fit in wanted
            if fit in evidence.fits
        ]
        return _result(key, points, evidence.bands(methods, len(evidence.executed(B)), reference))

    sines = [key for key in SINES if key in evidence.fits]
    fly_by = evidence.forms["fly-by"]
    inner = {key: fly_by.torque_kernels(evidence.executed(key)) for key in (*sines, B)}
    beside_b = corrected(
        [compared_on("fly-by", (key, B), (inner[key], inner[B]), drifts=False) for key in sines]
    )
    noises = [(f, method, noise_key(method, f)) for method in (A, B) for f in settings.noise]
    return [
        varied(
            "sines", [(k, A, key) for k, key in enumerate(sines)], evidence.sines, ()
        ).model_copy(update={"comparisons": beside_b}),
        varied("fly", [(one, B, fly_key(one)) for one in settings.fly], B, (B,)),
        varied("n_via", [(one, B, via_key(one)) for one in settings.n_via], B, (B,)),
        varied("weight", [(one, B, weight_key(one)) for one in settings.coupling_weight], B, (B,)),
        repetition_ablation(evidence, settings.subsets, (A, B)),
        varied("noise", noises, 1.0, (A, B)),
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
    return _result("repetitions", points, bands)


def _result(key: str, points: list[AblationPoint], bands: list[AblationBand]) -> AblationResult:
    title, variable, words = _TEXTS[key]
    return AblationResult(
        key=key, title=title, variable=variable, words=words, points=points, bands=bands
    )
