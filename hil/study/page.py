"""The page of a study: results in, one self-contained HTML file out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from jinja2 import ChoiceLoader, FileSystemLoader

from hil.report import numbers
from hil.report.figures.svg import Panel
from hil.report.rendering import Numbering, environment, page_bytes

from . import figures, figures_ablations, figures_ratios
from .designs import AP, B0, A, B
from .records import PLANTED
from .results import ComparisonResult, ConditionResult, CrossCell, MethodResult, StudyResults
from .wording import effect_words, labels_of, upper

_TEMPLATES: Final = Path(__file__).parent / "templates"
_METHOD_COLOURS: Final = ("--first", "--second", "--route-3", "--route-0")
_METHOD_SHAPES: Final = ("●", "◆", "▲", "■")


def study_page(results: StudyResults) -> bytes:
    """The page as one HTML file; the same results give the same bytes."""
    known = environment()
    assert known.loader is not None  # where macros and style sheet of all pages lie
    known.loader = ChoiceLoader([FileSystemLoader(_TEMPLATES), known.loader])
    template = known.get_template("study.html.j2")
    return page_bytes(template.render(**_context(results)))


@dataclass(frozen=True)
class ConditionPart:
    """What the page shows of one condition."""

    key: str
    words: str
    effects: list[str]
    boxes: list[Panel]
    archive: str
    example: list[Panel]
    equal: bool
    own: bool
    left_out: str
    cross_head: list[str]
    cross: list[tuple[str, list[tuple[str, str]]]]
    comparisons: list[list[str]]
    joints: list[list[str]]


@dataclass(frozen=True)
class ParameterRow:
    """One line of Table 2, every number already text."""

    id: str
    symbol: str
    ours: list[str]
    planted: str
    printed: list[str]


def _context(results: StudyResults) -> dict[str, Any]:
    first = results.conditions[0]
    paragraphs = {one.key: one for one in results.reading}
    return {
        "numbering": Numbering(),
        "results": results,
        "reading": paragraphs,
        "answers": [paragraphs[k] for k in ("prediction", "classes", "effects") if k in paragraphs],
        "legend": [
            (one.label, _METHOD_COLOURS[k % 4], _METHOD_SHAPES[k % 4])
            for k, one in enumerate(first.methods)
        ],
        "trajectories": figures.trajectory_panels(first, results.joint_names),
        "correlations": figures.correlation_panels(results, first),
        "ratios": figures_ratios.ratio_panels(results.conditions),
        "parts": [_part(one, results.joint_names) for one in results.conditions],
        "table1": [_motion_row(row) for row in results.table1],
        "searches": [_search_row(one) for one in results.searches],
        "has_print": any(one.printed_id is not None for one in results.parameters),
        "has_truth": any(one.truth is not None for one in results.parameters),
        "tables2": [(part, _table2(results, part)) for part in results.conditions],
        "ablations": [
            (
                one,
                figures_ablations.ablation_panels(one, labels_of(first)),
                paragraphs.get(f"ablation-{one.key}"),
            )
            for one in results.ablations
        ],
        "labels": labels_of(first),
        "facts": _facts(results),
        "times": _times(results),
    }


def _part(condition: ConditionResult, joint_names: list[str]) -> ConditionPart:
    labels, equal = _labels(condition), condition.equal_data
    example = next(iter(condition.examples), None)
    classes = [one.motion_class for one in condition.classes]
    cells = {(one.method, one.motion_class): one for one in condition.cross}
    return ConditionPart(
        key=condition.key,
        words=condition.words,
        effects=effect_words(condition.effects, joint_names),
        boxes=figures.error_panels(condition, joint_names),
        archive="" if example is None else example.archive,
        example=[] if example is None else figures.example_panels(condition, example, joint_names),
        equal=equal is not None,
        own=bool(condition.own_comparisons),
        left_out=_left_out(condition),
        cross_head=[
            f"{name} ({len(one.archives)})"
            for name, one in zip(classes, condition.classes, strict=True)
        ],
        cross=[
            (
                labels[method],
                [
                    _quartiles(cell)
                    for name in classes
                    if (cell := cells.get((method, name))) is not None
                ],
            )
            for method in dict.fromkeys(one.method for one in condition.cross)
        ],
        comparisons=[
            [
                f"{one.motion_class}{kind}",
                f"{labels[one.second]} / {labels[one.first]}",
                *_paired(one),
            ]
            for kind, some in (
                ("", condition.comparisons),
                (", as much motion", equal.comparisons if equal is not None else []),
                (", own", condition.own_comparisons),
            )
            for one in some
        ],
        joints=[[str(one.joint), *_paired(one)] for one in condition.joint_comparisons],
    )


def _left_out(condition: ConditionResult) -> str:
    """Share of the samples that errors leave out, over the classes."""
    shares = [100.0 * one.left_out_share for one in condition.classes]
    if not shares:
        return ""
    low, high = (f"{pick(shares):.0f}" for pick in (min, max))
    return f"{low} %" if low == high else f"by class {low} to {high} %"


def _paired(one: ComparisonResult) -> list[str]:
    known = one.low is not None and one.high is not None
    return [
        numbers.fixed(one.ratio, 3),
        f"{numbers.fixed(one.low, 3)} to {numbers.fixed(one.high, 3)}"
        if known
        else numbers.MISSING,
        "no different" if one.verdict == "none" else one.verdict,
        f"{one.wins} of {one.motions}",
        numbers.significant(one.p_value, 2),
        numbers.significant(one.p_corrected, 2),
    ]


def _quartiles(cell: CrossCell) -> tuple[str, str]:
    """Median and quartiles, and below them what else is known."""
    middle, low, high = (
        numbers.significant(100.0 * share, 3) for share in (cell.median, cell.lower, cell.upper)
    )
    also = f"all rows {numbers.significant(100.0 * cell.all_rows_median, 2)}"
    if cell.own_median is not None and cell.method != PLANTED:
        also += f"; own {numbers.significant(100.0 * cell.own_median, 2)}"
    return f"{middle} ({low} to {high})", also


def _labels(condition: ConditionResult) -> dict[str, str]:
    """Of every row of the cross table."""
    labels = {one.key: one.label for one in condition.methods}
    equal = condition.equal_data
    if equal is not None:
        labels[equal.name] = (
            f"{labels[equal.cut]}, {equal.repetitions} of its repetitions: as much motion as"
            f" {labels[equal.other]}"
        )
    return labels | {PLANTED: "planted values"}


def _motion_row(row: Any) -> list[str]:
    name = {A: "A", B: "B", B0: "B, fly 0", AP: "A as printed"}.get(row.key, row.key)
    return [
        f"{'paper, ' if row.printed else ''}{name}",
        row.words,
        numbers.fixed(row.duration, 2),
        str(row.n_samples),
        numbers.fixed(row.log10_det, 1),
        numbers.fixed(row.coupling_index, 1),
        numbers.fixed(row.executed_log10_det, 1),
        numbers.fixed(row.executed_coupling_index, 1),
    ]


def _search_row(row: Any) -> list[str]:
    broken = ", ".join(f"{name} {count}" for name, count in row.infeasible.items() if count)
    return [
        f"{row.words}{' (executed)' if row.chosen else ''}",
        str(row.tried),
        numbers.fixed(row.log10_det, 1),
        numbers.fixed(row.coupling_index, 1),
        numbers.fixed(row.duration, 1),
        broken or "none",
    ]


def _table2(results: StudyResults, condition: ConditionResult) -> list[ParameterRow]:
    rows, methods = [], condition.methods
    for k, parameter in enumerate(results.parameters):
        truth = parameter.truth
        factor = parameter.printed_factor
        planted = numbers.MISSING if truth is None else _with_digits(truth, methods, k, factor)
        rows.append(
            ParameterRow(
                id="" if parameter.printed_id is None else str(parameter.printed_id),
                symbol=parameter.printed_symbol or parameter.name,
                ours=[_with_scatter(one, k, factor) for one in methods],
                planted=planted,
                printed=[
                    numbers.fixed(parameter.printed_c, 3),
                    numbers.fixed(parameter.printed_a, 3),
                    numbers.fixed(parameter.printed_b, 3),
                ],
            )
        )
    return sorted(rows, key=lambda row: int(row.id) if row.id else len(rows) + 1)


def _with_scatter(method: MethodResult, k: int, factor: float) -> str:
    """An estimate to the digits that its scatter leaves it, and the scatter where it has one."""
    value, std = factor * method.mean[k], abs(factor) * method.std[k]
    if method.repetitions < 2 or std == 0.0:
        return f"{numbers.significant(value, 4)} ± {numbers.MISSING}"
    return f"{numbers.beside(value, std)} ± {numbers.significant(std, 2)}"


def _with_digits(truth: float, methods: Sequence[MethodResult], k: int, factor: float) -> str:
    """A planted value to the digits of the best known estimate beside it."""
    value = factor * truth
    stds = [one.std[k] for one in methods if one.repetitions > 1 and one.std[k] > 0.0]
    return numbers.beside(value, abs(factor) * min(stds)) if stds else numbers.significant(value, 4)


def _facts(results: StudyResults) -> list[tuple[str, str]]:
    settings = results.settings
    facts = [("Arm", f"{results.cell}{', simulated' if results.simulated else ''}")]
    if settings is not None:
        facts += [
            ("Seed", str(settings.seed)),
            ("Repetitions", f"{settings.repetitions} of each excitation"),
            ("Held out", f"{settings.motions} motions of each class"),
            (
                "Searches",
                f"{settings.effort_a.tried} motions for each of method A's,"
                f" {settings.effort_b.tried} for each of method B's",
            ),
        ]
    return facts


def _times(results: StudyResults) -> list[list[str]]:
    """Stage by stage, and in all: by the clock and of the processors."""
    wall, used = results.times, results.processor_times
    rows = [[upper(name), _clock(value), _clock(used.get(name))] for name, value in wall.items()]
    if len(rows) > 1:
        whole = sum(used.values()) if wall.keys() <= used.keys() else None
        rows.append(["In all", _clock(sum(wall.values())), _clock(whole)])
    return rows


def _clock(seconds: float | None) -> str:
    """A time for people."""
    if seconds is None:
        return numbers.MISSING
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{seconds:.1f} s"
