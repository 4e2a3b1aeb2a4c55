"""Your own excitation: chosen via points, compared with those of a search.

Prints the paper's criteria of both motions, the determinant (eq. 9, larger is better) and the
coupling index (eq. 5, smaller is better), and the effect on the intervals of the simulated NS 16.
The picture is Fig. 2: the correlation of the parameters with each motion. `Campaign.create` accepts
any `Excitation`: insert your own via points.
"""

import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np

from hil import Campaign, Cell, Silent
from hil.campaign import design
from identification.excitation import Excitation, Objective, correlation, midpoints
from identification.excitation.excitation import moves_through
from planner import plan_moves

PICTURE = Path("runs/examples/04_own_excitation.png")
VIA = np.radians([  # away from home, joint by joint; home stands at both ends
    [40, 20, -30, 60, -40, 90], [-50, -25, 20, -80, 20, -60], [20, 30, 10, 30, -60, 120],
    [-30, -20, -40, -40, -90, -100], [60, 10, 10, 90, 25, 30],
])  # fmt: skip


def mine(cell: Cell) -> Excitation:
    """The motion through `VIA`, at full speed, with its criteria."""
    points = np.vstack([cell.home, cell.home + VIA, cell.home])
    speed = np.ones(len(cell.home))
    planned = plan_moves(points[0], moves_through(points, speed, 0.5), cell.joint_limits)
    criteria = Objective(cell.model).criteria(planned.trajectory, cell.period)
    return Excitation(planned.trajectory, criteria, "by hand", 0, 1, {}, points, speed, 0.5)


def main(*, quick: bool) -> None:
    """Compare, run, identify."""
    cell = Cell.load("sim_fixtures/ns16/cell.toml").with_campaign(
        repetitions=2, validation_runs=1 if quick else 10
    )
    plan = design(cell, Silent())
    both = {"by hand": mine(cell), "searched": plan.excitation}
    std = []
    figure, places = plt.subplots(1, 2, figsize=(8, 4.2), layout="constrained")
    for axes, (name, excitation) in zip(places, both.items(), strict=True):
        gram = Objective(cell.model).information(midpoints(excitation.trajectory, cell.period))
        axes.imshow(np.abs(correlation(gram)), cmap="Greys", vmin=0, vmax=1)
        criteria = excitation.criteria
        axes.set_title(
            f"{name}: log det {criteria.log10_det:.1f}, I_c {criteria.coupling_index:.1f}"
        )
        with TemporaryDirectory() as folder:
            campaign = Campaign.create(
                Path(folder) / "campaign", cell, replace(plan, excitation=excitation, moves=None)
            )
            campaign.run(unrehearsed=True)
            results = campaign.identify().results
        std.append([parameter.std for parameter in results.parameters])
        print(f"{axes.get_title()}\n  {results.verdict.line}")
    ratio = np.exp(np.mean(np.log(std[0]) - np.log(std[1])))
    print(f"the search makes intervals {ratio:.2f} times narrower (geometric mean over parameters)")
    PICTURE.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(PICTURE, dpi=90)


if __name__ == "__main__":
    main(quick="--quick" in sys.argv)
