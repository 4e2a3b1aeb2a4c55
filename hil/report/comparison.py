"""The page that compares campaigns of one arm."""

from __future__ import annotations

import math
import string
from dataclasses import dataclass
from typing import Any

from hil.compare import words
from hil.compare.comparison import AxisChange, Comparison, ParameterChange
from hil.compare.payload import LEAST_EFFECT
from hil.compare.spread import FEWEST
from hil.compare.trend import FALSE_ALARMS, LEAST_FRICTION
from hil.report import numbers
from hil.report.figures.comparison import friction_panels
from hil.report.rendering import environment, page_bytes
from hil.version import software


@dataclass(frozen=True)
class Row:
    """One line of a table: a name, what stands beside it, and whether it changed."""

    name: str
    cells: list[str]
    changed: bool


def comparison_bytes(found: Comparison) -> bytes:
    """The page as one HTML file; the same input gives the same bytes."""
    return page_bytes(render_comparison(found))


def render_comparison(found: Comparison) -> str:
    """The page as text."""
    return environment().get_template("comparison.html.j2").render(**_context(found))


def _context(found: Comparison) -> dict[str, Any]:
    letters = [_letter(k) for k in range(len(found.campaigns))]
    return {
        "found": found,
        "letters": letters,
        "verdict": words.verdict(found),
        "findings": words.findings(found),
        "caveat": words.caveat(found),
        "names": words.names(found),
        "campaigns": [_campaign(found, k) for k in range(len(letters))],
        "friction_panels": friction_panels(found, letters),
        "axis_rows": [_axis(axis, letters) for axis in found.axes],
        "load_rows": [_load(found, k) for k in range(len(letters))],
        "seen_mass": any(math.isfinite(m) for m in found.payload.mass[1:]),
        "prediction_rows": _predictions(found),
        "joint_predictions": _joint_predictions(found, letters),
        "base_rows": [_parameter(p) for p in found.parameters if not p.is_friction],
        "coefficient_rows": [_parameter(p) for p in found.parameters if p.is_friction],
        "software": software(),
        "rules": {
            "fewest": FEWEST,
            "alarms": f"{100.0 * FALSE_ALARMS:g} %",
            "half": f"{50.0 * FALSE_ALARMS:g} %",
            "friction": f"{100.0 * LEAST_FRICTION:g} %",
            "effect": f"{100.0 * LEAST_EFFECT:g} %",
        },
    }


def _letter(k: int) -> str:
    """A, B ... Z, A1, B1 ..."""
    round_, place = divmod(k, len(string.ascii_uppercase))
    return string.ascii_uppercase[place] + (str(round_) if round_ else "")


def _campaign(found: Comparison, k: int) -> list[str]:
    one = found.campaigns[k]
    when = one.when[:16].replace("T", " ") if one.when else numbers.MISSING
    return [words.names(found)[k], when, str(one.repetitions), one.setup or "nothing", one.campaign]


def _axis(axis: AxisChange, letters: list[str]) -> Row:
    speed = numbers.speed_text(axis.speed, axis.speed_unit)
    cells = [speed, axis.unit, *(numbers.with_std(one.value, one.std) for one in axis.known)]
    for k in range(1, len(letters)):
        if not math.isfinite(axis.p_values[k]):
            cells += [numbers.MISSING] * 4
            continue
        change, low, high = (100.0 * one for one in axis.relative(k))
        cells += [
            ("■ " if axis.changed[k] else "□ " if axis.slight[k] else "")
            + numbers.fixed(change, 1, sign=True),
            f"{numbers.fixed(low, 1, sign=True)} to {numbers.fixed(high, 1, sign=True)}",
            numbers.significant(float(axis.p_values[k]), 2),
            numbers.significant(100.0 * float(axis.smallest[k]), 2),
        ]
    return Row(axis.joint, cells, any(axis.changed))


def _load(found: Comparison, k: int) -> Row:
    payload, change = found.payload, found.payload.changes[k]
    mass, std = float(payload.mass[k]), float(payload.mass_std[k])
    text = numbers.with_std(mass, std) if std > 0.0 else numbers.MISSING
    outcome = (
        "■ changed"
        if payload.changed[k]
        else "▲ other inertia"
        if payload.other[k]
        else "as before"
    )
    if k == 0 or change is None:
        return Row(
            words.names(found)[k], ["reference" if k == 0 else "not tested", text, "", ""], False
        )
    return Row(
        words.names(found)[k],
        [
            outcome,
            text,
            numbers.significant(change.p_value, 2),
            numbers.percent(change.effect),
        ],
        payload.changed[k] or payload.other[k],
    )


def _predictions(found: Comparison) -> list[Row]:
    """Rows: models; columns: whose validation motions."""
    overall = found.prediction.overall
    return [
        Row(name, [_percent(float(x)) for x in overall[k]], False)
        for k, name in enumerate(words.names(found))
    ]


def _joint_predictions(found: Comparison, letters: list[str]) -> list[Row]:
    """Per joint: the first model on the motions of the others, beside their own."""
    joints = found.prediction.joints
    return [
        Row(
            name,
            [
                _percent(float(joints[model, k, j]))
                for k in range(1, len(letters))
                for model in (0, k)
            ],
            False,
        )
        for j, name in enumerate(found.joint_names)
    ]


def _parameter(one: ParameterChange) -> Row:
    cells = [
        one.unit.replace(" ", "·"),
        *(numbers.with_std(each.value, each.std) for each in one.known),
    ]
    for k in range(1, len(one.known)):
        apart = one.differences[k]
        if apart is None or not math.isfinite(apart.value):
            cells += [numbers.MISSING, numbers.MISSING]
            continue
        mark = "■ " if one.differs(k) else ""
        cells += [
            mark + numbers.beside(apart.value, apart.std),
            numbers.significant(float(one.p_values[k]), 2),
        ]
    return Row(one.name, cells, any(one.differs(k) for k in range(1, len(one.known))))


def _percent(share: float) -> str:
    return numbers.percent(share) if math.isfinite(share) else numbers.MISSING
