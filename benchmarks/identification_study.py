"""How far to believe an identification: seeds of the simulated NS 16, whose truth is known.

Run with ``python -m benchmarks.identification_study [--seeds 40] [--folder DIR] [--workers 2]
[--only NAME ...] [--json FILE]``. Every seed is a campaign of its own: standstill and one
repetition of the excitation that `hil demo` finds, through the controller's link, with encoder and
current noise and their resolutions. Recordings are kept in the folder; what is there is not made
again, so a study that was stopped goes on, and one with more seeds begins with those it has.

- *coverage*: share of the 95 % intervals that hold the planted value, by parameter and over all of
  them; and the standard deviations reported over the scatter of the estimates over the seeds (a
  Monte Carlo test of the covariance). *effects*: the same with torque ripple, friction drift,
  elasticity and delay, which the model leaves out; *ripple*, *drift*, *elasticity* and *delay*
  with one of them alone.
- *consistent*: the physically consistent estimate beside the free one on motions that were not
  fitted; from the whole recording, and from so little of it that the free one is impossible.
- *instruments*: least squares and instrumental variables with so many times the position noise,
  and how often the Durbin-Wu-Hausman test says that least squares is biased. *size*: the same where
  it is not.
- *outliers*: estimators with gross errors in the torque.

Errors are of the torque on four validation motions, as shares of its RMS: *held out* is the error
that anyone would see, its noise included; *wrong* is the torque of the error of the parameters,
which only a simulation knows; *bias* that of their mean over the seeds.
"""

# ruff: noqa: E402 - threads are pinned before numpy is imported, or BLAS does not see it

from __future__ import annotations

import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"

import argparse
import json
import multiprocessing
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, cast, get_args

from benchmarks.study_fits import SHARES, Study
from benchmarks.study_recordings import (
    EFFECTS,
    Condition,
    Kept,
    excitation_path,
    record_excitation,
    record_validation,
    study_cell,
    study_plan,
)
from benchmarks.study_tables import (
    Covered,
    Table,
    consistent_table,
    coverage_table,
    instruments_table,
    markdown,
    outliers_table,
    size_table,
)

Name = Literal[
    "coverage", "effects", "ripple", "drift", "elasticity", "delay",
    "consistent", "instruments", "size", "outliers",
]  # fmt: skip

STUDIES: Final[tuple[Name, ...]] = get_args(Name)
FOLDER: Final = Path("runs/identification_study")
NOISES: Final = (1, 10, 30, 100, 300, 1000)
PARTS: Final = (1.0, 0.25)
"""Shares of a recording that the consistent estimate is made from: enough, and too little."""


class Task(NamedTuple):
    """One fit of one seed.

    Attributes:
        name: the study.
        folder: of the recordings.
        seed: of the recording.
        variant: how many times the noise, or which kind of outliers; nothing otherwise.
    """

    name: Name
    folder: Path
    seed: int
    variant: Any = None

    @property
    def condition(self) -> Condition:
        """What its recording has that the model leaves out."""
        return _condition(self.name)


def tasks_of(name: Name, folder: Path, seeds: Iterable[int]) -> list[Task]:
    """What a study consists of."""
    variants: tuple[Any, ...] = (None,)
    if name == "instruments":
        variants = NOISES
    elif name == "consistent":
        variants = PARTS
    elif name == "outliers":
        variants = tuple(SHARES)
    return [Task(name, folder, seed, variant) for variant in variants for seed in seeds]


def run(task: Task) -> Any:
    """Record what is missing, and fit."""
    cell = study_cell()
    plan = study_plan(task.folder, cell)
    record_excitation(task.folder, cell, plan, task.seed, task.condition)
    study = _study(task.folder, task.condition)
    kept = Kept.load(excitation_path(task.folder, task.seed, task.condition))
    if task.name == "consistent":
        return study.consistent(kept, task.variant)
    if task.name == "instruments":
        return study.instrumented(kept, task.variant, task.seed)
    if task.name == "size":
        return study.exogenous(kept, task.seed)
    if task.name == "outliers":
        return study.with_outliers(kept, task.variant, task.seed)
    return Covered(*study.weighted(kept))


@cache
def _study(folder: Path, condition: Condition) -> Study:
    return Study.of(folder, condition)


def _condition(name: Name) -> Condition:
    return cast(Condition, name) if name == "effects" or name in EFFECTS else "clean"


def table_of(name: Name, study: Study, tasks: Sequence[Task], found: Sequence[Any]) -> Table:
    """The table of a study, from what its tasks found."""
    by_variant: dict[Any, list[Any]] = {}
    for task, one in zip(tasks, found, strict=True):
        by_variant.setdefault(task.variant, []).append(one)
    make: dict[Name, Callable[[], Table]] = {
        "consistent": lambda: consistent_table(study, by_variant),
        "instruments": lambda: instruments_table(study, by_variant),
        "size": lambda: size_table(found),
        "outliers": lambda: outliers_table(study, by_variant),
    }
    return make[name]() if name in make else coverage_table(study, found)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the studies, and print their tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", type=int, default=40, help="of each study")
    parser.add_argument("--folder", type=Path, default=FOLDER, help="of the recordings")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--only", nargs="+", choices=STUDIES, default=STUDIES, metavar="NAME")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the tables there as well")
    options = parser.parse_args(arguments)

    folder = options.folder
    cell = study_cell()
    plan = study_plan(folder, cell)
    result: dict[str, Table] = {}
    with multiprocessing.get_context("spawn").Pool(options.workers) as pool:
        for name in options.only:
            record_validation(folder, cell, plan, _condition(name))
            tasks = tasks_of(name, folder, range(1, options.seeds + 1))
            found = []
            # In the order of the seeds: tables do not depend on who was faster.
            for done, one in enumerate(pool.imap(run, tasks), 1):
                found.append(one)
                if done % 20 == 0 or done == len(tasks):
                    print(f"{name}: {done} of {len(tasks)}", file=sys.stderr, flush=True)
            result[name] = table_of(name, _study(folder, _condition(name)), tasks, found)
            print(markdown(name, result[name]), flush=True)
    if options.json is not None:
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
