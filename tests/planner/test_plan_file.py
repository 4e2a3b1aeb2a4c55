from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planner import InvalidSetting, JointLimits, plan, to_csv
from planner.errors import InvalidPlanFile
from planner.moves import Move, Overrides, plan_moves
from planner.plan_file import PlanFile
from tests.motion_table import MotionTable
from tests.planner.problems import problems
from tests.planner.six_axes import SIX_AXES, random_points
from tests.tiers import quick_ones

NAMES = tuple(f"joint_{i}" for i in range(1, 7))


@st.composite
def files(draw):
    """Any valid file."""
    points, moves, limits, overrides = draw(problems())
    n = limits.n_joints
    letters = st.text('aé🤖\x7f"\\ .=\n#', min_size=1)
    names = tuple(draw(st.lists(letters, min_size=n, max_size=n, unique=True)))
    overrides, limits = draw(st.sampled_from([(overrides, limits), (Overrides(), None)]))
    return PlanFile(names, points[0], tuple(moves), overrides, limits)


@pytest.mark.safety
@given(files())
@settings(max_examples=150, deadline=None)
def test_json_restores_every_bit(file):
    data = json.dumps(file.to_dict())  # distinguishes -0.0 from 0.0
    assert json.dumps(PlanFile.from_dict(json.loads(data)).to_dict()) == data


@pytest.fixture
def planned():
    points = random_points(3)
    flies = [50.0, 100.0, 0.0, 25.0, 0.0]
    return plan_moves(
        points[0],
        [
            Move(target, speed=0.8, fly_percent=fly)
            for target, fly in zip(points[1:], flies, strict=True)
        ],
        SIX_AXES,
        Overrides(deceleration=0.7),
    )


def test_a_plan_is_restored_to_the_last_bit(planned):
    file = PlanFile.of(planned, NAMES)
    restored = PlanFile.from_dict(json.loads(json.dumps(file.to_dict()))).plan()
    assert restored.targets == planned.targets
    assert PlanFile.of(restored, NAMES).to_dict() == file.to_dict()


def test_the_stored_motion_is_used_not_one_planned_again(planned):
    data = PlanFile.of(planned, NAMES).to_dict()
    jerk = data["motion"]["coefficients"][2][0]
    jerk[3] = np.nextafter(jerk[3], 0.0)  # as another machine may have computed it
    restored = PlanFile.from_dict(data).plan()
    assert restored.trajectory.coefficients[2][0, 3] == jerk[3]


def slower(data):
    data["moves"][0]["speed"] = 0.79


def damaged(row, quantity, by):
    def damage(data):
        data["motion"]["coefficients"][0][row][quantity] *= by

    return damage


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (slower, "delete the motion"),
        (damaged(0, 3, 1.1), "stored motion"),
        (damaged(5, 0, 1.0 + 1e-6), "stored motion"),
    ],
)
def test_a_stored_motion_must_be_that_of_the_moves(planned, edit, message):
    data = PlanFile.of(planned, NAMES).to_dict()
    edit(data)
    edited = PlanFile.from_dict(data)
    with pytest.raises(InvalidPlanFile, match=message):
        edited.plan()
    without = replace(edited, trajectory=None).plan().trajectory.duration
    assert (without > planned.trajectory.duration) == (edit is slower)


HAND_WRITTEN = {
    "format": "joint motion plan",
    "version": 1,
    "joints": ["shoulder", "elbow"],
    "start": [0, 0],
    "limits": {
        "lower": [-1.6, -1.6],
        "upper": [1.6, 1.6],
        "velocity": [2, 2],
        "acceleration": [5, 5],
        "jerk": [50, 50],
    },
    "moves": [
        {"target": [0.5, 1], "fly_percent": 50},
        {"target": [0.5, -1], "fly_percent": 25, "speed": 0.5},
        {"target": [0, 0]},
    ],
}


def test_a_file_can_be_written_by_hand_without_limits():
    complete = PlanFile.from_dict(HAND_WRITTEN)
    assert [move.fly_percent for move in complete.moves] == [50.0, 25.0, 0.0]
    targets = complete.plan().targets
    assert targets[-1].how == "stopped" and targets[0].distance > 0.0
    file = replace(complete, limits=None)
    with pytest.raises(InvalidPlanFile, match="limits"):
        file.plan()
    assert file.plan(complete.limits).duration == complete.plan().duration


