"""A first motion: the simulated NS 16 goes home, and every cycle of it is archived.

Prints the initial posture, the duration and the outcome; the picture shows the archive: position,
speed, currents and their limits, following error, events.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hil import Cell, cell_link, plan_move, send, stop_on_interrupt
from hil.plots import save
from hil.plots.archive_view import draw_archive, view_of

PICTURE = Path("runs/examples/02_first_motion.png")


def main() -> None:
    """Connect, plan, check, move, look."""
    cell = Cell.load("sim_fixtures/ns16/cell.toml")
    with TemporaryDirectory() as folder, cell_link(cell) as link, stop_on_interrupt() as stop:
        here = link.connect(stop)  # a controller that does not fit the cell file is refused here
        print("the arm stands at", np.degrees(here).round(1), "degrees (URDF)")
        move = plan_move(cell, here, cell.home)  # limits, contacts, currents: checked
        print(f"home is {move.duration:.2f} s away")
        archive = Path(folder) / "move_000_a1.mcap"
        ended = send(move, cell, link, archive, stop=stop)
        print(f"{ended.outcome}; {archive.stat().st_size / 1e3:.0f} kB archived")
        PICTURE.parent.mkdir(parents=True, exist_ok=True)
        save(draw_archive(view_of(archive)), PICTURE)


if __name__ == "__main__":
    main()
