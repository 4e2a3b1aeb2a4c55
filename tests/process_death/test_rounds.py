"""Rounds as a person plays them, what is round_of for them, and planted defects that they find."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, cast, get_args

import numpy as np
import pytest

from drivers.cycle_records import cycle_dtype
from hil.base.progress import Silent
from hil.campaign.plan import design
from sim_fixtures import Phase
from tests.faults import Moment, StrikeKind, Victim, parse_strikes
from tests.laws.evidence import Evidence
from tests.laws.second_reader import Archived
from tests.laws.table import LAWS, broken, judged
from tests.messages import ARCHIVE_SILENT, NOTHING_RECEIVED
from tests.process_death.ends import ENDS
from tests.process_death.laws import (
    PROMISED,
    Processes,
    Recorded,
    evidence_of,
    file_of,
    lost_cycles,
)
from tests.process_death.page import row_dtype
from tests.process_death.play import DEFECTS, resumed
from tests.process_death.rig import Death, Seen, run
from tests.process_death.rounds import VICTIMS, LinkName, round_of

pytestmark = pytest.mark.safety

CYCLES = 3000
ROW = row_dtype(2)


def seen(*victims: Victim, text: str = "", behind: int = 0) -> Seen:
    """3000 cycles of motion at whose end these died, `behind` of them not archived yet."""
    records = np.zeros(CYCLES, cycle_dtype(2))
    rows = np.zeros(CYCLES, ROW)
    records["cycle"] = records["number"] = rows["number"] = np.arange(CYCLES)
    records["commanded_velocity"] = 0.1
    deaths = [Death(victim, CYCLES, behind) for victim in victims]
    return Seen(deaths, 4, {"text": text} if text else {}, rows, records, [])


def recorded(
    count: int, path: Path = Path("move_000_a1.mcap"), *, complete: bool = False
) -> Recorded:
    """An archive of the first so many cycles."""
    archive: Any = SimpleNamespace(complete=complete, missing="truncated", outcome=None)
    return Recorded(path, cast("Any", None), archive, np.arange(count, dtype=np.int64))


def ran(seen: Seen, *recordings: Recorded) -> Processes:
    return Processes(seen, cast("Any", None), recordings)


def problems(processes: Processes, law: str) -> list[str]:
    return list(LAWS[law].check(Evidence(processes=processes)))


@pytest.mark.parametrize(
    ("lost", "behind", "allowed"),
    [(PROMISED, 0, True), (PROMISED + 1, 0, False), (PROMISED + 20, 20, True), (2500, 100, False)],
)
def test_a_dead_archive_process_costs_a_chunk_and_its_backlog(
    lost: int, behind: int, allowed: bool
) -> None:
    processes = ran(seen("archive", behind=behind), recorded(CYCLES - lost))
    assert bool(problems(processes, "motion is archived once")) is not allowed
    assert lost_cycles(processes) == lost


def test_only_the_newest_archive_may_be_truncated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    older = tmp_path / "move_000_a1.mcap"
    newest = tmp_path / "excitation_000_a1.mcap"
    for place, path in enumerate((older, newest), 1):
        path.touch()
        os.utime(path, ns=(place * 10**9, place * 10**9))
    monkeypatch.setattr("tests.process_death.laws.read", Archived)

    def problems_of(path: Path, victim: Victim) -> list[str]:
        file = file_of(recorded(7, path), seen(victim))
        return list(LAWS["archives are complete"].check(Evidence(files=(file,))))

    assert problems_of(newest, "archive") == []
    (problem,) = problems_of(older, "archive")
    assert "is incomplete (truncated)" in problem
    assert problems_of(newest, "exchange")


@pytest.mark.parametrize(
    ("victim", "text", "true"),
    [
        ("exchange", "the exchange process ended; the controller receives no replies", True),
        ("exchange", "the exchange process is gone: no such process", True),
        ("exchange", f"repetition 1 was lost: {NOTHING_RECEIVED}", False),
        ("exchange", "the controller did not answer the exchange process", False),
        ("archive", "the archive process ended (exit status -9); nothing was sent", True),
        ("archive", f"validation 1 was stopped: the {ARCHIVE_SILENT}", True),
        ("archive", "the disk of the archive process is full", False),
        ("controller", f"move 1 was lost: {NOTHING_RECEIVED}", True),
        ("controller", "the exchange process ended", False),
    ],
)
def test_a_supervisor_names_the_process_that_died(victim: Victim, text: str, true: bool) -> None:
    law = "a supervisor names the process that died"
    assert (not problems(ran(seen(victim, text=text)), law)) is true


@pytest.mark.parametrize(
    ("phases", "deserted_answered", "broken"),
    [
        ((Phase.CLOSED, Phase.CLOSED, Phase.OPENING), False, False),  # opened after the last answer
        ((Phase.CLOSED, Phase.OPENING, Phase.OPENING), False, True),
        ((Phase.CLOSED, Phase.CLOSED, Phase.OPENING), True, True),  # it answered an opening axis
        ((Phase.OPEN, Phase.CLOSING, Phase.CLOSED), False, True),
        ((Phase.OPEN, Phase.CLOSED, Phase.CLOSED), False, False),
    ],
)
def test_an_exchange_ends_with_closed_axes(
    phases: tuple[Phase, ...], deserted_answered: bool, broken: bool
) -> None:
    rows = np.zeros(20, ROW)
    rows["phase"], rows["replied"] = Phase.CLOSED, True
    rows["phase"][7 : 7 + len(phases)] = phases
    rows["deserted"][10:] = True
    rows["replied"][10:] = False
    rows["replied"][10] = deserted_answered
    dead = Seen([Death("supervisor", 20)], None, {}, rows, rows, [])
    texts = problems(ran(dead), "the controller sees an arm that comes to rest")
    assert any("exchange ended by itself axes are open" in text for text in texts) is broken


ROOT: Final = Path(__file__).resolve().parents[2]


def process_death(*options: str) -> tuple[dict[str, Any], str]:
    """What `python -m tests.process_death --json` prints, and its standard error."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.process_death", "--json", *options],
        cwd=ROOT, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode in (0, 1), done.stderr
    report: dict[str, Any] = json.loads(done.stdout)
    assert done.returncode == (1 if report["failed"] else 0)
    return report, done.stderr


