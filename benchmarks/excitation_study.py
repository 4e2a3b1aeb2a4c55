"""What excites the NS 16 best: the paper's two methods, a front of compromises, constraints.

Run with ``python -m benchmarks.excitation_study [--seeds 3] [--quick] [--workers 2]
[--only NAME ...] [--json FILE]``. Every search is that of ``hil design`` with the preset of its
method; each is run with so many seeds. Three tables:

- *methods*: Table 1 of the paper beside its methods A and B, the balanced fitness and the knee of
  the front, with nothing but joint limits to keep, as in the paper;
- *goal*: the motion of least coupling with log10 det >= 104, and what the front reaches;
- *constraints*: the front of a path closed at the cell's home, with floor and self-collision, and
  with motor currents, each added to the one before. What a constraint costs is what the front
  loses: I_c at the same log10 det, and log10 det at the same I_c. Knees do not compare, since a
  knee that moves along the front wins in one measure what it loses in the other.

log10 det and I_c are those of the motion sampled every millisecond. Seconds are wall clock, so
the machine should have nothing else to do; everything else is the same to the last bit for a
seed, whatever the number of processes. ``--quick`` tries the program, not the methods.
"""

# ruff: noqa: E402 - threads are pinned before numpy is imported, or BLAS does not see it

from __future__ import annotations

import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from hil.cell import Cell
from hil.design.problem import problem_of, search_settings
from hil.design.settings import DesignSettings, preset
from identification.excitation import (
    Criteria,
    Design,
    NoFeasibleMotionError,
    Population,
    search,
)
from sim_fixtures.ns16 import CELL_PATH

GOAL: Final = 104.0
"""log10 det that a motion is to have at least, and ..."""
CEILING: Final = 80.0
"""... I_c that it is to have at most."""
_PAPER_WIDTH: Final = 150  # characters, in a file or a pipe
FINE: Final = 1e-3
QUICK: Final = {"search": {"population": 24, "generations": 6}}


class Case(NamedTuple):
    """One search, to be run with several seeds.

    Attributes:
        name: what it is called in the tables.
        table: the one it belongs to.
        settings: of the search.
    """

    name: str
    table: str
    settings: DesignSettings


@dataclass(frozen=True)
class Motion:
    """How good one motion is, from its samples 1 ms apart."""

    log10_det: float
    coupling_index: float
    fitness: float
    n_samples: int
    duration: float
    scaled_condition: float | None

    @classmethod
    def of(cls, criteria: Criteria, duration: float) -> Motion:
        """The motion with these criteria."""
        return cls(
            criteria.log10_det,
            criteria.coupling_index,
            criteria.fitness,
            criteria.n_samples,
            duration,
            criteria.scaled_condition,
        )


@dataclass(frozen=True)
class Row:
    """What one search came to.

    Attributes:
        case, table, seed: which one.
        seconds: wall clock.
        chosen: the motion that it returned; None where nothing feasible was found.
        goal: the least coupled motion with log10 det >= 104, of the front and the one returned.
        evaluated: motions scored.
        infeasible: how many of them broke each kind of constraint, or why there is no motion.
        front: (log10 det, I_c, duration [s]) of its front as scored every 8 ms, before any polish.
    """

    case: str
    table: str
    seed: int
    seconds: float
    chosen: Motion | None
    goal: Motion | None
    evaluated: int
    infeasible: dict[str, int] | str
    front: list[tuple[float, float, float]]


class Printed(NamedTuple):
    """A row of the paper's Table 1."""

    name: str
    n_samples: int
    log10_det: float
    coupling_index: float


PAPER: Final = (Printed("paper, A", 2000, 90.5, 127.9), Printed("paper, B", 15996, 30.9, 101.2))
REMARKS: Final = """\
Comparable with the paper: I_c, which has no units (58 parameters, I_c,max = 1653).
Not comparable: log10 det. It depends on the units of the parameters, which the paper does not
name (friction in degrees instead of radians alone adds 63 to 84), and on accelerations it does
not print. Among our rows it is: SI units, the same limits throughout. Eq. 8 as printed begins
and ends at full speed, which no controller can run; with the ramps of the preset it can.
Rows differ in effort as well as in method: A and B have the paper's sizes (12 000 and 18 000
individuals, K = 6 via points, no polish), balanced and front have K = 14 and a polish besides.
"front, K = 6" has as many via points as B; "tried" counts what each evaluated, the polish
included. What K and the polish add is no merit of the criterion."""

