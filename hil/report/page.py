"""The page: results and series in, one self-contained HTML file out.

Templates read the results themselves; here is what has to be computed for them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from hil.archive.header import ArchiveName
from hil.report import figures
from hil.report.numbers import MISSING, beside, fixed, significant
from hil.report.rendering import environment, page_bytes
from hil.report.series import ReportSeries
from hil.results import ChoiceResult, ParameterResult, RecordedResult, Results, outside_mark

_METHODS: Final = {
    "a": "designed by the paper's method A",
    "b": "designed by the paper's method B",
    "balanced": "designed for balanced criteria",
    "front": "designed as the knee of log det and I_c",
    "random": "the best of random motions",
}
_CRITERIA: Final = (
    ("log10_det", "log₁₀ det(ΦᵀΦ / N)", "eq. 9: information, in SI units; more is better", 2),
    ("coupling_index", "Coupling index I_c", "eq. 5: sum of |correlations|; less is better", 1),
    ("coupling_index_max", "Largest possible I_c", "p (p − 1) / 2 for p parameters", 0),
    ("fitness", "Fitness", "eq. 7: weighted log det and I_c,max / I_c", 2),
    ("scaled_condition", "Condition, columns scaled", "of Φ with columns of unit norm", 1),
    ("condition", "Condition", "of Φ as it is, in SI units", 0),
    ("n_samples", "Samples N", "samples of motion that entered", 0),
)
_MOST_CANDIDATES: Final = 6
"""Candidates of one choice that are shown: the first, and the best of the others."""

Fact = tuple[str, str]  #: A term and what is known of it


def report_bytes(results: Results, series: ReportSeries) -> bytes:
    """The report as one HTML file; the same input gives the same bytes.

    Raises:
        SeriesError: the series belong to another number of joints than the results.
    """
    series = series.checked_for(len(results.joint_names))
    joints, runs = figures.joints_of(results), results.validation
    recorded = [] if results.conduct is None else results.conduct.recorded
    errors = np.array([[r.overall_relative_error, r.all_rows_relative_error] for r in runs])
    context = {
        "results": results,
        "series": series,
        "facts": facts(results),
        "estimation_facts": estimation_facts(results),
        "criteria": criteria(results),
        "shown_candidates": shown_candidates,
        "expression": expression,
        "routes": routes(results),
        "reported_title": ROUTES[results.uncertainty.reported][0],
        "has_truth": any(p.truth is not None for p in results.parameters),
        "has_ids": any(p.table2_id is not None for p in results.parameters),
        "has_repetitions": any(p.repetition_std is not None for p in results.parameters),
        "by_name": {parameter.name: parameter for parameter in results.parameters},
        "outside_mark": outside_mark,
        "unseen": np.median(errors, axis=0).tolist() if runs else None,
        "worst": max(runs, key=lambda run: run.overall_relative_error) if runs else None,
        "error_rows": error_rows(results),
        "every_row_errors": every_row_errors(results),
        "when": when(recorded),
        "health": health(recorded),
        "motion_name": motion_name,
        "warm_up_panels": figures.warm_up_panels(results),
        "excitation_panels": figures.excitation_panels(series, results.joint_names),
        "has_reversals": bool(np.isfinite(series.reversal_travel).any()),
        "correlation": figures.correlation_matrix(results),
        "box_panels": figures.error_boxes(results),
        "torque_panels": figures.torque_panels(series, joints),
        "split_panels": figures.split_panels(series, joints),
        "spectrum_panels": figures.spectrum_panels(series, joints),
        "replay_panels": figures.replay_panels(series, joints),
        "curve_panels": figures.friction_curve_panels(series, joints),
        **figures.residual_panels(results),
    }
    return page_bytes(environment().get_template("report.html.j2").render(**context))


# Torque prediction


def error_rows(results: Results) -> list[tuple[str, float | None, float]]:
    """Motion, error of the verdict and error over every row, all joints, as shares."""
    runs, fitted = results.validation, results.fitted
    found: list[tuple[str, float | None, float]] = []
    if runs:
        both = np.array([[r.overall_relative_error, r.all_rows_relative_error] for r in runs])
        many = len(runs) > 1
        title = f"unseen, median of {len(runs)} runs" if many else "unseen"
        found.append((title, *np.median(both, axis=0).tolist()))
        if many:
            found.append(("unseen, worst run", *both.max(axis=0).tolist()))
    if fitted is not None:
        title = "fitted" if runs else "fitted (in-sample: nothing was held out)"
        found.append((title, fitted.overall_relative_error, fitted.all_rows_relative_error))
        smoothed = fitted.smoothed_overall_relative_error
        if smoothed is not None:
            found.append(("fitted, torque smoothed as it was fitted", None, smoothed))
    return found


def every_row_errors(results: Results) -> list[float]:
    """Error of each joint over every row, as a share; empty where no file says it.

    The median of the runs on unseen motion, or the error on what was fitted.
    """
    known = [run.all_rows_joint_errors for run in results.validation]
    if not known and results.fitted is not None:
        known = [results.fitted.all_rows_joint_errors]
    return np.median(np.array(known), axis=0).tolist() if known and all(known) else []


# Parameters

_VISCOUS_UNITS: Final = frozenset({"N·m·s/rad", "N·m/(rad/s)", "N m s/rad", "Nms/rad"})
ROUTES: Final = {
    "least_squares": (
        "Least squares",
        "residuals white: independent from sample to sample. Too small where they are coloured",
    ),
    "independent_repetitions": (
        "Independent repetitions",
        "residuals of any colour within a repetition, none from one repetition to the next",
    ),
    "phase_clustered": (
        "Phase-clustered",
        "residuals may also return at the same place of the motion in every repetition,"
        " as what the model leaves out does",
    ),
    "scatter_of_mean": (
        "Scatter of the mean",
        "nothing but independent repetitions: their scatter over the root of their number."
        " Blind to an error that all of them share",
    ),
    "posterior": (
        "Posterior",
        "what was believed before the data, and residuals of the colour they have",
    ),
}
"""Title of each route to a standard deviation, and what it assumes."""


def expression(p: ParameterResult) -> str:
    """What the name stands for; viscous friction also in the unit that manufacturers print."""
    text = p.expression if p.expression != p.name else ""
    if p.unit not in _VISCOUS_UNITS:
        return text
    scale = math.pi / 180.0
    per_degree = f"{beside(scale * p.estimate, scale * p.std)} N·m per °/s"
    return f"{text}; {per_degree}" if text else per_degree


def routes(results: Results) -> list[dict[str, Any]]:
    """The standard-deviation routes that were computed, compared with the reported one."""
    uncertainty, reported = results.uncertainty, np.array([p.std for p in results.parameters])
    far = np.array(
        [abs(p.estimate - p.truth) if p.truth is not None else np.nan for p in results.parameters]
    )
    found = []
    for key, (title, assumes) in ROUTES.items():
        if getattr(uncertainty, key) is None:
            continue
        std = np.array(getattr(uncertainty, key), dtype=np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio, z = std / reported, far / std
        ratio, z = ratio[np.isfinite(ratio)], z[~np.isnan(far)]
        low, median, high = np.quantile(ratio, (0.0, 0.5, 1.0)) if ratio.size else [None] * 3
        found.append(
            {
                "title": title,
                "assumes": assumes,
                "reported": key == uncertainty.reported,
                "ratios": (median, low, high),
                "within": [f"{np.sum(z <= most)} of {z.size}" for most in (2.0, 3.0)],
            }
        )
    return found


# What was run, and how


def facts(results: Results) -> list[Fact]:
    """Cell, motion and software; the archives are listed in the provenance."""
    excitation, runs = results.excitation, results.validation
    rate = 1.0 / results.period if results.period > 0 else float("inf")
    method = excitation.method
    motion = {
        f"{fixed(excitation.duration, 2)} s": True,
        f"{excitation.n_sines} sines per joint": excitation.n_sines is not None,
        f"{excitation.n_via} via points": excitation.n_via is not None,
        f"fly-by {100.0 * (excitation.fly or 0.0):g} %": excitation.fly is not None,
        _METHODS.get(method or "", f"found by {method}"): method is not None,
    }
    seconds = significant(sum(run.duration for run in runs))
    return [
        ("Cell", results.cell),
        ("Joints", f"{len(results.joint_names)}: " + ", ".join(results.joint_names)),
        ("Cycle", f"{1e3 * results.period:g} ms ({rate:g} Hz)"),
        ("Excitation", ", ".join(words for words, known in motion.items() if known)),
        ("Validation runs", f"{len(runs)}, {seconds} s in all" if runs else "none"),
        (
            "Parameters",
            f"{results.n_base} base + {len(results.parameters) - results.n_base} friction",
        ),
    ]


def estimation_facts(results: Results) -> list[Fact]:
    """Estimator, conditioning, bias by noise in the regressor, prior, and base parameters."""
    estimator = results.estimator
    condition = significant(estimator.condition, 3)
    found = [
        ("Estimator", f"{estimator.words} (--estimator {estimator.name})"),
        ("Values and std", results.uncertainty.method),
        ("Condition", f"{condition} with columns of unit length, weighted by joint"),
        ("Base parameters", estimator.grouping),
    ]
    bias = results.endogeneity.sentence if results.endogeneity else results.endogeneity_untested
    if bias:
        found.append(("Noise in the regressor", bias))
    if estimator.prior:
        learned = [p.learned for p in results.parameters if p.learned is not None]
        text = f"Nothing: {estimator.prior}."
        if learned:
            text = (
                f"{estimator.prior}. {sum(learned)} of {len(learned)} parameters were learned from"
                " the data: at least three quarters of what is now known of them comes from there."
            )
        found.append(("Known before the data", text))
    return found


def criteria(results: Results) -> list[tuple[str, ...]]:
    """Title, meaning, planned, executed and change; the paper's equations by number."""
    planned, executed = results.excitation.planned, results.excitation.executed
    rows: list[tuple[str, ...]] = []
    for name, title, meaning, decimals in _CRITERIA:
        pair = [None if one is None else getattr(one, name) for one in (planned, executed)]
        texts = [
            significant(one) if one is not None and abs(one) >= 1e7 else fixed(one, decimals)
            for one in pair
        ]
        before, after = pair
        change = MISSING
        if before is not None and after is not None and name != "n_samples":
            # A log has no meaningful percentage, the others get one.
            if name in {"log10_det", "fitness"} or before == 0.0:
                change = fixed(after - before, decimals, sign=True)
            else:
                change = fixed(100.0 * (after / before - 1.0), 1, sign=True) + " %"
        rows.append((title, meaning, *texts, change))
    return rows


