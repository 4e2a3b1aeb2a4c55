"""What becomes of a motion of a UR5e, whatever happens to controller, operator, link or PC."""

from __future__ import annotations

import re

import numpy as np
import pytest

from drivers.errors import Check, GuardError
from drivers.events import Refused
from drivers.guard import Guard
from drivers.states import State
from drivers.transports.simulated import Delay, Duplicate, Lose
from sim_fixtures.ur import UrProgram
from tests.drivers.ur.ur_bench import MIDST, PERIOD, UrBench, ur_cell

pytestmark = pytest.mark.safety

SILENT = 10
"""Cycles in 20 ms."""


def test_a_motion_arrives_where_it_was_planned_to() -> None:
    bench = UrBench().move(by=20.0)
    assert (bench.ended.outcome, bench.state) == ("completed", State.CLOSED)
    bench.run(100)
    there = bench.cell.initial + np.radians([20.0, 0, 0, 0, 0, 0])
    assert bench.robot.arm.plant.position == pytest.approx(there, abs=2e-3)
    assert bench.rests
    assert bench.robot.stream is None and not bench.robot.playing


def test_the_target_is_the_set_point_of_two_cycles_before() -> None:
    bench = UrBench().move()
    records = bench.ring.last(4000)
    open_ = records["state"] == State.OPEN
    commanded = records["commanded_position"][open_]
    target = records["target_position"][open_]
    assert np.abs(target[10:] - commanded[8:-2]).max() < 1e-14
    assert np.ptp(commanded[:, 0]) > 0.3


def test_each_record_has_the_state_of_the_arm_in_its_cycle() -> None:
    bench = UrBench(f"stop@{MIDST}").move()
    records = bench.ring.last(4000)
    state = records["arm_state"]
    cycles = records["cycle"] * PERIOD
    np.testing.assert_allclose(np.diff(state["controller_time"]), np.diff(cycles), atol=1e-9)
    first = np.flatnonzero(state["safety_mode"] == 3)[0]
    assert first == np.flatnonzero(records["state"] == State.FAULTED)[0]
    assert {*state["safety_mode"][:first]} == {1}
    assert {*state["robot_mode"]} == {7} and np.all(state["joint_temperature"] > 20.0)
    assert np.isfinite(state["target_moment"]).all()


def test_an_arm_that_is_not_moved_is_recorded_nevertheless() -> None:
    records = UrBench(remote_control=False).run(5).ring.last(5)
    assert np.isnan(records["position"]).all()
    assert {*records["arm_state"]["robot_mode"]} == {7}


