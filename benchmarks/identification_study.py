"""Whether 95 % intervals hold the planted truth: many seeds of the simulated NS 16.

Run with ``python -m benchmarks.identification_study [--seeds 200] [--workers 2] [--json]``. Every
seed is a campaign of its own: standstill and one repetition of the excitation that `hil demo`
finds, through the controller's link, with encoder and current noise and their resolutions.

- ``coverage``: share of the intervals that hold the planted value, over all parameters, and the
  ``least`` and ``most`` of a parameter; ``classical_coverage``: with the covariance of white
  residuals;
- ``reported_over_actual``: reported standard deviations over the scatter of the estimates.
"""

from __future__ import annotations

import multiprocessing
import sys
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from benchmarks import parser_of, show
from hil.base.progress import Silent
from hil.campaign import Campaign, CampaignPlan, design
from hil.cell import Cell
from hil.control.planted_arm import planted_values
from hil.control.simulated_cell import simulated_link
from hil.pipeline.sources import Sources, gather_sources
from identification.estimators.least_squares import estimate_repetitions
from identification.signals.samples import Preprocessing, prepare
from planner.arrays import Array
from sim_fixtures.ns16 import CELL_PATH

_CAMPAIGN: Final = {
    "repetitions": 1,
    "validation_runs": 4,
    "approach_speed": 1.0,
    "settle_s": 0.2,
    "standstill_s": 2.0,
}
_WORST: Final = 6


class Covered(NamedTuple):
    """Estimates of one seed with half their 95 % intervals, reported and classical, (p,) each."""

    values: Array
    half: Array
    classical: Array


@cache
def study() -> tuple[Cell, CampaignPlan]:
    """The NS 16, its arm at home when it is switched on, and the plan of `hil demo`."""
    cell = Cell.load(CELL_PATH)
    campaign = {f"campaign.{key}": value for key, value in _CAMPAIGN.items()}
    cell = cell.with_values({**campaign, "simulation.initial_deg": cell.campaign.home_deg})
    return cell, design(cell, Silent())


def recorded(seed: int, *, validation: bool = False) -> Sources:
    """A campaign of one seed, as `hil identify` reads its archives."""
    cell, plan = study()
    if not validation:
        plan = CampaignPlan(plan.excitation, (), plan.moves)
    seeded = cell.with_campaign(simulation_seed=seed)
    with tempfile.TemporaryDirectory() as scratch:
        campaign = Campaign.create(Path(scratch) / "campaign", seeded, plan)
        campaign.run(simulated_link(seeded), durable=False, unrehearsed=True)
        kinds = ("standstill", "excitation", "validation")
        archives = [path for kind in kinds for path in campaign.folder.completed(kind)]
        return gather_sources(archives, split=1.0)  # a single excitation is fitted whole


def run(seed: int) -> Covered:
    """Record a seed and fit it."""
    cell = study()[0]
    sources = recorded(seed)
    (source,) = sources.training
    samples = prepare(
        source.recording,
        cell.model,
        noise_variance=sources.noise_variance,
        options=Preprocessing(torque_delay=cell.controller.current_delay_cycles * cell.period),
        origin=source.origin,
    )
    estimate = estimate_repetitions(cell.model, [samples])
    half = estimate.pooled.interval_factor * estimate.pooled.std
    return Covered(estimate.pooled.values, half, 1.96 * estimate.classical_std)


def coverage(rows: Sequence[Covered], truth: Array, names: Sequence[str]) -> dict[str, Any]:
    """Coverage over all parameters (p,) and by parameter, reported over actual deviations."""
    values, half, classical = (np.array(column) for column in zip(*rows, strict=True))
    apart = np.abs(values - truth)
    held = (apart < half).mean(axis=0)
    spread = values.std(axis=0, ddof=1)
    bias = (values.mean(axis=0) - truth) / spread
    # Intervals of a few dozen blocks are Student's: compared as what Gaussian ones would be.
    honest = half.mean(axis=0) / 1.96 / spread
    return {
        "seeds": len(rows),
        "coverage": _figure(held.mean()),
        "coverage_least": _figure(held.min()),
        "coverage_most": _figure(held.max()),
        "classical_coverage": _figure((apart < classical).mean()),
        "reported_over_actual": _figure(np.median(honest)),
        "bias_over_std_rms": _figure(np.sqrt(np.mean(bias**2))),
        "worst": [
            {
                "name": names[k],
                "coverage": _figure(held[k]),
                "bias_over_std": _figure(bias[k]),
                "reported_over_actual": _figure(honest[k]),
            }
            for k in np.argsort(held, kind="stable")[:_WORST]
        ],
    }


def _figure(number: float | np.floating[Any]) -> float:
    return float(f"{number:.4g}")


def main() -> None:
    """Run the seeds, and print the figures."""
    parser = parser_of(__doc__)
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--workers", type=int, default=2, help="processes")
    options = parser.parse_args()
    rows = []
    with multiprocessing.get_context("spawn").Pool(options.workers) as pool:
        # In the order of the seeds: figures do not depend on which process was faster.
        for done, covered in enumerate(pool.imap(run, range(1, options.seeds + 1)), 1):
            rows.append(covered)
            print(f"{done} of {options.seeds}", file=sys.stderr, flush=True)
    cell = study()[0]
    result = coverage(rows, planted_values(cell), cell.model.parameter_names)
    show(result, only_json=options.json)


if __name__ == "__main__":
    main()