def shown_candidates(choice: ChoiceResult) -> list[int]:
    """Indices of the candidates of a choice that the page shows, the first one first."""
    errors = [math.inf if error is None else error for error in choice.errors]
    shown = list(range(len(errors)))
    if len(shown) <= _MOST_CANDIDATES:
        return shown
    # The first is the simplest, against which the others had to pay: least squares.
    best = sorted(shown[1:], key=lambda k: (k != choice.chosen, errors[k]))
    return [0, *best[: _MOST_CANDIDATES - 1]]


def when(recorded: Sequence[RecordedResult]) -> str:
    """From the first archive's begin to the last one's, in a sentence."""
    begins = sorted(one.when for one in recorded if one.when is not None)
    if not begins:
        return (
            "No date is on record; virtual time has none." if recorded else "Nothing was recorded."
        )
    first, last = (one[:16].replace("T", " ") for one in (begins[0], begins[-1]))
    if first[:10] == last[:10]:
        last = last[11:]
    return f"{first} to {last}, where the last motion began (UTC)."


def health(recorded: Sequence[RecordedResult]) -> str:
    """How the link did over all archives, in a sentence."""
    cycles = sum(one.cycles for one in recorded)
    if not cycles:
        return "No archive could be read."
    counts = {
        "packets missed": sum(one.missed for one in recorded),
        "answers late": sum(one.late for one in recorded),
        "replies not accepted": sum(one.not_accepted for one in recorded),
        "cycles not archived": sum(one.lost for one in recorded),
    }
    losses = ", ".join(
        f"{count} {words} ({significant(1e6 * count / cycles, 2)} in a million)"
        for words, count in counts.items()
        if count
    )
    return f"{cycles} cycles in {len(recorded)} archives: {losses or 'none lost or late'}."


def motion_name(one: RecordedResult) -> str:
    """The motion of an archive as a person calls it."""
    name = ArchiveName.parse(one.archive)
    return one.kind if name is None else name.motion