LUCK: Final = """\
Costs smaller than the differences between seeds are luck of the search. A kind of constraint
that is not among the infeasible ones was not broken by any motion tried, and cost nothing."""


def cases() -> Iterator[Case]:
    """Yield every search of the study."""
    front = preset("front")
    sines = preset("a").kinematic()
    yield Case("A (eq. 8 as printed)", "methods", sines.replaced(sines={"ramp": 0.0}))
    yield Case("A with ramps", "methods", sines)
    yield Case("B (eq. 7)", "methods", preset("b").kinematic())
    yield Case("balanced", "methods", preset("balanced").kinematic())
    yield Case("front, K = 6", "methods", front.replaced(via_points={"n_via": 6}).kinematic())
    yield Case("front", "methods", front.kinematic())
    closed = {"closed": True, "collision": False, "current": False}
    yield Case("closed at home", "constraints", front.replaced(constraints=closed))
    clear = {**closed, "collision": True}
    yield Case("+ floor, self-collision", "constraints", front.replaced(constraints=clear))
    whole = {**clear, "current": True}
    yield Case("+ motor currents", "constraints", front.replaced(constraints=whole))


def run(cell: Cell, case: Case, seed: int, *, workers: int, quick: bool) -> Row:
    """Search once."""
    settings = case.settings.replaced(seed=seed)
    if quick:
        polish = min(settings.search.polish, 50)
        settings = settings.replaced(search={**QUICK["search"], "polish": polish})
    begin = time.perf_counter()
    with Population(problem_of(cell, settings), workers=workers) as population:
        try:
            design = search(population, search_settings(settings))
        except NoFeasibleMotionError as error:
            took = time.perf_counter() - begin
            return Row(case.name, case.table, seed, took, None, None, 0, str(error), [])
        took = time.perf_counter() - begin
        chosen = Motion.of(design.excitation.criteria, design.excitation.trajectory.duration)
        goal = _goal(population, design, chosen)
    front = design.front
    return Row(
        case=case.name,
        table=case.table,
        seed=seed,
        seconds=took,
        chosen=chosen,
        goal=goal,
        evaluated=design.excitation.tried,
        infeasible=dict(design.excitation.rejected),
        front=list(
            zip(
                front.measure("log10_det").tolist(),
                front.measure("coupling_index").tolist(),
                front.duration.tolist(),
                strict=True,
            )
        ),
    )


def _goal(population: Population, design: Design, chosen: Motion) -> Motion | None:
    """Return the least coupled motion that reaches the goal, of the front and the polished one."""
    candidates = [chosen]
    front = design.front
    # By rising coupling index; what the two ways of sampling differ by is far below 0.1.
    for index in np.flatnonzero(front.measure("log10_det") >= GOAL - 0.1).tolist():
        trajectory, criteria = population.judged(front.genes[index], FINE)
        if criteria.log10_det >= GOAL:
            candidates.append(Motion.of(criteria, trajectory.duration))
            break
    reached = [motion for motion in candidates if motion.log10_det >= GOAL]
    return min(reached, key=lambda motion: motion.coupling_index, default=None)


def _figures(motion: Motion | None) -> tuple[str, ...]:
    if motion is None:
        return "-", "-", "-", "-", "-"
    condition = "-" if motion.scaled_condition is None else f"{motion.scaled_condition:.0f}"
    return (
        f"{motion.n_samples}",
        f"{motion.duration:.1f}",
        f"{motion.log10_det:.1f}",
        f"{motion.coupling_index:.1f}",
        condition,
    )


MOTION_HEADS: Final = ("N", "s", "log det", "I_c", "cond")


def methods_table(rows: Sequence[Row]) -> Table:
    """Return Table 1 rebuilt."""
    table = _table("Methods, joint limits only", "method", "seed", *MOTION_HEADS, "tried", "took s")
    for printed in PAPER:
        measures = f"{printed.log10_det}", f"{printed.coupling_index}"
        table.add_row(printed.name, "", f"{printed.n_samples}", "", *measures, "", "", "")
    for row in rows:
        table.add_row(
            row.case,
            f"{row.seed}",
            *_figures(row.chosen),
            f"{row.evaluated}",
            f"{row.seconds:.0f}",
        )
    return table


def goal_table(rows: Sequence[Row]) -> Table:
    """Return what the fronts reach: the goal, and their ends."""
    table = _table(
        f"The least coupled motion with log det >= {GOAL:g}, and the ends of the unpolished front",
        "search",
        "seed",
        *MOTION_HEADS,
        "largest log det",
        "smallest I_c",
        "motions",
    )
    for row in rows:
        if row.front:
            front = np.array(row.front)
            ends = f"{front[:, 0].max():.1f}", f"{front[:, 1].min():.1f}"
            table.add_row(row.case, f"{row.seed}", *_figures(row.goal), *ends, f"{len(front)}")
    return table


