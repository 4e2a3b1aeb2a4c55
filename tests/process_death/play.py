"""Runs one round, and checks it."""

from __future__ import annotations

import os
import shutil
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from hil.base.progress import Silent
from hil.campaign import Campaign, CampaignPlan, Stop
from hil.campaign.identified_campaign import identify_campaign
from hil.campaign.plan import design
from hil.cell import Cell
from hil.pipeline.options import FIXED
from identification import Estimate
from tests.faults import Strikes
from tests.laws.evidence import Evidence, entries_of
from tests.laws.manifests import Entry
from tests.laws.table import Scenario, judged
from tests.process_death.ends import ENDS
from tests.process_death.laws import evidence_of, lost_cycles, torn
from tests.process_death.rig import ARCHIVE, EXCHANGE, run
from tests.process_death.rounds import LinkName, Round, round_of


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
    defect = DEFECTS[name]
    there = folder / "planted"
    there.mkdir()
    (there / "sitecustomize.py").write_text(
        _SITE.format(module=defect.module, code=defect.code), "utf-8"
    )
    return there


ESTIMATED: Final = 3  # In every so many rounds the campaign is estimated from when it is complete


@dataclass(frozen=True, eq=False)
class Stage:
    folder: Path  # of the rounds
    link: LinkName  # of the campaign
    cell: Cell  # of the arm
    plan: CampaignPlan  # of its campaign
    undisturbed: Estimate  # of an undisturbed run
    planted: Path | None = None  # folder of a planted defect, None for none

    @classmethod
    def set_up(cls, folder: Path, link: LinkName, planted: Path | None = None) -> Stage:
        """Design the campaign, and run it undisturbed in virtual time."""
        ends = ENDS[link]
        cell = ends.cell(folder)
        plan = design(cell, Silent())
        campaign = ends.made(folder / "undisturbed", cell, plan)
        finish_in_virtual_time(campaign, link, seed=0)
        return cls(folder, link, cell, plan, estimate_of(campaign), planted)


def finish_in_virtual_time(campaign: Campaign, link: LinkName, seed: int) -> None:
    """Run what is missing, with the arm jogged home."""
    Campaign.open(campaign.folder.root).run(
        ENDS[link].in_virtual_time(campaign.cell, seed),
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
    played = round_of(number, stage.link)
    began = time.monotonic()
    played = played if strikes is None else replace(played, strikes=strikes)
    used = os.times()
    folder = stage.folder / f"round_{number:05d}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    result: dict[str, Any] = {"round": number, "link": stage.link, "what": str(played)}
    campaign = ENDS[stage.link].made(folder, stage.cell, stage.plan)

    def killed() -> Evidence:
        with _error_in(folder):
            seen = run(campaign, played, played.strikes, folder / "report.json", stage.planted)
            evidence = evidence_of(seen, campaign)
            result.update(
                killed=list(seen.killed),
                status=seen.status,
                message=seen.report.get("text", ""),
                cycles=len(seen.rows),
            )
            lost = lost_cycles(evidence.processes)
            if torn(evidence.processes) or lost:
                result["lost"] = lost
            return evidence

    lines = played.strikes.lines
    scenarios = [Scenario(str(played), lines, killed), resumed(campaign, played, folder)]
    problems = [violation.text for scenario in scenarios for violation in judged(scenario)]
    if not problems and number % ESTIMATED == 0:
        estimated = Scenario(
            f"{played}, estimated",
            lines,
            lambda: Evidence(estimates=(estimate_of(campaign), stage.undisturbed)),
        )
        problems += [violation.text for violation in judged(estimated)]
    now = os.times()
    processor = sum(now[:4]) - sum(used[:4])
    result |= {"broken": problems, "seconds": time.monotonic() - began, "processor": processor}
    if not problems:
        shutil.rmtree(folder)
    return result


@contextmanager
def _error_in(folder: Path) -> Iterator[None]:
    """Write an error of the round itself, of any kind, into its folder."""
    try:
        yield
    except Exception:
        (folder / "error.txt").write_text(traceback.format_exc())
        raise


def resumed(campaign: Campaign, played: Round, folder: Path) -> Scenario:
    """Return the scenario in which a campaign is run to its end, without a fault."""

    def complete() -> Evidence:
        with _error_in(folder):
            earlier = frozenset(path.name for path in campaign.folder.archives.iterdir())
            before = entries_of(campaign.folder.root)
            if played.over_sockets:
                seen = run(campaign, played, None, folder / "report-again.json")
                of_run = evidence_of(seen, campaign, earlier, undisturbed=True)
            else:
                finish_in_virtual_time(campaign, played.link, seed=played.seed)
                of_run = Evidence()
            return completed_evidence(campaign, before, of_run)

    return Scenario(f"{played}, resumed", (), complete)


def completed_evidence(campaign: Campaign, before: tuple[Entry, ...], run_of: Evidence) -> Evidence:
    """Return the evidence of a run that completed a campaign, with all of its motions."""
    plan = campaign.plan
    motions = {
        ("excitation", index): plan.excitation.trajectory
        for index in range(campaign.cell.campaign.repetitions)
    }
    motions |= {
        ("validation", index): motion.trajectory for index, motion in enumerate(plan.validation)
    }
    return replace(
        run_of,
        period=campaign.cell.period,
        folder=campaign.folder.root,
        manifests=(before, entries_of(campaign.folder.root)),
        counts=(1, campaign.cell.campaign.repetitions, len(plan.validation)),
        motions=motions,
        unreadable=(*run_of.unreadable, *campaign.folder.damaged()),
    )