CUBIC = {"type": "piecewise_cubic", "knots": [["0", 1]], "coefficients": [[[0] * 4]]}
DAMAGE = [
    ({"version": True}, "version"),
    ({"version": 2}, "version"),
    ({"format": "poem"}, "format"),
    ({"joints": ["a", "a"]}, "named twice"),
    ({"start": [10**400, 0]}, "start"),
    ({"start": ["0", 0]}, "start"),
    ({"moves": [{"target": [1]}]}, "joints are named"),
    ({"moves": [{"target": [1, np.nan]}]}, "finite"),
    ({"moves": [{"target": [1, 1], "speed": 10**400}]}, "speed"),
    ({"moves": [{"target": [1, 1], "fly_percent": True}]}, "fly_percent"),
    ({"moves": [{"target": [1, 1], "fly_percent": 150}]}, "fly percentage"),
    ({"moves": [{"target": [1, 1], "flyby": 50}]}, "flyby: Extra"),
    ({"overrides": {"joint": ["1", 1]}}, "overrides"),
    ({"limits": {"lower": [0, 0]}}, "limits.upper: Field required"),
    ({"limits": HAND_WRITTEN["limits"] | {"lower": [-1, 2]}}, "lower"),
    ({"motion": CUBIC}, "pieces"),
    ({"motion": CUBIC | {"knots": 5}}, "pieces"),
]


@pytest.mark.parametrize(("damage", "problem"), DAMAGE)
def test_errors_of_a_file_are_named(damage, problem):
    with pytest.raises(InvalidPlanFile, match=problem):
        PlanFile.from_dict(HAND_WRITTEN | damage)


def test_a_short_detour_differs_from_the_planned_motion():
    three = [np.full(2, value) for value in (3.0, 2.5, 9.0, 90.0)]
    limits = JointLimits(-three[0], *three)
    points = [[0.0, 0.0], [2.0, 1.0], [-2.0, -1.0]]
    planned = plan_moves(points[0], [Move(point, speed=0.002) for point in points[1:]], limits)
    data = PlanFile.of(planned, ("a", "b")).to_dict()
    assert PlanFile.from_dict(data).plan().duration == planned.duration
    # In the middle of a cruise, out and back within 50 ms of the minutes that it takes.
    knots, pieces = (data["motion"][name][0] for name in ("knots", "coefficients"))
    cruise = int(np.argmax(np.diff(knots)))
    begin = knots[cruise] + 100.0
    part = 0.05 / 8
    p, v, a, _ = pieces[cruise]
    state = [p + 100.0 * v, v, a]
    times = []
    detour = []
    for index, sign in enumerate((1, -1, -1, 1, -1, 1, 1, -1)):
        times.append(begin + index * part)
        detour.append([*state, 80.0 * sign])
        p, v, a = state
        j = 80.0 * sign
        state = [
            p + part * (v + part * (a / 2 + part * j / 6)),
            v + part * (a + part * j / 2),
            a + part * j,
        ]
    times.append(begin + 0.05)
    detour.append([*pieces[cruise][:1], *pieces[cruise][1:]])
    detour[-1][0] += (times[-1] - knots[cruise]) * pieces[cruise][1]
    knots[cruise + 1 : cruise + 1] = times
    pieces[cruise + 1 : cruise + 1] = detour
    with pytest.raises(InvalidPlanFile, match="differs from the one planned"):
        PlanFile.from_dict(data).plan()


class TestMotionAsCsv:
    JOINTS = ("axis 1", "wrist, long", "j3", "j4", "j5", "j6")

    @pytest.mark.parametrize("rate", quick_ones([7.0], [7.0, 100.0, 1000.0 / 3.0]))
    def test_it_has_every_bit_of_the_samples(self, rate):
        motion = plan(random_points(1), SIX_AXES)
        text = to_csv(motion, rate, self.JOINTS)
        assert text.startswith(
            "time [s],axis 1.position [rad],axis 1.velocity [rad/s],axis 1.acceleration [rad/s^2],"
        )
        table = MotionTable.of(text)
        assert table.joint_names == self.JOINTS
        assert table.duration == motion.duration
        np.testing.assert_array_equal(table.time[:-1], np.arange(len(table.time) - 1) / rate)
        assert 0.0 < table.time[-1] - table.time[-2] <= 1.0 / rate + 1e-9
        rows = (table.position, table.velocity, table.acceleration)
        for ours, theirs in zip(rows, motion.sample(table.time), strict=True):
            assert ours.tobytes() == np.ascontiguousarray(theirs).tobytes()

    @pytest.mark.parametrize(
        ("points", "rate", "name"),
        [
            *((random_points(1), rate, "rate") for rate in (0.0, np.nan, 1.01e5)),
            (np.zeros((2, 6)), 10.0, "duration"),
        ],
    )
    def test_an_impossible_rate_or_duration_is_refused(self, points, rate, name):
        with pytest.raises(InvalidSetting, match=name):
            to_csv(plan(points, SIX_AXES), rate, self.JOINTS)
