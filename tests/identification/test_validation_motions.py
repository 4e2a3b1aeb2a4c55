import hashlib
import json

import numpy as np
import pytest

from identification import RobotModel
from identification.excitation import (
    Box,
    CollisionChecker,
    CurrentModel,
    NoFeasibleMotionError,
    Workspace,
    check_motion,
    random_validation_motions,
)
from identification.excitation.collision.hulls import joint_poses
from planner import PlannerCrashed, plan, plan_moves
from sim_fixtures.ns16 import load_truth, urdf_text
from tests.identification.searching import NS16_HOME as HOME
from tests.identification.searching import NS16_LIMITS


@pytest.fixture(scope="module")
def limits():
    return NS16_LIMITS


@pytest.fixture(scope="module")
def model():
    return RobotModel.from_urdf(urdf_text())


@pytest.fixture(scope="module")
def checker():
    return CollisionChecker(urdf_text(), Workspace(margin=0.05))


@pytest.fixture(scope="module")
def make_currents(model):
    def make(share):
        truth = load_truth()
        friction = np.concatenate((truth.coulomb, truth.viscous, np.zeros(6)))
        return CurrentModel(
            model=model,
            values=np.concatenate((model.base.grouping @ model.nominal, friction)),
            motor_from_joint=np.diag([116.0, 116.0, 106.0, 50.0, 51.5, 33.0]),
            torque_constant=np.array([1.1, 1.1, 0.75, 0.36, 0.42, 0.42]),
            current_limit=share * np.array([16.5, 22.0, 9.5, 3.5, 7.0, 10.0]),
        )

    return make


@pytest.fixture(scope="module")
def found(limits, checker, make_currents):
    return random_validation_motions(
        limits, home=HOME, seed=3, count=6, checker=checker, currents=make_currents(1)
    )


def test_motions_are_feasible_wide_and_different(found, limits, checker, make_currents):
    motions = [each.trajectory for each in found]
    assert len(motions) == 6
    for motion in motions:
        assert not check_motion(motion, limits, checker=checker, currents=make_currents(1))
    for one in found[:2]:  # moves plan to the motion bit for bit
        again = plan_moves(one.via_points[0], one.moves, limits)
        assert again.trajectory.to_dict() == one.trajectory.to_dict()
    for motion in motions:
        ends, rates, _ = motion.sample(np.array([0.0, motion.duration]))
        np.testing.assert_allclose(ends, [HOME, HOME], atol=1e-12)
        np.testing.assert_allclose(rates, 0.0, atol=1e-9)
    assert len({motion.duration for motion in motions}) == 6
    low = np.min([motion.extrema().lower for motion in motions], axis=0)
    high = np.max([motion.extrema().upper for motion in motions], axis=0)
    assert np.all((high - low) / (limits.upper - limits.lower) > 0.7)


def test_motions_do_not_depend_on_their_number(found, limits, checker, make_currents):
    again = random_validation_motions(
        limits, home=HOME, seed=3, count=2, checker=checker, currents=make_currents(1)
    )
    assert [m.trajectory.to_dict() for m in again] == [m.trajectory.to_dict() for m in found[:2]]
    other = random_validation_motions(limits, home=HOME, seed=4, count=1)
    assert not np.array_equal(other[0].via_points, found[0].via_points)


def test_the_motions_of_a_seed_never_change(limits):
    # Recorded with the first campaigns; plans of old archives name these seeds.
    found = random_validation_motions(limits, home=HOME, seed=7, count=2)
    text = json.dumps([[m.via_points.tolist(), m.speed.tolist()] for m in found])
    assert (
        hashlib.sha256(text.encode()).hexdigest()
        == "81044cb7520ca0aff3077b96846fdaf58ac975ee6ca4b7021a38891c0c794bf7"
    )


def test_motions_satisfy_the_current_limits(limits, checker, make_currents):
    modest = make_currents(0.5)
    free = random_validation_motions(limits, home=HOME, seed=3, count=6, checker=checker)
    chosen = random_validation_motions(
        limits, home=HOME, seed=3, count=6, checker=checker, currents=modest
    )
    assert any(check_motion(m.trajectory, limits, currents=modest) for m in free)
    assert not any(check_motion(m.trajectory, limits, currents=modest) for m in chosen)


def test_a_motion_that_crashes_its_planner_is_skipped(limits, monkeypatch):
    first, second = random_validation_motions(limits, home=HOME, seed=3, count=2)
    calls = []

    def crash_once(*args, **kwargs):
        calls.append(1)
        if len(calls) == 1:
            raise PlannerCrashed(-11)
        return plan(*args, **kwargs)

    monkeypatch.setattr("identification.excitation.validation_motions.plan_in_child", crash_once)
    other, same = random_validation_motions(limits, home=HOME, seed=3, count=2)
    assert not np.array_equal(other.via_points, first.via_points)
    np.testing.assert_array_equal(same.via_points, second.via_points)


def test_the_error_names_the_violated_constraints(limits, make_currents, monkeypatch):
    with pytest.raises(NoFeasibleMotionError) as refusal:
        random_validation_motions(limits, home=HOME, seed=3, count=1, currents=make_currents(0.01))
    error = refusal.value
    assert error.rejected == {"current": 100}
    mildest = error.nearest["current"]
    assert mildest.subject.startswith("motor of joint_")
    assert mildest.value > mildest.bound
    assert str(mildest) in str(error)
    monkeypatch.setattr("identification.excitation.validation_motions._LONGEST", 2.0)
    with pytest.raises(NoFeasibleMotionError) as refusal:
        random_validation_motions(limits, home=HOME, seed=1, count=1)
    assert refusal.value.rejected == {"duration": 100}
    assert refusal.value.nearest["duration"].bound == 2.0


def test_a_home_posture_in_collision_is_refused_by_the_pair(limits):
    low = CollisionChecker(urdf_text(), Workspace(floor=1.2, margin=0.0))
    with pytest.raises(NoFeasibleMotionError, match="floor at home") as refusal:
        random_validation_motions(limits, home=HOME, seed=1, count=1, checker=low)
    assert refusal.value.nearest["collision"].value < 0.0


def test_a_blocked_cell_is_refused_with_the_obstacle(model, limits, monkeypatch):
    tries = "identification.excitation.validation_motions._TRIES_PER_MOTION"
    monkeypatch.setattr(tries, 3)  # of fifty via points each
    monkeypatch.setattr("identification.excitation.validation_motions._RANGE_SHARE", 0.02)
    middle = (limits.lower + limits.upper) / 2
    wrist = joint_poses(model.chain, middle[None])[1][5, 0]
    crate = Box(tuple(wrist - 0.15), tuple(wrist + 0.15))
    checker = CollisionChecker(urdf_text(), Workspace(boxes=(crate,)))
    assert checker.clear(HOME[None]).all()
    with pytest.raises(NoFeasibleMotionError) as refusal:
        random_validation_motions(limits, home=HOME, seed=1, count=1, checker=checker)
    error = refusal.value
    assert error.rejected == {"collision": 3}
    assert error.nearest["collision"].subject.endswith("and box 0")
    assert len(error.nearest["collision"].posture) == 6
    assert error.nearest["collision"].value < 0.05
