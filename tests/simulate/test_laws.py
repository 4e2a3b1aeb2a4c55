"""Each law finds an alteration of the observation of a campaign that satisfies all of them."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

from drivers.events import MotionEnded, RepliesLost
from hil.base.errors import ControllerError
from hil.control.errors import MotionFailedError
from tests.drivers import oracle
from tests.faults import parse_script
from tests.hil.mcap_bytes import chunks
from tests.laws.estimates import FALSE_ALARM, SEEDS, bound, degrees_of_freedom
from tests.laws.second_reader import read
from tests.simulate.laws import LAWS
from tests.simulate.laws.conversation import Talk, heard
from tests.simulate.observed import Observed
from tests.simulate.world import NEIGHBOURS, Twin, play, twin_of

pytestmark = pytest.mark.safety

SEED = 5
FAULTS = (
    "duplicate@300x2",
    "reorder@340",
    "corrupt@380:offset=1:mask=0x10",
    "lose@420",
    "override@460:60",
    "override@520:100",
    "kill@900",
)


def found(observed: Observed, law: str) -> str:
    """Violations of one family of laws, in one text."""
    return "; ".join(LAWS[law](observed))


def with_life(observed: Observed, number: int, **changes: Any) -> Observed:
    lives = list(observed.runs)
    lives[number] = replace(lives[number], **changes)
    return replace(observed, runs=tuple(lives))


@pytest.fixture(scope="module")
def twin(tmp_path_factory: pytest.TempPathFactory) -> Twin:
    """The campaign without faults."""
    return twin_of(SEED // NEIGHBOURS, tmp_path_factory.mktemp("twin"))


@pytest.fixture(scope="module")
def observed(twin: Twin, tmp_path_factory: pytest.TempPathFactory) -> Observed:
    """The campaign."""
    return play(SEED, twin, tmp_path_factory.mktemp("faulty"), parse_script(FAULTS))


def test_an_unaltered_campaign_satisfies_every_law(observed: Observed) -> None:
    assert observed.complete, observed.ended
    assert len(observed.runs) >= 2
    assert {name: found(observed, name) for name in LAWS} == dict.fromkeys(LAWS, "")


def test_the_faults_have_effects_of_every_kind(observed: Observed) -> None:
    fates = heard(observed)[0].fates
    for kind in ("init", "cyclic", "again", "nothing"):
        assert fates[kind] > 0, kind
    assert len(moving(observed)) > 100
    assert len(list((observed.folder / "archives").glob("*.mcap"))) > 4


# Alterations of what was exchanged ----------------------------------------------------------


def with_exchanged(observed: Observed, index: int, **changes: Any) -> Observed:
    """One exchanged packet of the first life changed."""
    life = observed.runs[0]
    exchanged = list(life.exchanged)
    exchanged[index] = exchanged[index]._replace(**changes)
    return with_life(observed, 0, exchanged=tuple(exchanged))


def with_answer(observed: Observed, index: int, offset: int, mask: int = 1) -> Observed:
    """One byte of the answer to a packet of the first life changed."""
    reply = bytearray(observed.runs[0].exchanged[index].replies[0])
    reply[offset] ^= mask
    return with_exchanged(observed, index, replies=(bytes(reply),))


def of_kind(observed: Observed, kind: str, number: int = 0) -> int:
    """Index of a packet of the first life with this kind of required answer."""
    kinds = heard(observed)[0].kinds
    return [index for index, packet_kind in enumerate(kinds) if packet_kind == kind][number]


def talk_of(observed: Observed) -> Talk:
    """The first session."""
    return heard(observed)[0].talks[0]


def moving(observed: Observed) -> np.ndarray:
    """Rows of the records of the first life in its longest motion, while it moves."""
    records = observed.runs[0].records
    moves = np.nan_to_num(records["commanded_velocity"]).any(axis=1)
    interval = np.bincount(records["interval"][moves]).argmax()
    return np.flatnonzero(moves & (records["interval"] == interval))


def index_of(observed: Observed, row: int) -> int:
    """Index of the packet of a record of the first life."""
    return next(
        k for k, exchanged in enumerate(observed.runs[0].exchanged) if exchanged.record == row
    )


def axis_of(observed: Observed) -> int:
    """Byte offset of the first joint in a packet."""
    return 12 + 36 * (talk_of(observed).init.slots or (0,))[0]


def in_motion(observed: Observed, further: int = 0) -> tuple[int, int]:
    """Index of a packet within a motion of the first life, and byte offset in its first joint."""
    rows = moving(observed)
    return index_of(observed, int(rows[len(rows) // 2])), axis_of(observed) + further


def at_rest(observed: Observed) -> int:
    """Index of a packet with closed axes and the drive on."""
    talk = talk_of(observed)
    on = talk.received.status[:, arm_of(observed) - 1] == oracle.DRIVE_ON
    return int(talk.index[np.flatnonzero(on & (talk.received.mode == 0).all(axis=1))[2]])


def arm_of(observed: Observed) -> int:
    return int(observed.runs[0].settings["arm"])


def reply_at(observed: Observed) -> tuple[bytes, ...]:
    """Reply at rest."""
    return observed.runs[0].exchanged[at_rest(observed)].replies


def refused_instead(observed: Observed, index: int, *modes: int) -> Observed:
    """A packet answered with these modes and the targets received."""
    exchanged = observed.runs[0].exchanged[index]
    talk = talk_of(observed)
    assert talk.init.arms is not None
    safe = oracle.safe_answer(oracle.parse(exchanged.packet, talk.init.n_axes), talk.init.arms)
    axes = tuple(
        axis._replace(mode=modes[k % len(modes)] or axis.mode) for k, axis in enumerate(safe.axes)
    )
    return with_exchanged(observed, index, replies=(oracle.build(safe._replace(axes=axes)),))


def with_received(observed: Observed, place: tuple[int, int], data: bytes) -> Observed:
    """Some bytes of a packet of the first life changed; place is its index, and where."""
    index, at = place
    packet = bytearray(observed.runs[0].exchanged[index].packet)
    packet[at : at + len(data)] = data
    return with_exchanged(observed, index, packet=bytes(packet))


def received_in_motion(observed: Observed, field: int, value: float) -> Observed:
    """One of D1..D5 of the first joint within a motion."""
    index, at = in_motion(observed)
    return with_received(observed, (index, at + 4 + 4 * field), np.float32(value).tobytes())


def first_set_point(observed: Observed, further: int = 0) -> tuple[int, int]:
    """Index of its packet, and byte offset behind the target of the first joint."""
    sent = np.isfinite(observed.runs[0].records["commanded_position"]).all(axis=1)
    return index_of(observed, int(np.argmax(sent))), axis_of(observed) + 4 + further


def with_set_points(
    observed: Observed, change: Callable[[int], float], *, records: bool = True, first: int = 0
) -> Observed:
    """The set-points of a motion of the first life moved by `change(row)` motor revolutions.

    Rows count from the record `first`, by default from the middle of the longest motion.
    """
    life = observed.runs[0]
    rows = observed.runs[0].records.copy()
    first = first or int(moving(observed)[len(moving(observed)) // 2])
    slots = list(talk_of(observed).init.slots or ())
    drives = observed.cell.drive_train
    exchanged = list(life.exchanged)
    before = 0.0
    for index, exchange in enumerate(exchanged):
        row = exchange.record
        q = rows["commanded_position"][row]
        if row < first or rows["interval"][row] != rows["interval"][first] or np.isnan(q).any():
            continue
        now = change(row - first)
        reply = bytearray(exchange.replies[0])
        origin = drives.joint_position(np.zeros(len(q)))
        q = q + drives.joint_position(np.full(len(q), now)) - origin
        position = np.asarray(drives.motor_revolutions(q), np.float32)
        for joint, slot in enumerate(slots):
            at = 16 + 36 * slot
            step = float(np.frombuffer(reply[at + 4 : at + 8], np.float32)[0]) + now - before
            reply[at : at + 8] = np.array([position[joint], step], np.float32).tobytes()
        exchanged[index] = exchange._replace(replies=(bytes(reply),))
        before = now
        if records:
            rows["commanded_position"][row] = q
    return with_life(observed, 0, exchanged=tuple(exchanged), records=rows)


def leapt(observed: Observed, height: float = 0.2, *, records: bool = True) -> Observed:
    """One set-point in the middle of a motion shifted [motor revolutions]."""
    return with_set_points(observed, lambda row: height * (row == 0), records=records)


def revolutions_of_jerk(observed: Observed) -> np.ndarray:
    """(n,) the largest third difference of each joint's set-points."""
    limits = observed.cell.joint_limits
    period = observed.cell.period
    gears = np.abs(np.diag(observed.cell.drive_train.motor_from_joint)) / (2.0 * np.pi)
    return np.asarray(limits.jerk * period**3 * gears)


