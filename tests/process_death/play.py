"""Runs one round, and checks it."""

from __future__ import annotations

import os
import shutil
import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from drivers.transports.simulated import SimulatedTransport
from hil.campaign import Campaign, CampaignPlan, Stop, VirtualLink
from hil.campaign.plan import design
from hil.cell import Cell
from hil.identify import identify_campaign
from hil.identify.options import FIXED
from hil.progress import Silent
from hil.simulation import simulated_controller
from identification import Estimate
from tests.faults import Strikes
from tests.hil.fast_cell import fast_cell
from tests.laws.estimates import alike
from tests.laws.manifests import (
    completed,
    entered_as_archived,
    entered_once,
    entries_kept,
    manifest_of,
    nothing_missing,
)
from tests.laws.motions import as_planned
from tests.laws.second_reader import read
from tests.process_death.laws import broken_by
from tests.process_death.rig import ARCHIVE, EXCHANGE, Seen, made, run
from tests.process_death.rounds import Round, round_of


@dataclass(frozen=True)
class Defect:
    module: str  # that the broken process runs
    code: str  # what breaks it
    found: str  # words of the law that finds it


DEFECTS: Final = {
    "archive-flushes-rarely": Defect(
        ARCHIVE,
        "from hil.archive import writer; writer.FLUSH_PERIOD = 5.0",
        "lost with the archive process",
    ),
    "archive-drops-records": Defect(
        ARCHIVE,
        "from hil.archive.recorder import Recorder; write = Recorder._write; "
        "Recorder._write = lambda self, rows: write(self, rows[rows['cycle'] % 61 != 0])",
        "has gaps",
    ),
    "exchange-leaves-the-arm": Defect(
        EXCHANGE,
        "import os; from drivers.exchange.serving import CommandHandler; "
        "CommandHandler._detach = lambda *_: os._exit(0)",
        "where the exchange ended by itself the arm moves",
    ),
}

_SITE: Final = """import sys
if {module!r} in sys.orig_argv:
    {code}
"""


def planted(name: str, folder: Path) -> Path:
    """Return a folder that injects a defect into processes with it on their path."""
    defect, there = DEFECTS[name], folder / "planted"
    there.mkdir()
    (there / "sitecustomize.py").write_text(
        _SITE.format(module=defect.module, code=defect.code), "utf-8"
    )
    return there


SHORT: Final = {
    "repetitions": 2,
    "validation_runs": 1,
    "n_via": 2,
    "standstill_s": 0.1,
    "settle_s": 0.15,
    "candidates": 6,
}  # Of the cell's `[campaign]`: a campaign of four seconds
NOISE: Final = 0.004
"""A, of the simulated currents. With the cell's own the arm trembles at rest about as fast as what
still counts as standstill, and some runs are refused for it without anybody having died."""
ESTIMATED: Final = 3  # In every so many rounds the campaign is estimated from when it is complete


@dataclass(frozen=True, eq=False)
class Stage:
    folder: Path  # of the rounds
    cell: Cell  # of the small arm
    plan: CampaignPlan  # of its campaign
    undisturbed: Estimate  # of an undisturbed run
    planted: Path | None = None  # folder of a planted defect, None for none

    @classmethod
    def set_up(cls, folder: Path, planted: Path | None = None) -> Stage:
        """Design the campaign, and run it undisturbed in virtual time."""
        cell = fast_cell(folder, **SHORT).with_values({"simulation.current_noise": NOISE})
        plan = design(cell, Silent())
        campaign = made(folder / "undisturbed", cell, plan)
        finish_in_virtual_time(campaign, seed=0)
        return cls(folder, cell, plan, estimate_of(campaign), planted)


def finish_in_virtual_time(campaign: Campaign, seed: int) -> None:
    """Run what is missing, with the arm jogged home."""
    cell = campaign.cell
    at_home = cell.with_values({"simulation.initial_deg": cell.campaign.home_deg})
    controller = simulated_controller(at_home, seed=seed)
    Campaign.open(campaign.folder.root).run(
        VirtualLink.over(SimulatedTransport(controller), cell, finish=controller.finish),
        Stop(),
        Silent(),
        durable=False,
        unrehearsed=True,
    )


def estimate_of(campaign: Campaign) -> Estimate:
    """Return the estimate from the archives of a campaign, with fixed settings."""
    return identify_campaign(campaign.folder.root, Silent(), FIXED).estimate.pooled


def play(stage: Stage, number: int, strikes: Strikes | None = None) -> dict[str, Any]:
    """Run a round, with its own script or another one, and return its result.

    The folder remains if a law was broken.
    """
    played, began = round_of(number), time.monotonic()
    played = played if strikes is None else replace(played, strikes=strikes)
    used = os.times()
    folder = stage.folder / f"round_{number:05d}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    broken: list[str]
    result: dict[str, Any] = {"round": number, "what": str(played)}
    campaign = made(folder, stage.cell, stage.plan)
    try:
        seen = run(campaign, played, played.strikes, folder / "report.json", stage.planted)
        broken, figures = broken_by(seen, campaign)
        result |= {
            "killed": list(seen.killed),
            "status": seen.status,
            "message": seen.report.get("text", ""),
            "cycles": len(seen.rows),
            **figures,
        }
        broken += finished(campaign, played, seen, folder)
        if not broken and number % ESTIMATED == 0:
            broken += alike(estimate_of(campaign), stage.undisturbed)
    except Exception as error:
        # Of any kind: this round is reported, and the others continue.
        broken = [f"{type(error).__name__}: {error}"]
        (folder / "error.txt").write_text(traceback.format_exc())
    now = os.times()
    processor = sum(now[:4]) - sum(used[:4])
    result |= {"broken": broken, "seconds": time.monotonic() - began, "processor": processor}
    if not broken:
        shutil.rmtree(folder)
    return result


def finished(campaign: Campaign, played: Round, seen: Seen, folder: Path) -> list[str]:
    """Finish the campaign; return broken laws."""
    earlier = frozenset(path.name for path in campaign.folder.archives.iterdir())
    before = manifest_of(campaign.folder.root)[1]
    problems: list[str] = []
    if played.over_sockets:
        again = run(campaign, played, None, folder / "report-again.json")
        if again.status != 0:
            problems.append(f"the next run failed with status {again.status}: {again.report}")
        problems += broken_by(again, campaign, earlier)[0]
    else:
        finish_in_virtual_time(campaign, seed=played.seed)
    problems += entries_kept(before, manifest_of(campaign.folder.root)[1])
    return [*problems, *_complete(campaign, seen)]


def _complete(campaign: Campaign, seen: Seen) -> Iterator[str]:
    """Each motion of the plan is entered once as completed, as it was planned."""
    folder, plan = campaign.folder.root, campaign.plan
    entries = manifest_of(folder)[1]
    yield from nothing_missing(entries, (1, campaign.cell.campaign.repetitions, 1))
    yield from entered_once(entries)
    for entry in entries:
        yield from entered_as_archived(entry, folder)
    for entry in completed(entries):
        kind, index = entry.motion
        if kind != "standstill":
            motion = plan.excitation if kind == "excitation" else plan.validation[index]
            archived = read(folder / "archives" / entry.name)
            yield from as_planned(archived, motion.trajectory, campaign.cell.period)
    if damaged := campaign.folder.damaged():
        yield f"after {seen.killed}: {damaged}"
