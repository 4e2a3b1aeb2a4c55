"""The page: results and series in, one self-contained HTML file out.

Templates read the results themselves; here is what has to be computed for them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hil.archive.header import ArchiveName
from hil.report import figures
from hil.report.numbers import MISSING, beside, fixed, significant
from hil.report.rendering import environment, page_bytes
from hil.report.series import ReportSeries
from hil.results import (
    ChoiceResult,
    ParameterResult,
    RecordedResult,
    Results,
    outside_mark,
)

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
_PAIRS: Final = 10

Fact = tuple[str, str]
"""A term and what is known of it."""


def report_bytes(results: Results, series: ReportSeries) -> bytes:
    """The report as one HTML file; the same input gives the same bytes.

    Raises:
        SeriesError: the series belong to another number of joints than the results.
    """
    return page_bytes(render_report(results, series))


def render_report(results: Results, series: ReportSeries) -> str:
    """The page as text.

    Raises:
        SeriesError: the series belong to another number of joints than the results.
    """
    series = series.checked_for(len(results.joint_names))
    template = environment().get_template("report.html.j2")
    return template.render(**_context(results, series))


def _context(results: Results, series: ReportSeries) -> dict[str, Any]:
    joints = figures.joints_of(results)
    return {
        "results": results,
        "series": series,
        "facts": facts(results),
        "estimation_facts": estimation_facts(results),
        "criteria": criteria(results),
        "shown_candidates": shown_candidates,
        "expression": expression,
        "routes": routes(results),
        "reported_title": ROUTES[results.uncertainty.reported][0],
        "pairs": strongest_pairs(results),
        "pairs_above": pairs_above(results, 0.9),
        "has_truth": any(p.truth is not None for p in results.parameters),
        "has_ids": any(p.table2_id is not None for p in results.parameters),
        "has_repetitions": any(p.repetition_std is not None for p in results.parameters),
        "excitation_panels": figures.excitation_panels(series, results.joint_names),
        "has_reversals": bool(np.isfinite(series.reversal_travel).any()),
        "correlation": figures.correlation_matrix(results),
        "box_panels": figures.error_boxes(results),
        "torque_panels": figures.torque_panels(series, joints),
        "split_panels": figures.split_panels(series, joints),
        "spectrum_panels": figures.spectrum_panels(series, joints),
        "replay_panels": figures.replay_panels(series, joints),
        "curve_panels": figures.friction_curve_panels(series, joints),
        **validation_context(results),
        **judgement_context(results),
        **trust_context(results),
        **conduct_context(results),
    }


def validation_context(results: Results) -> dict[str, Any]:
    """What `verdict.html.j2` and `validation.html.j2` need; `unseen` is None without runs."""
    runs, unseen = results.validation, None
    measures = [
        ("Mean |e|", "mean_abs_error", ""),
        ("RMS error", "rms_error", ""),
        ("Signed mean error", "mean_error", ""),
        ("Relative error", "relative_error", "overall_relative_error"),
    ]
    if all(run.all_rows_joint_errors for run in runs):
        every = ("Relative error over every row", "all_rows_joint_errors")
        measures.append((*every, "all_rows_relative_error"))
    if runs:
        worst = max(runs, key=lambda run: run.overall_relative_error)
        unseen = {
            "seconds": sum(run.duration for run in runs),
            "median": float(np.median([run.overall_relative_error for run in runs])),
            "worst": worst.overall_relative_error,
            "worst_archive": worst.archive,
            "every_row": float(np.median([run.all_rows_relative_error for run in runs])),
        }
    return {
        "unseen": unseen,
        "error_rows": error_rows(results),
        "joint_errors": joint_errors(results),
        "run_measures": measures,
        # One number of decimals per joint, so that a column of signed means can be read down.
        "usual_rms": [float(x) for x in np.median([r.rms_error for r in runs] or [[]], axis=0)],
    }


def judgement_context(results: Results) -> dict[str, Any]:
    """What `judgement.html.j2` and `residuals.html.j2` need."""
    judgement = results.judgement
    if judgement is None:
        return {}
    return {
        "every_row_errors": every_row_errors(results),
        "speed_panels": figures.speed_panels(judgement),
        "position_panels": figures.position_panels(judgement),
        "autocorrelation_panels": figures.autocorrelation_panels(judgement),
        "friction_panels": figures.friction_panels(judgement),
    }


def trust_context(results: Results) -> dict[str, Any]:
    """What `trust.html.j2` and `consistency.html.j2` need."""
    by_name = {parameter.name: parameter for parameter in results.parameters}
    return {"by_name": by_name, "outside_mark": outside_mark}


def conduct_context(results: Results) -> dict[str, Any]:
    """What `conduct.html.j2` needs."""
    if results.conduct is None:
        return {}
    recorded = results.conduct.recorded
    return {
        "when": when(recorded),
        "health": health(recorded),
        "motion_name": motion_name,
        "warm_up_panels": figures.warm_up_panels(results),
    }


# Torque prediction


def joint_errors(results: Results) -> list[dict[str, Any]]:
    """Errors of each joint over all validation runs, N·m or N, and as shares of its torque.

    Quartiles of the mean absolute error over the runs; RMS and signed mean over all runs, each
    counting by its duration.
    """
    runs = results.validation
    if not runs:
        return []
    seconds = np.array([run.duration for run in runs])
    mean_abs, rms, signed, relative = (
        np.array([getattr(run, name) for run in runs])
        for name in ("mean_abs_error", "rms_error", "mean_error", "relative_error")
    )
    lower, median, upper = np.percentile(mean_abs, (25.0, 50.0, 75.0), axis=0)
    columns: dict[str, NDArray[np.float64]] = {
        "lower": lower,
        "median": median,
        "upper": upper,
        "rms": np.sqrt(np.average(rms**2, axis=0, weights=seconds)),
        "mean": np.average(signed, axis=0, weights=seconds),
        "relative_median": np.median(relative, axis=0),
        "relative_worst": relative.max(axis=0),
        "fit_std": np.array(results.noise_std),
    }
    return [
        {"joint": joint} | {name: float(column[j]) for name, column in columns.items()}
        for j, joint in enumerate(results.joint_names)
    ]


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
    found = []
    for key, (title, assumes) in ROUTES.items():
        if getattr(uncertainty, key) is None:
            continue
        std = np.array(getattr(uncertainty, key), dtype=np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = std / reported
        ratio = ratio[np.isfinite(ratio)]
        median, low, high = (
            significant(float(edge(ratio)), 2) if ratio.size else MISSING
            for edge in (np.median, np.min, np.max)
        )
        far = [
            abs(p.estimate - p.truth) / one if one else math.inf
            for p, one in zip(results.parameters, std.tolist(), strict=True)
            if p.truth is not None
        ]
        found.append(
            {
                "title": title,
                "assumes": assumes,
                "reported": key == uncertainty.reported,
                "median_ratio": median,
                "span": f"{low} to {high}" if ratio.size else MISSING,
                "within_2": f"{sum(z <= 2.0 for z in far)} of {len(far)}" if far else MISSING,
                "within_3": f"{sum(z <= 3.0 for z in far)} of {len(far)}" if far else MISSING,
            }
        )
    return found


# What was run, and how


def facts(results: Results) -> list[Fact]:
    """Cell, motion and software; the archives are listed in the provenance."""
    excitation, runs = results.excitation, results.validation
    rate = 1.0 / results.period if results.period > 0 else float("inf")
    n_friction = len(results.parameters) - results.n_base
    motion = [f"{fixed(excitation.duration, 2)} s"]
    if excitation.n_sines is not None:
        motion.append(f"{excitation.n_sines} sines per joint")
    if excitation.n_via is not None:
        motion.append(f"{excitation.n_via} via points")
    if excitation.fly is not None:
        motion.append(f"fly-by {100.0 * excitation.fly:g} %")
    if excitation.method is not None:
        motion.append(_METHODS.get(excitation.method, f"found by {excitation.method}"))
    seconds = significant(sum(run.duration for run in runs))
    held_out = f"{len(runs)}, {seconds} s in all, none of it used for fitting" if runs else "none"
    return [
        ("Cell", results.cell),
        ("Joints", f"{len(results.joint_names)}: " + ", ".join(results.joint_names)),
        ("Cycle", f"{1e3 * results.period:g} ms ({rate:g} Hz)"),
        ("Excitation", ", ".join(motion)),
        ("Repetitions", str(len(results.repetitions))),
        ("Validation runs", held_out),
        ("Parameters", f"{results.n_base} base + {n_friction} friction"),
        ("Software", " · ".join(f"{k} {v}" for k, v in results.software.items())),
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


def criteria(results: Results) -> list[tuple[str, str, str, str, str]]:
    """Title, meaning, planned, executed and change; the paper's equations by number."""
    planned, executed = results.excitation.planned, results.excitation.executed
    rows = []

    def shown(value: float | None, decimals: int) -> str:
        large = value is not None and abs(value) >= 1e7
        return significant(value) if large else fixed(value, decimals)

    for name, title, meaning, decimals in _CRITERIA:
        before = None if planned is None else getattr(planned, name)
        after = getattr(executed, name)
        change = MISSING
        if before is not None and after is not None and name != "n_samples":
            # A log has no meaningful percentage, the others get one.
            if name in {"log10_det", "fitness"} or before == 0.0:
                change = fixed(after - before, decimals, sign=True)
            else:
                change = fixed(100.0 * (after / before - 1.0), 1, sign=True) + " %"
        rows.append((title, meaning, shown(before, decimals), shown(after, decimals), change))
    return rows


