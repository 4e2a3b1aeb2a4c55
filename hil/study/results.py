"""Results of a study: `results.json`, made from the archives of its campaigns.

SI units; lists per joint follow `joint_names`, lists per parameter `parameters`. Torque errors are
low-passed at 30 Hz as in the paper's Fig. 4, which removes the noise of the currents, unless stated
otherwise. The low-passed error Phi pi - tau is linear in the parameters pi: its squared norm is
y' G y with y = [-pi; 1] and G the Gram matrix of the low-passed [Phi | tau], so that one matrix per
motion gives the error of any estimate.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import pi
from pathlib import Path
from typing import Any, Final, Literal, Self

import numpy as np
from scipy import stats

from hil.base.arrays import Array
from hil.base.errors import InputError
from hil.base.progress import Silent
from hil.base.safe_input import read_text
from hil.campaign import CampaignFolder
from hil.cell import Cell
from hil.pipeline.options import FIXED
from hil.pipeline.prepared import Prepared, executed_rows, moving_rows, prepare_sources
from hil.pipeline.sources import gather_sources
from hil.report.numbers import capitalised, fixed, significant
from hil.results.results import Frozen
from identification import Factor, RobotModel
from identification.estimators.least_squares import estimate_repetitions
from identification.excitation import correlation, coupling_index, information, log10_det
from identification.signals.samples import Samples
from identification.signals.smoothing import low_pass
from identification.validation.prediction import FIGURE_BANDWIDTH, for_figure
from sim_fixtures.ns16 import N_ESSENTIAL, TABLE2, URDF_PATH

from .campaigns import LABELS, A, B
from .settings import StudySettings

Verdict = Literal["better", "slightly better", "none", "slightly worse", "worse", "too few"]

SCHEMA_VERSION: Final = 2
TRUE_VALUES: Final = "planted"  #: Key of the true parameters among the estimates
SMALL: Final = 0.02  #: A difference of errors below this share exists and does not matter
MIN_UNITS: Final = 3  #: Repetitions, or blocks of them, needed for their scatter
TABLE1: Final = (
    ("a", 2000, 90.5, 127.9, "W = 3, own frequencies; 100 individuals"),
    ("b", 15996, 30.9, 101.2, "K = 6, λ1 = 0.7, λ2 = 0.3; 150 individuals"),
)
"""The paper's Table 1: method, N, log det (units not stated), I_c, notes."""

_DRAWS = 4000
_SEED = 20140901
_SHOWN: Final = 1200  # maximum number of rows of a series in a figure
_MOVING: Final = 1e-3  # speed above which a joint moves, rad/s or m/s


class StudyParameter(Frozen):
    """One parameter with the values that the paper prints (null for another arm)."""

    name: str
    unit: str
    truth: float  #: Of the simulated arm
    printed_id: int | None = None  #: Row of the paper's Table 2
    printed_symbol: str | None = None
    printed_factor: float = 1.0  #: What a value is multiplied with to compare it with the print
    printed_a: float | None = None
    printed_b: float | None = None
    printed_c: float | None = None


class MotionRow(Frozen):
    """A row of Table 1: a search of this study, or a row of the paper; null figures if none."""

    key: str
    words: str
    printed: bool = False
    executed: bool = False  #: Whether it is the motion of a method in this study
    tried: int = 0
    n_samples: int | None = None
    duration: float | None = None
    log10_det: float | None = None
    coupling_index: float | None = None
    executed_log10_det: float | None = None
    executed_coupling_index: float | None = None


class MethodResult(Frozen):
    """Estimates from the repetitions of one excitation under one condition (eq. 4)."""

    key: str
    label: str
    values: list[list[float]]  #: Of each repetition
    mean: list[float]  #: Over the repetitions' own estimates: the paper's Table 2
    std: list[float]  #: Over the repetitions, of one of them
    pooled: list[float]
    pooled_std: list[float]
    undetermined: list[str]
    log10_det: float  #: Of the executed motion
    coupling_index: float  #: Of the executed motion
    correlation: list[list[float]]  #: Of the executed motion
    duration: float  #: Of one repetition
    time: list[float]
    position: list[list[float]]  #: Per joint, of the first repetition