def constraints_table(rows: Sequence[Row]) -> Table:
    """Return the front under one constraint more in each row, and what it costs."""
    table = _table(
        "Front under constraints; what each costs against the row before (+: worse)",
        "constraints",
        "seed",
        f"I_c at log det >= {GOAL:g}",
        "costs",
        f"log det at I_c <= {CEILING:g}",
        "costs",
        *(f"knee: {head}" for head in MOTION_HEADS),
        "infeasible",
        "took s",
    )
    before: dict[int, tuple[float, float]] = {}
    for row in rows:
        reached = _reached(row)
        last = before.get(row.seed, (np.nan, np.nan))
        table.add_row(
            row.case,
            f"{row.seed}",
            _number(reached[0]),
            _number(reached[0] - last[0], "+"),
            _number(reached[1]),
            _number(last[1] - reached[1], "+"),
            *_figures(row.chosen),
            _shares(row),
            f"{row.seconds:.0f}",
        )
        before[row.seed] = reached
    return table


def _reached(row: Row) -> tuple[float, float]:
    """Return the least I_c with log10 det >= GOAL and the largest log10 det with I_c <= CEILING.

    Of all motions that the search returned; nan where none is so good.
    """
    found = [(log10_det, coupling_index) for log10_det, coupling_index, _ in row.front]
    found += [(m.log10_det, m.coupling_index) for m in (row.chosen, row.goal) if m is not None]
    return (
        min((index for log10_det, index in found if log10_det >= GOAL), default=np.nan),
        max((log10_det for log10_det, index in found if index <= CEILING), default=np.nan),
    )


def _number(value: float, sign: str = "") -> str:
    return "-" if np.isnan(value) else f"{value:{sign}.1f}"


def _shares(row: Row) -> str:
    """Return how often each kind of constraint was broken."""
    if isinstance(row.infeasible, str):
        return row.infeasible
    return ", ".join(
        f"{kind} {count / row.evaluated:.0%}" for kind, count in row.infeasible.items() if count
    )


def _table(title: str, first: str, *heads: str) -> Table:
    table = Table(title=title, title_justify="left")
    table.add_column(first, no_wrap=True)
    for head in heads:
        table.add_column(head, justify="right")
    return table


def report(console: Console, rows: Sequence[Row]) -> None:
    """Print the tables."""
    methods = [row for row in rows if row.table == "methods"]
    ladder = [row for row in rows if row.case == "front" or row.table == "constraints"]
    console.print(methods_table(methods))
    console.print(REMARKS, highlight=False)
    console.print(goal_table([row for row in rows if "front" in row.case or row in ladder]))
    console.print(constraints_table(ladder))
    console.print(LUCK, highlight=False)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", type=int, default=3, help="how many seeds, from 1 on")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--quick", action="store_true", help="a handful of individuals only")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="only searches named so")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures there")
    return parser.parse_args()


def _wide(console: Console) -> Console:
    """Return a console on which the tables are legible where there is no terminal to fit into."""
    return console if console.is_terminal else Console(width=_PAPER_WIDTH)


def main() -> None:
    """Run the searches, and print and write what they came to."""
    arguments = _arguments()
    chosen = [case for case in cases() if not arguments.only or case.name in arguments.only]
    if not chosen:
        raise SystemExit(f"--only knows {', '.join(repr(case.name) for case in cases())}")
    console, cell = _wide(Console()), Cell.load(CELL_PATH)
    rows: list[Row] = []
    for case in chosen:
        for seed in range(1, arguments.seeds + 1):
            console.print(f"{case.name}, seed {seed} ...", style="dim")
            rows.append(run(cell, case, seed, workers=arguments.workers, quick=arguments.quick))
            if arguments.json is not None:  # after each search: the study takes its time
                arguments.json.write_text(json.dumps(_content(arguments, rows), indent=1) + "\n")
    report(console, rows)


def _content(arguments: argparse.Namespace, rows: Sequence[Row]) -> dict[str, Any]:
    return {
        "goal_log10_det": GOAL,
        "quick": arguments.quick,
        "workers": arguments.workers,
        "paper": [printed._asdict() for printed in PAPER],
        "rows": [asdict(row) for row in rows],
    }


if __name__ == "__main__":
    main()
