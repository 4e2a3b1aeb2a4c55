from __future__ import annotations

import json

import numpy as np
import pytest

from identification import RobotModel
from identification.excitation import (
    Box,
    CollisionChecker,
    Criteria,
    CurrentModel,
    DesignError,
    Drawing,
    Excitation,
    NoFeasibleMotionError,
    Workspace,
    check_motion,
    random_search,
    random_validation_motions,
)
from identification.excitation.collision import joint_poses
from identification.excitation.constraints import sampled
from planner import JointLimits, PlannerCrashed, plan, plan_moves
from sim_fixtures.ns16 import load_truth, urdf_text

DEG = np.pi / 180.0
HOME = DEG * np.array([0.0, -90.0, 180.0, 0.0, 90.0, 0.0])


@pytest.fixture(scope="module")
def limits():
    velocity = DEG * np.array([155.0, 155.0, 170.0, 360.0, 350.0, 550.0])
    return JointLimits(
        lower=DEG * np.array([-180.0, -140.0, -20.0, -360.0, -120.0, -360.0]),
        upper=DEG * np.array([180.0, 5.0, 260.0, 360.0, 120.0, 360.0]),
        velocity=velocity,
        acceleration=velocity / 0.3,
        jerk=velocity / 0.03,
    )


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
        standard = model.nominal
        friction = np.concatenate((truth.coulomb, truth.viscous, np.zeros(6)))
        values = np.concatenate((model.base.grouping @ standard, friction))
        return CurrentModel(
            model=model,
            values=values,
            motor_from_joint=np.diag([116.0, 116.0, 106.0, 50.0, 51.5, 33.0]),
            torque_constant=np.array([1.1, 1.1, 0.75, 0.36, 0.42, 0.42]),
            current_limit=share * np.array([16.5, 22.0, 9.5, 3.5, 7.0, 10.0]),
        )

    return make


@pytest.fixture(scope="module")
def found(model, limits, checker, make_currents):
    return random_search(
        model, limits, home=HOME, seed=3, candidates=20, checker=checker, currents=make_currents(1)
    )


def test_what_is_found_keeps_every_constraint_and_ends_where_it_began(
    found, limits, checker, make_currents
):
    check = check_motion(found.trajectory, limits, checker=checker, currents=make_currents(1))
    assert check.ok
    np.testing.assert_array_equal(found.via_points[[0, -1]], [HOME, HOME])
    assert found.via_points.shape == (8, 6)
    q, qd, _ = found.trajectory.sample(np.array([0.0, found.trajectory.duration]))
    np.testing.assert_allclose(q, [HOME, HOME], atol=1e-12)
    np.testing.assert_allclose(qd, 0.0, atol=1e-9)
    assert np.all(found.trajectory.extrema().velocity <= found.speed * limits.velocity)
    again = plan(found.via_points, limits, speed=found.speed, fly=found.fly)
    assert again.to_dict() == found.trajectory.to_dict()


def test_its_criteria_are_the_papers_equations_taken_literally(found, model):
    motion = sampled(found.trajectory, 0.008)
    phi = model.regressor(motion.position, motion.velocity, motion.acceleration)
    phi = phi.dense(model.n_parameters).reshape(-1, model.n_parameters)
    n, p = len(motion.time), model.n_parameters
    # scaled columns and extended precision are for the solver only; eq. 5 and 7 as printed
    sign, log_det = np.linalg.slogdet(phi.T @ phi)
    assert sign == 1.0
    criterion = log_det / np.log(10.0) - p * np.log10(n)
    length = np.linalg.norm(phi, axis=0)
    psi = np.linalg.inv((phi / length).T @ (phi / length))
    scaled = np.abs(psi) / np.sqrt(np.outer(np.diag(psi), np.diag(psi)))
    coupling = np.sum(np.triu(scaled, 1))
    fitness = 0.7 * criterion + 0.3 * (p * (p - 1) / 2) / coupling
    assert (p, found.criteria.n_samples) == (58, n)
    assert found.criteria.log10_det == pytest.approx(criterion, abs=1e-6)
    assert found.criteria.coupling_index == pytest.approx(coupling, rel=1e-6)
    assert found.criteria.fitness == pytest.approx(fitness, rel=1e-6)


