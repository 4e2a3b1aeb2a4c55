"""Laws find plausible defects injected into the product; without them the same seed is valid."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.c4g_packets import PacketSequence
from drivers.execution import Execution
from drivers.guard import Guard
from drivers.packet_losses import LossTracker
from hil.archive.recorder import Recorder
from hil.campaign.folder import CampaignFolder
from hil.campaign.motion_runner import Runner
from planner import TrajectoryPlayer
from tests.laws.table import judged
from tests.simulate.many import stage_folder
from tests.simulate.scenes import NEIGHBOURS
from tests.simulate.verdicts import Stage

pytestmark = pytest.mark.safety

SEED = 6
"""Its controller extrapolates the motion over up to eight missing answers."""
Plant = Callable[[pytest.MonkeyPatch], None]


@pytest.fixture(scope="module")
def stage() -> Iterator[Stage]:
    with stage_folder() as root:
        yield Stage(Path(root))


def answers_duplicates_again(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(PacketSequence, "is_duplicate", lambda self, number: False)
    patch.setattr(PacketSequence, "is_stale", lambda self, number: False)


def catches_up_unguarded(patch: pytest.MonkeyPatch) -> None:
    """After a gap the motion catches up, and the guard does not check speeds."""
    advance = TrajectoryPlayer.advance
    gap = [0]
    receive = LossTracker.receive

    def received(self: LossTracker, missed: int, elapsed: float) -> None:
        gap[0] = missed
        receive(self, missed, elapsed)

    def advanced(self: TrajectoryPlayer) -> Any:
        for _ in range(gap[0]):
            advance(self)
        gap[0] = 0
        return advance(self)

    patch.setattr(LossTracker, "receive", received)
    patch.setattr(TrajectoryPlayer, "advance", advanced)
    patch.setattr(Guard, "check_set_point", lambda *arguments: None)


def replaced(owner: type, name: str, value: Any) -> Plant:
    return lambda patch: patch.setattr(owner, name, value)


write = Recorder._write
loses_a_record = replaced(Recorder, "_write", lambda self, records: write(self, records[:-1]))
ignores_checksums = replaced(
    CampaignFolder, "_unchanged", lambda self, entry: (self.archives / entry.name).is_file()
)
accepts_set_points = replaced(Guard, "check_set_point", lambda *_: None)
accepts_feedback = replaced(Guard, "check_feedback", lambda *_: None)
leaves_at_once = replaced(Execution, "settled", property(lambda self: self.finished))

DEFECTS: dict[str, tuple[Plant, tuple[str, ...], str]] = {
    "a duplicate is answered again": (answers_duplicates_again, ("duplicate@300x40",), "replies"),
    "a motion catches up, unguarded": (
        catches_up_unguarded, ("lose@{moving}x2", "kill@9999"), "guard"),
    "set-points are not checked": (accepts_set_points, ("lurch@{moving}x3:0.0001",), "guard"),
    "feedback is not checked": (
        accepts_feedback, ("following-error@{moving}x60:axis=1:slip",), "guard"),
    "open mode is left before the arm settles": (leaves_at_once, ("lose@{moving}x4",), "rest"),
    "a lost record is not stated": (loses_a_record, (), "archives"),
    "a truncated archive is valid": (
        ignores_checksums, ("power-cut@{late}x2:keep=0.6",), "resume"),
}  # fmt: skip
"""Defect, script with which it has an effect, and the law that finds it."""


def script(stage: Stage, lines: tuple[str, ...]) -> list[str]:
    moving = stage.twin(SEED).story.moving
    middle = int(np.median([cycle for cycle in moving if cycle < moving[len(moving) // 2]]))
    return [line.format(moving=middle, late=moving[-len(moving) // 5]) for line in lines]


FAST = "a motion catches up, unguarded"


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] if name != FAST else []) for name in DEFECTS],
)
def test_it_is_found(name: str, stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    plant, lines, law = DEFECTS[name]
    wanted = script(stage, lines)
    assert judged(stage.scenario(SEED, wanted)) == []
    plant(monkeypatch)
    assert law in {violation.law for violation in judged(stage.scenario(SEED, wanted))}


def test_a_defect_without_faults_is_reported(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(self: Runner, *arguments: Any) -> str:
        raise TypeError("planted")

    monkeypatch.setattr(Runner, "run_motion", fails)
    verdict = stage.verdict(SEED + NEIGHBOURS)
    assert verdict.broken[0][0] == "undisturbed"
    assert "it ended TypeError: planted" in verdict.broken[0][1]
