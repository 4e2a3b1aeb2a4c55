"""Run of a study: searches, campaigns, estimates, comparisons; its page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from hil.base.arrays import Array
from hil.base.files import digest, write_files
from hil.base.progress import Reporter
from hil.base.threads import one_thread
from hil.base.version import software
from hil.batch.cluster import Cluster
from hil.cell import Cell
from hil.control.planted_arm import planted_values
from hil.control.simulated_cell import simulated_link
from identification.excitation import Method
from sim_fixtures.ns16 import CELL_PATH

from . import estimates
from .campaigns import MOTION_CLASSES, StudyExecution, execute, plan_study
from .child_calls import in_children
from .criteria_relations import design_points, relations_of
from .estimates import DesignEstimates, HeldOutForms
from .messages import conclusion_of, effect_words
from .method_comparison import compared
from .model_errors import ALL, NONE, Condition, ModelErrors, conditions_of
from .page import study_page
from .paper_figures import best_of, parameters_of, printed_rows, shown_condition
from .results import (
    ConditionResult,
    MotionRow,
    ShownCondition,
    StudyComparison,
    StudyResults,
)
from .searches import LABELS, Search, run_searches, search_plans
from .settings import FULL_STUDY, StudyFolder, StudySettings

_PAIRS: Final[tuple[tuple[Method, Method], ...]] = (
    ("a", "b"),
    ("a", "gradient"),
    ("b", "gradient"),
    ("gradient", "b"),
)
"""First and second method of each comparison."""


@one_thread()
def run_study(
    root: Path,
    settings: StudySettings,
    reporter: Reporter,
    *,
    workers: int = 2,
    cell: Cell | None = None,
) -> StudyResults:
    """Compare the paper's methods on a simulated cell; write results and page.

    An interrupted study resumes with the searches and campaigns that are not complete. Results do
    not depend on the number of workers.

    Args:
        root: folder of the study.
        settings: of the study.
        reporter: of progress.
        workers: processes.
        cell: that is simulated, by default the NS 16.

    Raises:
        CellError: the cell is not simulated.
        InputError: the folder contains other files, or another study is running in it.
        StudyError: a part was not completed; a restart resumes.
        NoExcitationError: a search found no feasible motion.
        OutputError: the results cannot be written.
    """
    folder = StudyFolder(root)
    if cell is None:
        cell = Cell.load(CELL_PATH)
    else:
        simulated_link(cell)  # raises for real hardware
        settings = settings.model_copy(update={"cell": digest(cell.text + cell.urdf)})
    conditions = conditions_of(cell, effects=settings.effects)
    errors = ModelErrors(cell, settings.seed)
    with folder.locked(), Cluster(workers, reporter=reporter) as cluster:
        folder.begin(settings)
        plans = search_plans(settings, len(cell.joint_names))
        searches = run_searches(folder, cell, plans, reporter, cluster)
        executions = plan_study(folder, cell, settings, searches)
        runs = [(execution.root, (execution,)) for execution in executions]
        in_children(execute, runs, "running campaigns", reporter, cluster)
        calls = [(execution.root, (execution, errors, conditions)) for execution in executions]
        held_out = [call for call in calls if call[1][0].held_out]
        designs = in_children(estimates.design_estimates, calls, "estimating", reporter, cluster)
        forms = in_children(estimates.held_out_forms, held_out, "predicting", reporter, cluster)
        shown = _shown(conditions, errors, executions, reporter, cluster)
    parts = _Parts(conditions, searches, designs, forms, shown)
    study = _results(root.resolve().name, cell, settings, parts)
    study = study.model_copy(update={"conclusion": conclusion_of(study)})
    write_files(root, {"results.json": study.to_json(), "report.html": study_page(study)})
    return study


def _shown(
    conditions: Sequence[Condition],
    errors: ModelErrors,
    executions: Sequence[StudyExecution],
    reporter: Reporter,
    cluster: Cluster,
) -> list[ShownCondition]:
    """Return tables and figures of the best excitation of each method, as in the paper."""
    by_key = {execution.search.key: execution for execution in executions}
    best = {
        method: by_key[search.key]
        for method, search in best_of([execution.search for execution in executions]).items()
    }
    fly_by = next(execution for execution in executions if execution.held_out == MOTION_CLASSES[0])
    truth = planted_values(errors.cell)
    calls = [
        (fly_by.root, (condition, errors, best, fly_by, truth))
        for condition in (NONE, ALL)
        if condition in conditions
    ]
    return in_children(shown_condition, calls, "drawing the best", reporter, cluster)


class _Parts(NamedTuple):
    """What the children of a study have made."""

    conditions: tuple[Condition, ...]
    searches: list[Search]
    designs: list[DesignEstimates]
    forms: list[HeldOutForms]
    shown: list[ShownCondition]


def _results(name: str, cell: Cell, settings: StudySettings, parts: _Parts) -> StudyResults:
    """Compare the methods and relate the criteria, without a conclusion."""
    values = {design.key: design.values for design in parts.designs}
    errors = {
        design.key: np.concatenate([forms.errors(design.mean) for forms in parts.forms], axis=1)
        for design in parts.designs
    }
    points = design_points(parts.searches, parts.conditions, values, errors)
    return StudyResults(
        name=name,
        cell=cell.name,
        quick=_is_quick(settings),
        settings=settings,
        software=software(),
        joint_names=list(cell.joint_names),
        n_base=len(cell.model.base.names),
        parameters=parameters_of(cell, planted_values(cell)),
        table1=[*_rows(parts.searches, parts.shown), *printed_rows(cell)],
        conditions=_compared(parts),
        designs=points,
        relations=relations_of(points, parts.conditions),
        shown=parts.shown,
        effects=effect_words(cell) if settings.effects else [],
        conclusion=[],
    )


def _compared(parts: _Parts) -> list[ConditionResult]:
    """Compare the methods under each condition and on each class of motions."""
    methods = {search.key: search.method for search in parts.searches}

    def errors(forms: HeldOutForms, method: Method, *, few_rows: bool = False) -> Array:
        """Return the errors of a method's searches (c, s, m)."""
        return np.stack(
            [
                forms.errors(design.few_rows.mean(axis=1) if few_rows else design.mean)
                for design in parts.designs
                if methods[design.key] == method
            ],
            axis=1,
        )

    rows: list[list[StudyComparison]] = [[] for _ in parts.conditions]
    for of_class in sorted(parts.forms, key=lambda one: MOTION_CLASSES.index(one.motions)):
        whole = {method: errors(of_class, method) for method in LABELS}
        thinned = errors(of_class, "a", few_rows=True)
        pairs = [(first, second, whole[first], whole[second], False) for first, second in _PAIRS]
        pairs.append(("a", "b", thinned, whole["b"], True))
        for number, of_condition in enumerate(rows):
            for first, second, before, after, printed_sizes in pairs:
                ratio = compared(before[number], after[number])
                of_condition.append(
                    StudyComparison(
                        first=first,
                        second=second,
                        motions=of_class.motions,
                        printed_sizes=printed_sizes,
                        **ratio.fields(),
                    )
                )
    return [
        ConditionResult(
            key=condition.key, error=condition.error, size=condition.size, comparisons=comparisons
        )
        for condition, comparisons in zip(parts.conditions, rows, strict=True)
    ]


def _is_quick(settings: StudySettings) -> bool:
    """Return whether less is searched than in the full study."""
    return (
        settings.searches < FULL_STUDY.searches
        or settings.effort_b.tried < FULL_STUDY.effort_b.tried
    )


def _rows(searches: Sequence[Search], shown: Sequence[ShownCondition]) -> list[MotionRow]:
    """Return a row of Table 1 for each search, with what was executed of the best of a method."""
    best = {search.key: method for method, search in best_of(searches).items()}
    executed = {method.key: method for method in shown[0].methods}
    rows = []
    for search in searches:
        criteria = search.excitation.criteria
        method = executed[best[search.key]] if search.key in best else None
        row = MotionRow(
            key=search.key,
            words=search.choice,
            executed=method is not None,
            tried=search.tried,
            n_samples=criteria.n_samples,
            duration=float(search.excitation.trajectory.duration),
            log10_det=criteria.log10_det,
            coupling_index=criteria.coupling_index,
            condition=criteria.condition,
            scaled_condition=criteria.scaled_condition,
            executed_log10_det=None if method is None else method.log10_det,
            executed_coupling_index=None if method is None else method.coupling_index,
        )
        rows.append(row)
    return rows