class HeldOut(Frozen):
    """Relative errors ||e|| / ||tau|| on the held-out motions, by estimate and motion."""

    archives: list[str]
    overall: dict[str, list[float]]  #: Of all joints together, over the rows that a fit uses
    all_rows: dict[str, list[float]]  #: The same with rest, ends of motion and reversals
    mean_abs: dict[str, list[list[float]]]
    """Motion by motion, mean |e| per joint, N·m: the paper's Fig. 3."""
    left_out: list[float]  #: Share of the moving samples that `overall` excludes, per joint
    example: str  #: Archive of the motion of median error
    time: list[float]  #: Of that motion
    measured: list[list[float]]  #: Torque per joint
    predicted: dict[str, list[list[float]]]


class StudyComparison(Frozen):
    """Errors with B over errors with A, motion by motion.

    The interval treats motions and repetitions as random samples; the verdict follows from it.
    """

    ratio: float  #: Geometric mean over the motions
    wins: int  #: Motions that B predicts better
    motions: int
    low: float | None = None
    high: float | None = None  #: 95 % interval; null with too few repetitions or motions
    verdict: Verdict = "too few"  #: On B: whether the interval excludes 1


class ConditionResult(Frozen):
    """Results of one condition: with or without effects."""

    key: str
    words: str
    effects: list[str]
    methods: list[MethodResult]
    held_out: HeldOut
    comparison: StudyComparison


class StudyResults(Frozen):
    """Content of the `results.json` of a study."""

    schema_version: int = SCHEMA_VERSION
    name: str
    cell: str
    simulated: bool = True
    quick: bool
    settings: StudySettings
    software: dict[str, str]
    joint_names: list[str]
    n_base: int
    parameters: list[StudyParameter]
    table1: list[MotionRow]
    conditions: list[ConditionResult]
    conclusion: list[str]  #: Sentences

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a study's `results.json`; InputError if it is not one."""
        try:
            return cls.model_validate_json(read_text(path))
        except (OSError, ValueError) as error:
            problem = f"is not the result of a study ({error})"
            raise InputError(path, problem, remedy="run the study again") from error

    @property
    def summary(self) -> dict[str, Any]:
        """The conclusion as JSON data, with the ratios that it is based on."""
        return {
            "name": self.name,
            "simulated": self.simulated,
            "quick": self.quick,
            "line": " ".join(self.conclusion),
            "ratios": [{"condition": c.key} | c.comparison.model_dump() for c in self.conditions],
        }


# The paper's numbers


def is_printed(cell: Cell) -> bool:
    """Return whether a cell has the arm of the paper, the NS 16."""
    return cell.urdf == URDF_PATH.read_text(encoding="utf-8")


def printed_rows(cell: Cell) -> list[MotionRow]:
    """Return the printed rows of Table 1; none for another arm than the NS 16."""
    names = ("key", "n_samples", "log10_det", "coupling_index", "words")
    return [
        MotionRow.model_validate(dict(zip(names, row, strict=True)) | {"printed": True})
        for row in (TABLE1 if is_printed(cell) else ())
    ]


def parameters_of(cell: Cell, truth: Array) -> list[StudyParameter]:
    """Return the parameters with true values (p,) and the printed values of Table 2.

    Rows 41 to 52 are interleaved. Viscous and third friction terms are assumed to be per degree and
    per degree²: per radian the viscous friction would be negligible.
    """
    model = cell.model
    printed = dict[str, dict[str, Any]]()
    for row in TABLE2 if is_printed(cell) else ():
        order = {"f1": 1, "f2": 2}.get(row.parameter[:2], 0) if row.id > N_ESSENTIAL else 0
        printed[row.pivot or row.parameter] = {
            "printed_id": row.id,
            "printed_symbol": row.parameter,
            "printed_factor": row.sign * (pi / 180.0) ** order,
            "printed_a": row.pi_a,
            "printed_b": row.pi_b,
            "printed_c": row.pi_c,
        }
    return [
        StudyParameter(name=name, unit=unit, truth=float(value), **printed.get(name, {}))
        for name, unit, value in zip(model.parameter_names, model.units, truth, strict=True)
    ]


