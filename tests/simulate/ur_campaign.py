"""Whole campaigns of a UR5e with random faults of link, controller and operator, by seed.

    python -m tests.simulate.ur_campaign [--seed N] [--count N]

Each seed runs a campaign in virtual time until a fault ends it, then completes it by a second run
without faults, as its operator would.
"""

from __future__ import annotations

import random
import tempfile
from collections import Counter
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from drivers.transports.simulated import SimulatedTransport
from hil.base.errors import ArchiveError, HilError
from hil.base.progress import Silent
from hil.campaign import Campaign, CampaignPlan, Stop
from hil.campaign.plan import design
from hil.cell import Cell
from hil.control.ur_simulation import UrPeer, simulated_ur
from hil.control.virtual_link import VirtualLink
from sim_fixtures.faults import split_faults
from sim_fixtures.ur.controller import parse_ur_fault
from tests.faults import parse_script
from tests.laws.evidence import ArchiveFile, Evidence, Rest, entries_of
from tests.laws.table import Scenario, judged
from tests.process_death.ends import ENDS
from tests.process_death.play import completed_evidence, finish_in_virtual_time
from tests.simulate.draws import Story
from tests.simulate.ur import DRAWS, PREFIX, play_seeds

CYCLES: Final = 3600
"""Of the campaign without faults; faults are drawn in these."""
_STORY: Final = Story(
    cycles=CYCLES, moving=tuple(range(CYCLES)), n_joints=6, bytes=68, writes=1, saves=1, creates=1
)
_SETTLED: Final = 400
"""Cycles after the end of a run in which the program has stopped the arm."""
_STILL: Final = 0.01  # rad/s


def draw_script(seed: int) -> tuple[str, ...]:
    """Return the lines of a seed, of link and controller; `stop@CYCLE` is the operator's."""
    chance = random.Random(f"ur campaign {seed}")
    kinds = [kind for kind in DRAWS if kind not in ("override", "hold")]
    count = chance.choices((1, 2, 3), (3, 2, 1))[0]
    lines: list[str] = []
    for kind in chance.choices(kinds, [DRAWS[kind][0] for kind in kinds], k=count):
        lines += DRAWS[kind][1](chance, _STORY).splitlines()
    return tuple(dict.fromkeys(lines))


class _StopAt(Stop):
    """An operator who stops the run at a cycle of the controller."""

    def __init__(self, peer: UrPeer, cycle: int | None) -> None:
        super().__init__()
        self._peer = peer
        self._cycle = cycle

    @property
    def requested(self) -> bool:
        """Whether the cycle has come."""
        return self._cycle is not None and self._peer.controller.cycle >= self._cycle

    @requested.setter
    def requested(self, value: bool) -> None:
        if value:
            self._cycle = -1


@dataclass(frozen=True, eq=False)
class CampaignStage:
    """What all seeds share.

    Attributes:
        cell, plan: of the campaign.
    """

    cell: Cell
    plan: CampaignPlan

    @classmethod
    def set_up(cls) -> CampaignStage:
        """Design the campaign."""
        cell = ENDS["rtde"].cell(Path())
        return cls(cell, design(cell, Silent()))

    def scenarios(self, seed: int, folder: Path, ends: Counter[str]) -> list[Scenario]:
        """Return the run with faults, and the one that completes the campaign, in this order."""
        lines = draw_script(seed)
        name = f"python -m tests.simulate.ur_campaign --seed {seed}"
        campaign = ENDS["rtde"].made(folder, self.cell, self.plan)
        root = campaign.folder.root

        def faulty() -> Evidence:
            before = entries_of(root)
            rest, error = run(campaign, lines, seed)
            ends.update([type(error).__name__ if error else "completed"])
            files, unreadable = archives_of(campaign)
            return Evidence(
                period=self.cell.period,
                files=files,
                unreadable=unreadable,
                folder=root,
                manifests=(before, entries_of(root)),
                rests=(rest,),
            )

        def completed() -> Evidence:
            before = entries_of(root)
            finish_in_virtual_time(campaign, "rtde", seed)
            return completed_evidence(campaign, before, Evidence())

        return [Scenario(name, lines, faulty), Scenario(f"{name}, resumed", (), completed)]


def run(campaign: Campaign, lines: tuple[str, ...], seed: int) -> tuple[Rest, HilError | None]:
    """Run a campaign under a script; return the arm some time later, and the error of the run."""
    ours = [line for line in lines if line.startswith(PREFIX)]
    faults = [parse_ur_fault(line.removeprefix(PREFIX)) for line in ours]
    script = parse_script(line for line in lines if line not in ours)
    stops = [event.at for event in script.of("cycle") if event.kind == "stop"]
    link: Any = split_faults([fault for _, fault in script.faults])[0]
    robot = simulated_ur(campaign.cell, faults=faults, seed=seed)
    peer = UrPeer(robot)
    error: HilError | None = None
    try:
        Campaign.open(campaign.folder.root).run(
            VirtualLink.over(SimulatedTransport(peer, link), campaign.cell, finish=peer.finish),
            _StopAt(peer, min(stops, default=None)),
            Silent(),
            durable=False,
            unrehearsed=True,
        )
    except HilError as ended:
        error = ended
    for _ in range(_SETTLED):  # without a PC
        robot.step()
    velocity = np.array(robot.arm.plant.velocity)
    return Rest("after the run", velocity, _STILL, any_open=robot.playing), error


def archives_of(campaign: Campaign) -> tuple[tuple[ArchiveFile, ...], tuple[str, ...]]:
    """Return the archives, and what is said of files that are none."""
    files: list[ArchiveFile] = []
    unreadable: list[str] = []
    for path in sorted(campaign.folder.archives.iterdir()):
        try:
            files.append(ArchiveFile.of(path))
        except ArchiveError as error:
            unreadable.append(f"{path.name}: {error}")
    return tuple(files), tuple(unreadable)


def violations(stage: CampaignStage, seed: int, ends: Counter[str]) -> list[str]:
    """Play a seed; return a sentence and the script for each law that was broken."""
    script = "  ".join(draw_script(seed))
    with tempfile.TemporaryDirectory() as folder:
        return [
            f"{scenario.name}: {law}: {text}\n    {script}"
            for scenario in stage.scenarios(seed, Path(folder), ends)
            for law, text in judged(scenario)
        ]


if __name__ == "__main__":
    play_seeds(__doc__, partial(violations, CampaignStage.set_up()))
