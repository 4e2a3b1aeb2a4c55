"""What counts tell of a long run is judged: campaigns, answers, threads, how it ended."""

from __future__ import annotations

import lzma
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from tests.endurance.__main__ import main
from tests.endurance.journal import Piece, Ran, read_journal
from tests.endurance.test_verdict import piece, ran
from tests.endurance.verdict import judge
from tests.journal import Journal


@pytest.fixture(scope="module")
def sound() -> Piece:
    """80 minutes on a machine of two cores at a load of 1, and 160 campaigns of them."""
    return replace(piece(1), campaigns=[ran(number) for number in range(160)])


def loaded(one: Piece, load: float = 6.0) -> Piece:
    """The same on a machine that had more to do."""
    return replace(one, samples=[replace(sample, load=load) for sample in one.samples])


def counted(one: Piece, name: str, share: float) -> Piece:
    """The same with a share of its answers missed or late, evenly."""
    samples = [
        replace(s, counters={**s.counters, name: round(share * s.counters["answered"])})
        for s in one.samples
    ]
    return replace(one, samples=samples)


def with_given_up(one: Piece, *numbers: int) -> Piece:
    """The same with these campaigns given up after some restarts."""
    campaigns: list[Ran] = [
        replace(ran, complete=False, restarts=("open mode was closed",) * 5)
        if ran.number in numbers
        else ran
        for ran in one.campaigns
    ]
    return replace(one, campaigns=campaigns)