def beyond_the_range(observed: Observed) -> Observed:
    limits = observed.cell.joint_limits
    far = 200.0 * float(np.max(limits.upper - limits.lower))
    return with_set_points(observed, lambda row: far)


def unrequested(observed: Observed) -> Observed:
    acts = tuple(act for act in observed.runs[0].acts if act.name != "request")
    return with_life(observed, 0, acts=acts)


def ended_early(observed: Observed) -> Observed:
    events = tuple(
        (at, replace(event, cycle=event.cycle - 150) if isinstance(event, MotionEnded) else event)
        for at, event in observed.runs[0].events
    )
    return with_life(observed, 0, events=events)


def with_arm(observed: Observed, **changes: Any) -> Observed:
    return replace(observed, arm=replace(observed.arm, **changes))


def other_excitation(observed: Observed) -> Observed:
    plan = observed.plan
    other = replace(plan.excitation, trajectory=plan.validation[0].trajectory)
    return replace(observed, plan=replace(plan, excitation=other))


def ended(observed: Observed, reason: str) -> Observed:
    return with_life(observed, len(observed.runs) - 1, result=None, error=ControllerError(reason))


def unarchived(observed: Observed) -> Observed:
    """One exchanged cycle without a record."""
    life = observed.runs[0]
    rows = life.records.copy()
    index = len(life.exchanged) // 2
    later = [exchanged.record for exchanged in life.exchanged[index + 1 :] if exchanged.record >= 0]
    rows["cycle"][later] += 1
    rows["gap"][later[0]] += 1
    return with_life(observed, 0, records=rows)


