"""A leak, a slow-down, a lost archive or answer is found in the figures; noise is not."""

from __future__ import annotations

import json
import mmap
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.exchange.control import BINS, upper_edge
from tests.endurance.__main__ import main
from tests.endurance.piece import own_memory
from tests.endurance.verdict import PROCESSES, Line, Piece, judge, read_journal
from tests.journal import Journal

MIB = 2**20
SECONDS = 80 * 60
EDGES = [0.0, *(upper_edge(index) for index in range(BINS))]
IDLE = {"exchange": 12, "archive": 11, "supervisor": 16, "controller": 4}
Change = Callable[[Piece], Piece]


def piece(seed: int, leak: float = 0.0, slow: float = 1.0, load: float = 1.0) -> Piece:
    """80 minutes and 160 campaigns on two cores.

    With a leak in the archive process [MiB/h], or replies slower by a factor at another load in the
    last quarter of an hour. Memory varies by pages, the median latency of each minute by 5 %.
    """
    rng = np.random.default_rng(seed)
    samples, counts, level = [], np.zeros(BINS, np.int64), 0.0
    for second in range(0, SECONDS + 1, 5):
        late = second > SECONDS - 900
        if second % 60 == 0:
            level = 150e-6 * np.exp(0.05 * rng.standard_normal())
        took = level * (slow if late else 1.0) * np.exp(0.3 * rng.standard_normal(500))
        counts += np.histogram(took, EDGES)[0]
        grown = {"archive": leak * MIB * second / 3600.0}
        own = {n: int(40 * MIB + grown.get(n, 0) + 4096 * rng.integers(0, 64)) for n in PROCESSES}
        samples.append({
            "t": float(second), "load": load if late else 1.0,
            "stalls": 0, "stood": 0.0,
            "processes": {name: {"own": size, "threads": 1} for name, size in own.items()},
            "counters": {"missed": 0.0, "late": 0.0, "answered": float(counts.sum())},
            "latencies": counts.tolist(),
        })  # fmt: skip
    begun = {"scheduling": "SCHED_FIFO 50", "rate": 100}
    return Piece(begun, samples, [ran(number) for number in range(160)], {"reason": ""})


def ran(number: int, **changes: Any) -> Line:
    """A faultless campaign with changes."""
    return {
        "number": number, "t": 30.0 * number, "complete": True, "stopped": False, "restarts": [],
        "motions": 26, "archives": 26, "faulty": [], "outcomes": {"completed": 26},
        "records": 30_000, "records_lost": 0, "descriptors": IDLE, **changes,
    }  # fmt: skip


@pytest.fixture(scope="module")
def sound() -> Piece:
    return piece(1)


def sampled(change: Callable[[int, Line], Line]) -> Change:
    return lambda one: replace(
        one, samples=[s | change(place, s) for place, s in enumerate(one.samples)]
    )


def each_campaign(change: Callable[[Line], Line]) -> Change:
    return lambda one: replace(one, campaigns=[ran | change(ran) for ran in one.campaigns])


def not_in_time(name: str, share: float) -> Change:
    """A share of the replies missed or late, evenly."""
    return sampled(
        lambda _, s: {"counters": s["counters"] | {name: round(share * s["counters"]["answered"])}}
    )


def stalling(share: float) -> Change:
    """Cores stall for this share of the time, 10 ms each."""
    return sampled(lambda _, s: {"stalls": round(100 * share * s["t"]), "stood": share * s["t"]})


def given_up(*numbers: int) -> Change:
    """Abandon these campaigns after some restarts."""
    lost = {"complete": False, "restarts": ["closed"] * 5}
    return each_campaign(lambda ran: lost if ran["number"] in numbers else {})


def with_one(**changes: Any) -> Change:
    return each_campaign(lambda ran: changes if ran["number"] == 159 else {})


def all_of(*changes: Change) -> Change:
    return lambda one: reduce(lambda piece, change: change(piece), changes, one)


LOADED = sampled(lambda _, s: {"load": 6.0})
MORE_THREADS = sampled(
    lambda _, s: {
        "processes": s["processes"]
        | {"exchange": {"own": 40 * MIB, "threads": 1 + int(s["t"] // 600)}}
    }
)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            all_of(given_up(*range(81)), not_in_time("missed", 0.004), stalling(0.005)),
            "81 of 160 campaigns were abandoned",
        ),
        (given_up(70), "campaign 70 was abandoned, and no core stalled"),
        (all_of(LOADED, given_up(70)), "campaign 70 was abandoned, and no core"),
        (all_of(given_up(70), stalling(0.005)), "campaign 70 was abandoned"),
        (not_in_time("missed", 0.2), "20.0% of the replies were missed"),
        (all_of(LOADED, not_in_time("late", 2e-4)), "96 of 480500 replies were late while"),
        (
            all_of(stalling(0.003), not_in_time("missed", 0.009)),
            "were missed while no core stalled",
        ),
        (all_of(stalling(0.05), not_in_time("late", 0.02)), "2.0% of the replies were late"),
        (lambda one: replace(one, ended={"reason": "no link"}), "ended early: no link"),
        (MORE_THREADS, "the exchange has 9 threads in the second half, 5 in"),
        (with_one(archives=25), "26 motions ended and there are 25 archives"),
        (with_one(faulty=["x.mcap is damaged"]), "x.mcap is damaged"),
        (with_one(records_lost=3), "3 records lost"),
        (with_one(descriptors={**IDLE, "exchange": 13}), "the exchange has 13 descriptors"),
        (lambda _: piece(3, leak=1.0), "the archive's memory grows by"),
        (lambda one: replace(one, campaigns=[], ended=None), "4800 s without one campaign"),
    ],
)
def test_what_is_wrong_is_a_fault(sound: Piece, change: Change, words: str) -> None:
    """In one piece of two: the other one does not cover it up."""
    (fault,) = judge([sound, change(sound)]).faults
    assert fault.startswith("piece 2: ")
    assert words in fault