def threads_growing(one: Piece) -> Piece:
    samples = []
    for s in one.samples:
        grown = replace(s.processes["exchange"], threads=1 + int(s.t // 600.0))
        samples.append(replace(s, processes={**s.processes, "exchange": grown}))
    return replace(one, samples=samples)


def shared_growing(one: Piece) -> Piece:
    """One file in ten minutes is left, while others' come and go."""
    samples = [
        replace(s, shared=3 + int(s.t // 600.0) + place % 2) for place, s in enumerate(one.samples)
    ]
    return replace(one, samples=samples)


def stalling(one: Piece, share: float) -> Piece:
    """The same on a machine that stands still for this share of the time, 10 ms now and then."""
    samples = [replace(s, stalls=round(100 * share * s.t), stood=share * s.t) for s in one.samples]
    return replace(one, samples=samples)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda one: stalling(counted(with_given_up(one, *range(81)), "missed", 0.004), 0.005),
            "81 of 160 campaigns were given up",
        ),
        (lambda one: with_given_up(one, 70), "campaign 70 was given up, and no core stood"),
        (lambda one: with_given_up(loaded(one), 70), "campaign 70 was given up, and no core"),
        (lambda one: counted(one, "missed", 0.2), "20.0% of the answers were missed"),
        (lambda one: counted(loaded(one), "late", 2e-4), "96 of 480500 answers were late while"),
        (
            lambda one: counted(stalling(one, 0.003), "missed", 0.009),
            "answers were missed while no core stood still",
        ),
        (
            lambda one: counted(stalling(one, 0.05), "late", 0.02),
            "2.0% of the answers were late",
        ),
        (lambda one: replace(one, ended={"supervisor": 1}), "ended with exit status 1"),
        (lambda one: replace(one, ended={"supervisor": -9}), "ended with exit status -9"),
        (lambda one: replace(one, ended={"supervisor": None}), "did not end by itself"),
        (
            lambda one: replace(one, ended={"reason": "hung", "supervisor": 0}),
            "ended early: hung",
        ),
        (threads_growing, "the exchange has 9 threads in the second half of piece 1, 5 in"),
        (shared_growing, "files in shared memory grow in number: 3, 5, 7, 9 at least"),
    ],
)
def test_what_is_wrong_is_a_fault_at_whatever_load(
    sound: Piece, change: Callable[[Piece], Piece], words: str
) -> None:
    (fault,) = judge([change(sound)]).faults
    assert words in fault


def test_no_campaign_at_all_is_a_fault(sound: Piece) -> None:
    faults = judge([replace(sound, campaigns=[], ended=None)]).faults
    assert "no campaign was run" in faults
    assert any("4800 s without one campaign" in text for text in faults)
    assert judge([replace(sound, samples=[], campaigns=[])]).faults == ["no campaign was run"]
    # One piece of several that hangs is not covered up by the others.
    (fault,) = judge([sound, replace(sound, campaigns=[])]).faults
    assert "piece 2 ran for 4800 s without" in fault


def test_some_answers_missed_and_campaigns_resumed_without_a_stall_are_doubts(sound: Piece) -> None:
    campaigns = [*sound.campaigns[:-1], replace(sound.campaigns[-1], restarts=("lost",) * 2)]
    verdict = judge([counted(replace(sound, campaigns=campaigns), "missed", 5e-5)])
    assert verdict.faults == []
    resumed, missed = verdict.doubts
    assert "2 restarts of campaigns, and no core stood still" in resumed
    assert "24 of 480500 answers were missed while no core stood still" in missed


def test_answers_missed_while_the_machine_stood_still_are_its_own_doing(sound: Piece) -> None:
    missed = counted(with_given_up(sound, 70), "missed", 0.004)
    verdict = judge([stalling(missed, 0.005)])
    assert verdict.faults == []
    (doubt,) = verdict.doubts
    assert "1 of 160 campaigns were given up, as cores stood still" in doubt


def test_a_stall_excuses_no_more_answers_than_it_lasts(sound: Piece) -> None:
    missed = counted(with_given_up(sound, 70), "missed", 0.004)
    campaign, answers = judge([stalling(missed, 0.001)]).faults
    assert "campaign 70 was given up, and no core stood still" in campaign
    assert "of 480500 answers were missed while no core stood still" in answers


def test_a_stall_excuses_no_campaign_that_missed_nothing(sound: Piece) -> None:
    (fault,) = judge([stalling(with_given_up(sound, 70), 0.005)]).faults
    assert "campaign 70 was given up" in fault


def test_a_piece_without_an_end_is_a_doubt(sound: Piece) -> None:
    verdict = judge([replace(sound, ended=None)])
    assert verdict.faults == []
    assert verdict.doubts == ["piece 1 has no end: it was killed, or it still runs"]


def test_shared_memory_of_others_that_comes_and_goes_is_none_of_ours(sound: Piece) -> None:
    samples = [replace(s, shared=3 + (place // 40) % 3) for place, s in enumerate(sound.samples)]
    assert judge([replace(sound, samples=samples)]).faults == []


def written(path: Path, one: Piece) -> Path:
    with Journal(path) as journal:
        journal.add(kind="begin", **one.begun)
        for sample in one.samples:
            journal.add(kind="sample", **asdict(sample))
        for campaign in one.campaigns:
            journal.add(kind="campaign", **asdict(campaign))
        journal.add(kind="end", **(one.ended or {}))
    return path


def test_pieces_of_several_journals_are_merged_compressed_or_not(
    sound: Piece, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = written(tmp_path / "monday.jsonl", sound)
    small = tmp_path / "tuesday.jsonl.xz"
    small.write_bytes(lzma.compress(plain.read_bytes()))
    assert read_journal(small) == read_journal(plain)
    assert main(["--merge", "--journal", str(plain), str(small), "--json"]) == 0
    assert '"pieces": 2' in capsys.readouterr().out


def test_a_piece_is_not_appended_to_what_is_no_journal(tmp_path: Path) -> None:
    path = tmp_path / "j.jsonl"
    path.write_text('{"round": 1}\n')
    folder = tmp_path / "folder"
    run = ["--minutes", "1", "--folder", str(folder)]
    assert main([*run, "--journal", str(path)]) == 2
    with pytest.raises(SystemExit):
        main([*run, "--journal", str(path.with_name("small.jsonl.xz"))])
    assert not folder.exists()
