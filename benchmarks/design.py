"""Time of one individual of an excitation's design, against a loop over pinocchio in one run.

Run with ``python -m benchmarks.design [--json] [--search]``: the NS 16 (6 joints, 58 columns).

- ``ratio_to_pinocchio``: one motion through six via points, some 16 s. Pinocchio:
  ``computeJointTorqueRegressor`` sample by sample at 1 kHz, then the dense Gram matrix. Ours:
  every 8 ms, regressor, Gram and criteria. ``ratio_same_rate``: both every 8 ms. Ours makes
  friction and rotor columns and the criteria besides; pinocchio makes 60 columns.
- ``log10_det_difference``: criteria of the columns that both have, ours at 8 ms less those of
  pinocchio's regressor by numpy's QR at 8 ms; ``..._to_1_khz``: less those at 1 kHz.
- ``individual_ms``: plan, sample, regressor, Gram and criteria of random motions through six via
  points as a search scores them, their mean; ``individual_worst_ms`` the slowest one,
  ``individual_20_s_ms`` one that is as long as a motion may be.
- with ``--search``: wall time of the paper's whole method B (150 individuals, 120 generations) by
  one worker process and by two, kinematic limits only; and the processor time of all processes in
  it, which is the fairer figure where others use the machine. Some minutes.

Processor time of one thread but for the search; alternating repetitions; medians.
"""

# ruff: noqa: E402 - threads are pinned before numpy is imported, or BLAS does not see it

from __future__ import annotations

import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"

import argparse
import json
import math
import resource
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from benchmarks.regressor import common_columns, pinocchio_gram, timed
from hil import Cell
from identification import Motion, RobotModel
from identification.excitation import (
    Constraints,
    Objective,
    Population,
    Problem,
    SearchSettings,
    ViaPointGenome,
    search,
)
from identification.excitation.sampling import SAMPLE_PERIOD, midpoints
from planner import JointLimits, PiecewiseCubic, PlannerError
from planner.arrays import Array
from planner.batch import plan_chunk
from sim_fixtures.ns16 import CELL_PATH, urdf_text

N_VIA = 6
FLY = 0.5
LONGEST = 20.0
CHUNK = 32  # motions planned together, as a search does
FINE = 1e-3


class Individuals(NamedTuple):
    """Motions by what they are planned from.

    Attributes:
        via_points: (m, K, n) [rad].
        speed: (m, n) shares of the joints' velocity limits.
    """

    via_points: Array
    speed: Array


def random_individuals(limits: JointLimits, count: int, seed: int) -> Individuals:
    """Draw via points over all of the joints' range, and speeds from 0.3 to 1."""
    random = np.random.default_rng(seed)
    shape = (count, N_VIA, limits.n_joints)
    return Individuals(
        random.uniform(limits.lower, limits.upper, shape),
        random.uniform(0.3, 1.0, (count, limits.n_joints)),
    )


def planned(individuals: Individuals, limits: JointLimits) -> list[PiecewiseCubic]:
    """Plan together what can be planned."""
    results = plan_chunk([*individuals.via_points], individuals.speed, limits, FLY)
    return [motion for motion in results if not isinstance(motion, PlannerError)]


def of_length(limits: JointLimits, seconds: float) -> PiecewiseCubic:
    """Return a random motion, run at the one speed that makes it last so long."""
    via_points = random_individuals(limits, 1, seed=3).via_points
    slow, fast = 0.01, 1.0
    for _ in range(40):
        middle = math.sqrt(slow * fast)
        (motion,) = planned(Individuals(via_points, np.full((1, limits.n_joints), middle)), limits)
        slow, fast = (middle, fast) if motion.duration > seconds else (slow, middle)
    return motion


def compare(
    objective: Objective, reference: pin.Model, motion: PiecewiseCubic, repetitions: int
) -> dict[str, float]:
    """Time both on one motion, and compare what they find."""
    coarse, fine = midpoints(motion, SAMPLE_PERIOD), midpoints(motion, FINE)
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
    own, foreign = common_columns(objective.model)
    found = Objective(objective.model, parameters=np.array(own)).measures(coarse)
    theirs = [_criteria_by_qr(rows[..., foreign]) for rows in stacked]
    return {
        "ratio_to_pinocchio": round(one_khz / ours, 3),
        "ratio_same_rate": round(same_rate / ours, 3),
        "ours_ms": round(ours, 3),
        "pinocchio_1_khz_ms": round(one_khz, 3),
        "pinocchio_same_rate_ms": round(same_rate, 3),
        "duration_s": round(motion.duration, 3),
        "log10_det_difference": found.log10_det - theirs[0][0],
        "coupling_index_difference": found.coupling_index - theirs[0][1],
        "log10_det_difference_to_1_khz": found.log10_det - theirs[1][0],
        "coupling_index_difference_to_1_khz": found.coupling_index - theirs[1][1],
    }


