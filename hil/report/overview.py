"""What was run, and how exciting the motion was, as rows of text."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hil.report import numbers
from hil.results import CriteriaResult, Results

_METHODS = {
    "a": "designed by the paper's method A",
    "b": "designed by the paper's method B",
    "balanced": "designed for balanced criteria",
    "front": "designed as the knee of log det and I_c",
    "random": "the best of random motions",
}


@dataclass(frozen=True)
class Fact:
    """One line of "what was run"."""

    term: str
    text: str


@dataclass(frozen=True)
class Criterion:
    """One excitation criterion, as planned and as executed."""

    title: str
    explanation: str
    planned: str
    executed: str
    change: str


@dataclass(frozen=True)
class CorrelatedPair:
    """Two parameters whose estimates move together."""

    first: str
    second: str
    correlation: str


def facts(results: Results) -> list[Fact]:
    """Cell, motion and software; the archives are listed in the provenance."""
    excitation = results.excitation
    rate = 1.0 / results.period if results.period > 0 else float("inf")
    n_friction = len(results.parameters) - results.n_base
    motion = [f"{numbers.fixed(excitation.duration, 2)} s"]
    if excitation.n_sines is not None:
        motion.append(f"{excitation.n_sines} sines per joint")
    if excitation.n_via is not None:
        motion.append(f"{excitation.n_via} via points")
    if excitation.fly is not None:
        motion.append(f"fly-by {100.0 * excitation.fly:g} %")
    if excitation.method is not None:
        motion.append(_METHODS.get(excitation.method, f"found by {excitation.method}"))
    return [
        Fact("Cell", results.cell),
        Fact("Joints", f"{len(results.joint_names)}: " + ", ".join(results.joint_names)),
        Fact("Cycle", f"{1e3 * results.period:g} ms ({rate:g} Hz)"),
        Fact("Excitation", ", ".join(motion)),
        Fact("Repetitions", str(len(results.repetitions))),
        Fact("Validation runs", _validation_fact(results)),
        Fact("Parameters", f"{results.n_base} base + {n_friction} friction"),
        Fact("Software", " · ".join(f"{k} {v}" for k, v in results.software.items())),
    ]


def _validation_fact(results: Results) -> str:
    runs = results.validation
    if not runs:
        return "none"
    seconds = numbers.significant(sum(run.duration for run in runs))
    return f"{len(runs)}, {seconds} s in all, none of it used for fitting"


def criteria(results: Results) -> list[Criterion]:
    """Planned against executed; the paper's equations by number."""
    planned, executed = results.excitation.planned, results.excitation.executed
    spec = (
        ("log10_det", "log₁₀ det(ΦᵀΦ / N)", "eq. 9: information, in SI units; more is better", 2),
        ("coupling_index", "Coupling index I_c", "eq. 5: sum of |correlations|; less is better", 1),
        ("coupling_index_max", "Largest possible I_c", "p (p − 1) / 2 for p parameters", 0),
        ("fitness", "Fitness", "eq. 7: weighted log det and I_c,max / I_c", 2),
        ("scaled_condition", "Condition, columns scaled", "of Φ with columns of unit norm", 1),
        ("condition", "Condition", "of Φ as it is, in SI units", 0),
        ("n_samples", "Samples N", "samples of motion that entered", 0),
    )
    return [
        Criterion(
            title=title,
            explanation=explanation,
            planned=_criterion(planned, field, decimals),
            executed=_criterion(executed, field, decimals),
            change=_change(planned, executed, field, decimals),
        )
        for field, title, explanation, decimals in spec
    ]


def _criterion(criteria: CriteriaResult | None, field: str, decimals: int) -> str:
    value = None if criteria is None else getattr(criteria, field)
    if value is None:
        return numbers.MISSING
    return numbers.fixed(value, decimals) if abs(value) < 1e7 else numbers.significant(value)


def _change(
    planned: CriteriaResult | None, executed: CriteriaResult, field: str, decimals: int
) -> str:
    """Executed minus planned; a log has no meaningful percentage, the others get one."""
    before = None if planned is None else getattr(planned, field)
    after = getattr(executed, field)
    if before is None or after is None or field == "n_samples":
        return numbers.MISSING
    if field in {"log10_det", "fitness"} or before == 0.0:
        return numbers.fixed(after - before, decimals, sign=True)
    return numbers.fixed(100.0 * (after / before - 1.0), 1, sign=True) + " %"


def strongest_pairs(results: Results, labels: list[str], count: int = 10) -> list[CorrelatedPair]:
    """The `count` pairs of largest |correlation|, friction included."""
    size = len(results.correlation)
    pairs = [
        (i, j)
        for i in range(size)
        for j in range(i + 1, size)
        if math.isfinite(results.correlation[i][j])  # none is, where the motion excites too little
    ]
    pairs.sort(key=lambda ij: -abs(results.correlation[ij[0]][ij[1]]))
    return [
        CorrelatedPair(labels[i], labels[j], numbers.fixed(results.correlation[i][j], 3, sign=True))
        for i, j in pairs[:count]
    ]


def pairs_above(results: Results, limit: float) -> tuple[int, int]:
    """Pairs of base parameters with |correlation| above `limit`, and all such pairs."""
    n = results.n_base
    above = sum(abs(results.correlation[i][j]) > limit for i in range(n) for j in range(i + 1, n))
    return above, n * (n - 1) // 2
