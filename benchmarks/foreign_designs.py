"""Designs for the NS 16, UR5 and Panda: `python -m benchmarks.foreign_designs --seeds 5`.

The cell of the UR5 and the Panda is that of ``hil new --design-only`` from their URDF; searches run
as ``hil design`` with all constraints does, in one process. ``gradient`` and, for sines in place
of via points, ``sines`` end after ``--seconds`` (30, of the NS 16 60); ``quick`` (``--quick``) runs
to its end. Seconds are processor time, summed over the processes of a search: on a machine with
other work a wall clock would count that as well. A search ends after the generation or step in
which its time is over.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks import parser_of, show
from benchmarks.arms import ARMS, urdf
from hil.campaign.plan import quick_settings
from hil.cell import Cell
from hil.cli import new
from hil.design.problem import problem_of, search_settings
from hil.design.settings import DesignSettings, preset, settings_of
from identification.excitation import NoFeasibleMotionError, Population, search
from sim_fixtures.ns16 import CELL_PATH

_ARMS: Final = {
    "ns16": None,
    "ur5": "ur_description/urdf/ur5_robot.urdf",
    "panda": ARMS["panda"],
}
_SECONDS: Final = {"ns16": 60.0, "ur5": 30.0, "panda": 30.0}
_SEARCHES: Final = ("gradient", "sines", "quick")


def _settings(name: str, cell: Cell) -> DesignSettings:
    if name == "quick":
        return quick_settings(cell)
    if name == "sines":
        return settings_of({"sines": {"fastest": "from limits"}})
    return preset("gradient")


def _processor_time() -> float:
    """Return the processor time of this process and its present children [s]."""
    children = Path("/proc/self/task").glob("*/children")
    pids = [pid for listed in children for pid in listed.read_text().split()]
    threads = [thread for pid in pids for thread in Path(f"/proc/{pid}/task").iterdir()]
    counts = [int((thread / "schedstat").read_text().split()[0]) for thread in threads]
    return time.process_time() + 1e-9 * sum(counts)


def designed(cell: Cell, name: str, seed: int, limit: float) -> dict[str, Any]:
    """Search once."""
    settings = _settings(name, cell).replaced(seed=seed)
    row: dict[str, Any] = {"search": name, "seed": seed}
    begin = _processor_time()
    with Population(problem_of(cell, settings), workers=1) as population:

        def seconds() -> float:
            return _processor_time() - begin

        try:
            design = search(population, search_settings(settings), stop=lambda: seconds() > limit)
        except NoFeasibleMotionError as error:
            return row | {"infeasible": str(error), "seconds": round(seconds(), 1)}
        row["seconds"] = round(seconds(), 1)
    criteria = design.excitation.criteria
    return row | {
        "log10_det": round(criteria.log10_det, 2),
        "coupling_index": round(criteria.coupling_index, 1),
        "motions": design.excitation.tried,
    }


def main() -> None:
    """Print the searches of each arm and seed."""
    parser = parser_of(__doc__)
    parser.add_argument("--arms", nargs="+", choices=_ARMS, default=list(_ARMS))
    parser.add_argument(
        "--searches", nargs="+", choices=_SEARCHES, default=["gradient"], metavar="NAME"
    )
    parser.add_argument("--seeds", type=int, default=5, help="how many seeds, from 1 on")
    parser.add_argument("--seconds", type=float, help="of processor for each search")
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        for arm in options.arms:
            path = CELL_PATH
            if (description := _ARMS[arm]) is not None:
                path = Path(scratch) / arm / "cell.toml"
                new.new(urdf(description), output=path, design_only=True, json=True)
            cell = Cell.load(path)
            seconds = options.seconds or _SECONDS[arm]
            for seed in range(1, options.seeds + 1):
                for name in options.searches:
                    limit = np.inf if name == "quick" else seconds
                    rows.append({"arm": arm} | designed(cell, name, seed, limit))
                    if not options.json:
                        print(
                            *(f"{key} {value}" for key, value in rows[-1].items()),
                            sep=", ",
                            flush=True,
                        )
    show({"rows": rows}, only_json=True)


if __name__ == "__main__":
    main()
