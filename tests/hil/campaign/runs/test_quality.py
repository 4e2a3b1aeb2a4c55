"""Repetitions that differ are rejected and run again."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final
from unittest.mock import ANY

import numpy as np
import pytest

from drivers.transports.simulated import SimulatedTransport
from hil.archive import open_archive
from hil.campaign import (
    Campaign,
    VirtualLink,
)
from hil.campaign.errors import (
    RepetitionsRejectedError,
)
from hil.campaign.quality import FIELDS, Executed, RepetitionCheck
from hil.campaign.quality_problems import (
    ReplacedRepetitions,
    IncompleteArchive,
    MissedPackets,
    OtherRepetition,
    SaturatedCurrent,
    StuckJoint,
)
from hil.campaign.campaign_run import RunResult
from hil.control.motion_watch import OperatorRequest
from hil.control.simulated_cell import controller_settings, simulated_controller
from hil.pipeline.notes import RejectedArchive
from hil.pipeline.sources import gather_sources
from sim_fixtures.faults import parse_fault, split_faults
from tests import messages
from tests.hil.campaign.runs.rig import (
    Make,
    Operator,
    Push,
    cycles_of,
    middle_of,
    outcomes,
    run_pushed,
    slowing,
)
from tests.hil.fast_cell import fast_cell, set_points
from tests.messages import OTHERS_AGREE

pytestmark = pytest.mark.safety


def test_a_slowed_repetition_is_rejected_and_run_again(make: Make) -> None:
    campaign = make(repetitions=2)
    operator = Operator(slowing(range(1, 4), number=2))
    result = campaign.run(operator=operator, unrehearsed=True)
    (rejected,) = result.rejected
    assert rejected.archive == "excitation_001_a1.mcap"
    assert "held or slowed" in rejected.reason
    assert result.repetitions == (2, 2)
    assert outcomes(campaign) == {
        "000_a1": "completed", "001_a1": "rejected", "001_a2": "completed"
    }  # fmt: skip
    (entry,) = (e for e in campaign.folder.manifest() if e.outcome == "rejected")
    assert entry.reason == rejected.reason
    archive = open_archive(campaign.folder.archives / rejected.archive)
    assert archive.complete
    assert archive.outcome.entries["outcome"] == "rejected"
    assert archive.outcome.entries["reason"] == rejected.reason
    # Whoever names all files of the folder does not pool it either.
    loose = sorted(campaign.folder.archives.glob("excitation_*"))
    sources = gather_sources(loose, split=0.5)
    assert rejected.archive not in {
        source.name for source in (*sources.training, *sources.held_out)
    }
    assert RejectedArchive(rejected.archive, rejected.reason) in sources.warnings


def test_a_motion_that_is_always_rejected_ends_the_run(make: Make) -> None:
    campaign = make(bad_repetitions=2)
    slow = Operator(lambda status: OperatorRequest(0.5 if status.phase == "repetition" else 1.0))
    with pytest.raises(RepetitionsRejectedError, match="was rejected 3 times") as ended:
        campaign.run(operator=slow, unrehearsed=True)
    assert ended.value.exit_code == 5
    assert [*outcomes(campaign).values()] == ["rejected"] * 3
    assert campaign.run(unrehearsed=True).repetitions == (1, 1), "a next run continues"


def test_a_load_on_an_axis_is_detected(
    tmp_path: Path, designed: Campaign, undisturbed: Campaign
) -> None:
    """The same campaign to the bit, but for 0.1 s in the middle of its last repetition."""
    campaign = Campaign.create(tmp_path / "campaign", fast_cell(tmp_path), designed.plan)
    result = run_pushed(campaign, Push(middle_of(undisturbed, "excitation_003_a1.mcap")))
    (rejected,) = result.rejected
    assert rejected.archive == "excitation_003_a1.mcap"
    assert "shoulder" in rejected.reason
    assert result.repetitions == (4, 4)


def test_a_disturbed_first_repetition_rejects_no_others(make: Make, undisturbed: Campaign) -> None:
    campaign = make(repetitions=3)
    result = run_pushed(campaign, Push(middle_of(undisturbed, "excitation_000_a1.mcap")))
    assert result.complete
    assert [rejection.archive[11:-5] for rejection in result.rejected] == [
        "001_a1",
        "001_a2",
        "000_a1",
    ]
    assert OTHERS_AGREE in result.rejected[2].reason
    (replaced,) = result.notes
    assert isinstance(replaced, ReplacedRepetitions)
    assert replaced.archives == ("excitation_000_a1.mcap",)
    good = [path.name[11:-5] for path in campaign.folder.completed("excitation")]
    assert good == ["000_a2", "001_a3", "002_a1"]
    touched = open_archive(campaign.folder.archives / "excitation_000_a1.mcap")
    assert touched.outcome.outcome == "rejected"
    assert not campaign.folder.damaged()


def test_an_arm_that_changes_during_a_campaign_ends_it(make: Make, undisturbed: Campaign) -> None:
    begins = int(cycles_of(undisturbed, "excitation_002_a1.mcap")[0])
    campaign = make(repetitions=3)
    with pytest.raises(RepetitionsRejectedError, match="current of shoulder"):
        run_pushed(campaign, Push(begins - 1, 0.05, cycles=10**9))
    assert [*outcomes(campaign).values()] == ["completed"] * 2 + ["rejected"] * 4


def test_a_repetition_with_lost_replies_is_as_planned(
    tmp_path: Path, designed: Campaign, undisturbed: Campaign
) -> None:
    """Two in a row, at speed: the motion pauses for two cycles and skips no set-point."""
    name = "excitation_001_a1.mcap"
    middle = middle_of(undisturbed, name)
    cell = fast_cell(tmp_path)
    settings = replace(controller_settings(cell), missed_replies=5)
    controller = simulated_controller(cell, settings=settings)
    lost, _ = split_faults([parse_fault(f"lose@{middle}x2:to_controller")])
    link = VirtualLink.over(SimulatedTransport(controller, lost), cell, controller.finish)
    campaign = Campaign.create(tmp_path / "campaign", cell, designed.plan)
    campaign.run(link, unrehearsed=True, durable=False)
    sent, intended = (
        run_campaign.folder.archives / name for run_campaign in (campaign, undisturbed)
    )
    assert len(set_points(open_archive(sent))) == len(set_points(open_archive(intended))) + 2
    both = [played(path).commanded for path in (sent, intended)]
    np.testing.assert_allclose(*both, atol=1e-5)


def played(archive: Path) -> Executed:
    return Executed.of(open_archive(archive, fields=FIELDS))


@pytest.mark.parametrize(
    ("channel", "joint", "name"), [("position", 1, "elbow"), ("current", 0, "shoulder")]
)
def test_the_check_lets_noise_pass_and_names_what_differs(
    undisturbed: Campaign, channel: str, joint: int, name: str
) -> None:
    check = RepetitionCheck(undisturbed.cell, undisturbed.plan.excitation.trajectory)
    *earlier, last = (played(path) for path in undisturbed.folder.completed("excitation"))
    for repetition in earlier:
        assert check.problem(repetition) is None
        check.accept(repetition)
    assert check.problem(last) is None
    values = getattr(last, channel).copy()
    values[:, joint] += 0.2 * np.std(values[:, joint])
    problem = check.problem(replace(last, **{channel: values}))
    assert isinstance(problem, OtherRepetition)
    assert (problem.quantity, problem.joint, problem.repetitions) == (channel, name, len(earlier))
    assert problem.difference > problem.allowed


def test_a_truncated_stuck_or_saturated_motion_is_named(undisturbed: Campaign) -> None:
    check = RepetitionCheck(undisturbed.cell, undisturbed.plan.excitation.trajectory)
    good = played(undisturbed.folder.completed("excitation")[0])
    short = {name: getattr(good, name)[:400] for name in ("position", "current", "commanded")}
    position = good.position.copy()
    current = good.current.copy()
    saturated = good.current.copy()
    commanded = good.commanded[:, 1]
    end = 100 + int(np.argmax(np.abs(commanded[100:] - commanded[100]) > 0.03))
    position[100:end, 1] = position[100, 1]
    limit = undisturbed.cell.drive_train.current_limit[1]
    current[100:102, 1] = limit
    saturated[100:105, 1] = -limit
    few, many = (round(share * len(good.position)) for share in (0.005, 0.03))
    duration = undisturbed.plan.excitation.trajectory.duration
    cycles = math.ceil(duration / undisturbed.cell.period)
    for changes, expected in (
        ({}, None),
        (short, IncompleteArchive(400, cycles)),
        ({"missed": few}, None),
        ({"missed": many}, MissedPackets(many, cycles)),
        ({"position": position}, StuckJoint("elbow", 0.2, ANY)),
        ({"current": current}, None),
        ({"current": saturated}, SaturatedCurrent("elbow", 0.01)),
    ):
        assert check.problem(replace(good, **changes)) == expected


class TestMissedPackets:
    """Repetitions 1 and 2 of three are disturbed alike, and a packet may be missed in each."""

    @pytest.fixture
    def begins(self, undisturbed: Campaign) -> list[int]:
        """Cycles in which repetitions begin, where a missed packet disturbs none."""
        cycles = [cycles_of(undisturbed, f"excitation_{k:03d}_a1.mcap") for k in range(2)]
        first, second = (int(of_repetition[0]) + _AT_REST for of_repetition in cycles)
        return [first + k * (second - first) for k in range(9)]

    def run(
        self,
        campaign: Campaign,
        begins: Sequence[int],
        missed: Collection[int],
        disturbed: int = 2,
    ) -> RunResult:
        # Each missed packet delays what follows by a cycle.
        cycles = [
            begin + sum(k in missed for k in range(number)) for number, begin in enumerate(begins)
        ]
        lost, _ = split_faults([parse_fault(f"lose@{cycles[k]}") for k in sorted(missed)])
        settings = replace(controller_settings(campaign.cell), missed_replies=5)
        controller = simulated_controller(
            campaign.cell,
            settings=settings,
            faults=[Push(cycles[k] + 100 + (k in missed)) for k in range(disturbed)],  # type: ignore[misc]
        )
        link = VirtualLink.over(
            SimulatedTransport(controller, lost), campaign.cell, controller.finish
        )
        return campaign.run(link, unrehearsed=True, durable=False)

    def test_sound_ones_replace_as_many(self, make: Make, begins: list[int]) -> None:
        campaign = make(repetitions=3)
        result = self.run(campaign, begins, {0, 1})
        assert result.complete
        assert [rejection.archive[11:-5] for rejection in result.rejected] == [
            *("002_a1", "002_a2", "000_a1", "001_a1"),
        ]
        assert messages.MISSED_IN_IT_ONLY in result.rejected[-1].reason
        (replaced,) = result.notes
        assert isinstance(replaced, ReplacedRepetitions)
        assert replaced.archives == ("excitation_000_a1.mcap", "excitation_001_a1.mcap")
        good = [path.name[11:-5] for path in campaign.folder.completed("excitation")]
        assert good == ["000_a2", "001_a2", "002_a3"]

    def test_one_that_missed_some_is_none_of_those_that_agree(
        self, make: Make, begins: list[int]
    ) -> None:
        """The first of the later ones missed a packet: it takes one attempt more."""
        campaign = make(repetitions=3)
        result = self.run(campaign, begins, {0, 1, 2})
        assert result.complete
        assert [rejection.archive[11:-5] for rejection in result.rejected] == [
            *("002_a1", "002_a2", "002_a3", "000_a1", "001_a1"),
        ]

    def test_as_many_must_agree_as_are_replaced(self, make: Make, begins: list[int]) -> None:
        campaign = make(repetitions=4, bad_repetitions=2)
        result = self.run(campaign, begins, {0, 1, 2}, disturbed=3)
        assert result.complete
        assert [rejection.archive[11:-5] for rejection in result.rejected] == [
            *("003_a1", "003_a2", "000_a1", "001_a1", "002_a1"),
        ]

    @pytest.mark.parametrize("missed", [{0}, {1}, set(), {*range(9)}])
    def test_others_need_an_operator(
        self, make: Make, begins: list[int], missed: Collection[int]
    ) -> None:
        """Of those that count one missed none, or the later ones missed some, too."""
        campaign = make(repetitions=3)
        with pytest.raises(RepetitionsRejectedError):
            self.run(campaign, begins, missed)
        good = [path.name[11:-5] for path in campaign.folder.completed("excitation")]
        assert good == ["000_a1", "001_a1"]


_AT_REST: Final = 32  # cycles after the first of an archive, when the first set-point is sent
