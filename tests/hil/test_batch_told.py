"""What a batch tells of its archives: doubts, other statements, and what was left alone."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pytest
from typer.testing import CliRunner

from benchmarks import archive_files
from hil.archive import ArchiveWriter
from hil.batch.estimates import WarningCounts
from hil.batch.run import Plan, reidentify
from hil.batch.types import ArchiveRef, BatchResult, Broken, Summary
from hil.cell import Cell
from hil.cli import app
from hil.cli.reidentify import alarm_lines, skipped_line
from hil.compare.trend import Trends
from hil.identify.options import FIXED
from hil.progress import Silent

from .arm_histories import Load, steady, trend_of
from .batch_workers import NOTHING_OPEN, Here

SLIP = "the clock falls back 2 times; cut the log where it does"
ASSUMED = "the torque constants are assumed"
LADEN = "\n[robot.payload]\nmass = 3.0\ncentre = [0.0, 0.0, 0.1]\n"

Record = Callable[..., list[Path]]


@pytest.fixture
def record(monkeypatch: pytest.MonkeyPatch) -> Record:
    """Four seconds of motion per archive, of a real arm for all that the archive says."""

    def make(
        folder: Path,
        count: int,
        *,
        first: int,
        cell: str = "",
        metadata: Mapping[str, str] = MappingProxyType({}),
    ) -> list[Path]:
        plain = Cell.load(archive_files.CELL_PATH)

        def writer(path: Path, **facts: Any) -> ArchiveWriter:
            facts["metadata"] = {**facts["metadata"], **metadata}
            text = facts["attachments"]["cell.toml"] + cell.encode()
            facts["attachments"] = facts["attachments"] | {"cell.toml": text}
            return ArchiveWriter(path, **facts)

        assert plain.file.robot.payload is None
        monkeypatch.setattr(archive_files, "ArchiveWriter", writer)
        return archive_files.repetitions(folder, count, first=first, cycles=4000)

    return make


def batch(folder: Path) -> BatchResult:
    return reidentify([str(folder)], Plan(FIXED, keep=False), Here(), Silent())


def test_doubts_of_import_and_of_torque_constants_stand_with_every_estimate(
    record: Record, tmp_path: Path
) -> None:
    record(tmp_path / "plain", 2, first=0)
    findings = json.dumps({"lines": [], "doubts": [SLIP]})
    record(tmp_path / "slipped", 2, first=2, metadata={"findings": findings})
    command = ["reidentify", str(tmp_path), "--workers", "1", "-o", str(tmp_path / "out")]
    ran = CliRunner().invoke(app, [*command, "--cache", "none", *NOTHING_OPEN])
    assert ran.exit_code == 0, ran.output
    assert f"note: {ASSUMED}" in ran.output
    told = f"2 of 4 archives, such as slipped/excitation_000_a1.mcap: {SLIP}"
    assert f"note: {told}" in ran.output
    with (tmp_path / "out" / "parameters.csv").open(newline="") as file:
        doubts = {
            (row["level"], Path(row["campaign"]).name): row["warnings"]
            for row in csv.DictReader(file)
        }
    assert all(ASSUMED in text for text in doubts.values())
    assert [SLIP in doubts[level, "slipped"] for level in ("repetition", "campaign")] == [True] * 2
    assert [SLIP in doubts[level, "plain"] for level in ("repetition", "campaign")] == [False] * 2
    assert told in doubts["pooled", ""]
    page = (tmp_path / "out" / "trend.html").read_text()
    assert SLIP in page


def test_one_folder_in_which_a_payload_is_stated_halfway_is_two_campaigns(
    record: Record, tmp_path: Path
) -> None:
    record(tmp_path / "line" / "a", 1, first=0)
    (laden,) = record(tmp_path / "line" / "b", 1, first=1, cell=LADEN, metadata={"index": "1"})
    laden.rename(tmp_path / "line" / "a" / "excitation_001_a1.mcap")
    found = batch(tmp_path)
    assert len(found.campaigns) == 2
    stated = {None if one.payload is None else one.payload.mass for one in found.campaigns}
    assert stated == {None, 3.0}
    (pooled,) = found.pooled
    assert (pooled.repetitions, pooled.setup, pooled.payload) == (2, "", None)
    assert "cells state different things" in pooled.warnings[0]
    command = ["reidentify", str(tmp_path), "--cache", "none", "--json", *NOTHING_OPEN]
    ran = CliRunner().invoke(app, command)
    (arm,) = json.loads(ran.stdout)["arms"].values()
    assert len(arm["campaigns"]) == 2
    assert sum("carries 3 kg" in one["setup"] for one in arm["campaigns"].values()) == 1


def test_what_is_to_be_looked_into_is_told_even_quietly() -> None:
    arm = trend_of(lambda k, random: replace(steady(k, random), load=Load(2.0 * k)), 2)
    calm = trend_of(steady, 2)
    (line,) = alarm_lines(Trends((calm, arm), (), "wls", 4))
    assert line.startswith("arm: The payload has changed")


def summary_of(name: str, *doubts: str) -> Summary:
    ref = ArchiveRef(f"/line/c1/archives/{name}", "", "excitation", "", "/line/c1", 0, "", "")
    return Summary(ref, None, {}, doubts)  # type: ignore[arg-type]


def test_a_doubt_is_told_once_with_what_it_concerns() -> None:
    doubts = WarningCounts()
    for name in ("a", "b", "c"):
        doubts.count(summary_of(name, "of all"))
    assert doubts.lines() == ("of all",)
    others = WarningCounts()
    others.count(summary_of("d", "of all", "of one"))
    others.count(summary_of("e", "of all", "of two"))
    doubts.add(others)
    doubts.count(summary_of("f", "of all", "of two"))
    assert doubts.lines() == (
        "of all",
        "2 of 6 archives, such as c1/e: of two",
        "c1/d: of one",
    )


def test_very_many_different_doubts_are_counted() -> None:
    doubts = WarningCounts()
    for k in range(100):
        doubts.count(summary_of(f"{k}", f"the clock falls back {k} times"))
    assert len(doubts.lines()) < 20
    assert "more warnings stand with the repetitions" in doubts.lines()[-1]


def test_what_is_left_alone_is_counted_by_reason() -> None:
    reasons = [
        "is a move",
        "is a move",
        "ended aborted",
        "attempt 2 took its place",
        "attempt 3 took its place",
        "holds the same as /data/line/excitation_000_a1.mcap",
    ]
    line = skipped_line([Broken(f"{k}.mcap", one) for k, one in enumerate(reasons)])
    assert line == (
        "left alone, as not meant to be fitted: 2 moves; 2: a later attempt took its place;"
        " 1: ended aborted; 1: holds the same as another"
    )
    assert skipped_line([]) == ""