def test_one_seed_gives_one_motion_and_another_gives_another(
    found, model, limits, checker, make_currents
):
    def search(seed):
        return random_search(
            model,
            limits,
            home=HOME,
            seed=seed,
            candidates=20,
            checker=checker,
            currents=make_currents(1),
        )

    assert search(3).to_dict() == found.to_dict()
    assert not np.array_equal(search(4).via_points, found.via_points)


def test_more_candidates_never_give_less(found, model, limits, checker, make_currents):
    notes = []
    short = random_search(
        model,
        limits,
        home=HOME,
        seed=3,
        candidates=5,
        checker=checker,
        currents=make_currents(1),
        progress=notes.append,
    )
    assert short.criteria.fitness <= found.criteria.fitness
    assert len(notes) == 5
    assert notes[-1] == f"fitness {short.criteria.fitness:.1f}"
    # and the best is better than a plain motion to and fro
    plain = plan([HOME, HOME + 0.3, HOME], limits)
    assert found.criteria.fitness > Criteria.of(model, plain).fitness


def test_an_excitation_survives_being_written_down(found):
    restored = Excitation.from_dict(json.loads(json.dumps(found.to_dict())))
    assert restored.to_dict() == found.to_dict()
    assert restored.criteria == found.criteria
    np.testing.assert_array_equal(restored.via_points, found.via_points)


def test_motions_that_ask_for_too_much_current_are_counted_and_not_chosen(
    model, limits, checker, make_currents
):
    currents = make_currents(0.55)
    search = {"home": HOME, "seed": 3, "checker": checker, "currents": currents}
    modest = random_search(model, limits, candidates=20, **search)
    assert 0 < modest.rejected["current"] < 20
    assert check_motion(modest.trajectory, limits, currents=currents).ok


def test_a_motion_whose_planning_kills_its_process_is_infeasible_and_no_more(
    model, limits, checker, monkeypatch
):
    calls = []

    def crash_twice(*args, **kwargs):
        calls.append(1)
        if len(calls) <= 2:
            raise PlannerCrashed(-11)
        return plan(*args, **kwargs)

    monkeypatch.setattr("identification.excitation.design.plan_in_child", crash_twice)
    chosen = random_search(model, limits, candidates=5, home=HOME, seed=3, checker=checker)
    assert chosen.rejected["planning"] == 2


def test_when_nothing_is_feasible_the_error_says_what_forbids_it_where_and_by_how_much(
    model, limits, checker, make_currents
):
    with pytest.raises(NoFeasibleMotionError) as refusal:
        random_search(
            model,
            limits,
            home=HOME,
            seed=3,
            candidates=4,
            checker=checker,
            currents=make_currents(0.1),
        )
    error = refusal.value
    assert error.rejected == {"current": 4}
    mildest = error.nearest["current"]
    assert mildest.subject.startswith("motor of joint_")
    assert mildest.value > mildest.bound
    assert str(mildest) in str(error)


def test_a_home_posture_in_collision_is_refused_by_the_pair(model, limits):
    low = CollisionChecker(urdf_text(), Workspace(floor=1.2, margin=0.0))
    with pytest.raises(NoFeasibleMotionError, match="floor at home") as refusal:
        random_search(model, limits, home=HOME, seed=1, candidates=3, checker=low)
    assert refusal.value.nearest["collision"].value < 0.0


def test_a_cell_that_is_full_where_the_arm_should_go_is_refused_by_the_obstacle(model, limits):
    middle = (limits.lower + limits.upper) / 2
    wrist = joint_poses(model.chain, middle[None])[1][5, 0]
    crate = Box(tuple(wrist - 0.15), tuple(wrist + 0.15))
    checker = CollisionChecker(urdf_text(), Workspace(boxes=(crate,)))
    drawing = Drawing(range_share=0.02)
    assert checker.first_contact(HOME[None]) is None
    with pytest.raises(NoFeasibleMotionError) as refusal:
        random_search(
            model, limits, home=HOME, seed=1, candidates=2, drawing=drawing, checker=checker
        )
    error = refusal.value
    assert error.rejected == {"collision": 2}
    assert error.nearest["collision"].subject.endswith("and box 0")
    assert len(error.nearest["collision"].posture) == 6
    assert error.nearest["collision"].value < 0.05


