"""A leak, a slow-down or a lost archive is found in the figures; noise is not."""

from __future__ import annotations

import mmap
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import psutil
import pytest

from drivers.exchange.control import BINS, bin_of, upper_edge
from tests.endurance.__main__ import main
from tests.endurance.journal import Piece, Ran, Sample, Use, read_journal
from tests.endurance.piece import _use
from tests.endurance.supervisor import held
from tests.endurance.trends import largest_rise, quantile, slope
from tests.endurance.verdict import PROCESSES, judge, minutes_of
from tests.journal import Journal

MIB = 2**20
SECONDS = 80 * 60
EDGES = [0.0, *(upper_edge(index) for index in range(BINS))]
IDLE = {"exchange": 12, "archive": 11, "supervisor": 16, "controller": 4}


def piece(
    seed: int,
    *,
    leak: float = 0.0,
    slow: float = 1.0,
    slow_from: float = SECONDS,
    load: float = 1.0,
) -> Piece:
    """80 minutes as they look, with a leak in the archive process (MiB/h) or slower answers.

    Memory is a level that wanders up and down by pages; answers take about 150 µs, the median of
    each minute scatters by 5 %.
    """
    rng = np.random.default_rng(seed)
    samples = []
    counts = np.zeros(BINS, np.int64)
    for second in range(0, SECONDS + 1, 5):
        if second % 60 == 0:
            level = 150e-6 * np.exp(0.05 * rng.standard_normal())
        factor = slow if second > slow_from else 1.0
        drawn = level * factor * np.exp(0.3 * rng.standard_normal(500))
        counts += np.histogram(drawn, EDGES)[0]
        used = {}
        for name in PROCESSES:
            grown = leak * second / 3600.0 if name == "archive" else 0.0
            rss = int(40 * MIB + grown * MIB + 4096 * rng.integers(0, 64))
            used[name] = Use(rss=rss, own=rss, fds=11, threads=1, cpu=0.2 * second)
        counters = dict.fromkeys(("missed", "late", "worst_turnaround_us"), 0.0)
        busy = load if second > slow_from else 1.0
        samples.append(
            Sample(
                t=float(second),
                load=busy,
                processes=used,
                shared=0,
                counters={**counters, "answered": float(counts.sum())},
                latencies=counts.tolist(),
            )
        )
    begun = {"scheduling": "SCHED_FIFO 50", "machine": "2 cores, Linux", "rate": 100}
    return Piece(begun, samples, [ran(n) for n in range(3)], {"reason": "", "supervisor": 0})


def ran(number: int) -> Ran:
    """A campaign as it should be."""
    return Ran(
        number=number,
        t=30.0 * number,
        complete=True,
        stopped=False,
        restarts=(),
        motions=26,
        archives=26,
        faulty=(),
        outcomes={"completed": 26},
        records=30_000,
        records_lost=0,
        descriptors=IDLE,
    )


@pytest.fixture(scope="module")
def sound() -> list[Piece]:
    return [piece(1), piece(2)]


def test_hours_without_a_fault_are_good(sound: list[Piece]) -> None:
    verdict = judge(sound)
    assert verdict.faults == []
    assert verdict.doubts == []
    assert verdict.figures["minutes"] == 160.0
    assert verdict.figures["archives"]["archives"] == 6 * 26


def test_noise_is_not_taken_for_a_fault() -> None:
    for seed in range(10, 14):
        assert judge([piece(seed)]).faults == []


def test_a_leak_is_found_in_the_process_that_has_it() -> None:
    (fault,) = judge([piece(3, leak=1.0)]).faults
    assert "the archive's memory grows" in fault


def test_a_leak_that_pages_do_not_show_yet_is_found_in_what_the_supervisor_holds() -> None:
    rng = np.random.default_rng(4)
    even = [
        replace(
            ran(number),
            held={"bytes": int(30 * MIB + 0.1 * MIB * rng.standard_normal()), "blocks": 400_000},
        )
        for number in range(160)
    ]
    assert judge([replace(piece(4), campaigns=even)]).faults == []
    for name, much in (("bytes", MIB), ("blocks", 10_000)):
        leaking = [
            replace(one, held={**one.held, name: one.held[name] + round(much * one.t / 3600.0)})
            for one in even
        ]
        (fault,) = judge([replace(piece(4), campaigns=leaking)]).faults
        assert "what the supervisor holds grows" in fault
        assert f" {name} an hour" in fault


def test_what_a_process_holds_is_known_to_the_byte() -> None:
    before = held()
    kept = np.ones(MIB), [object() for _ in range(1000)]
    after = held()
    assert after["bytes"] - before["bytes"] == pytest.approx(8 * MIB, rel=0.01)
    assert after["blocks"] - before["blocks"] == pytest.approx(1000, abs=50)
    del kept
    assert held()["bytes"] - before["bytes"] < MIB


def test_what_python_keeps_for_its_own_speed_is_not_held() -> None:
    before = held()
    names = ["no attribute is " + number % 40 * "x" + str(number) for number in range(5000)]
    for name in names:
        getattr(Ran, name, None)
    tuples = [(name, name) for name in names]
    del names, name, tuples
    assert sys.getallocatedblocks() > before["blocks"] + 2000
    assert held()["blocks"] == pytest.approx(before["blocks"], abs=50)


def test_a_table_of_strings_that_are_gone_is_not_held() -> None:
    before = held()
    for number in range(200_000):
        sys.intern(f"excitation_{number}.mcap")
    assert held()["bytes"] == pytest.approx(before["bytes"], abs=MIB / 10)


