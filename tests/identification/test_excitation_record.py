from __future__ import annotations

import json
from dataclasses import asdict

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identification.excitation import Excitation
from identification.excitation.criteria import Criteria
from planner import FourierSeries, JointLimits, plan, plan_moves

LIMITS = JointLimits(
    lower=np.array([-2.0, -1.0, -3.0]),
    upper=np.array([2.0, 1.5, 3.0]),
    velocity=np.array([1.0, 2.0, 3.0]),
    acceleration=np.array([4.0, 5.0, 9.0]),
    jerk=np.array([40.0, 50.0, 90.0]),
)


def planned(seed: int, fly: float = 0.5) -> Excitation:
    random = np.random.default_rng(seed)
    points = random.uniform(LIMITS.lower, LIMITS.upper, (5, 3))
    speed = random.uniform(0.2, 1.0, 3)
    return Excitation(
        trajectory=plan(points, LIMITS, speed=speed, fly=fly),
        criteria=Criteria(*random.normal(size=3).tolist(), 700, 1e5, 12.25),
        method="b",
        seed=seed,
        tried=12,
        rejected={"duration": 3, "collision": 1},
        via_points=points,
        speed=speed,
        fly=fly,
    )


def sines(seed: int) -> Excitation:
    random = np.random.default_rng(seed)
    amplitude, frequency = random.uniform(0.1, 1.0, (2, 3, 2))
    return Excitation(
        trajectory=FourierSeries(np.zeros(3), amplitude, frequency, 20.0, 2.0),
        criteria=Criteria(*random.normal(size=3).tolist(), 2501),
        method="a",
        seed=seed,
        tried=100,
        rejected={},
    )


def through_json(excitation: Excitation) -> Excitation:
    return Excitation.from_dict(json.loads(json.dumps(excitation.to_dict())))


@given(
    make=st.sampled_from([planned, lambda seed: planned(seed, 0.0), sines]),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=30, deadline=None)
def test_every_bit_of_an_excitation_comes_back(make, seed):
    excitation = make(seed)
    restored = through_json(excitation)
    assert restored.to_dict() == excitation.to_dict()
    assert restored.criteria == excitation.criteria
    assert (restored.method, restored.seed, restored.tried, dict(restored.rejected)) == (
        excitation.method,
        excitation.seed,
        excitation.tried,
        excitation.rejected,
    )
    times = np.linspace(0.0, excitation.trajectory.duration, 101)
    assert type(restored.trajectory) is type(excitation.trajectory)
    for ours, theirs in zip(
        restored.trajectory.sample(times), excitation.trajectory.sample(times), strict=True
    ):
        np.testing.assert_array_equal(ours, theirs)
    if restored.via_points is not None:  # its moves plan to the motion bit for bit
        again = plan_moves(restored.via_points[0], restored.moves, LIMITS)
        assert again.trajectory.to_dict() == excitation.trajectory.to_dict()


def test_sines_have_no_moves_and_say_nothing_of_via_points():
    excitation = through_json(sines(1))
    assert excitation.moves is None
    assert (excitation.via_points, excitation.speed, excitation.fly) == (None, None, None)
    assert not {"via_points", "speed", "fly"} & excitation.to_dict().keys()


def test_records_from_before_methods_still_load():
    excitation = planned(5)
    old = excitation.to_dict()
    del old["method"]
    for name in ("condition", "scaled_condition"):
        del old["criteria"][name]
    restored = Excitation.from_dict(old)
    assert restored.method == "random"
    assert (restored.criteria.condition, restored.criteria.scaled_condition) == (None, None)
    assert restored.criteria.log10_det == excitation.criteria.log10_det
    np.testing.assert_array_equal(restored.via_points, excitation.via_points)


@pytest.mark.parametrize(
    "damage",
    [
        {"trajectory": {"type": "fourier_series"}},
        {"trajectory": {"type": "fourier_series", "length": "long"}},
        {"criteria": {"log10_det": 1.0}},
        {"criteria": {**sines(1).to_dict()["criteria"], "beauty": 1.0}},
        {"seed": "first"},
        {"seed": float("inf")},
        {"seed": 10**400},
        {"method": "\ud800"},
        {"trajectory": []},
        {"trajectory": {"type": "spline"}},
        {"trajectory": sines(1).trajectory.to_dict() | {"length": 10**400}},
        {"trajectory": sines(1).trajectory.to_dict() | {"amplitude": [[10**400], [1]]}},
        {"criteria": {}},
        {"criteria": asdict(sines(1).criteria) | {"log10_det": "x"}},
        {"rejected": 3},
        {"rejected": {"limits": "many"}},
    ],
)
def test_data_that_are_no_excitation_are_refused(damage):
    with pytest.raises(ValueError, match="not an excitation"):
        Excitation.from_dict({**sines(1).to_dict(), **damage})


@pytest.mark.parametrize("missing", ["trajectory", "criteria", "seed", "rejected", "via_points"])
def test_data_that_lack_something_are_refused(missing):
    data = planned(1).to_dict()
    del data[missing]
    with pytest.raises(ValueError, match=f"not an excitation.*{missing}"):
        Excitation.from_dict(data)