@pytest.mark.parametrize(
    ("drawing", "bound"),
    [(Drawing(max_duration=2.0), 2.0), (Drawing(min_duration=50.0), 50.0)],
)
def test_durations_outside_their_range_are_refused(model, limits, drawing, bound):
    with pytest.raises(NoFeasibleMotionError) as refusal:
        random_search(model, limits, home=HOME, seed=1, candidates=3, drawing=drawing)
    assert refusal.value.rejected == {"duration": 3}
    assert refusal.value.nearest["duration"].bound == bound


def test_via_points_stay_in_the_share_of_the_range_they_are_given(model, limits):
    drawing = Drawing(range_share=0.2, speed=(0.3, 0.3))
    centre = (limits.lower + limits.upper) / 2
    found = random_search(model, limits, home=centre, seed=1, candidates=3, drawing=drawing)
    reach = np.abs(found.via_points - centre) / (limits.upper - limits.lower)
    assert np.all(reach <= 0.1)
    np.testing.assert_array_equal(found.speed, 0.3)


def test_validation_motions_are_feasible_wide_and_never_the_excitation(
    found, limits, checker, make_currents
):
    drawn = random_validation_motions(
        limits, home=HOME, seed=3, count=6, checker=checker, currents=make_currents(1)
    )
    motions = [each.trajectory for each in drawn]
    assert len(motions) == 6
    for motion in motions:
        assert check_motion(motion, limits, checker=checker, currents=make_currents(1)).ok
        np.testing.assert_allclose(motion.sample_one(0.0)[0], HOME)
        assert motion.to_dict() != found.trajectory.to_dict()
    assert len({motion.duration for motion in motions}) == 6
    low = np.min([motion.extrema().lower for motion in motions], axis=0)
    high = np.max([motion.extrema().upper for motion in motions], axis=0)
    assert np.all((high - low) / (limits.upper - limits.lower) > 0.7)
    again = random_validation_motions(
        limits, home=HOME, seed=3, count=2, checker=checker, currents=make_currents(1)
    )
    assert [m.trajectory.to_dict() for m in again] == [m.to_dict() for m in motions[:2]]


def test_what_was_drawn_plans_to_the_motion_bit_for_bit(found, limits, checker, make_currents):
    (drawn,) = random_validation_motions(
        limits, home=HOME, seed=3, count=1, fly=0.3, checker=checker, currents=make_currents(1)
    )
    assert drawn.fly == 0.3
    for motion in (drawn, found):
        np.testing.assert_array_equal(motion.via_points[[0, -1]], [HOME, HOME])
        again = plan_moves(motion.via_points[0], motion.moves, limits)
        assert again.trajectory.to_dict() == motion.trajectory.to_dict()


def test_validation_gives_up_by_name(limits, make_currents):
    with pytest.raises(NoFeasibleMotionError, match="current"):
        random_validation_motions(limits, home=HOME, seed=3, count=1, currents=make_currents(0.01))


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("candidates", {"candidates": 0}),
        ("n_via", {"n_via": 0}),
        ("home", {"home": HOME + 10.0}),
        ("home", {"home": HOME[:5]}),
        ("home", {"home": HOME * np.nan}),
    ],
)
def test_settings_outside_their_range_are_refused(model, limits, name, settings):
    with pytest.raises(DesignError) as refusal:
        random_search(model, limits, **{"home": HOME, "seed": 1, **settings})
    assert refusal.value.name == name


@pytest.mark.parametrize(
    "settings",
    [
        {"speed": (0.0, 1.0)},
        {"speed": (0.9, 0.5)},
        {"speed": (0.5, 1.1)},
        {"range_share": 0.0},
        {"range_share": 1.1},
        {"min_duration": 5.0, "max_duration": 4.0},
        {"max_duration": -1.0, "min_duration": -2.0},
    ],
)
def test_drawings_outside_their_range_are_refused(settings):
    with pytest.raises(DesignError):
        Drawing(**settings)
