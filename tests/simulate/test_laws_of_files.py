"""Altered archives, folders, ends and estimates are found by the laws; see `test_laws`."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

from drivers.events import MotionEnded
from hil import Campaign
from hil.campaign.errors import MotionFailedError
from hil.campaign.status import CampaignStatus
from hil.errors import ControllerFault
from tests.hil.mcap_bytes import chunks
from tests.simulate.altered import found, played, with_life
from tests.simulate.laws.archived import read
from tests.simulate.laws.estimated import FALSE_ALARM, SEEDS, bound, degrees_of_freedom
from tests.simulate.observed import Life, Observed


@pytest.fixture(scope="module")
def observed(tmp_path_factory: pytest.TempPathFactory) -> Observed:
    return played(tmp_path_factory.mktemp("simulated"))


@pytest.fixture
def copied(observed: Observed, tmp_path: Path) -> Observed:
    """The same with a folder of its own, to be put out of order."""
    shutil.copytree(observed.folder, tmp_path / "folder")
    return replace(observed, folder=tmp_path / "folder")


# Archives -----------------------------------------------------------------------------------


def whole(observed: Observed) -> Path:
    """An archive of a repetition."""
    return sorted((observed.folder / "archives").glob("excitation_*.mcap"))[-1]


def spoilt(path: Path, at: int, length: int = 1) -> None:
    data = bytearray(path.read_bytes())
    data[at : at + length] = bytes(byte ^ 0x5A for byte in data[at : at + length])
    path.write_bytes(data)


def test_a_byte_flipped_in_a_chunk_is_found(copied: Observed) -> None:
    path = whole(copied)
    begin, end = chunks(path.read_bytes())[1]
    spoilt(path, (begin + end) // 2)
    assert f"{path.name}: is not whole" in found(copied, "archives")
    assert f"{path.name} is not what was entered" in found(copied, "folder")
    assert f"{path.name} was pooled" in found(copied, "estimate")


def test_a_tail_that_is_missing_is_found(copied: Observed) -> None:
    path = whole(copied)
    path.write_bytes(path.read_bytes()[:-300])
    assert "though nobody tore it" in found(copied, "archives")


def test_a_record_that_was_not_archived_is_found(observed: Observed) -> None:
    """One cycle more was exchanged than there are records in the file."""
    life = observed.runs[0]
    index = len(life.exchanged) // 2
    rows = life.records.copy()
    later = [one.record for one in life.exchanged[index + 1 :] if one.record >= 0]
    rows["cycle"][later] += 1
    rows["gap"][later[0]] += 1
    assert found(with_life(observed, 0, records=rows), "archives")


@pytest.mark.parametrize("name", ["position", "target_current", "commanded_position", "mode"])
def test_a_record_that_is_not_what_crossed_the_wire_is_found(
    observed: Observed, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    archived = read(whole(observed))
    cycles = archived.cycles.copy()
    cycles[name][len(cycles) // 2] += 1
    monkeypatch.setattr(archived, "cycles", cycles)
    said = found(replace(observed), "archives")
    assert {
        "position": "position is not what the packets say",
        "target_current": "target_current is not what the packets say",
        "commanded_position": "not the one that was sent",
        "mode": "mode is not that of the cycle exchanged",
    }[name] in said
    assert name == "mode" or "JointState" in said or name == "target_current"


@pytest.mark.parametrize("rows", [slice(100, 101), slice(100, 110)])
def test_a_hole_in_an_archive_is_found_unless_it_is_stated(
    observed: Observed, monkeypatch: pytest.MonkeyPatch, rows: slice
) -> None:
    archived = read(whole(observed))
    kept = np.ones(len(archived.cycles), bool)
    kept[rows] = False
    for name in ("cycles", "stamps", "sequences", "states", "commanded"):
        monkeypatch.setattr(archived, name, getattr(archived, name)[kept])
    count = int((~kept).sum())
    said = found(replace(observed), "archives")
    assert f"{count} cycles in between were exchanged and not archived, 0 are stated" in said
    assert f"samples is stated as {len(kept)}, and is {len(kept) - count}" in said
    assert "not numbered without a hole" in said
    outcome = {**(archived.outcome or {}), "records_lost": str(count)}
    monkeypatch.setattr(archived, "outcome", outcome)
    assert "not archived" not in found(replace(observed), "archives")


def test_an_outcome_that_is_not_the_motions_own_is_found(
    observed: Observed, monkeypatch: pytest.MonkeyPatch
) -> None:
    archived = read(whole(observed))
    monkeypatch.setattr(archived, "outcome", {**(archived.outcome or {}), "outcome": "stopped"})
    said = found(replace(observed), "archives")
    assert "it ended completed, and" in said
    assert "says 'stopped', and is entered as 'completed'" in found(replace(observed), "folder")


def test_an_interval_without_an_archive_is_found(copied: Observed) -> None:
    path = whole(copied)
    path.unlink()
    assert "cycles are in 0 archives" in found(copied, "archives")
    assert f"{path.name} is in the manifest and not in the folder" in found(copied, "folder")


# The folder ---------------------------------------------------------------------------------


def edited(observed: Observed, edit: Callable[[list[dict[str, str]]], None]) -> Observed:
    path = observed.folder / "manifest.json"
    content = json.loads(path.read_text())
    edit(content["archives"])
    path.write_text(json.dumps(content))
    return observed


def test_a_manifest_that_says_otherwise_is_found(copied: Observed) -> None:
    name = whole(copied).name

    def worse(entries: list[dict[str, str]]) -> None:
        entries[-1]["sha256"] = "0" * 64

    def twice(entries: list[dict[str, str]]) -> None:
        entries.append(next(one for one in entries if one["name"] == name))

    assert "is not what was entered" in found(edited(copied, worse), "folder")
    assert "an archive is entered twice" in found(edited(copied, twice), "folder")


def test_inputs_that_changed_are_found(copied: Observed) -> None:
    with (copied.folder / "cell.toml").open("a") as file:
        file.write("# edited\n")
    assert "cell.toml is not the one in the manifest" in found(copied, "folder")


def test_what_was_whole_is_neither_changed_nor_removed_nor_done_again(observed: Observed) -> None:
    life = observed.runs[1]
    kept = next(name for name in life.before if name.startswith("standstill"))
    changed = with_life(observed, 1, after={**life.after, kept: "0" * 64})
    assert f"{kept} was changed" in found(changed, "folder")
    gone = {name: digest for name, digest in life.after.items() if name != kept}
    assert f"{kept} is gone" in found(with_life(observed, 1, after=gone), "folder")
    again = with_life(observed, 1, archives=(*life.archives, "standstill_000_a2.mcap"))
    assert f"was done although {kept} was whole by then" in found(again, "folder")


def test_what_does_not_count_is_named_to_whoever_asks(
    copied: Observed, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "hil status" not in found(copied, "folder")  # one file is torn by the death of its run
    told = Campaign.status

    def silent(campaign: Campaign) -> CampaignStatus:
        return replace(told(campaign), notes=())

    monkeypatch.setattr(Campaign, "status", silent)
    assert "hil status does not name" in found(copied, "folder")


# The end ------------------------------------------------------------------------------------


def test_a_run_may_only_end_as_the_documents_say(observed: Observed) -> None:
    strange = with_life(observed, 0, error=ValueError("what?"))
    assert "life 1 ended with ValueError" in found(strange, "resume")
    known = with_life(observed, 0, error=MotionFailedError("repetition 1", "lost", "silence"))
    assert found(known, "resume") == ""


def test_complete_means_that_everything_is_there(copied: Observed) -> None:
    name = whole(copied).name

    def without(entries: list[dict[str, str]]) -> None:
        entries[:] = [one for one in entries if one["name"] != name]

    assert "are missing" in found(edited(copied, without), "resume")


def test_what_counts_is_the_motion_as_it_was_planned(observed: Observed) -> None:
    other = replace(observed.plan.excitation, trajectory=observed.plan.validation[0].trajectory)
    swapped = replace(observed, plan=replace(observed.plan, excitation=other))
    assert "it is not the motion as it was planned" in found(swapped, "resume")


# The estimate -------------------------------------------------------------------------------


@pytest.mark.parametrize("wrong", [0.0, -1.0, 10.0])
def test_an_estimate_elsewhere_than_the_undisturbed_one_is_found(
    observed: Observed, wrong: float
) -> None:
    assert observed.found is not None
    pooled = observed.found.result.pooled
    name = int(np.argmax(np.abs(pooled.values) / pooled.std))
    values = pooled.values.copy()
    values[name] *= wrong
    result = replace(observed.found.result, pooled=replace(pooled, values=values))
    moved = replace(observed, found=observed.found._replace(result=result))
    assert f"{pooled.names[name]} is" in found(moved, "estimate")


def test_a_model_that_predicts_other_torques_of_the_same_motion_is_found(
    observed: Observed,
) -> None:
    """By far less than what the few degrees of freedom of each standard deviation allow."""
    assert observed.found is not None
    assert observed.twin_found is not None
    found_one, pooled = observed.found, observed.found.result.pooled
    (samples, *_) = found_one.fitted
    for share, seen in ((0.1, False), (10.0, True)):
        change = share * pooled.std * np.sign(pooled.values)
        torque = samples.predicted_torque(found_one.model, change)
        assert (np.abs(torque).max(axis=0) > pooled.noise_std).any() is np.bool_(seen)
        result = replace(found_one.result, pooled=replace(pooled, values=pooled.values + change))
        calm = replace(observed, found=found_one._replace(result=result), struck=())
        assert ("predicted torques differ" in found(calm, "estimate")) is seen


def test_what_does_not_count_must_not_be_pooled(copied: Observed) -> None:
    name = whole(copied).name

    def reject(entries: list[dict[str, str]]) -> None:
        next(one for one in entries if one["name"] == name)["outcome"] = "rejected"

    assert copied.found is not None
    less = replace(copied, found=copied.found._replace(pooled=copied.pooled[1:]))
    assert "count and were not pooled" in found(less, "estimate")
    assert f"{name} was pooled, though" in found(edited(copied, reject), "estimate")


def test_the_bound_on_estimates_is_the_quantile_that_it_says() -> None:
    assert degrees_of_freedom(1.9599639845400545) == math.inf
    assert degrees_of_freedom(2.3646242510102993) == pytest.approx(7.0, rel=1e-6)
    # Normal deviates: 2 (1 - Phi(z)) for one of 10 parameters in all seeds together.
    z = bound(math.inf, 10)
    assert 2.0 * norm.sf(z) * 10 * SEEDS == pytest.approx(FALSE_ALARM, rel=1e-9)


# The campaign as a whole --------------------------------------------------------------------


def test_a_campaign_that_never_completes_is_found(observed: Observed) -> None:
    for why in ("the way was not sent: jog the arm", "the drive is off"):
        stuck = with_life(observed, len(observed.runs) - 1, result=None, error=ControllerFault(why))
        assert why in found(stuck, "completion")
    assert "not identified" in found(replace(observed, found=None), "completion")


def test_a_run_that_ends_with_any_other_error_is_found(observed: Observed) -> None:
    assert "TypeError" in found(with_life(observed, 0, error=TypeError("?")), "resume")


def test_a_motion_that_completes_though_too_many_packets_were_missed_is_found(
    observed: Observed,
) -> None:
    number, moving = next(
        (number, packets)
        for number, life in enumerate(observed.runs)
        if (packets := moved_and_completed(life))
    )
    middle, most = moving[len(moving) // 2], observed.cell.controller.max_gap
    exchanged = observed.runs[number].exchanged
    without = exchanged[:middle] + exchanged[middle + most + 1 :]
    assert f"{most} are allowed, and the motion completed" in found(
        with_life(observed, number, exchanged=without), "gaps"
    )


def moved_and_completed(life: Life) -> list[int]:
    """Packets of motions that completed, where set-points moved."""
    ends = [event for _, event in life.events if isinstance(event, MotionEnded)]
    done = [event.interval for event in ends if event.outcome == "completed"]
    speed = np.nan_to_num(np.abs(life.records["commanded_velocity"])).max(axis=1)
    moving = (speed > 0.1) & np.isin(life.records["interval"], done)
    return [k for k, one in enumerate(life.exchanged) if one.record >= 0 and moving[one.record]]


def test_two_answers_to_one_pile_are_found(observed: Observed) -> None:
    life = observed.runs[0]
    mode = observed.cell.controller.mode
    at = next(
        index
        for index, one in enumerate(life.exchanged)
        if one.record >= 0 and one.packet[12] == mode and one.replies
    )
    exchanged = list(life.exchanged)
    exchanged[at + 1] = exchanged[at + 1]._replace(cycle=exchanged[at].cycle)
    assert "of one pile were both answered" in found(
        with_life(observed, 0, exchanged=tuple(exchanged)), "piles"
    )