@pytest.mark.parametrize(
    ("link", "first", "count"), [("udp", 0, 25), ("udp", 25, 25), ("rtde", 0, 4)]
)
def test_the_arm_rests_and_the_campaign_is_completed(
    link: LinkName, first: int, count: int
) -> None:
    """Whoever is killed; two rounds at a time: a busy machine stops runs by their heartbeats."""
    where = ("--link", link, "--start", str(first), "--rounds", str(count))
    report, errors = process_death(*where, "--jobs", "2")
    assert report["ran"] == count
    assert not report["failed"], errors
    assert report["nobody_killed"] <= count // 4, "the rounds must come to their kills"


@pytest.mark.parametrize("link", ENDS)
def test_rounds_are_known_by_number_and_kill_all_at_all_moments(link: LinkName) -> None:
    assert round_of(417, link) == round_of(417, link)
    rounds = [round_of(number, link) for number in range(1000)]
    assert len({str(played) for played in rounds[:200]}) > 190
    assert [played.strikes.victims[0] for played in rounds[:4]] == list(VICTIMS)
    assert all(len(set(played.strikes.victims)) == len(played.strikes.victims) for played in rounds)
    assert {played.strikes.trigger.moment for played in rounds} == set(get_args(Moment))
    pairs = {played.strikes.victims[:2] for played in rounds if len(played.strikes.victims) > 1}
    assert len(pairs) == len(VICTIMS) * (len(VICTIMS) - 1)


def test_the_script_of_a_round_says_all_of_it() -> None:
    for number in range(300):
        strikes = round_of(number).strikes
        assert parse_strikes(strikes.lines) == strikes
    assert parse_strikes(["# by hand", "interrupt@motion3:way=0.3s:supervisor"]).victims


@pytest.mark.parametrize(
    "lines",
    [
        ["kill@motion"],
        ["kill@noon:archive"],
        ["maim@start:archive"],
        ["kill@then:archive"],
        ["kill@start:archive", "freeze@then:exchange"],
        ["kill@state1:state=asleep:archive"],
        [],
    ],
)
def test_a_script_that_cannot_be_read_is_refused(lines: list[str]) -> None:
    with pytest.raises(ValueError, match=r"lines are|the lines after|no state"):
        parse_strikes(lines)


def round_in_which(victim: Victim) -> int:
    """The first round that kills it alone, half way through a repetition."""
    for number in range(10_000):
        played = round_of(number)
        trigger = played.strikes.trigger
        half_way = trigger.count in (3, 4) and 0.25 < trigger.way < 0.45
        if (
            played.strikes.victims == (victim,)
            and trigger.moment == "motion"
            and half_way
            and not played.loops
        ):
            return number
    raise AssertionError("no round is like that")


@pytest.mark.parametrize("link", ENDS)
@pytest.mark.parametrize(
    ("victim", "kind", "status", "message"),
    [
        ("supervisor", "interrupt", 4, "was stopped: a stop was requested"),
        pytest.param("supervisor", "hangup", 4, "was stopped", marks=pytest.mark.slow),
        (
            "archive",
            "freeze",
            4,
            "with `hil doctor`); the arm was brought to rest",
        ),
        ("archive", "disk-full", 2, "cannot be written any more"),
    ],
)
def test_what_is_no_kill_brings_the_arm_to_rest_too(
    link: LinkName, victim: Victim, kind: StrikeKind, status: int, message: str, tmp_path: Path
) -> None:
    """Ctrl-C, a terminal that is closed, an archive process that hangs, a full disk."""
    cell = ENDS[link].cell(tmp_path)
    campaign = ENDS[link].made(tmp_path, cell, design(cell, Silent()))
    played = replace(round_of(round_in_which(victim), link), over_sockets=False)
    strikes = replace(played.strikes, kind=kind)
    seen = run(campaign, played, strikes, tmp_path / "report.json")
    assert broken(evidence_of(seen, campaign)) == []
    assert seen.status == status
    assert message in seen.report["text"]
    assert judged(resumed(campaign, played, tmp_path)) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "victim"),
    [
        ("archive-flushes-rarely", "archive"),
        ("archive-drops-records", "archive"),
        ("exchange-leaves-the-arm", "supervisor"),
    ],
)
def test_a_planted_defect_is_found(name: str, victim: Victim, tmp_path: Path) -> None:
    """In a round that can show it; a law that nothing can break would be none."""
    number = round_in_which(victim)
    journal = tmp_path / "journal.jsonl"
    where = ("--start", str(number), "--rounds", "1")
    report, _ = process_death(*where, "--defect", name, "--journal", str(journal))
    assert report["seeds_failed"] == [number]
    broken = json.loads(journal.read_text())["broken"]
    assert any(DEFECTS[name].found in text for text in broken), broken
    healthy, errors = process_death(*where)
    assert not healthy["failed"], errors