# Estimates and predictions


def condition_result(
    key: str, description: str, effects: Sequence[str], roots: Mapping[str, Path], truth: Array
) -> ConditionResult:
    """Estimate from the campaigns of A and B (by method), and predict the held-out motions of B.

    `truth` are the true parameters (p,).
    """
    methods = [_method(name, _prepared(roots[name], "excitation")) for name in (A, B)]
    estimates = {method.key: np.array(method.mean) for method in methods} | {TRUE_VALUES: truth}
    prepared = _prepared(roots[B], "validation")
    model = prepared.sources.cell.model
    names = [source.name for source in prepared.sources.training]
    forms = np.array([motion_form(model, run) for run in prepared.fitted])
    values = [np.array(method.values) for method in methods]
    return ConditionResult(
        key=key,
        words=description,
        effects=list(effects),
        methods=methods,
        held_out=_held_out(model, dict(zip(names, prepared.fitted, strict=True)), forms, estimates),
        comparison=compared(forms, values[0], values[1]),
    )


def _prepared(root: Path, kind: str) -> Prepared:
    """Prepare all archives of a kind, with the standstill, for a fit."""
    folder = CampaignFolder(root)
    options = replace(FIXED, in_sample=True)
    paths = [*folder.completed(kind), *folder.completed("standstill")]
    return prepare_sources(gather_sources(paths, options.split, in_sample=True), options, Silent())


def _method(key: str, prepared: Prepared) -> MethodResult:
    """Estimate from each repetition and from all."""
    model = prepared.sources.cell.model
    sources = prepared.sources.training
    estimates = estimate_repetitions(model, prepared.fitted)
    executed = Factor.zero(model)
    parts = [
        executed_rows(source, samples)
        for source, samples in zip(sources, prepared.fitted, strict=True)
    ]
    for samples, part in zip(prepared.fitted, parts, strict=True):
        executed = executed + Factor.from_samples(
            model, samples.motion.rows(part), samples.torque[part]
        )
    gram = information(executed)
    motion = prepared.fitted[0].motion
    rows = parts[0]
    shown = motion.rows(_thinned(rows))
    return MethodResult(
        key=key,
        label=LABELS[key],
        values=estimates.values.tolist(),
        mean=estimates.mean.tolist(),
        std=estimates.values.std(axis=0, ddof=1).tolist(),
        pooled=estimates.pooled.values.tolist(),
        pooled_std=estimates.pooled.std.tolist(),
        undetermined=list(estimates.pooled.undetermined),
        log10_det=log10_det(gram, (rows.stop - rows.start) * len(sources)),
        coupling_index=coupling_index(gram),
        correlation=correlation(gram).tolist(),
        duration=float(motion.time[rows.stop - 1] - motion.time[rows.start]),
        time=_rounded(shown.time - shown.time[0]),
        position=[_rounded(column) for column in shown.position.T],
    )


def motion_form(model: RobotModel, run: Samples) -> Array:
    """Return the Gram matrix of the low-passed [Phi | tau] (p + 1, p + 1) over the usable rows.

    It is divided by the sum of the squared torque, so that a quadratic form is a relative error.
    """
    n = model.n_parameters
    gram = np.zeros((n + 1, n + 1))
    for j, (block, used) in enumerate(zip(*run.regressor(model), strict=True)):
        usable = run.usable[:, j]
        table = np.column_stack([block, run.torque[:, j]]) * usable[:, None]
        passed = low_passed(run, table)[usable]
        both = [*used, n]
        gram[np.ix_(both, both)] += passed.T @ passed
    return np.asarray(gram / (np.where(run.usable, run.torque, 0.0) ** 2).sum())