@pytest.mark.parametrize(
    ("robot_mode", "state"),
    [
        *((mode, State.DRIVE_OFF) for mode in (-1, 0, 1, 2, 3, 6, 8)),
        *((mode, State.DRIVING_ON) for mode in (4, 5)),
        (7, State.CLOSED),
    ],
)
def test_an_arm_without_power_or_with_brakes_is_not_ready(
    robot_mode: int, state: State, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = UrBench()
    outputs = bench.robot.outputs
    monkeypatch.setattr(bench.robot, "outputs", lambda: {**outputs(), "robot_mode": robot_mode})
    assert bench.run(5).state is state


def test_each_motion_has_a_program_of_its_own() -> None:
    bench = UrBench().move()
    first = bench.robot.output_registers.ints[27]
    bench.run(200)
    bench.events.clear()
    bench.session.request(bench.player())
    bench.run(4000, until=lambda: not bench.session.requested)
    assert bench.robot.output_registers.ints[27] != first
    # This plan begins where the arm is not any more.
    assert (bench.ended.outcome, "StartMismatch" in bench.ended.reason) == ("refused", True)
    assert bench.run(200).rests and not bench.robot.playing


@pytest.mark.parametrize(
    ("faults", "outcome", "reason", "state"),
    [
        (("stop@{c}",), "lost", "protective stop", State.FAULTED),
        (("emergency-stop@{c}",), "lost", "robot emergency stop", State.DRIVE_OFF),
        (("power-off@{c}",), "lost", "power off", State.DRIVE_OFF),
        (("safeguard@{c}",), "lost", "safeguard stop", State.FREEZING),
        (("pause@{c}",), "lost", "paused", State.FREEZING),
        (("halt@{c}",), "lost", "was stopped there", State.CLOSED),
        (("freedrive@{c}x50",), "refused", "freedrive", State.FAULTED),
        (("slider@{c}x50",), "refused", "speed slider is at 50 %", State.FAULTED),
        (("push@{c}x90",), "refused", "deviation that stops it", State.FAULTED),
        (("push@{c}x300",), "lost", "too far from its set-point", State.FAULTED),
    ],
)
def test_what_happens_at_the_controller_ends_the_motion(
    faults: tuple[str, ...], outcome: str, reason: str, state: State
) -> None:
    bench = UrBench(*(fault.format(c=MIDST) for fault in faults)).move()
    assert (bench.ended.outcome, reason in bench.ended.reason) == (outcome, True), bench.ended
    assert bench.started and bench.state is state
    bench.run(400)
    assert bench.rests
    # Nothing is unlocked, switched on or played again from here.
    assert bench.robot.playing is False
    safety = {"stop": 3, "emergency-stop": 7, "safeguard": 5}
    assert bench.robot.outputs()["safety_mode"] == safety.get(faults[0].partition("@")[0], 1)


@pytest.mark.parametrize(
    ("outputs", "problem", "remedy"),
    [
        ({"robot_status_bits": 0b111}, "a person moves the arm by hand", "release the freedrive"),
        ({"target_speed_fraction": 0.6}, "speed slider is at 60 %", "set it to 100 %"),
        ({"speed_scaling": 0.6}, "slows the arm down to 60 %", "at the pendant for the limit"),
        ({"speed_scaling": np.nan}, "slows the arm down to nan %", "at the pendant for the limit"),
        (
            {"joint_position_deviation_ratio": 0.81},
            "81 % of the deviation",
            "payload and obstacles",
        ),
    ],
)
def test_a_disturbed_motion_is_refused_with_its_remedy(
    outputs: dict[str, float], problem: str, remedy: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = UrBench()
    own = bench.robot.outputs
    monkeypatch.setattr(
        bench.robot, "outputs", lambda: own() | (outputs if bench.robot.cycle >= MIDST else {})
    )
    bench.move()
    (refused,) = [event.error for event in bench.events if isinstance(event, Refused)]
    assert bench.ended.outcome == "refused" and bench.started
    assert problem in str(refused) and remedy in refused.remedy
    assert bench.run(200).rests and not bench.robot.playing


@pytest.mark.parametrize("first", ["stop", "safeguard", "pause"])
@pytest.mark.parametrize("pc_lives", [True, False])
def test_a_program_that_an_operator_resumes_ends_without_moving(first: str, pc_lives: bool) -> None:
    bench = UrBench(f"{first}@{MIDST}", f"resume@{MIDST + 400}")
    bench.silent_from = None if pc_lives else MIDST
    bench.move()
    assert bench.ended.outcome == "lost"
    bench.run(900 - bench.robot.cycle)
    assert bench.travel(MIDST + 399) < 2e-3
    assert bench.rests and not bench.robot.playing


def test_without_the_pc_the_program_stops_the_arm_within_20_ms() -> None:
    bench = UrBench()
    bench.silent_from = MIDST
    bench.move()
    bench.run(300)
    # The last reply is used two cycles after it was sent.
    used = next(k for k in range(MIDST, len(bench.stages)) if bench.stages[k] == 3)
    assert used - (MIDST + 1) <= SILENT
    assert bench.rests and not bench.robot.playing
    assert (bench.ended.outcome, "no new set-point" in bench.ended.reason) == ("lost", True)
    limits = ur_cell().guard_limits
    assert (bench.robot.arm.plant.position < limits.upper).all()


@pytest.mark.parametrize("gap", [1, 2, 3, 4])
@pytest.mark.parametrize("direction", ["to_controller", "to_pc"])
def test_a_short_gap_is_bridged_on_the_path(gap: int, direction: str) -> None:
    bench = UrBench(link=[Lose(MIDST, direction, gap)]).move()
    assert bench.ended.outcome == "completed", bench.ended
    assert bench.run(100).rests


@pytest.mark.parametrize("gap", [5, 6, 20])
@pytest.mark.parametrize("direction", ["to_controller", "to_pc"])
def test_a_longer_one_ends_in_the_stop_of_the_program(gap: int, direction: str) -> None:
    bench = UrBench(link=[Lose(MIDST, direction, gap)]).move()
    assert bench.ended.outcome in ("lost", "refused"), bench.ended
    assert bench.run(300).rests
    assert not bench.robot.playing


def test_replies_lost_again_and_again_stop_the_motion() -> None:
    faults = [Lose(MIDST + 8 * k, "to_controller", 1) for k in range(5)]
    bench = UrBench(link=faults).move()
    assert (bench.ended.outcome, "5 replies were lost" in bench.ended.reason) == ("stopped", True)
    assert bench.run(100).rests


def test_frames_twice_and_late_replies_change_nothing() -> None:
    bench = UrBench(link=[Duplicate(MIDST, count=5), Delay(MIDST + 20, cycles=0.5, count=20)])
    assert bench.move().ended.outcome == "completed"


def test_the_operator_slows_holds_releases_and_stops_it() -> None:
    bench = UrBench()
    bench.run(3)
    bench.session.request(bench.player(by=40.0))
    bench.run(MIDST - 3)
    bench.session.override(0.5)
    bench.run(100)
    bench.session.hold()
    bench.run(400)
    assert bench.rests and bench.state is State.OPEN and bench.robot.playing
    bench.session.resume()
    bench.run(150)
    assert not bench.rests
    bench.session.stop()
    bench.run(2000, until=lambda: not bench.session.requested)
    assert (bench.ended.outcome, bench.state) == ("stopped", State.CLOSED)
    assert bench.run(100).rests and not bench.robot.playing
    assert not bench.session.counters.rejected


C4G_WORDS = re.compile(r"open mode|drive on|cabinet|Open program|C4G|mode \d|TP ")


@pytest.mark.parametrize("check", [*Check])
def test_remedies_have_no_words_of_another_controller(
    check: Check, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = UrBench()

    def refuses(guard: Guard, *arguments: object) -> None:
        if bench.transport.cycle > MIDST:
            raise GuardError(check, 0, 2.0, 1.0, bench.transport.cycle)

    monkeypatch.setattr(Guard, "check_set_point", refuses)
    bench.move()
    (refused,) = [event.error for event in bench.events if isinstance(event, Refused)]
    assert bench.ended.outcome == "refused" and refused.remedy
    assert not C4G_WORDS.search(f"{refused} {refused.remedy}")


class TestBefore:
    """What keeps a motion from beginning; the arm does not move."""

    @pytest.mark.parametrize(
        ("settings", "reason"),
        [
            ({"slider": 0.5}, "speed slider is at 50 %"),
            ({"slider": 0.0}, "speed slider is at 0 %"),
        ],
    )
    def test_state_of_the_controller(self, settings: dict[str, float], reason: str) -> None:
        bench = UrBench(**settings).move()
        assert (bench.ended.outcome, reason in bench.ended.reason) == ("refused", True)
        assert bench.stages[-1] == 0 and bench.travel(0) < 1e-3

    @pytest.mark.parametrize(
        ("table", "reason"),
        [
            ({"cell.serial_number": "20999999999"}, "serial number"),
            ({"controller.rtde.model": "UR10e"}, "type"),
            ({"controller.rtde.calibration": "00ff"}, "calibration"),
        ],
    )
    def test_another_arm(self, table: dict[str, str], reason: str) -> None:
        wrong = ur_cell().with_values(table)
        bench = UrBench(cell=wrong, serial_number="20235500123", kind=1)
        bench.run(5)
        assert bench.session.init is not None
        with pytest.raises(Exception, match=reason):
            bench.session.request(bench.player())

    @pytest.mark.parametrize(
        ("settings", "reason"),
        [
            ({"remote_control": False}, "local mode"),
            ({"version": (5, 9, 4, 0)}, "5.10"),
            ({"version": (3, 10, 0, 0)}, "3.10.0.0; motions need .* or 3.11 or newer of a CB3"),
            ({"version": (3, 15, 8, 0)}, "8 ms in the controller, 2 ms in the cell"),
            ({"version": (10, 7, 0, 0)}, "PolyScope 5"),
        ],
    )
    def test_a_controller_that_is_not_moved(self, settings: dict, reason: str) -> None:
        bench = UrBench(**settings).run(5)
        with pytest.raises(Exception, match=reason):
            bench.session.request(bench.player())

    def test_another_payload(self) -> None:
        bench = UrBench()
        bench.cell = ur_cell()
        heavy = ur_cell().with_values({"robot.payload": {"mass": 2.0, "centre": [0.0, 0.0, 0.05]}})
        light = UrBench(cell=heavy)
        light.robot.settings = bench.robot.settings
        light.move()
        assert (light.ended.outcome, "payload of 0 kg" in light.ended.reason) == ("refused", True)

    def test_another_program(self) -> None:
        bench = UrBench()
        still = np.zeros((6, 1))
        bench.robot._program = UrProgram(bench.cell.initial, still, period=60.0)
        bench.move()
        assert (bench.ended.outcome, "another program" in bench.ended.reason) == ("refused", True)

    def test_a_program_that_does_not_run(self) -> None:
        bench = UrBench()
        bench.robot.upload = lambda text: None  # type: ignore[method-assign]
        bench.move()
        assert (bench.ended.outcome, "did not run within 5 s" in bench.ended.reason) == (
            "refused",
            True,
        )
        assert bench.transport.cycle * PERIOD < 6.0
