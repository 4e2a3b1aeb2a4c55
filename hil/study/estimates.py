"""Estimates of a study from archives, and the errors of any estimate on held-out motions.

Both are sums: of a repetition those of [Phi | tau], of a held-out motion those of the low-passed
[Phi | tau], with a column of torques for each condition. An error Phi pi - tau is linear in the
parameters pi, so that its squared norm is y' G y with y = [-pi; 1] and one matrix G per motion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.base.arrays import Array
from hil.base.progress import Silent
from hil.campaign import CampaignFolder
from hil.pipeline.options import FIXED
from hil.pipeline.prepared import Prepared, executed_rows, prepare_sources
from hil.pipeline.sources import gather_sources
from identification import Factor, RobotModel
from identification.factor.estimate import joint_weights
from identification.signals.samples import Samples
from identification.signals.smoothing import low_pass
from identification.validation.prediction import FIGURE_BANDWIDTH

from .campaigns import StudyExecution
from .model_errors import Condition, ModelErrors, PlannedTorque
from .settings import PRINTED_DURATION, PRINTED_REPETITIONS

PRINTED_ROWS: Final = 2000
"""Samples of a repetition of method A in the paper."""
CAMPAIGN_TIME: Final = PRINTED_REPETITIONS * PRINTED_DURATION
"""Duration of the paper's repetitions, in which the friction drifts, s.

Repetitions of a study are evenly spread over it; held-out motions come at its end.
"""


@dataclass(frozen=True, eq=False)
class DesignEstimates:
    """Estimates from the repetitions of one excitation, by condition."""

    key: str  #: of the search
    values: Array  #: (c, r, p)
    few_rows: Array  #: from as many rows as method A has in the paper (c, r, p)

    @property
    def mean(self) -> Array:
        """Mean over the repetitions (c, p), as in the paper's Table 2."""
        return np.asarray(self.values.mean(axis=1))


@dataclass(frozen=True, eq=False)
class HeldOutForms:
    """Quadratic forms of the errors on one class of held-out motions."""

    motions: str  #: the class
    forms: Array  #: of each condition and motion, relative to the torque (c, m, p + 1, p + 1)

    def errors(self, values: Array) -> Array:
        """Return the relative errors (c, m) of an estimate under each condition (c, p)."""
        y = np.concatenate([-values, np.ones((len(values), 1))], axis=1)
        squared = np.einsum("cp,cmpq,cq->cm", y, self.forms, y, optimize=True)
        return np.asarray(np.sqrt(np.maximum(squared, 0.0)))


def prepared_archives(root: Path, kind: str) -> Prepared:
    """Prepare all archives of a kind, with the standstill, for a fit."""
    folder = CampaignFolder(root)
    options = replace(FIXED, in_sample=True)
    paths = [*folder.completed(kind), *folder.completed("standstill")]
    return prepare_sources(gather_sources(paths, options.split, in_sample=True), options, Silent())


def repetition_elapsed(number: int, count: int) -> float:
    """Return how long an arm has moved before a repetition of a study [s]."""
    return number / count * CAMPAIGN_TIME


def models_of(
    errors: ModelErrors, conditions: Sequence[Condition]
) -> Mapping[int, tuple[RobotModel, list[int]]]:
    """Return the model that is fitted, by the error of its lengths, and its conditions."""
    models: dict[int, tuple[RobotModel, list[int]]] = {}
    for number, condition in enumerate(conditions):
        if condition.lengths not in models:
            models[condition.lengths] = errors.fitted(condition).model, []
        models[condition.lengths][1].append(number)
    return models


