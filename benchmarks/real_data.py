"""Torque error of identified models on real recordings, read by the package's own importers.

Run with ``python -m benchmarks.real_data --data DIR [--json]``, where DIR is a folder that is
named like a file of ``benchmarks/recordings`` (``ur10_unisa``, ``tx40``). Errors are
||tau - tau_hat|| / ||tau|| over all joints and over all rows of the part in question, those at
rest and first and last rows included:

- *in sample*: the whole recording fitted and predicted;
- *held out*: the first 70 % fitted, the last 30 % predicted; *held out first*: the last 70 %
  fitted, the first 30 % predicted. Temporal splits of one motion, not predictions of other motions.

Three tables. *Models*: friction linear or with the third term and, where the drive train couples
axes, with inertia and friction of the coupled motors or without (the same angles and torques in
both). *Estimators*: on the largest of these models. *Essential*: that model after backward
elimination; "chosen on it" means on the very part that is predicted, as the tool's own table shows
it, "chosen inside" on the last two sevenths of the part that is fitted, which is then fitted whole:
only that is a prediction.

`torque_bandwidth` is that of the low-pass of the logged torque, found on the fitted part alone;
"plain" is without it. The headline figures are not from these tables: they are those of `hil
identify` with its default settings, in sample and held out.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from benchmarks import parser_of, show
from benchmarks.published import FITTED_SHARE, Published
from hil.archive.recording_of_archive import open_recording
from hil.base.progress import Silent
from hil.pipeline.estimating import estimate_with
from hil.pipeline.options import Options
from hil.pipeline.prepared import prepare_sources, samples_of
from hil.pipeline.sources import gather_sources
from identification.estimators.consistent import consistent_estimate
from identification.estimators.least_squares import fit_least_squares
from identification.estimators.loss_functions import Huber, Tukey
from identification.estimators.prior import body_prior, fit_posterior
from identification.estimators.robust import robust_estimate
from identification.estimators.torque_channel import possible_low_passes
from identification.factor.estimate import Estimate, joint_weights
from identification.factor.factor import Factor, total_factor
from identification.factor.normal_equations import NormalEquations, solve
from identification.model.coupling import Coupling
from identification.model.friction import FrictionLaw
from identification.model.robot import RobotModel
from identification.selection.essential import eliminate
from identification.selection.questions import choose_settings
from identification.selection.settings import Settings
from identification.signals.recording import Recording
from identification.signals.samples import Preprocessing, Samples, prepare
from identification.validation.prediction import prediction_error
from planner.arrays import Array

LAWS: Final = {
    "linear_friction": FrictionLaw(third=None, offset=True),
    "quadratic_friction": FrictionLaw(third="quadratic", offset=True),
}
_CHOSEN_SHARE: Final = 5.0 / 7.0
"""Of the fitted part: what is fitted while parameters are chosen on the rest of it."""


class Split(NamedTuple):
    """What is fitted, and what is predicted."""

    fitted: Recording
    predicted: Recording


def splits_of(recording: Recording) -> dict[str, Split]:
    """The three divisions of a recording."""
    m = recording.n_samples
    cut = round(FITTED_SHARE * m)
    return {
        "in_sample": Split(recording, recording),
        "held_out": Split(recording.between(0, cut), recording.between(cut, m)),
        "held_out_first": Split(recording.between(m - cut, m), recording.between(0, m - cut)),
    }


@dataclass(frozen=True, eq=False)
class Case:
    """One recording, and how its torque is treated.

    Attributes:
        recording: all of it.
        urdf: text of the robot description.
        motor_from_joint: motor angles per joint angle (n, n) where axes are coupled, else None.
        options: what is done to the torque; its bandwidth is looked for where it is not smoothed.
    """

    recording: Recording
    urdf: str
    motor_from_joint: Array | None
    options: Preprocessing

    def models(self) -> dict[str, RobotModel]:
        """The models that are compared, the largest last."""
        couplings: dict[str, Coupling | None] = {"": None}
        if self.motor_from_joint is not None:
            couplings = {
                ", without coupling": None,
                ", with coupling": Coupling(self.motor_from_joint),
            }
        return {
            f"{law}{suffix}": RobotModel.from_urdf(self.urdf, friction=friction, coupling=coupling)
            for suffix, coupling in couplings.items()
            for law, friction in LAWS.items()
        }

    def prepared(self, model: RobotModel, split: Split) -> tuple[Samples, Samples, Preprocessing]:
        """Fitted and predicted samples, and how they were treated."""
        options = self.options
        if not options.smooth_torque:
            options = _with_low_pass(split.fitted, model, options)
        fitted, predicted = (prepare(part, model, options=options) for part in split)
        return fitted, predicted, options


def _with_low_pass(
    recording: Recording, model: RobotModel, options: Preprocessing
) -> Preprocessing:
    """With the low-pass of the torque, if predicting stretches from the others asks for one."""

    def ready(of: RobotModel, how: Preprocessing) -> list[Samples]:
        return [prepare(recording, of, options=how)]

    def low_passes(of: RobotModel, how: Preprocessing) -> tuple[Preprocessing, ...]:
        return possible_low_passes(recording, of, options=how)

    return choose_settings(model, ready, Settings(options), {"low-pass"}, low_passes).preprocessing


Estimator = Callable[[RobotModel, Samples], Array]


def _consistent(model: RobotModel, samples: Samples) -> Array:
    free = fit_least_squares(model, [samples])
    return consistent_estimate(model, Factor.of(model, samples), free).estimate.values


def _values(fit: Callable[[RobotModel, Sequence[Samples]], Estimate]) -> Estimator:
    return lambda model, samples: fit(model, [samples]).values


def _posterior(model: RobotModel, runs: Sequence[Samples]) -> Estimate:
    factor = total_factor(model, runs)
    return fit_posterior(model, factor, body_prior(model, factor).gaussian).estimate


ESTIMATORS: Final[dict[str, Estimator]] = {
    "ols": _values(lambda model, runs: fit_least_squares(model, runs, "ordinary")),
    "wls": _values(fit_least_squares),
    "huber": _values(lambda model, runs: robust_estimate(model, runs, Huber()).estimate),
    "tukey": _values(lambda model, runs: robust_estimate(model, runs, Tukey()).estimate),
    "posterior": _values(_posterior),
    "consistent": _consistent,
}


def error(model: RobotModel, values: Array, predicted: Samples) -> float:
    """Relative torque error over all joints and all rows."""
    (prediction,) = prediction_error(model, values, [predicted], all_rows=True)
    return round(prediction.overall, 5)


def model_table(case: Case, splits: dict[str, Split]) -> dict[str, Any]:
    """Weighted least squares with every model, by split."""
    table: dict[str, Any] = {}
    for name, model in case.models().items():
        row: dict[str, Any] = {"parameters": model.n_parameters}
        for kind, split in splits.items():
            fitted, predicted, options = case.prepared(model, split)
            row[kind] = error(model, ESTIMATORS["wls"](model, fitted), predicted)
            if kind == "in_sample":
                (prediction,) = prediction_error(
                    model, ESTIMATORS["ols"](model, fitted), [predicted], all_rows=True
                )
                row["in_sample_ols"] = round(prediction.overall, 5)
                row["in_sample_ols_by_joint"] = [round(e, 4) for e in prediction.relative.tolist()]
            if not options.smooth_torque:
                row[f"plain_{kind}"] = _without_lowpass(model, split)
                row[f"{kind}_torque_bandwidth"] = options.torque_bandwidth
        table[name] = row
    return table


def estimator_table(
    case: Case, model: RobotModel, splits: dict[str, Split]
) -> dict[str, dict[str, float]]:
    """Every estimator on one model, by split."""
    table: dict[str, dict[str, float]] = {name: {} for name in ESTIMATORS}
    for kind, split in splits.items():
        fitted, predicted, _ = case.prepared(model, split)
        for name, estimator in ESTIMATORS.items():
            table[name][kind] = error(model, estimator(model, fitted), predicted)
    return table


def essential_table(
    case: Case, model: RobotModel, splits: dict[str, Split]
) -> dict[str, dict[str, float | int]]:
    """Essential parameters, chosen on what is predicted and chosen without having seen it."""
    table: dict[str, dict[str, float | int]] = {}
    for kind in ("held_out", "held_out_first"):
        fitted, predicted, options = case.prepared(model, splits[kind])
        whole = Factor.by_time(model, fitted)
        flattered = eliminate(model, whole, Factor.by_time(model, predicted))
        part = splits[kind].fitted
        cut = round(_CHOSEN_SHARE * part.n_samples)
        inner = [
            Factor.by_time(model, prepare(samples, model, options=options))
            for samples in (part.between(0, cut), part.between(cut, part.n_samples))
        ]
        essential = eliminate(model, *inner).estimate.names
        table[kind] = {
            "parameters": model.n_parameters,
            "all": error(model, ESTIMATORS["wls"](model, fitted), predicted),
            "chosen_on_it": error(model, flattered.values, predicted),
            "chosen_on_it_parameters": len(flattered.estimate.names),
            "chosen_inside": error(model, _refitted(model, whole, essential), predicted),
            "chosen_inside_parameters": len(essential),
        }
    return table


def default_errors(folder: Path) -> dict[str, float]:
    """Errors of `hil identify` by default settings, in sample and on the last 30 %.

    Of torque that the configuration smooths, the smoothed torque's.
    """
    published = Published.named(folder.name)
    errors = {}
    width = published.smooth_bandwidth
    for kind in ("in_sample", "held_out"):
        options = Options(
            in_sample=kind == "in_sample",
            method="default" if width is None else "paper",
            torque_bandwidth="auto" if width is None else width,
        )
        with tempfile.TemporaryDirectory() as scratch:
            path = Path(scratch) / "imported.mcap"
            archive = published.imported(next(iter(published.logs)), folder, path)
            sources = gather_sources([archive], FITTED_SHARE, in_sample=options.in_sample)
        prepared = prepare_sources(sources, options, Silent())
        values = estimate_with(prepared, options, Silent()).result.pooled.values
        sources = prepared.sources
        model = prepared.sources.cell.model
        predicted = samples_of(sources.held_out[0], sources.cell, prepared.settings, model)
        errors[kind] = error(model, values, predicted)
    return errors


def load_case(folder: Path) -> Case:
    """The first recording of a folder, imported by its configuration, and its coupling."""
    published = Published.named(folder.name)
    with tempfile.TemporaryDirectory() as scratch:
        archive = Path(scratch) / "imported.mcap"
        recording = open_recording(published.imported(next(iter(published.logs)), folder, archive))
    bandwidth = published.smooth_bandwidth
    return Case(
        recording,
        published.urdf_text(folder),
        _coupled_motors(recording),
        Preprocessing(smooth_torque=bandwidth is not None, torque_bandwidth=bandwidth),
    )


def main() -> None:
    """Measure, and print the figures."""
    parser = parser_of(__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder with the recording")
    arguments = parser.parse_args()
    folder = arguments.data.resolve()
    case = load_case(folder)
    splits = splits_of(case.recording)
    models = model_table(case, splits)
    model = [*case.models().values()][-1]
    estimators = estimator_table(case, model, splits)
    essential = essential_table(case, model, splits)
    default = default_errors(folder)
    result = {
        "data": folder.name,
        "held_out_relative_error": default["held_out"],
        "in_sample_relative_error": default["in_sample"],
        "models": models,
        "estimators": estimators,
        "essential": essential,
    }
    show(result, only_json=arguments.json)


def _coupled_motors(recording: Recording) -> Array | None:
    """The motors' angles per joint angle (n, n) where axes are coupled, else None."""
    stored = recording.provenance.get("motor_from_joint")
    if stored is None:
        return None
    matrix = np.array(json.loads(stored))
    return matrix if np.any(matrix != np.diag(np.diag(matrix))) else None


def _without_lowpass(model: RobotModel, split: Split) -> float:
    """Return the error without a low-pass of the torque."""
    fitted, predicted = (prepare(part, model) for part in split)
    return error(model, ESTIMATORS["wls"](model, fitted), predicted)


def _refitted(model: RobotModel, whole: Factor, essential: Collection[str]) -> Array:
    """Weighted least squares of some parameters (p,), zero for the others."""
    equations = whole.weighted(joint_weights(whole))
    index = np.flatnonzero([name in essential for name in model.parameter_names])
    values = np.zeros(model.n_parameters)
    values[index] = solve(
        NormalEquations(
            equations.A[np.ix_(index, index)], equations.b[index], equations.yy, equations.n
        )
    ).values
    return values


if __name__ == "__main__":
    main()
