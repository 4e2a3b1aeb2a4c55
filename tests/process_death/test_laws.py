"""Laws about deaths, each broken by what would break it: a law that nothing can break is none."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from drivers.record import cycle_dtype
from sim_fixtures.program import Phase
from tests.process_death.controller import ROW
from tests.process_death.laws import PROMISED, Kept, _archived, _arm, _readable, _told
from tests.process_death.rig import Death, Seen
from tests.process_death.rounds import Victim

CYCLES = 3000


def seen(*victims: Victim, text: str = "", behind: int = 0) -> Seen:
    """A motion of 3000 cycles at whose end somebody died.

    Args:
        victims: who.
        text: what the supervisor said.
        behind: cycles that the archive process had not taken.
    """
    records, rows = np.zeros(CYCLES, cycle_dtype(2)), np.zeros(CYCLES, ROW)
    records["cycle"] = records["number"] = rows["number"] = np.arange(CYCLES)
    records["commanded_velocity"] = 0.1
    deaths = [Death(victim, CYCLES, behind) for victim in victims]
    return Seen(deaths, 4, {"text": text} if text else {}, rows, records, [])


def kept(count: int, path: Path = Path("move_000_a1.mcap"), *, complete: bool = False) -> Kept:
    """An archive of the first so many cycles."""
    archive: Any = SimpleNamespace(complete=complete, missing="torn", outcome=None)
    return Kept(path, cast("Any", None), archive, np.arange(count, dtype=np.int64))


@pytest.mark.parametrize(
    ("lost", "behind", "allowed"),
    [(PROMISED, 0, True), (PROMISED + 1, 0, False), (PROMISED + 20, 20, True), (2500, 100, False)],
)
def test_a_dead_archive_process_costs_a_chunk_and_what_it_had_not_taken(
    lost: int, behind: int, allowed: bool
) -> None:
    figures: dict[str, int] = {}
    broken = list(_archived([kept(CYCLES - lost)], seen("archive", behind=behind), figures))
    assert bool(broken) is not allowed
    assert figures["lost"] == lost


def test_only_the_newest_archive_may_be_torn_by_a_death(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    older, newest = tmp_path / "move_000_a1.mcap", tmp_path / "excitation_000_a1.mcap"
    for place, path in enumerate((older, newest), 1):
        path.touch()
        os.utime(path, ns=(place * 10**9, place * 10**9))
    monkeypatch.setattr("tests.process_death.laws._counted_plainly", lambda *_, **__: 7)
    assert list(_readable(kept(7, newest), seen("archive"))) == []
    (broken,) = _readable(kept(7, older), seen("archive"))
    assert "move_000_a1.mcap is not complete" in broken
    assert list(_readable(kept(7, newest), seen("exchange")))


@pytest.mark.parametrize(
    ("victim", "text", "true"),
    [
        ("exchange", "the exchange process ended; the controller gets no answers", True),
        ("exchange", "the exchange process is gone: no such process", True),
        ("exchange", "repetition 1 was lost: nothing was heard from the controller", False),
        ("exchange", "the controller did not answer the exchange process", False),
        ("archive", "the archive process ended (exit status -9); nothing was sent", True),
        ("archive", "the disk of the archive process is full", False),
        ("controller", "move 1 was lost: nothing was heard from the controller", True),
        ("controller", "the exchange process ended", False),
    ],
)
def test_a_supervisor_blames_who_died_and_nobody_else(
    victim: Victim, text: str, true: bool
) -> None:
    assert (not list(_told(seen(victim, text=text)))) is true


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
def test_an_exchange_ends_when_the_last_packet_it_answered_told_of_closed_axes(
    phases: tuple[Phase, ...], deserted_answered: bool, broken: bool
) -> None:
    rows = np.zeros(20, ROW)
    rows["phase"], rows["replied"] = Phase.CLOSED, True
    rows["phase"][7 : 7 + len(phases)] = phases
    rows["deserted"][10:] = True
    rows["replied"][10:] = False
    rows["replied"][10] = deserted_answered
    said = list(_arm(Seen([Death("supervisor", 20)], None, {}, rows, rows, [])))
    assert any("ended by itself" in one for one in said) is broken
