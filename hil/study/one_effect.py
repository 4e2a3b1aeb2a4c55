"""One at a time of what the model leaves out: which of it decides between A and B."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.cell import Cell
from hil.cell.text import replaced_value

from .bands import bands_of
from .comparing import Estimated, compared_on, corrected, torque_kernels
from .designs import A, B
from .forms import ClassForms
from .records import FitRecord
from .results import AblationPoint, AblationResult
from .summary import parameter_error

Array = NDArray[np.float64]

ONE_EFFECT: Final = "effects"
NONE, ALL = "none", "all"
EFFECT_SETTINGS: Final = {
    "ripple": ("torque_ripple", 0.0),
    "drift": ("friction_drift", 0.0),
    "elasticity": ("elasticity", []),
    "delay": ("delay", 0.0),
}
"""Setting in a cell's `[simulation]` for each effect, and what switches it off."""


def effects_of(cell: Cell) -> list[str]:
    """Effects that a cell names a size of."""

    def size(setting: str) -> bool:
        return bool(np.any(getattr(cell.simulation, setting)))

    return [name for name, (setting, _) in EFFECT_SETTINGS.items() if size(setting)]


def with_only(cell: Cell, effect: str) -> Cell:
    """The cell with every effect but one at nothing, in its text too."""
    text = cell.text
    for name, (setting, off) in EFFECT_SETTINGS.items():
        if name != effect:
            text = replaced_value(text, "simulation", setting, str(off))
    return Cell.from_texts(text, cell.urdf, cell.path)


def effect_key(method: str, effect: str) -> str:
    """Key of a method's campaign with one effect."""
    return f"{method}-only-{effect}"


@dataclass(frozen=True, eq=False)
class EffectSetting:
    """What A and B gave with some of the effects on.

    Attributes:
        label: which effects.
        fits: of both methods, by method.
        forms: of the held-out fly-by motions of an arm with the same effects.
        repetitions: the first so many of each fit.
        base: whether it is a condition of the study itself.
    """

    label: str
    fits: Mapping[str, FitRecord]
    forms: ClassForms
    repetitions: int
    base: bool = False

    def values(self, method: str) -> Array:
        """Estimates (r, p) of a method's repetitions."""
        return np.array(self.fits[method].values[: self.repetitions])


def effect_ablation(
    settings: list[EffectSetting],
    main: Mapping[str, FitRecord],
    plain: Mapping[str, ClassForms],
    truth: Array,
) -> AblationResult:
    """A and B with one effect at a time, on fly-by motions of an arm with the same effect.

    Args:
        settings: in the order they are shown in, that without effects first.
        main: all repetitions of A and B without effects.
        plain: held-out motions of the arm without effects, by class.
        truth: planted parameters (p,).
    """
    reference = settings[0].values(B).mean(axis=0)
    few = settings[0].repetitions
    counts = sorted({len(one.forms.whole) for one in settings if not one.base})
    return AblationResult(
        key=ONE_EFFECT,
        title="One effect at a time",
        variable="effects that are on",
        words=f"A and B run {'once' if few == 1 else f'{few} times'} on an arm with only one of"
        " the effects that the model leaves out, and asked to predict"
        f" {' or '.join(map(str, counts)) or 'the same'} fly-by motions of the same arm.",
        points=[
            _point(k, method, one, plain, truth, reference)
            for method in (A, B)
            for k, one in enumerate(settings)
        ],
        comparisons=corrected(
            [
                compared_on(
                    "fly-by",
                    Estimated(A, one.values(A)),
                    Estimated(B, one.values(B)),
                    torque_kernels(one.forms),
                    drifts=True,
                ).model_copy(update={"setting": one.label})
                for one in settings
            ]
        ),
        bands=[
            band
            for method in (A, B)
            for band in bands_of(
                method,
                np.array(main[method].values),
                few,
                plain,
                truth,
                reference,
                ("own", "parameter_error"),
            )
        ],
        missing=[],
    )


def _point(
    k: int,
    method: str,
    setting: EffectSetting,
    plain: Mapping[str, ClassForms],
    truth: Array,
    reference: Array,
) -> AblationPoint:
    record, estimate = setting.fits[method], setting.values(method).mean(axis=0)
    return AblationPoint(
        value=float(k),
        label=setting.label,
        method=method,
        base=setting.base,
        repetitions=len(setting.values(method)),
        log10_det=record.log10_det,
        coupling_index=record.coupling_index,
        duration=record.duration,
        parameter_error=parameter_error(estimate, reference, truth),
        error={"fly-by": float(np.median(setting.forms.overall(estimate)))},
        own={name: float(np.median(one.own(estimate, truth))) for name, one in plain.items()},
    )
