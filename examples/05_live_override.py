"""Overriding a motion while it runs: slower, then at full speed again, always on the path.

Prints the distance of the commanded positions from the planned straight motion: rounding errors.
The picture shows the requested override, the resulting speed along the path within the limits of
`[bounds]`, and that of the joints. On a real arm the keys of `hil run` do this; any object with
`show` and `request` can.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np

from hil import Cell, cell_link, open_archive, plan_move, send, stop_on_interrupt
from hil.control.motion_watch import MotionProgress, OperatorRequest

PICTURE = Path("runs/examples/05_live_override.png")


class Operator:
    """Slows the motion down from a quarter to half of the motion."""

    def __init__(self) -> None:
        self.requested = OperatorRequest()
        self.seen = []

    def show(self, progress: MotionProgress) -> None:
        """Choose the override from the progress; called about ten times a second."""
        done = (progress.motion_time or 0.0) / (progress.duration or 1.0)
        self.requested = OperatorRequest(override=0.25 if 0.25 < done < 0.5 else 1.0)
        self.seen.append((progress.cycles, self.requested.override, progress.rate or 0.0))

    def request(self) -> OperatorRequest:
        """Return the present request."""
        return self.requested


cell = Cell.load("sim_fixtures/ns16/cell.toml")
operator = Operator()
with TemporaryDirectory() as folder, cell_link(cell) as link, stop_on_interrupt() as stop:
    move = plan_move(cell, link.connect(stop), cell.home, speed=0.02)
    archive = Path(folder) / "move_000_a1.mcap"
    print(send(move, cell, link, archive, stop=stop, watch=operator).outcome)
    q = open_archive(archive).columns["commanded_position"]
    q = q[np.isfinite(q).all(axis=1)]
along = (move.target - move.start) / np.linalg.norm(move.target - move.start)
beside = (q - move.start) - np.outer((q - move.start) @ along, along)
print(f"{move.duration:.2f} s planned, {len(q) * cell.period:.2f} s executed")
print(f"largest distance from the planned path: {np.abs(beside).max():.1e} rad")
figure, rows = plt.subplots(2, sharex=True, figsize=(8, 4.5), layout="constrained")
cycles, requested, rate = np.array(operator.seen).T
rows[0].step(
    cycles * cell.period, requested, "--", where="post", color="#666666", label="requested"
)
rows[0].plot(cycles * cell.period, rate, color="#0072b2", label="speed along the path")
rows[0].legend(loc="lower right")
speed = np.degrees(np.diff(q, axis=0)) / cell.period
rows[1].plot(np.arange(len(speed)) * cell.period, speed, label=cell.joint_names)
rows[1].set(xlabel="time [s]", ylabel="commanded speed [°/s]")
rows[1].legend(ncols=3, fontsize="small")
PICTURE.parent.mkdir(parents=True, exist_ok=True)
figure.savefig(PICTURE, dpi=90)
