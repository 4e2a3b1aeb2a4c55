"""Time of one individual of an excitation's design, against a loop over pinocchio in one run.

Run with ``python -m benchmarks.design [--json] [--search]``: the NS 16 (6 joints, 58 columns).

- ``ratio_to_pinocchio``: one motion through six via points, some 16 s. Pinocchio:
  ``computeJointTorqueRegressor`` sample by sample at 1 kHz, then the dense Gram matrix. Ours:
  every 8 ms, regressor, Gram and criteria. ``ratio_same_rate``: both every 8 ms. Ours makes
  friction and rotor columns and the criteria besides; pinocchio makes 60 columns.
- ``log10_det_difference``: criteria of the columns that both have, ours at 8 ms less those of
  pinocchio's regressor by numpy's QR at 8 ms; ``..._to_1_khz``: less those at 1 kHz.
- ``individual_ms``: plan, sample, regressor, Gram and criteria of random motions of method B
  with its preset, planned eight together as a search does; their mean, and
  ``individual_worst_ms`` the slowest one, ``individual_20_s_ms`` one that is as long as a motion
  may be. ``scoring_ms`` and ``scoring_worst_ms``: all that a search does with each, joint limits
  included. The same of the default search, with ``_default``: 16 via points, and in its scoring
  floor, self-collision and motor currents as well.
- with ``--search``: wall time of the paper's whole method B (150 individuals, 120 generations) by
  one worker process and by two, kinematic limits only; and the processor time of all processes in
  it, which is the fairer figure where others use the machine. Some minutes.

Processor time of one thread but for the search; alternating repetitions; medians.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from benchmarks import parser_of, processor_time, show, timed
from benchmarks.regressor import common_columns, pinocchio_gram
from hil import Cell
from hil.design.problem import problem_of, search_settings
from hil.design.settings import preset
from identification import Motion
from identification.excitation import Objective, Population, Problem, search
from identification.excitation.constraints import SAMPLE_PERIOD, midpoints, sampled
from planner import FourierSeries, JointLimits, PiecewiseCubic, PlannerError
from planner.arrays import Array
from planner.moves import plan_chunk
from sim_fixtures.ns16 import CELL_PATH

N_VIA = 6
FLY = 0.5
LONGEST = 20.0
CHUNK = 8  # motions planned together, as a search does
FINE = 1e-3


class Times(NamedTuple):
    """What motions took [s], (m,).

    Attributes:
        judging: plan, sample, regressor, Gram and criteria.
        scoring: that, and looking after what a motion must keep.
        planning: the share of planning in both, mean.
        duration: of the motions themselves.
    """

    judging: Array
    scoring: Array
    planning: float
    duration: Array


def of_length(limits: JointLimits, seconds: float) -> PiecewiseCubic:
    """Return a random motion, run at the one speed that makes it last so long."""
    random = np.random.default_rng(3)
    via_points = [random.uniform(limits.lower, limits.upper, (N_VIA, limits.n_joints))]
    slow = 0.01
    fast = 1.0
    for _ in range(40):
        middle = math.sqrt(slow * fast)
        speed = np.full((1, limits.n_joints), middle)
        (planned,) = plan_chunk(via_points, speed, limits, FLY)
        if isinstance(planned, PlannerError):
            raise planned
        motion = planned
        slow, fast = (middle, fast) if motion.duration > seconds else (slow, middle)
    return motion


def compare(
    objective: Objective, reference: pin.Model, motion: PiecewiseCubic, repetitions: int
) -> dict[str, float]:
    """Time both on one motion, and compare what they find."""
    coarse = midpoints(motion, SAMPLE_PERIOD)
    fine = midpoints(motion, FINE)
    # Memory is made once for either side: ours keeps its working arrays between calls.
    stacked = [_room(reference, samples) for samples in (coarse, fine)]
    tasks: list[Callable[[], object]] = [
        partial(objective.measures, coarse),
        partial(pinocchio_gram, reference, coarse, stacked[0]),
        partial(pinocchio_gram, reference, fine, stacked[1]),
    ]
    for task in tasks:
        task()
    times = np.array([[timed(task) for task in tasks] for _ in range(repetitions)])
    ours, same_rate, one_khz = (float(value) * 1e3 for value in np.median(times, axis=0))
    columns, foreign = common_columns(objective.model)
    measures = Objective(objective.model, parameters=np.array(columns)).measures(coarse)
    theirs = [_criteria_by_qr(rows[..., foreign]) for rows in stacked]
    return {
        "ratio_to_pinocchio": round(one_khz / ours, 3),
        "ratio_same_rate": round(same_rate / ours, 3),
        "ours_ms": round(ours, 3),
        "pinocchio_1_khz_ms": round(one_khz, 3),
        "pinocchio_same_rate_ms": round(same_rate, 3),
        "duration_s": round(motion.duration, 3),
        "log10_det_difference": measures["log10_det"] - theirs[0][0],
        "coupling_index_difference": measures["coupling_index"] - theirs[0][1],
        "log10_det_difference_to_1_khz": measures["log10_det"] - theirs[1][0],
        "coupling_index_difference_to_1_khz": measures["coupling_index"] - theirs[1][1],
    }


def time_individuals(cell: Cell, count: int, repetitions: int) -> dict[str, float]:
    """Time random individuals of method B and of the default search."""
    result: dict[str, float] = {}
    b = problem_of(cell, preset("b").kinematic())
    default = problem_of(cell, preset("gradient"))
    for name, problem in (("", b), ("_default", default)):
        times = time_problem(problem, count, repetitions)
        for kind, each in (("individual", times.judging), ("scoring", times.scoring)):
            result[f"{kind}{name}_ms"] = round(float(each.mean()) * 1e3, 3)
            result[f"{kind}{name}_worst_ms"] = round(float(each.max()) * 1e3, 3)
        result[f"individuals{name}"] = len(times.judging)
        result[f"individual{name}_duration_s"] = round(float(times.duration.mean()), 3)
        if problem is b:
            longest = of_length(cell.joint_limits, LONGEST)
            alone = [timed(partial(_judge, b.objective, longest)) for _ in range(3 * repetitions)]
            result["individual_20_s_ms"] = round(
                (float(np.median(alone)) + times.planning) * 1e3, 3
            )
    return result


def time_problem(problem: Problem, count: int, repetitions: int) -> Times:
    """Time random individuals one by one; planning is shared by those planned together."""
    genes = problem.genome.sample(np.random.default_rng(1), count)
    judging: list[float] = []
    scoring: list[float] = []
    plannings: list[float] = []
    durations: list[float] = []
    for begin in range(0, count, CHUNK):
        part = genes[begin : begin + CHUNK]
        together = [timed(partial(problem.genome.motions, part)) for _ in range(repetitions)]
        planning = float(np.median(together)) / len(part)
        for motion in problem.genome.motions(part):
            if isinstance(motion, PlannerError):
                continue
            tasks = partial(_judge, problem.objective, motion), partial(_check, problem, motion)
            measured = [[timed(task) for task in tasks] for _ in range(repetitions)]
            judged, checked = np.median(measured, axis=0).tolist()
            judging.append(planning + judged)
            scoring.append(planning + judged + checked)
            plannings.append(planning)
            durations.append(motion.duration)
    return Times(
        np.array(judging), np.array(scoring), float(np.mean(plannings)), np.array(durations)
    )


def time_search(cell: Cell, population: int, generations: int) -> dict[str, float]:
    """Run the paper's method B by one worker and by two; their results are equal."""
    asked = preset("b").kinematic()
    asked = asked.replaced(search={"population": population, "generations": generations})
    problem = problem_of(cell, asked)
    settings = search_settings(asked)
    durations: dict[str, float] = {}
    fitness = []
    for workers, name in ((1, "ga_one_worker_s"), (2, "ga_two_workers_s")):
        with Population(problem, workers=workers) as individuals:
            start = time.perf_counter()
            used = processor_time()
            design = search(individuals, settings)
            durations[name] = round(time.perf_counter() - start, 2)
        # A child's time is known when it has ended.
        durations[name.removesuffix("_s") + "_processor_s"] = round(processor_time() - used, 2)
        fitness.append(design.excitation.criteria.fitness)
    if fitness[0] != fitness[1]:
        raise SystemExit(f"the number of workers changed the result: {fitness}")
    return {**durations, "ga_individuals": population * generations, "ga_fitness": fitness[0]}


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, and print the figures."""
    parser = parser_of(__doc__)
    parser.add_argument("--search", action="store_true", help="time the paper's search as well")
    parser.add_argument("--repetitions", type=int, default=15)
    parser.add_argument("--individuals", type=int, default=160)
    parser.add_argument("--population", type=int, default=150, help="of the search")
    parser.add_argument("--generations", type=int, default=120, help="of the search")
    options = parser.parse_args(arguments)

    cell = Cell.load(CELL_PATH)
    objective = Objective(cell.model)
    reference = pin.buildModelFromXML(cell.urdf)
    motion = of_length(cell.joint_limits, 16.0)
    result: dict[str, object] = {
        **compare(objective, reference, motion, options.repetitions),
        **time_individuals(cell, options.individuals, options.repetitions),
    }
    if options.search:
        result |= time_search(cell, options.population, options.generations)
    result["columns"] = cell.model.n_parameters
    result["repetitions"] = options.repetitions
    result["clock"] = "processor time of one thread; searches: wall time"
    show(result, only_json=options.json)


def _judge(objective: Objective, motion: PiecewiseCubic | FourierSeries) -> None:
    objective.measures(midpoints(motion, SAMPLE_PERIOD))


def _check(problem: Problem, motion: PiecewiseCubic | FourierSeries) -> None:
    problem.constraints.violations(motion, sampled(motion, SAMPLE_PERIOD))


def _room(reference: pin.Model, motion: Motion) -> Array:
    return np.zeros((motion.n_samples, reference.nv, 10 * reference.nv))


def _criteria_by_qr(regressor: Array) -> tuple[float, float]:
    """Return log10 det and the coupling index from the QR of a regressor (m, n, p)."""
    m, n, p = regressor.shape
    r = np.linalg.qr(regressor.reshape(m * n, p), mode="r")
    logs = np.log10(np.abs(np.diag(r))) - 0.5 * math.log10(m)
    inverse = np.linalg.inv(r)
    psi = inverse @ inverse.T
    deviation = np.sqrt(np.diag(psi))
    coupling = np.abs(np.triu(psi / deviation / deviation[:, None], 1)).sum()
    return float(2.0 * logs.sum()), float(coupling)


if __name__ == "__main__":
    main()