def design_estimates(
    execution: StudyExecution, errors: ModelErrors, conditions: Sequence[Condition]
) -> DesignEstimates:
    """Estimate from each repetition under each condition (eq. 4)."""
    prepared = prepared_archives(execution.root, "excitation")
    plan = PlannedTorque.of(execution.cell, execution.plan.excitation.trajectory)
    models = models_of(errors, conditions)
    values, few = [], []
    for number, samples in enumerate(prepared.fitted):
        elapsed = repetition_elapsed(number, len(prepared.fitted))
        torques = torques_under(conditions, samples, errors, plan, elapsed)
        rows = executed_rows(prepared.sources.training[number], samples)
        every = max(1, (rows.stop - rows.start) // PRINTED_ROWS)
        thinned = np.zeros(len(samples.torque), dtype=np.bool_)
        thinned[rows.start :: every] = True
        values.append(_fitted(samples, models, torques, samples.usable))
        few.append(_fitted(samples, models, torques, samples.usable & thinned[:, None]))
    return DesignEstimates(execution.search.key, np.stack(values, axis=1), np.stack(few, axis=1))


def torques_under(
    conditions: Sequence[Condition],
    samples: Samples,
    errors: ModelErrors,
    plan: PlannedTorque,
    elapsed: float,
) -> Array:
    """Return the measured torque under each condition (c, m, n).

    Args:
        conditions: of the study.
        samples: of the motion.
        errors: of the model.
        plan: planned torque.
        elapsed: duration for which the arm has moved like this before [s].
    """
    time = samples.motion.time - samples.origin
    return np.array(
        [
            errors.measured(condition, samples.torque, plan, time, elapsed)
            for condition in conditions
        ]
    )


def _fitted(
    samples: Samples,
    models: Mapping[int, tuple[RobotModel, list[int]]],
    torques: Array,
    usable: NDArray[np.bool_],
) -> Array:
    """Return the estimates (c, p) from the usable rows (m, n)."""
    p = next(iter(models.values()))[0].n_parameters
    values = np.zeros((len(torques), p))
    for model, numbers in models.values():
        gram = np.zeros((model.n_joints, p + len(numbers), p + len(numbers)))
        for joint, (block, used) in enumerate(zip(*samples.regressor(model), strict=True)):
            rows = usable[:, joint]
            table = np.column_stack([block[rows], torques[numbers][:, rows, joint].T])
            both = np.concatenate([used, np.arange(p, p + len(numbers))])
            gram[joint][np.ix_(both, both)] = table.T @ table
        for k, number in enumerate(numbers):
            chosen = np.append(np.arange(p), p + k)
            of_condition = gram[:, chosen[:, None], chosen]
            factor = Factor.of_gram(of_condition, usable.sum(axis=0), model.parameter_names)
            values[number] = factor.solve(joint_weights(factor)).values
    return values


def held_out_forms(
    execution: StudyExecution, errors: ModelErrors, conditions: Sequence[Condition]
) -> HeldOutForms:
    """Reduce the held-out motions of a campaign."""
    prepared = prepared_archives(execution.root, "validation")
    models = models_of(errors, conditions)
    forms = []
    for samples, motion in zip(prepared.fitted, execution.plan.validation, strict=True):
        plan = PlannedTorque.of(execution.cell, motion.trajectory)
        torques = torques_under(conditions, samples, errors, plan, CAMPAIGN_TIME)
        forms.append(_forms(samples, models, torques))
    return HeldOutForms(execution.held_out, np.stack(forms, axis=1))


def _forms(
    samples: Samples, models: Mapping[int, tuple[RobotModel, list[int]]], torques: Array
) -> Array:
    """Return the forms of one motion (c, p + 1, p + 1) over its usable rows."""
    p = next(iter(models.values()))[0].n_parameters
    forms = np.zeros((len(torques), p + 1, p + 1))
    for model, numbers in models.values():
        for joint, (block, used) in enumerate(zip(*samples.regressor(model), strict=True)):
            usable = samples.usable[:, joint]
            table = np.column_stack([block, torques[numbers][:, :, joint].T]) * usable[:, None]
            passed = low_passed(samples, table)[usable]
            gram = passed.T @ passed
            for k, number in enumerate(numbers):
                from_gram = np.append(np.arange(len(used)), len(used) + k)
                both = np.append(used, p)
                forms[number][np.ix_(both, both)] += gram[np.ix_(from_gram, from_gram)]
    squares = (np.where(samples.usable, torques, 0.0) ** 2).sum(axis=(1, 2))
    return np.asarray(forms / squares[:, None, None])


def low_passed(run: Samples, values: Array) -> Array:
    """Low-pass values (m, c) as in the paper's Fig. 4, per segment; zero without usable rows."""
    slow = np.zeros_like(values)
    for part in run.segments:
        if run.usable[part].any():
            slow[part] = low_pass(run.motion.time[part], values[part], FIGURE_BANDWIDTH)
    return slow