def too_many_missed(observed: Observed) -> Observed:
    """Packets removed within a motion that completed."""
    for number, life in enumerate(observed.runs):
        ends = [event for _, event in life.events if isinstance(event, MotionEnded)]
        done = [event.interval for event in ends if event.outcome == "completed"]
        speed = np.nan_to_num(np.abs(life.records["commanded_velocity"])).max(axis=1)
        moving = (speed > 0.1) & np.isin(life.records["interval"], done)
        at = [
            k
            for k, exchanged in enumerate(life.exchanged)
            if exchanged.record >= 0 and moving[exchanged.record]
        ]
        if at:
            middle = at[len(at) // 2]
            most = observed.cell.controller.max_gap
            left = life.exchanged[:middle] + life.exchanged[middle + most + 1 :]
            return with_life(observed, number, exchanged=left)
    raise AssertionError("no motion completed")


def piled_up(observed: Observed) -> Observed:
    exchanged = list(observed.runs[0].exchanged)
    mode = observed.cell.controller.mode
    at = next(
        index
        for index, exchange in enumerate(exchanged)
        if exchange.record >= 0 and exchange.packet[12] == mode and exchange.replies
    )
    exchanged[at + 1] = exchanged[at + 1]._replace(cycle=exchanged[at].cycle)
    return with_life(observed, 0, exchanged=tuple(exchanged))


Alter = Callable[[Observed], Observed]
REST = at_rest
ALTERED: list[tuple[str, Alter, tuple[str, ...]]] = [
    ("replies", lambda o: with_answer(o, REST(o), 0), ("an answer of another number",)),
    ("replies", lambda o: with_answer(o, REST(o), 8), ("function bytes",)),
    ("replies", lambda o: with_answer(o, of_kind(o, "init"), 700), ("not echoed byte for byte",)),
    ("replies", lambda o: with_answer(o, of_kind(o, "again"), 20), ("second answer differs",)),
    ("replies", lambda o: with_exchanged(o, REST(o), replies=()),
     ("got no answer although required",)),
    ("replies", lambda o: with_exchanged(o, REST(o), replies=(), given=False),
     ("late is 0, and 1 were observed",)),
    ("replies", lambda o: with_exchanged(o, of_kind(o, "again"), replies=()),
     ("got no answer although required (again)",)),
    ("replies", lambda o: with_exchanged(o, REST(o), replies=2 * reply_at(o)), ("2 answers",)),
    ("replies", lambda o: with_exchanged(o, of_kind(o, "nothing"), replies=(bytes(48),)),
     ("must not be",)),
    ("replies", lambda o: with_exchanged(o, REST(o), replies=(reply_at(o)[0][:-4],)),
     ("was answered by",)),
    ("replies", lambda o: with_exchanged(o, REST(o), record=-1), ("has no record",)),
    ("replies", lambda o: with_life(o, 0, counters=replace(o.runs[0].counters, duplicates=0)),
     ("duplicates is 0",)),
    ("guard", lambda o: with_answer(o, in_motion(o)[0], 4 + arm_of(o) % 4, 4),
     ("status bytes",)),
    ("guard", lambda o: with_answer(o, REST(o), 3 + arm_of(o)), ("asked for outside of it",)),
    ("guard", lambda o: with_answer(o, REST(o), 17), ("not the safe answer",)),
    ("guard", lambda o: with_answer(o, *in_motion(o)), ("another mode",)),
    ("guard", lambda o: with_answer(o, *in_motion(o, 24)), ("no use for",)),
    ("guard", lambda o: refused_instead(o, REST(o), 505), ("not the safe answer",)),
    ("guard", lambda o: refused_instead(o, in_motion(o)[0], 505, 0), ("505",)),
    ("guard", lambda o: refused_instead(o, in_motion(o)[0], 505),
     ("a refused set-point was recorded as sent",)),
    ("guard", lambda o: with_received(o, in_motion(o), bytes(4)), ("not the safe answer",)),
    ("guard", leapt, ("velocity",)),
    ("guard", lambda o: leapt(o, records=False), ("sent and recorded differ",)),
    ("guard", beyond_the_range, ("velocity",)),
    ("guard", lambda o: with_answer(o, *first_set_point(o, 1), 8), ("first: target, at rest",)),
    ("guard", lambda o: with_received(o, first_set_point(o, 12), np.float32(0.01).tobytes()),
     ("first set-point in motion",)),  # D4 [motor revolutions per cycle]
    ("guard", lambda o: received_in_motion(o, 0, 1e3), ("following error",)),
    ("guard", lambda o: received_in_motion(o, 2, 1e3), ("following error",)),
    ("guard", lambda o: received_in_motion(o, 4, 1e4), ("current",)),
    ("guard", unrequested, ("moved without a motion requested",)),
    ("guard", ended_early, ("moved without a motion requested",)),
    ("rest", lambda o: with_arm(o, velocity=o.arm.velocity + 1.0),
     ("at the end the arm moves", "ends the arm moves")),
    ("rest", lambda o: with_arm(o, open_axes=np.ones(len(o.arm.phase), bool)),
     ("at the end axes are open, phase ", "ends axes are open, phase ")),
    ("archives", unarchived, ("",)),
    ("resume", lambda o: with_life(o, 0, error=ValueError("what?")),
     ("life 1 ended with ValueError",)),
    ("resume", other_excitation, ("it is not the motion as it was planned",)),
    ("completion", lambda o: ended(o, "the drive is off"), ("the drive is off",)),
    ("completion", lambda o: replace(o, found=None), ("not identified",)),
    ("gaps", too_many_missed, ("are allowed, and the motion completed",)),
    ("piles", piled_up, ("both were answered",)),
]  # fmt: skip


@pytest.mark.parametrize(
    ("law", "alter", "texts"), ALTERED, ids=[f"{law}: {texts[0]}" for law, _, texts in ALTERED]
)
def test_an_alteration_is_found(
    observed: Observed, law: str, alter: Alter, texts: tuple[str, ...]
) -> None:
    broken = found(alter(observed), law)
    assert broken
    for text in texts:
        assert text in broken


@pytest.fixture(scope="module")
def led(twin: Twin, tmp_path_factory: pytest.TempPathFactory) -> Observed:
    """Four packets are lost within a motion, which the controller extrapolates."""
    lost = twin.story.moving[3 * len(twin.story.moving) // 10]
    return play(SEED + 1, twin, tmp_path_factory.mktemp("led"), parse_script([f"lose@{lost}x4"]))


def after_gap(observed: Observed) -> int:
    """Row of the record after the long gap in a motion of the first life."""
    records = observed.runs[0].records
    moved = np.nan_to_num(records["commanded_velocity"]).any(axis=1)
    return int(np.flatnonzero((records["gap"] > 2) & moved)[0])


def received_there(observed: Observed, field: int, factor: float, more: float = 0.0) -> Observed:
    """One of D1..D5 of the first joint after the gap, scaled and shifted."""
    index = index_of(observed, after_gap(observed))
    at = axis_of(observed) + 4 + 4 * field
    packet = observed.runs[0].exchanged[index].packet
    value = factor * np.frombuffer(packet[at : at + 4], np.float32)[0] + more
    return with_received(observed, (index, at), np.float32(value).tobytes())


def moved_from_there(observed: Observed, way: float, speed: float) -> Observed:
    """Set-points after the gap moved by revolutions, and by revolutions per cycle."""
    return with_set_points(observed, lambda row: way + speed * row, first=after_gap(observed))


@pytest.mark.parametrize(
    ("alter", "text"),
    [
        (lambda o: received_there(o, 0, 1.0, 50.0), "following error"),
        (lambda o: received_there(o, 1, 1.6), "continues at another speed"),
        (lambda o: received_there(o, 1, 0.0), "continues at another speed"),
        (lambda o: received_there(o, 2, 1.0, 50.0), "following error"),
        (lambda o: moved_from_there(o, 0.01, 0.0), "acceleration"),
        (lambda o: moved_from_there(o, 0.0, 0.02), "acceleration"),
    ],
)
def test_set_points_after_a_long_gap_are_checked(led: Observed, alter: Alter, text: str) -> None:
    """As those of a motion that begins where the controller extrapolated it."""
    assert found(led, "guard") == ""
    assert text in found(alter(led), "guard")


def test_a_jerk_visible_only_in_the_records_is_found(observed: Observed) -> None:
    """Two millionths of a revolution: below a step of float32 at 100 revolutions."""
    broken = found(leapt(observed, float(np.max(2.0 * revolutions_of_jerk(observed)))), "guard")
    assert "jerk" in broken
    assert "velocity" not in broken


def test_bounds_of_a_stop_without_lost_answers_are_found(observed: Observed) -> None:
    """Whatever the events of the session state."""
    wide = leapt(observed, float(np.min(0.6 * revolutions_of_jerk(observed))))
    cycle = int(observed.runs[0].records["cycle"][moving(observed)[0]])
    events = observed.runs[0].events
    lost = with_life(wide, 0, events=(*events, (events[-1][0], RepliesLost(3, cycle))))
    assert "jerk" in found(wide, "guard")
    assert "jerk" in found(lost, "guard")


@pytest.fixture
def copied(observed: Observed, tmp_path: Path) -> Observed:
    """The same with a copy of its folder."""
    shutil.copytree(observed.folder, tmp_path / "folder")
    return replace(observed, folder=tmp_path / "folder")


def whole(observed: Observed) -> Path:
    """An archive of a repetition."""
    return sorted((observed.folder / "archives").glob("excitation_*.mcap"))[-1]


def flipped(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[sum(chunks(bytes(data))[1]) // 2] ^= 0x5A
    path.write_bytes(data)


def entered(path: Path, edit: Callable[[dict[str, str]], list[dict[str, str]]]) -> None:
    """Its entry in the manifest replaced by others."""
    manifest = path.parents[1] / "manifest.json"
    content = json.loads(manifest.read_text())
    old = content["archives"]
    content["archives"] = [new for o in old for new in (edit(o) if o["name"] == path.name else [o])]
    manifest.write_text(json.dumps(content))


def cell_edited(path: Path) -> None:
    with (path.parents[1] / "cell.toml").open("a") as file:
        file.write("# edited\n")


SPOILT: dict[str, tuple[Callable[[Path], object], dict[str, str]]] = {
    "a byte": (flipped,
     {"archives": "{name}: is incomplete", "folder": "{name} differs from its checksum",
      "estimate": "{name} was pooled"}),
    "the tail": (lambda path: path.write_bytes(path.read_bytes()[:-300]),
     {"archives": "without a fault that truncated it"}),
    "an archive": (Path.unlink,
     {"archives": "cycles are in 0 archives",
      "folder": "{name} is in the manifest and not in the folder"}),
    "a digest": (lambda path: entered(path, lambda entry: [entry | {"sha256": "0" * 64}]),
     {"folder": "differs from its checksum"}),
    "an entry twice": (lambda path: entered(path, lambda entry: [entry, entry]),
     {"folder": "an archive is entered twice"}),
    "no entry": (lambda path: entered(path, lambda entry: []), {"resume": "is missing"}),
    "a rejection": (lambda path: entered(path, lambda entry: [entry | {"outcome": "rejected"}]),
     {"estimate": "{name} was pooled although"}),
    "the cell": (cell_edited, {"folder": "cell.toml is not the one in the manifest"}),
}  # fmt: skip


@pytest.mark.parametrize("what", SPOILT)
def test_a_damaged_folder_is_found(copied: Observed, what: str) -> None:
    spoil, texts = SPOILT[what]
    path = whole(copied)
    spoil(path)
    for law, text in texts.items():
        assert text.format(name=path.name) in found(copied, law)


@pytest.mark.parametrize("name", ["position", "target_current", "commanded_position", "mode"])
def test_a_record_that_differs_from_its_packet_is_found(
    observed: Observed, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    archived = read(whole(observed))
    cycles = archived.cycles.copy()
    cycles[name][len(cycles) // 2] += 1
    monkeypatch.setattr(archived, "cycles", cycles)
    broken = found(replace(observed), "archives")
    assert {
        "position": "position is not that of the packets",
        "target_current": "target_current is not that of the packets",
        "commanded_position": "not the one that was sent",
        "mode": "mode is not that of the cycle exchanged",
    }[name] in broken
    assert name == "mode" or "JointState" in broken or name == "target_current"


@pytest.mark.parametrize("rows", [slice(100, 101), slice(100, 110)])
def test_missing_records_are_found_unless_stated(
    observed: Observed, monkeypatch: pytest.MonkeyPatch, rows: slice
) -> None:
    archived = read(whole(observed))
    present = np.ones(len(archived.cycles), bool)
    present[rows] = False
    for name in ("cycles", "stamps", "sequences", "states", "commanded"):
        monkeypatch.setattr(archived, name, getattr(archived, name)[present])
    count = int((~present).sum())
    broken = found(replace(observed), "archives")
    assert f"{count} cycles in between were exchanged and not archived, 0 are stated" in broken
    assert f"samples is stated as {len(present)}, and is {len(present) - count}" in broken
    assert "not numbered consecutively" in broken
    outcome = {**(archived.outcome or {}), "records_lost": str(count)}
    monkeypatch.setattr(archived, "outcome", outcome)
    assert "not archived" not in found(replace(observed), "archives")


def test_another_outcome_than_the_motions_is_found(
    observed: Observed, monkeypatch: pytest.MonkeyPatch
) -> None:
    archived = read(whole(observed))
    monkeypatch.setattr(archived, "outcome", {**(archived.outcome or {}), "outcome": "stopped"})
    assert "it ended completed, and" in found(replace(observed), "archives")
    assert "says 'stopped', and is entered as 'completed'" in found(replace(observed), "folder")


def test_changed_removed_and_repeated_archives_are_found(observed: Observed) -> None:
    life = observed.runs[1]
    name = next(name for name in life.before if name.startswith("standstill"))
    changed = with_life(observed, 1, after={**life.after, name: "0" * 64})
    assert f"{name} was changed" in found(changed, "folder")
    gone = {other: digest for other, digest in life.after.items() if other != name}
    assert f"{name} is gone" in found(with_life(observed, 1, after=gone), "folder")
    again = with_life(observed, 1, archives=(*life.archives, "standstill_000_a2.mcap"))
    assert f"was run although {name} was complete by then" in found(again, "folder")


def test_a_failed_motion_may_end_a_run(observed: Observed) -> None:
    failed = MotionFailedError("repetition 1", "lost", "silence")
    assert found(with_life(observed, 0, error=failed), "resume") == ""


@pytest.mark.parametrize("wrong", [0.0, -1.0, 10.0])
def test_an_estimate_that_differs_from_the_undisturbed_is_found(
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


def test_a_model_that_predicts_other_torques_is_found(observed: Observed) -> None:
    """By far less than the few degrees of freedom of each standard deviation allow."""
    assert observed.found is not None
    assert observed.twin_found is not None
    found_one = observed.found
    pooled = observed.found.result.pooled
    (samples, *_) = found_one.fitted
    for share, seen in ((0.05, False), (10.0, True)):
        change = share * pooled.std * np.sign(pooled.values)
        torque = samples.predicted_torque(found_one.model, change)
        assert (np.abs(torque).max(axis=0) > pooled.noise_std).any() is np.bool_(seen)
        result = replace(found_one.result, pooled=replace(pooled, values=pooled.values + change))
        calm = replace(observed, found=found_one._replace(result=result), struck=())
        assert ("predicted torques differ" in found(calm, "estimate")) is seen


def test_valid_archives_must_be_pooled(observed: Observed) -> None:
    assert observed.found is not None
    less = replace(observed, found=observed.found._replace(pooled=observed.pooled[1:]))
    assert "are valid and were not pooled" in found(less, "estimate")


def test_the_bound_on_estimates_is_its_quantile() -> None:
    assert degrees_of_freedom(1.9599639845400545) == math.inf
    assert degrees_of_freedom(2.3646242510102993) == pytest.approx(7.0, rel=1e-6)
    # Normal deviates: 2 (1 - Phi(z)) for one of 10 parameters in all seeds together.
    z = bound(math.inf, 10)
    assert 2.0 * norm.sf(z) * 10 * SEEDS == pytest.approx(FALSE_ALARM, rel=1e-9)