def test_a_leak_too_small_to_matter_is_not_hidden() -> None:
    memory = judge([piece(5, leak=0.2)]).figures["memory"]["archive"]
    assert memory["growth"]["low"] > 0.0
    assert memory["growth"]["low"] < 0.2 < memory["growth"]["high"]


def test_a_run_that_is_too_short_says_so(sound: list[Piece]) -> None:
    short = replace(sound[0], samples=sound[0].samples[:40])
    verdict = judge([short])
    assert verdict.faults == []
    assert sum("too short to tell" in text for text in verdict.doubts) == len(PROCESSES) + 2


@pytest.mark.parametrize("since", [60.0, 900.0])
def test_answers_that_become_slower_before_the_end_are_found(since: float) -> None:
    slowed = piece(7, slow=1.5, slow_from=SECONDS - since)
    assert any("p50 of the latency" in text for text in judge([slowed]).faults)


def test_a_busier_machine_explains_slower_answers() -> None:
    verdict = judge([piece(8, slow=1.5, slow_from=SECONDS - 900.0, load=6.0)])
    assert not any("p50" in text for text in verdict.faults)
    assert any("p50" in text and "at loads of 6.0 and 1.0" in text for text in verdict.doubts)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"archives": 25}, "26 motions ended and there are 25 archives"),
        ({"faulty": ("x.mcap is damaged",)}, "x.mcap is damaged"),
        ({"records_lost": 3}, "3 records lost"),
        ({"descriptors": {**IDLE, "exchange": 13}}, "the exchange has 13 descriptors"),
    ],
)
def test_what_is_wrong_with_a_campaign_is_named(
    sound: list[Piece], change: dict[str, object], words: str
) -> None:
    campaigns = [*sound[0].campaigns[:2], replace(ran(2), **change)]  # type: ignore[arg-type]
    faults = judge([replace(sound[0], campaigns=campaigns)]).faults
    assert len(faults) == 1
    assert words in faults[0]


def test_the_trend_of_a_line_is_its_slope_and_of_a_constant_none() -> None:
    hours = np.arange(50.0)
    line = slope([(hours, 3.0 * hours), (hours, 100.0 + 3.0 * hours)], 0.99)
    assert (line.low, line.value, line.high) == pytest.approx((3.0, 3.0, 3.0))
    flat = slope([(hours, np.full(50, 7.0))], 0.99)
    assert (flat.low, flat.value, flat.high) == (0.0, 0.0, 0.0)


def test_the_interval_of_a_trend_holds_the_truth_as_often_as_it_says() -> None:
    rng = np.random.default_rng(1)
    hours = np.arange(40.0)
    held = 0
    for _ in range(400):
        found = slope([(hours, 0.5 * hours + rng.standard_normal(40)) for _ in range(2)], 0.9)
        held += found.low <= 0.5 <= found.high
    # Four standard deviations of a binomial count about 90 %.
    assert abs(held - 360) < 4 * (400 * 0.9 * 0.1) ** 0.5


def test_a_quantile_lies_in_its_bin() -> None:
    counts = np.zeros(BINS, int)
    counts[bin_of(150e-6)] = 99
    counts[bin_of(3e-3)] = 1
    for share, latency in ((0.5, 150e-6), (0.995, 3e-3)):
        assert bin_of(quantile(counts, share)) == bin_of(latency)


def test_the_largest_rise_is_from_an_earlier_to_a_later_value() -> None:
    assert largest_rise([5.0, 1.0, 3.0, 2.0, 4.0]) == 3.0
    assert largest_rise([5.0, 4.0, 3.0]) == -1.0


def test_a_killed_piece_leaves_its_journal(
    tmp_path: Path, sound: list[Piece], capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "long.jsonl"
    with Journal(path) as journal:
        journal.add(kind="begin", rate=1000)
    with path.open("ab") as file:
        file.write(b'{"kind":"samp')  # torn by SIGKILL
    with Journal(path) as journal:
        journal.add(kind="begin", rate=1000)
        journal.add(kind="link", scheduling="ordinary", notes=[], t=1.0)
        journal.add(kind="campaign", **asdict(ran(0)))
        journal.add(kind="end", reason="interrupted", supervisor=0, controller=None)
    first, second = read_journal(path)
    assert first.ended is None
    assert second.ended is not None
    assert second.begun["scheduling"] == "ordinary"
    assert main(["--merge", "--journal", str(path), "--json"]) == 0
    assert '"killed": 1' in capsys.readouterr().out


def test_minutes_are_taken_between_samples_at_their_ends(sound: list[Piece]) -> None:
    minutes = minutes_of(sound[0])
    assert len(minutes) == 80
    assert sum(one.answered for one in minutes) == 500 * SECONDS // 5


def test_memory_of_its_own_is_what_a_process_made_and_no_file_that_it_maps(tmp_path: Path) -> None:
    process, size = psutil.Process(), 40 * MIB
    (tmp_path / "library").write_bytes(b"x" * size)
    before = _use(process)
    private = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS
    with mmap.mmap(-1, size, flags=private) as made:  # pages that nobody has used before
        made.write(b"x" * size)
        after = _use(process)
        assert after.own - before.own == pytest.approx(size, rel=0.1)
        with (
            (tmp_path / "library").open("rb") as file,
            mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped,
        ):
            assert mapped[::4096] == b"x" * (size // 4096)
            mapping = _use(process)
    assert mapping.own - after.own < size / 10
    assert mapping.rss - after.rss == pytest.approx(size, rel=0.1)