def strongest_pairs(results: Results) -> list[tuple[str, str, float]]:
    """Ten pairs of largest |correlation| with it, friction included."""
    size, rho = len(results.correlation), results.correlation
    labels = [p.label for p in results.parameters]
    pairs = [
        (labels[i], labels[j], rho[i][j])
        for i in range(size)
        for j in range(i + 1, size)
        if math.isfinite(rho[i][j])  # none is, where the motion excites too little
    ]
    return sorted(pairs, key=lambda pair: -abs(pair[2]))[:_PAIRS]


def pairs_above(results: Results, limit: float) -> tuple[int, int]:
    """Pairs of base parameters with |correlation| above `limit`, and all such pairs."""
    n = results.n_base
    above = sum(abs(results.correlation[i][j]) > limit for i in range(n) for j in range(i + 1, n))
    return above, n * (n - 1) // 2


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
    sums = {
        "packets missed": sum(one.missed for one in recorded),
        "answers late": sum(one.late for one in recorded),
        "replies not accepted": sum(one.not_accepted for one in recorded),
        "cycles not archived": sum(one.lost for one in recorded),
    }
    losses = [
        f"{count} {words} ({significant(1e6 * count / cycles, 2)} in a million)"
        for words, count in sums.items()
        if count
    ]
    size = f"{cycles:,} cycles in {len(recorded)} archives".replace(",", "\u202f")
    return f"{size}: {', '.join(losses) or 'no packet missed, no answer late, none lost'}."


def motion_name(one: RecordedResult) -> str:
    """The motion of an archive as a person calls it."""
    name = ArchiveName.parse(one.archive)
    return one.kind if name is None else name.motion
