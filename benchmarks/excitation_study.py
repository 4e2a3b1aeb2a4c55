"""What excites the NS 16 best: the paper's method B, the default search, and it with constraints.

Run with ``python -m benchmarks.excitation_study [--seeds 3] [--quick] [--workers 2]
[--only NAME ...] [--weights OF_LOG_DET OF_I_C] [--via-points N --duration S] [--json]``. Every
search is that of ``hil design`` with the preset of its method: ``B (eq. 7)`` and ``gradient`` with
nothing but joint limits to keep, as in the paper; ``all constraints`` closed at the cell's home,
clear of floor and itself, and within 80 % of the currents.
Motions with a number of via points take at most 1.25 s for each and are improved from one start.
``--via-points`` and ``--duration`` of the longest motion replace those of a case.

log10 det and I_c are those of the motion sampled every millisecond; ``with_rests`` are both as they
were counted before, when a joint that rests had dry friction of full size. Seconds are wall clock,
and of processor; everything else is the same to the last bit for a seed, whatever the number of
processes. I_c has no units and compares with the paper's 101.2 of method B; log10 det depends on
the units of the parameters, which the paper does not name. ``--quick`` tries the program, not the
methods.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import cached_property
from typing import Any, Final

from benchmarks import parser_of, processor_time, show
from hil.base.errors import InputError
from hil.cell import Cell
from hil.design.problem import problem_of, search_settings
from hil.design.settings import DesignSettings, preset
from identification.excitation import (
    RESCORE_PERIOD,
    NoFeasibleMotionError,
    Objective,
    Population,
    search,
)
from identification.model.friction import JointFriction
from sim_fixtures.ns16 import CELL_PATH

_PACE: Final = 1.25  # s for each via point


def _longer(
    settings: DesignSettings, via_points: int, steps: int, weight: float = 0.75
) -> DesignSettings:
    """Return settings of a longer motion, improved by some steps from one start."""
    return settings.replaced(
        search={"gradient": steps, "starts": 1, "weights": (weight, 1.0 - weight)},
        via_points={"n_via": via_points},
        constraints={"max_duration": _PACE * via_points},
    )


CASES: Final[dict[str, DesignSettings]] = {
    "B (eq. 7)": preset("b").kinematic(),
    "gradient": preset("gradient").kinematic(),
    "gradient, all constraints": preset("gradient"),
    "gradient, 60 via points": _longer(preset("gradient").kinematic(), 60, 75, 0.8),
    "gradient, all constraints, 36 via points": _longer(preset("gradient"), 36, 110),
}


class _WithRests(Objective):
    """Criteria to which the dry friction of resting joints counts, by the sign of rounding."""

    @cached_property
    def _friction(self) -> JointFriction:
        return self.model.friction


def run(
    cell: Cell,
    name: str,
    seed: int,
    *,
    workers: int,
    quick: bool,
    weights: Sequence[float] | None = None,
    via_points: int | None = None,
    duration: float | None = None,
) -> dict[str, Any]:
    """Search once."""
    settings = CASES[name].replaced(seed=seed)
    if weights is not None:
        settings = settings.replaced(search={"weights": tuple(weights)})
    if via_points is not None and settings.via_points is not None:
        settings = settings.replaced(via_points={"n_via": via_points})
    if duration is not None:
        settings = settings.replaced(constraints={"max_duration": duration})
    if quick:
        steps = min(settings.search.gradient, 5)
        effort = {"population": 24, "generations": 6, "gradient": steps}
        settings = settings.replaced(search=effort)
    row: dict[str, Any] = {"case": name, "seed": seed}
    begin = time.perf_counter()
    used = processor_time()
    with Population(problem_of(cell, settings), workers=workers) as population:
        try:
            design = search(population, search_settings(settings))
        except NoFeasibleMotionError as error:
            return row | {"infeasible": str(error)}
    criteria = design.excitation.criteria
    former = _WithRests(cell.model).criteria(design.excitation.trajectory, RESCORE_PERIOD)
    return row | {
        "log10_det": round(criteria.log10_det, 2),
        "coupling_index": round(criteria.coupling_index, 2),
        "with_rests": [round(former.log10_det, 2), round(former.coupling_index, 2)],
        "duration_s": round(design.excitation.trajectory.duration, 2),
        "evaluated": design.excitation.tried,
        "infeasible": dict(design.excitation.rejected),
        "seconds": round(time.perf_counter() - begin, 1),
        "processor_seconds": round(processor_time() - used, 1),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the searches, and print what they came to."""
    parser = parser_of(__doc__)
    parser.add_argument("--seeds", type=int, default=3, help="how many seeds, from 1 on")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--quick", action="store_true", help="a handful of individuals only")
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES), metavar="NAME")
    parser.add_argument("--weights", nargs=2, type=float, help="instead of those of the preset")
    parser.add_argument("--via-points", type=int, help="instead of those of the preset")
    parser.add_argument("--duration", type=float, help="longest motion, s, likewise")
    options = parser.parse_args(arguments)
    names = ("workers", "quick", "weights", "via_points", "duration")
    effort = {name: getattr(options, name) for name in names}
    cell = Cell.load(CELL_PATH)
    rows = []
    for name in options.only:
        for seed in range(1, options.seeds + 1):
            try:
                rows.append(run(cell, name, seed, **effort))
            except InputError as error:
                parser.error(str(error))
            if not options.json:
                print(*(f"{key} {value}" for key, value in rows[-1].items()), sep=", ", flush=True)
    show({"rows": rows}, only_json=True)


if __name__ == "__main__":
    main()
