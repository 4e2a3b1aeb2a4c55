"""Tables of `benchmarks.identification_study`: figures over the seeds, and as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from benchmarks.study_fits import Consistent, Fit, Instrumented, Study
from planner.arrays import Array

LEVEL: Final = 0.05
LOWEST: Final = 0.90
HIGHEST: Final = 0.99
"""What the coverage of 95 % intervals is to lie between."""
_WORST: Final = 6

Table = dict[str, Any]


class Covered(NamedTuple):
    """One seed of a coverage study.

    Attributes:
        fit: with the reported intervals.
        classical: half intervals of the classical covariance (p,).
    """

    fit: Fit
    classical: Array


def coverage_table(study: Study, rows: Sequence[Covered]) -> Table:
    """Coverage over all parameters and by parameter, and reported over actual deviations."""
    fits = [row.fit for row in rows]
    values, half = _stacked(fits)
    classical = np.array([row.classical for row in rows])
    apart = np.abs(values - study.truth)
    by_parameter = (apart < half).mean(axis=0)
    spread = values.std(axis=0, ddof=1)
    bias = (values.mean(axis=0) - study.truth) / spread
    # Intervals of a few dozen blocks are Student's: compared as what Gaussian ones would be.
    honest = half.mean(axis=0) / 1.96 / spread
    worst = np.argsort(by_parameter, kind="stable")[:_WORST]
    return {
        "seeds": len(rows),
        "coverage": _share((apart < half).mean()),
        "coverage_inertial": _share((apart < half)[:, : study.model.base.rank].mean()),
        "coverage_friction": _share((apart < half)[:, study.model.base.rank :].mean()),
        "coverage_std_over_parameters": _share(by_parameter.std()),
        "coverage_least": _share(by_parameter.min()),
        "coverage_most": _share(by_parameter.max()),
        "parameters_below_90": int(np.count_nonzero(by_parameter < LOWEST)),
        "parameters_above_99": int(np.count_nonzero(by_parameter > HIGHEST)),
        "coverage_seed_least": _share((apart < half).mean(axis=1).min()),
        "classical_coverage": _share((apart < classical).mean()),
        "reported_over_actual": _figure(np.median(honest)),
        "reported_over_actual_least": _figure(honest.min()),
        "reported_over_actual_most": _figure(honest.max()),
        "classical_over_actual": _figure(np.median(classical.mean(axis=0) / 1.96 / spread)),
        "bias_over_std_rms": _figure(np.sqrt(np.mean(bias**2))),
        "held_out": _mean(fit.held_out for fit in fits),
        "wrong": _mean(fit.wrong for fit in fits),
        "bias": _figure(_bias(study, values)),
        "worst": [
            {
                "name": study.model.parameter_names[k],
                "coverage": _share(by_parameter[k]),
                "bias_over_std": _figure(bias[k]),
                "bias_over_value": _relative(values[:, k].mean() - study.truth[k], study.truth[k]),
                "reported_over_actual": _figure(honest[k]),
            }
            for k in worst
        ],
    }


def consistent_table(study: Study, by_share: Mapping[float, Sequence[Consistent]]) -> Table:
    """Whether it is possible, and what it costs, in points of the held-out error, by share."""
    table = {}
    for share, rows in by_share.items():
        points = np.array([100.0 * (row.consistent.held_out - row.free.held_out) for row in rows])
        table[f"first {share:.0%}"] = {
            "seeds": len(rows),
            "possible": sum(row.possible and row.margin > 0.0 for row in rows),
            "free": _errors(study, [row.free for row in rows]),
            "consistent": _errors(study, [row.consistent for row in rows]),
            "points_mean": _figure(points.mean()),
            "points_most": _figure(points.max()),
        }
    return table


def instruments_table(study: Study, by_noise: Mapping[int, Sequence[Instrumented]]) -> Table:
    """Least squares and instrumental variables, by noise."""
    table = {}
    for times, rows in by_noise.items():
        kinds = {
            "usual": [row.usual for row in rows],
            "least_squares": [row.least_squares for row in rows],
            "instrumental": [row.instrumental for row in rows],
        }
        table[str(times)] = {
            "seeds": len(rows),
            "bandwidth": _figure(np.mean([row.bandwidth for row in rows])),
            **{name: _errors(study, fits) for name, fits in kinds.items()},
            "rejected": _share(np.mean([row.p_value < LEVEL for row in rows])),
            "weak": _figure(np.mean([row.weak for row in rows])),
        }
    return table


def size_table(p_values: Sequence[float]) -> Table:
    """How often the test sees a bias that is not there: one time in twenty, if it is right."""
    p = np.array(p_values)
    return {
        "seeds": len(p),
        "rejected_at_5": _share((p < LEVEL).mean()),
        "rejected_at_20": _share((p < 0.2).mean()),
        "rejected_at_50": _share((p < 0.5).mean()),
    }


def outliers_table(study: Study, by_kind: Mapping[str, Sequence[Mapping[str, Fit]]]) -> Table:
    """Every estimator, by kind of disturbance."""
    return {
        kind: {name: _errors(study, [row[name] for row in rows]) for name in rows[0]}
        for kind, rows in by_kind.items()
    }


def markdown(name: str, table: Table) -> str:
    """One study as a heading and a Markdown table."""
    lines = [f"### {name}", ""]
    if "worst" in table:
        lines += _grid(["figure", "value"], [[k, v] for k, v in table.items() if k != "worst"])
        head = ["parameter", "coverage", "bias / std", "bias / value", "reported / actual std"]
        lines += ["", *_grid(head, [list(row.values()) for row in table["worst"]])]
    elif name == "instruments":
        head = ["noise", "seeds", "bandwidth [Hz]", "fit", "wrong [%]", "bias [%]", "coverage",
                "held out [%]", "DWH rejects"]  # fmt: skip
        lines += _grid(head, [
            [f"x {times}", row["seeds"], row["bandwidth"], kind, *_cells(row[kind]),
             row["rejected"] if kind == "instrumental" else ""]
            for times, row in table.items()
            for kind in ("usual", "least_squares", "instrumental")
        ])  # fmt: skip
    elif name == "consistent":
        head = ["fitted", "estimate", "wrong [%]", "bias [%]", "coverage", "held out [%]",
                "points more, mean", "at most", "possible"]  # fmt: skip
        lines += _grid(head, [
            [share, kind, *_cells(row[kind]), *(
                [row["points_mean"], row["points_most"], f"{row['possible']} of {row['seeds']}"]
                if kind == "consistent" else ["", "", ""]
            )]
            for share, row in table.items()
            for kind in ("free", "consistent")
        ])  # fmt: skip
    elif name == "outliers":
        head = ["disturbance", "estimator", "wrong [%]", "bias [%]", "coverage", "held out [%]"]
        lines += _grid(head, [
            [kind, estimator, *_cells(errors)]
            for kind, row in table.items()
            for estimator, errors in row.items()
        ])  # fmt: skip
    else:
        lines += _grid(["figure", "value"], [[k, v] for k, v in table.items()])
    return "\n".join([*lines, ""])


def _errors(study: Study, fits: Sequence[Fit]) -> Table:
    values, half = _stacked(fits)
    return {
        "wrong": _mean(fit.wrong for fit in fits),
        "bias": _figure(_bias(study, values)),
        "coverage": _share((np.abs(values - study.truth) < half).mean()),
        "held_out": _mean(fit.held_out for fit in fits),
    }


def _cells(errors: Table) -> list[Any]:
    return [
        f"{100.0 * errors['wrong']:.3f}",
        f"{100.0 * errors['bias']:.3f}",
        errors["coverage"],
        f"{100.0 * errors['held_out']:.3f}",
    ]


def _stacked(fits: Iterable[Fit]) -> tuple[Array, Array]:
    """Values and half intervals, both (seeds, p)."""
    fits = list(fits)
    return np.array([fit.values for fit in fits]), np.array([fit.half for fit in fits])


def _bias(study: Study, values: Array) -> float:
    """Relative torque of what the mean of estimates (seeds, p) is off by."""
    gram = study.validation.gram.sum(axis=0)
    apart = values.mean(axis=0) - study.truth
    return float(np.sqrt(max(apart @ gram[:-1, :-1] @ apart, 0.0) / gram[-1, -1]))


def _grid(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> list[str]:
    def line(cells: Iterable[Any]) -> str:
        return "| " + " | ".join(str(cell) for cell in cells) + " |"

    return [line(head), line("---" for _ in head), *(line(row) for row in rows)]


def _mean(numbers: Iterable[float]) -> float:
    return _figure(np.mean(list(numbers)))


def _figure(number: float | np.floating[Any]) -> float:
    return float(f"{number:.4g}")


def _share(number: float | np.floating[Any]) -> float:
    return round(float(number), 4)


def _relative(difference: float, value: float) -> float | None:
    return _figure(difference / value) if value != 0.0 else None
