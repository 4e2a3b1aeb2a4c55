"""A leak, a slow-down, a lost archive or reply is found in the figures; noise is not."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.exchange.control import LATENCY_BINS, upper_edge
from tests.endurance.__main__ import main
from tests.endurance.piece import PROCESSES, Line, Piece
from tests.endurance.verdict import judge, read_journal
from tests.journal import Journal

pytestmark = pytest.mark.safety

MIB = 2**20
SECONDS = 80 * 60
EDGES = [0.0, *(upper_edge(index) for index in range(LATENCY_BINS))]
Change = Callable[[Line], None]


def piece(change: Change = lambda _: None, **campaign: Any) -> Piece:
    """80 minutes with noise; a change of each sample, and of the last campaign."""
    rng = np.random.default_rng(1)
    samples = []
    counts = np.zeros(LATENCY_BINS, np.int64)
    for second in range(0, SECONDS + 1, 5):
        sample: Line = {
            "t": float(second),
            "slower": 1.0,
            "processes": {
                name: {"memory": int(40 * MIB + 4096 * rng.integers(0, 64)), "threads": 1}
                for name in PROCESSES
            },
            "counters": {"replied": 100 * second, "missed": 0, "late": 0},
        }
        change(sample)
        took = 150e-6 * sample["slower"] * np.exp(0.3 * rng.standard_normal(500))
        counts += np.histogram(took, EDGES)[0]
        samples.append({**sample, "latencies": counts.tolist()})
    ran = {
        "complete": True, "stopped": False, "restarts": [], "motions": 26, "archives": 26,
        "faulty": [], "outcomes": {"completed": 26}, "records": 30_000, "records_lost": 0,
        "descriptors": dict.fromkeys(PROCESSES, 12),
    }  # fmt: skip
    campaigns = [{"number": number, **ran} for number in range(160)]
    campaigns[-1] |= campaign
    return Piece({"rate": 100}, samples, campaigns, [{"reason": ""}])


def leaking(sample: Line) -> None:
    sample["processes"]["archive"]["memory"] += int(MIB * sample["t"] / 600.0)


def with_a_thread_more(sample: Line) -> None:
    sample["processes"]["supervisor"]["threads"] += sample["t"] > 4000.0


def slower(sample: Line) -> None:
    sample["slower"] = 2.0 if sample["t"] > 3000.0 else 1.0


def missing(sample: Line) -> None:
    sample["counters"]["missed"] = sample["counters"]["replied"] // 50


@pytest.mark.parametrize(
    ("change", "campaign", "fault"),
    [
        (leaking, {}, "the archive's memory grew"),
        (with_a_thread_more, {}, "the supervisor has 2 threads"),
        (slower, {}, "p50 of the latency grew from"),
        (missing, {}, "replies were missed"),
        (None, {"complete": False}, "campaign 159: abandoned"),
        (None, {"archives": 25}, "26 motions ended and there are 25 archives"),
        (None, {"faulty": ["a.mcap: ['x']"]}, "a.mcap"),
        (None, {"records_lost": 3}, "3 records were lost"),
        (None, {"descriptors": dict.fromkeys(PROCESSES, 13)}, "has 13 descriptors"),
    ],
)
def test_each_fault_is_found(change: Change | None, campaign: Line, fault: str) -> None:
    journal_piece = piece(*([] if change is None else [change]), **campaign)
    assert any(fault in text for text in judge([journal_piece]).faults)


def test_hours_without_a_fault_pass_and_short_runs_warn() -> None:
    sound = piece()
    verdict = judge([sound, sound])
    assert (verdict.faults, verdict.warnings) == ([], [])
    assert verdict.figures[0]["motions"] == 26 * 160
    short = judge([Piece(sound.begun, sound.samples[:20], sound.campaigns[:3])])
    assert short.faults == []
    assert len(short.warnings) == 2
    assert judge([Piece({})]).faults == ["no campaign was run"]


def test_pieces_of_a_journal_are_merged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "j.jsonl"
    original = piece()
    for _ in range(2):
        with Journal(path) as journal:
            journal.add(kind="begin", **original.begun)
            for kind, lines in [
                ("sample", original.samples[:9]),
                ("campaign", original.campaigns[:2]),
            ]:
                for line in lines:
                    journal.add(kind=kind, **line)
    assert [len(merged.campaigns) for merged in read_journal(path)] == [2, 2]
    assert main(["--merge", "--journal", str(path), "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["figures"]) == 2
    (tmp_path / "other.jsonl").write_text('{"round": 1}\n')
    folder = tmp_path / "folder"
    run = ["--minutes", "1", "--folder", str(folder), "--journal"]
    assert main([*run, str(tmp_path / "other.jsonl")]) == 2
    assert not folder.exists()


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
    (recorded,) = read_journal(journal)
    assert recorded.ended == [{"reason": ""}]
    last = recorded.samples[-1]
    assert set(last["processes"]) == set(PROCESSES)
    # Every packet with a reply is in the histogram, but for those under way.
    assert abs(sum(last["latencies"]) - last["counters"]["replied"]) <= 50