def test_slower_replies_are_a_fault_where_no_load_explains_them() -> None:
    faults = judge([piece(7, slow=1.5)]).faults
    assert len(faults) == 4 and "p50 of the latency" in faults[0]
    verdict = judge([piece(8, slow=1.5, load=6.0)])
    assert not verdict.faults
    assert "at loads of 6.0 and 1.0" in verdict.warnings[0]


@pytest.mark.parametrize("seed", range(10, 14))
def test_hours_without_a_fault_are_good(seed: int) -> None:
    verdict = judge([piece(seed)])
    assert (verdict.faults, verdict.warnings) == ([], [])
    (figures,) = verdict.figures
    assert (figures["minutes"], figures["archives"]) == (80.0, 160 * 26)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (with_one(restarts=["lost"] * 2), "2 restarts of campaigns, and no core stalled"),
        (not_in_time("missed", 5e-5), "24 of 480500 replies were missed while no core stalled"),
        (
            all_of(given_up(70), not_in_time("missed", 0.004), stalling(0.005)),
            "1 of 160 campaigns were abandoned, as cores stalled",
        ),
        (lambda one: replace(one, ended=None), "no end: it was killed, or it still runs"),
    ],
)
def test_what_stalls_explain_is_a_warning(sound: Piece, change: Change, words: str) -> None:
    verdict = judge([change(sound)])
    assert verdict.faults == []
    (warning,) = verdict.warnings
    assert words in warning


def test_a_stall_excuses_no_more_replies_than_it_lasts(sound: Piece) -> None:
    change = all_of(given_up(70), not_in_time("missed", 0.004), stalling(0.001))
    campaign, replies = judge([change(sound)]).faults
    assert "campaign 70 was abandoned, and no core stalled" in campaign
    assert "of 480500 replies were missed while no core stalled" in replies


def test_a_run_that_is_too_short_has_warnings(sound: Piece) -> None:
    short = replace(sound, samples=sound.samples[:40], campaigns=sound.campaigns[:3])
    verdict = judge([short])
    assert verdict.faults == []
    assert sum("too short to tell" in text for text in verdict.warnings) == len(PROCESSES) + 2
    assert "no campaign was run" in judge([replace(short, campaigns=[])]).faults


def test_pieces_of_several_journals_are_merged(
    sound: Piece, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One with a piece that was killed in the middle of a line."""
    first = tmp_path / "monday.jsonl"
    with Journal(first) as journal:
        journal.add(kind="begin", **sound.begun)
        for sample in sound.samples:
            journal.add(kind="sample", **sample)
        for campaign in sound.campaigns:
            journal.add(kind="campaign", **campaign)
        journal.add(kind="end", **(sound.ended or {}))
    second = tmp_path / "tuesday.jsonl"
    second.write_bytes(first.read_bytes() + b'{"kind":"begin"}\n{"kind":"samp')
    whole, killed = read_journal(second)
    assert whole == read_journal(first)[0]
    assert killed.ended is None
    assert main(["--merge", "--journal", str(first), str(second), "--json"]) == 0
    assert capsys.readouterr().out.count('"minutes"') == 3


def test_a_piece_is_not_appended_to_what_is_no_journal(tmp_path: Path) -> None:
    path = tmp_path / "j.jsonl"
    path.write_text('{"round": 1}\n')
    folder = tmp_path / "folder"
    run = ["--minutes", "1", "--folder", str(folder)]
    assert main([*run, "--journal", str(path)]) == 2
    with pytest.raises(SystemExit):
        main([*run, "--journal", str(folder / "one.jsonl"), str(folder / "two.jsonl")])
    assert not folder.exists()


def test_own_memory_excludes_mapped_files(tmp_path: Path) -> None:
    pid, size = os.getpid(), 40 * MIB
    (tmp_path / "library").write_bytes(b"x" * size)
    before = own_memory(pid)
    private = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS
    with mmap.mmap(-1, size, flags=private) as made:  # unused pages
        made.write(b"x" * size)
        after = own_memory(pid)
        assert after - before == pytest.approx(size, rel=0.1)
        with (
            (tmp_path / "library").open("rb") as file,
            mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped,
        ):
            assert mapped[::4096] == b"x" * (size // 4096)
            assert own_memory(pid) - after < size / 10


@pytest.mark.slow
def test_some_seconds_of_it_leave_archives_and_a_journal(tmp_path: Path) -> None:
    """Real processes, real time, a real journal."""
    journal = tmp_path / "long.jsonl"
    done = subprocess.run(
        [sys.executable, "-m", "tests.endurance", "--minutes", "0.3", "--journal", str(journal),
         "--folder", str(tmp_path / "work"), "--rate", "500", "--json"],
        cwd=Path(__file__).parents[2], capture_output=True, text=True, timeout=200,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads(done.stdout)
    assert report["faults"] == []
    assert report["figures"][0]["archives"] > 0
    (found,) = read_journal(journal)
    assert found.ended is not None
    assert found.ended["reason"] == ""
    last = found.samples[-1]
    assert set(last["processes"]) == set(PROCESSES)
    # Every packet answered is in the histogram, but for the one under way.
    assert abs(sum(last["latencies"]) - last["counters"]["answered"]) <= 50