def relative_errors(forms: Array, values: Array) -> Array:
    """Return ||e|| / ||tau|| (m, s) of s estimates (s, p) on m motions (m, p + 1, p + 1)."""
    left = np.column_stack([-values, np.ones(len(values))])
    squared = np.einsum("sp,mpq,sq->ms", left, forms, left, optimize=True)
    return np.asarray(np.sqrt(np.maximum(squared, 0.0)))


def _held_out(
    model: RobotModel, runs: Mapping[str, Samples], forms: Array, estimates: Mapping[str, Array]
) -> HeldOut:
    """Predict motions by several estimates (p,); the series are of the motion of median error."""
    table = np.array(list(estimates.values()))
    overall = dict(zip(estimates, relative_errors(forms, table).T, strict=True))
    errors = [_errors(model, table, run) for run in runs.values()]
    usable = [run.usable[_motion_rows(run)] for run in runs.values()]
    every = overall[A] + overall[B]
    typical = list(runs)[int(np.argsort(every, kind="stable")[(len(every) - 1) // 2])]
    run = runs[typical]
    time = run.motion.time
    shown = _thinned(moving_rows(run))

    def joints(torque: Array) -> list[list[float]]:
        return [_rounded(column) for column in for_figure(time, torque)[shown].T]

    return HeldOut(
        archives=list(runs),
        overall={name: error.tolist() for name, error in overall.items()},
        all_rows={n: [float(error[k]) for _, error in errors] for k, n in enumerate(estimates)},
        mean_abs={n: [error[k].tolist() for error, _ in errors] for k, n in enumerate(estimates)},
        left_out=(1.0 - np.mean(np.concatenate(usable), axis=0)).tolist(),
        example=typical,
        time=_rounded(time[shown] - time[shown.start]),
        measured=joints(run.torque),
        predicted={n: joints(run.predicted_torque(model, estimates[n])) for n in (A, B)},
    )


def _errors(model: RobotModel, table: Array, run: Samples) -> tuple[Array, Array]:
    """Return low-passed errors of estimates on one motion.

    These are mean |e| per joint over usable rows (k, n) and the relative error over all rows (k,).
    """
    left = np.zeros((*run.torque.shape, len(table)))
    for j, (block, used) in enumerate(zip(*run.regressor(model), strict=True)):
        left[:, j] = run.torque[:, j, None] - block @ table[:, used].T

    def filtered(error: Array) -> Array:
        return low_passed(run, error.reshape(len(error), -1)).reshape(error.shape)

    whole = _motion_rows(run)
    squared = (filtered(left)[whole] ** 2).sum(axis=(0, 1)) / (run.torque[whole] ** 2).sum()
    left[~run.usable] = 0.0
    slow = np.where(run.usable[..., None], filtered(left), 0.0)
    rows = np.maximum(np.count_nonzero(run.usable, axis=0), 1)
    return (np.abs(slow).sum(axis=0) / rows[:, None]).T, np.sqrt(squared)


def low_passed(run: Samples, values: Array) -> Array:
    """Low-pass values (m, c) as in the paper's Fig. 4, per segment; zero without usable rows."""
    slow = np.zeros_like(values)
    for part in run.segments:
        if run.usable[part].any():
            slow[part] = low_pass(run.motion.time[part], values[part], FIGURE_BANDWIDTH)
    return slow


def _motion_rows(run: Samples) -> slice:
    """Return the samples from the first to the last at which a joint moves."""
    moving = np.flatnonzero((np.abs(run.motion.velocity) > _MOVING).any(axis=1))
    return slice(int(moving[0]), int(moving[-1]) + 1) if moving.size else slice(0, 0)


def _thinned(rows: slice) -> slice:
    return slice(rows.start, rows.stop, max(1, (rows.stop - rows.start) // _SHOWN))


def _rounded(values: Array) -> list[float]:
    return [float(f"{value:.5g}") for value in values.tolist()]


# Comparison and conclusion


def compared(forms: Array, first: Array, second: Array) -> StudyComparison:
    """Compare the errors of the mean estimates of A (r, p) and B (s, p) on motions (see above).

    The noise of an estimate acts on all motions that it predicts, so repetitions are resampled
    together with the motions (hierarchical bootstrap), in blocks of successive ones, which share
    their temperature. Of n units n - 1 are sampled, since a mean of n would scatter by (n - 1) / n
    too little. The interval is Student's, with the degrees of freedom of the fewest units.
    """
    means = np.array([first.mean(axis=0), second.mean(axis=0)])
    logs = np.log(np.divide(*relative_errors(forms, means).T[::-1]))
    ratio = float(np.exp(logs.mean()))
    wins = int((logs < 0.0).sum())
    motions = len(logs)
    random = np.random.default_rng(_SEED)
    units = [_blocks(first), _blocks(second)]
    fewest = min(len(unit) for unit in units)
    low = high = None
    if fewest >= MIN_UNITS and motions > 1:
        before, after = (
            np.log(relative_errors(forms, _weights(len(unit), random) @ unit)) for unit in units
        )
        draws = ((after - before) * _weights(motions, random).T).sum(axis=0)
        width = stats.t.ppf(0.975, min(fewest, motions) - 1) * draws.std(ddof=1)
        low, high = (float(bound) for bound in ratio * np.exp([-width, width]))
    verdict = verdict_of(ratio, low, high)
    return StudyComparison(
        ratio=ratio, wins=wins, motions=motions, low=low, high=high, verdict=verdict
    )


def _blocks(values: Array) -> Array:
    """Return the means (u, p) of blocks of successive estimates (r, p), as long as r^(1/3)."""
    length = max(1, int(len(values) ** (1.0 / 3.0) + 1e-9))
    units = len(values) // length
    return np.asarray(values[: units * length].reshape(units, length, -1).mean(axis=1))


def _weights(count: int, random: np.random.Generator) -> Array:
    """Return the weights (draws, count) of means over count - 1 units with replacement."""
    return random.multinomial(count - 1, [1.0 / count] * count, _DRAWS) / (count - 1.0)


def verdict_of(ratio: float, low: float | None, high: float | None) -> Verdict:
    """Return the verdict on the second of two estimates: significant if the interval excludes 1."""
    if low is None or high is None:
        return "too few"
    if low <= 1.0 <= high:
        return "none"
    if ratio < 1.0:
        return "slightly better" if 1.0 - ratio < SMALL else "better"
    return "slightly worse" if ratio - 1.0 < SMALL else "worse"


def conclusion_of(conditions: Sequence[ConditionResult], *, quick: bool) -> list[str]:
    """Return the sentences of the conclusion: which method predicts better, and by how much."""
    sentences = [
        f"{capitalised(condition.words)}: {_outcome(condition.comparison)}."
        for condition in conditions
    ]
    a, b = (len(method.values) * method.duration for method in conditions[0].methods)
    sentences.append(f"A was fitted to {a:.0f} s of motion, B to {b:.0f} s.")
    if quick:
        sentences.append("The quick setting supports no conclusion about the methods.")
    return sentences


def _outcome(row: StudyComparison) -> str:
    """Format whose error is smaller, by how much, and how certain that is."""
    if row.verdict == "too few":
        return "too few repetitions or motions for a conclusion"
    ratio_text = (
        f"the error with B is {fixed(row.ratio, 3)} times that with A"
        f" (95 %: {fixed(row.low, 3)} to {fixed(row.high, 3)}),"
        f" smaller on {row.wins} of {row.motions} motions"
    )
    if row.verdict == "none":
        return f"no significant difference, {ratio_text}"
    saved = significant(100.0 * (1.0 - min(row.ratio, 1.0 / row.ratio)), 2)
    slightly = "slightly " if row.verdict in ("slightly better", "slightly worse") else ""
    return f"{'B' if row.ratio < 1.0 else 'A'} is {slightly}better by {saved} %, {ratio_text}"
