"""Result of `hil compare` for simulated campaigns: one arm unchanged, then with more friction.

Three short campaigns of one plan on the simulated NS 16, with other noise in each; in the last one
Coulomb and viscous friction of axis 3 are raised by 35 %.

    python -m benchmarks.comparison [--json] [--repetitions N]
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any, Final

from benchmarks import parser_of, show
from hil import Campaign, Cell
from hil.batch.workers import LocalWorkers
from hil.campaign import design
from hil.compare import compare_campaigns, gather
from hil.progress import Silent
from sim_fixtures.ns16 import CELL_PATH

AXIS: Final = 2
"""Whose friction is raised, from 0."""
FACTOR: Final = 1.35


def with_more_friction(cell: Cell) -> Cell:
    """The same cell, whose simulated arm has more friction on one axis."""
    changed: dict[str, list[float]] = {}
    for key in ("coulomb", "viscous"):
        assert cell.file.simulation is not None
        values = list(getattr(cell.file.simulation, key))
        values[AXIS] *= FACTOR
        changed[f"simulation.{key}"] = values
    return cell.with_values(changed)


def measure(repetitions: int) -> dict[str, Any]:
    """Run three campaigns, and compare the second and the third with the first."""
    usual = Cell.load(CELL_PATH).with_campaign(repetitions=repetitions, validation_runs=5)
    plan = design(usual, Silent())
    arms = {
        "first": usual,
        "unchanged": usual.with_campaign(simulation_seed=2),
        "rubbing": with_more_friction(usual.with_campaign(simulation_seed=3)),
    }
    with tempfile.TemporaryDirectory() as folder, LocalWorkers(1) as workers:
        places = {name: Path(folder) / name for name in arms}
        for name, cell in arms.items():
            Campaign.create(places[name], cell, plan).run(unrehearsed=True)

        def compared(name: str) -> dict[str, Any]:
            pair = [str(places["first"]), str(places[name])]
            found = compare_campaigns(gather(pair, workers, Silent()))
            shares = found.friction.shares[:, 1]
            return {
                "verdict": found.verdict,
                "axes": {
                    axis.joint: {"change": share, "changed": changed}
                    for axis, share, changed in zip(
                        found.axes,
                        shares.tolist(),
                        found.friction.changed[:, 1].tolist(),
                        strict=True,
                    )
                },
                "prediction": found.prediction.tolist(),
            }

        return {name: compared(name) for name in ("unchanged", "rubbing")}


def main() -> None:
    """Print what was found."""
    parser = parser_of(__doc__)
    parser.add_argument("--repetitions", type=int, default=3)
    options = parser.parse_args()
    show(measure(options.repetitions), only_json=options.json)


if __name__ == "__main__":
    main()