def time_individuals(
    objective: Objective, limits: JointLimits, count: int, repetitions: int
) -> dict[str, float]:
    """Time random individuals one by one; planning is shared by those planned together."""
    individuals = random_individuals(limits, count, seed=1)
    totals: list[Array] = []
    durations: list[float] = []
    for begin in range(0, count, CHUNK):
        part = Individuals(*(array[begin : begin + CHUNK] for array in individuals))
        planning = np.median(
            [timed(partial(planned, part, limits)) for _ in range(repetitions)]
        ) / len(part.via_points)
        motions = planned(part, limits)
        durations += [motion.duration for motion in motions]
        times = [
            [timed(partial(_judge, objective, m)) for m in motions] for _ in range(repetitions)
        ]
        totals.append(planning + np.median(times, axis=0))
    longest = of_length(limits, LONGEST)
    alone = [timed(partial(_judge, objective, longest)) for _ in range(3 * repetitions)]
    each = np.concatenate(totals) * 1e3
    return {
        "individual_ms": round(float(each.mean()), 3),
        "individual_worst_ms": round(float(each.max()), 3),
        "individual_20_s_ms": round(float(np.median(alone)) * 1e3 + float(planning) * 1e3, 3),
        "individuals": len(each),
        "individual_duration_s": round(float(np.mean(durations)), 3),
    }


def time_search(
    model: RobotModel, limits: JointLimits, population: int, generations: int
) -> dict[str, float]:
    """Run the paper's method B by one worker and by two; their results are equal."""
    problem = Problem(
        ViaPointGenome(limits, n_via=N_VIA, fly=FLY),
        Objective(model),
        Constraints(limits, max_duration=LONGEST),
    )
    settings = SearchSettings(
        method="b", population=population, generations=generations, crossover=0.9, mutation=0.01
    )
    found: dict[str, float] = {}
    fitness = []
    for workers, name in ((1, "ga_one_worker_s"), (2, "ga_two_workers_s")):
        with Population(problem, workers=workers) as individuals:
            start = time.perf_counter()
            used = _processor_time()
            design = search(individuals, settings)
            found[name] = round(time.perf_counter() - start, 2)
        # A child's time is known when it has ended.
        found[name.removesuffix("_s") + "_processor_s"] = round(_processor_time() - used, 2)
        fitness.append(design.excitation.criteria.fitness)
    if fitness[0] != fitness[1]:
        raise SystemExit(f"the number of workers changed the result: {fitness}")
    return {**found, "ga_individuals": population * generations, "ga_fitness": fitness[0]}


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--json", action="store_true", help="print the line of JSON only")
    parser.add_argument("--search", action="store_true", help="time the paper's search as well")
    parser.add_argument("--repetitions", type=int, default=15)
    parser.add_argument("--individuals", type=int, default=160)
    parser.add_argument("--population", type=int, default=150, help="of the search")
    parser.add_argument("--generations", type=int, default=120, help="of the search")
    options = parser.parse_args(arguments)

    limits = Cell.load(CELL_PATH).joint_limits
    model = RobotModel.from_urdf(urdf_text())
    objective = Objective(model)
    reference = pin.buildModelFromXML(urdf_text())
    result: dict[str, object] = {
        **compare(objective, reference, of_length(limits, 16.0), options.repetitions),
        **time_individuals(objective, limits, options.individuals, options.repetitions),
    }
    if options.search:
        result |= time_search(model, limits, options.population, options.generations)
    result["columns"] = model.n_parameters
    result["repetitions"] = options.repetitions
    result["clock"] = "processor time of one thread; searches: wall time"
    if not options.json:
        for name, value in result.items():
            print(f"  {name:36} {value}")
    print(json.dumps(result))


def _processor_time() -> float:
    """Return the processor time [s] of this process and of its children that have ended."""
    usages = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def _judge(objective: Objective, motion: PiecewiseCubic) -> None:
    objective.measures(midpoints(motion, SAMPLE_PERIOD))


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
