"""Settings of designs, search problems of cells, and messages about motions."""

from __future__ import annotations

import math
import re
import time
import tomllib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.cell import AngleFrame, Cell
from hil.design import METHODS, DesignSettings, load_settings, preset, problem_of, search_settings
from hil.design.advice import NoExcitationError, margins, no_excitation, weakest
from hil.design.problem import EarlierEstimate
from hil.design.settings import SettingsError, preset_text, settings_of
from hil.motion_checks import MotionChecks
from identification.excitation import (
    CollisionChecker,
    NoFeasibleMotionError,
    Objective,
    Violation,
    check_motion,
    sampled,
)
from identification.model.payload import Load, Payload
from planner import FourierSeries
from planner.toml_text import Angles, from_text, to_text
from sim_fixtures.ns16 import CELL_PATH
from tests.docs.typed import ROOT


@pytest.fixture(scope="module")
def cell() -> Cell:
    return Cell.load(CELL_PATH)


def test_presets_have_the_values_of_table_1():
    a, b = preset("a"), preset("b")
    assert (a.search.population, a.search.generations) == (100, 120)
    assert (a.search.mutation, a.search.crossover, a.search.polish) == (0.01, 0.7, 0)
    assert a.sines is not None and a.sines.harmonics == 3
    assert a.sines.fastest == [0.94, 2.38, 0.53, 0.44, 0.89, 0.44]
    assert a.sines.slowest == [0.314]
    assert (b.search.population, b.search.generations) == (150, 120)
    assert (b.search.mutation, b.search.crossover, b.search.polish) == (0.01, 0.9, 0)
    assert b.search.weights == (0.7, 0.3)
    assert b.via_points is not None and b.via_points.n_via == 6


@pytest.mark.parametrize("method", METHODS)
def test_presets_are_files_with_all_constraints_on(method, tmp_path):
    path, settings = tmp_path / "my.toml", preset(method)
    path.write_text(preset_text(method))
    assert load_settings(path) == settings
    assert settings.method == search_settings(settings).method == method
    given = settings.constraints
    assert given.closed and given.collision and given.current
    bare = settings.kinematic().constraints
    assert not (bare.closed or bare.collision or bare.current)
    assert bare.max_duration == given.max_duration == 20.0
    changed = settings.replaced(seed=7, search={"mutation": 1 / 3})
    path.write_text(to_text(changed.to_dict(), {"search": "how"}))
    assert load_settings(path) == changed


def test_missing_settings_are_those_of_the_preset():
    """All methods can search both kinds of motion."""
    assert settings_of({"method": "b"}) == preset("b")
    assert settings_of({}) == preset("front")
    mine = settings_of({"method": "b", "via_points": {"n_via": 9}})
    assert mine.via_points.n_via == 9
    assert mine.via_points.fly == 0.5 and mine.search == preset("b").search
    front = settings_of({"method": "front", "sines": {"harmonics": 5}})
    assert front.via_points is None
    assert front.sines.harmonics == 5 and front.sines.length == 20.0
    a = settings_of({"method": "a", "via_points": {}})
    assert a.sines is None and a.via_points == preset("b").via_points


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('metod = "b"', ["metod", "is not a field", "valid fields", "method"]),
        ('method = "c"', ["method = 'c'", "a, b, balanced, front"]),
        ("[search]\npopulation = 2", ["search.population = 2", "4 to 10000"]),
        ('[search]\npopulation = "24"', ["search.population = '24'", "4 to 10000"]),
        ("[search]\npopulation = true", ["search.population = True", "4 to 10000"]),
        ('[constraints]\nclosed = "yes"', ["constraints.closed = 'yes'", "true or false"]),
        ("[search]\nmutation = 1.5", ["search.mutation = 1.5", "0 to 1"]),
        ("[search]\nweights = [0.7, 0.7]", ["search", "1.4", "add up to 1"]),
        ("[search]\nweights = [1.0]", ["search.weights", "log det"]),
        ("[via_points]\nn = 6", ["via_points.n", "valid fields", "n_via"]),
        ("[via_points]\nslowest = 0.0", ["via_points.slowest = 0.0", "above 0, at most 1"]),
        ("[via_points]\n[sines]", ["both", "[via_points]", "[sines]", "give one"]),
        ("[sines]\nramp = 0.04", ["sines", "a ramp of 0.04 s is too short", "0.05 s or longer"]),
        ("[sines]\nramp = 11.0", ["sines", "two ramps of 11 s", "20 s"]),
        ("[sines]\nfastest = [1.0, -1.0]", ["sines.fastest", "rad/s"]),
        ('[sines]\noffset = "nowhere"', ["sines.offset = 'nowhere'", '"middle"', '"home"']),
        ("[constraints]\nmin_duration = 30.0", ["min_duration = 30 s", "max_duration = 20 s"]),
        ("[constraints]\nmax_duration = inf", ["constraints.max_duration", "above 0"]),
        ("[[search]]\n", ["search", "is not a table", "a table [search]"]),
        (
            'method = "a"\n[constraints]\nmax_duration = 10.0',
            ["[sines] length = 20 s is not between [constraints] min_duration = 0 s and max_dur"],
        ),
        ("seed = -1", ["seed = -1", "0 or more"]),
        ("[objective]\nparameters = []", ["objective.parameters", '"all"', "hil identify"]),
        (
            '[objective]\nparameters = ["mc2y"]',
            ["objective.parameters", "a list of at least two names"],
        ),
        (
            '[objective]\nparameters = ["mc2y", "mc2z"]\nmax_relative_std = 30.0',
            ["objective", "leave one of them out"],
        ),
        ("[search\n", ["is not TOML", "--show-settings"]),
    ],
)
def test_invalid_settings_name_file_field_value_and_remedy(text, words, tmp_path):
    path = tmp_path / "my.toml"
    path.write_text(text)
    with pytest.raises(SettingsError) as caught:
        load_settings(path)
    text = str(caught.value)
    for word in ["my.toml", *words]:
        assert word in text
    for word in ("Value error", "value error", "dictionary", "instance of"):
        assert word not in text
    with pytest.raises(SettingsError, match=r"none\.toml: cannot be read.*name a TOML file"):
        load_settings(tmp_path / "none.toml")


def test_motions_through_via_points_are_closed_by_default(cell):
    closed = problem_of(cell, preset("b")).genome
    np.testing.assert_array_equal(closed.home, cell.home)
    open_path = problem_of(cell, preset("b").kinematic())
    assert open_path.genome.home is None
    assert open_path.constraints.checker is None and open_path.constraints.currents is None
    assert open_path.genome.n_genes == (6 + 1) * 6  # K via points and a speed, for each joint


def test_frequencies_are_the_papers_or_those_of_the_limits(cell):
    """Offsets are in the frame of the limits; sines without a ramp need not rest."""
    settings, limits = preset("a").kinematic(), cell.joint_limits
    slowest, fastest = problem_of(cell, settings).genome.frequency_range
    np.testing.assert_array_equal(slowest, np.full(6, 0.314))
    np.testing.assert_array_equal(fastest, [0.94, 2.38, 0.53, 0.44, 0.89, 0.44])
    of_limits = problem_of(cell, settings.replaced(sines={"fastest": "from limits"})).genome
    room = (limits.upper - limits.lower) / 2.0
    np.testing.assert_allclose(of_limits.frequency_range[1], np.sqrt(limits.acceleration / room))
    for offset in ("home", [0.0, 0.0, -90.0, 0.0, 90.0, 0.0]):
        genome = problem_of(cell, settings.replaced(sines={"offset": offset})).genome
        np.testing.assert_array_equal(genome.centre, cell.home)
    assert problem_of(cell, settings).constraints.at_rest
    assert not problem_of(cell, settings.replaced(sines={"ramp": 0.0})).constraints.at_rest
    with pytest.raises(SettingsError, match=r"sines\.fastest.*2 entries.*6 joints.*joint_6"):
        problem_of(cell, settings.replaced(sines={"fastest": [1.0, 2.0]}))


def test_an_offset_outside_the_limits_is_named_as_it_was_written(cell):
    offset = [0.0, 0.0, 120.0, 0.0, 90.0, 0.0]
    with pytest.raises(SettingsError) as caught:
        problem_of(cell, preset("a").kinematic().replaced(sines={"offset": offset}))
    text = str(caught.value)
    assert f"sines.offset = {offset}" in text
    assert "joint_3 = 120 deg is outside its limits, -170 to 110 deg" in text
    assert "teach pendant angles" in text and "rad" not in text


def test_unchecked_constraints_are_named():
    assert preset("b").unchecked == preset("a").unchecked == ()
    everything = ("floor", "walls", "the arm itself", "motor currents")
    assert preset("b").kinematic().unchecked == everything
    bare = preset("a").replaced(sines={"ramp": 0.0}, constraints={"current": False})
    assert bare.unchecked == ("motor currents", "rest at both ends")


def test_named_parameters_are_in_the_criteria(cell):
    names = cell.model.parameter_names
    settings = preset("b").kinematic()
    chosen = settings.replaced(objective={"parameters": [names[9], names[2]]})
    objective = problem_of(cell, chosen).objective
    np.testing.assert_array_equal(objective.parameters, [2, 9])
    for wrong, words in (([names[0], "m9"], "a parameter.*I1yy"), ([names[0]] * 2, "named twice")):
        with pytest.raises(SettingsError, match=words):
            problem_of(cell, settings.replaced(objective={"parameters": wrong}))


def test_a_cell_without_drive_train_has_torque_limits_only():
    cell = Cell.load(CELL_PATH)
    start, end = cell.text.index("[nominal]"), cell.text.index("[limits]")
    without = Cell.from_texts(cell.text[:start] + cell.text[end:], cell.urdf, cell.path)
    assert problem_of(without, preset("b").kinematic()).constraints.currents is None
    with pytest.raises(Exception, match=r"add a table \[nominal\]"):
        problem_of(without, preset("b"))


def known_of(names: tuple[str, ...], values: np.ndarray, std: np.ndarray) -> EarlierEstimate:
    p = len(names)
    return EarlierEstimate(names, values, std, np.ones(6), np.eye(p), samples=100, repetitions=30)


def test_parameters_with_a_large_deviation_are_left_out(cell):
    names, p = cell.model.parameter_names, cell.model.n_parameters
    known = known_of(names, np.full(p, -2.0), np.linspace(0.01, 3.0, p))
    settings = preset("b").kinematic().replaced(objective={"max_relative_std": 30.0})
    objective = problem_of(cell, settings, known).objective
    np.testing.assert_array_equal(objective.parameters, np.flatnonzero(known.std <= 0.6))
    assert objective.repetitions == 30 and objective.earlier_samples == 100
    with pytest.raises(SettingsError, match=r"max_relative_std = 30.*--earlier"):
        problem_of(cell, settings)
    too_good = settings.replaced(objective={"max_relative_std": 0.1})
    with pytest.raises(SettingsError, match="leaves 0 parameters"):
        problem_of(cell, too_good, known)
    nothing = known_of(("a", "b"), np.array([0.0, 1.0]), np.array([0.1, math.inf]))
    assert np.all(np.isinf(nothing.relative_std))


@given(
    angles=st.lists(st.floats(-1e3, 1e3), max_size=8),
    numbers=st.lists(st.floats(allow_nan=False), max_size=4),
    words=st.text(st.characters(exclude_categories=["Cs"]), max_size=12),
    key=st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=6).filter(
        lambda name: not name.endswith("_deg")
    ),
)
def test_text_restores_every_bit(angles, numbers, words, key):
    data = {
        "turn": Angles(angles),
        "rows": Angles([angles, angles]),
        "numbers": numbers,
        "inner": {key: words, "below": {"yes": True, "count": 3}},
        "many": [{"angle": Angles(angle), "name": words} for angle in angles],
    }
    text = to_text(data, {"inner": "what it is"})
    tomllib.loads(text)
    back = from_text(text)
    assert repr(back["turn"]) == repr(angles) and repr(back["rows"]) == repr([angles, angles])
    assert repr(back["numbers"]) == repr(numbers)
    assert back["inner"] == data["inner"]
    assert [row["name"] for row in back["many"]] == [words] * len(angles)
    with pytest.raises(ValueError, match=r"turn_deg.*'far'"):
        from_text('turn_deg = [1.0, "far"]')


class TestPayload:
    @pytest.mark.parametrize("method", METHODS)
    def test_a_motion_for_a_payload_takes_ten_seconds(self, method):
        asked = preset(method).for_payload()
        assert asked.objective.parameters == "payload"
        assert asked.constraints.max_duration == 10.0
        assert asked.sines is None or asked.sines.length <= 10.0

    def test_the_objective_has_ten_parameters_of_the_payload(self, cell):
        """The regressor is that of the load alone."""
        objective = problem_of(cell, preset("front").for_payload()).objective
        assert objective.n_parameters == 10
        rng = np.random.default_rng(2)
        q, qd, qdd = rng.uniform(-1.0, 1.0, (3, 5, 6))
        load = Payload(3.0, (0.1, -0.05, 0.2), (0.02, 0.001, 0.0, 0.03, 0.002, 0.04))
        expected = Load(cell.model.chain, cell.model.gravity, load).torque(q, qd, qdd)
        torque = objective.model.torque(load.parameters, q, qd, qdd)
        np.testing.assert_allclose(torque, expected, atol=1e-9)

    def test_parameters_that_no_motion_separates_are_left_out(self):
        """Mass, moments in the plane and Iyy act on two joints about y."""
        flat = Cell.load(ROOT / "examples" / "two_joints" / "cell.toml")
        objective = problem_of(flat, preset("front").for_payload()).objective
        assert objective.parameters is not None
        names = [objective.model.parameter_names[k] for k in objective.parameters]
        assert names == ["Iyy", "mcx", "mcz", "m"]

    def test_earlier_archives_are_refused(self, cell):
        names = cell.model.parameter_names
        known = known_of(names, np.ones(len(names)), np.ones(len(names)))
        with pytest.raises(SettingsError, match=r"known.*leave out --earlier"):
            problem_of(cell, preset("front").for_payload(), known)


VIA, SINES = preset("b"), preset("a")
CONTACT = Violation("collision", "link_2 and link_4", 0.01, 0.05, 1.0, (0.0,) * 6)
DEEPER = Violation("collision", "link_1 and link_6", -0.1, 0.05, 2.0, (0.0,) * 6)
CURRENT = Violation("current", "motor of joint_2", 12.0, 10.0, 1.0, (0.0,) * 6)


def duration(value: float, bound: float) -> Violation:
    return Violation("duration", "the motion", value, bound, None)


def message(cell: Cell, settings: DesignSettings, rejected: dict, nearest: list, **more) -> str:
    found = {violation.kind: violation for violation in nearest}
    error = NoFeasibleMotionError(rejected, found, **({"tried": 1000} | more))
    return str(no_excitation(error, AngleFrame.of(cell), None, settings))


def advised(*arguments, **more) -> str:
    return message(*arguments, **more).partition("Possible changes: ")[2]


@pytest.mark.parametrize(
    ("settings", "rejected", "more", "words", "absent"),
    [
        # Every kind that excludes more than half.
        (VIA, {"collision": 900, "current": 501}, {}, ("range_share", "current limits"), ""),
        (VIA, {"collision": 900, "current": 500}, {}, ("range_share",), "current limits"),
        (VIA, {"collision": 400, "current": 450}, {}, ("current limits",), "range_share"),
        (VIA, {"collision": 1000}, {}, ("[via_points]",), "evaluate more"),
        (VIA, {"current": 1000}, {}, ("[via_points]",), "evaluate more"),
        # Sines have other remedies; after a small search a larger one is proposed.
        (SINES, {"collision": 1000}, {}, ("[sines] offset",), "via"),
        (SINES, {"current": 1000}, {}, ("[sines] slowest, fastest",), "via"),
        (VIA, {"collision": 24}, {"tried": 24}, ("evaluate more than 24 motions",), "nan"),
        (VIA, {"collision": 100}, {"unexciting": 900}, ("more via points or fewer parameters",),
         "range_share"),
    ],
)  # fmt: skip
def test_frequent_violations_have_remedies(cell, settings, rejected, more, words, absent):
    nearest = [one for one in (CONTACT, CURRENT) if one.kind in rejected]
    advice = advised(cell, settings, rejected, nearest, **more)
    assert all(word in advice for word in words)
    assert not absent or absent not in advice


@pytest.mark.parametrize(
    ("value", "asked", "words", "longer"),
    [
        (18.5, (0.0, 0.5), "the shortest motion lasts 18.5 s, allowed are 0 to 0.5 s", False),
        (22.0, (0.0, 20.0), "allow more time", True),
        (12.0, (60.0, 100.0), "the longest motion lasts 12 s, allowed are 60 to 100 s", False),
        (20.3, (19.9, 20.0), "allowed are 19.9 to 20 s: allow more time", True),
    ],
)
def test_a_duration_is_reported_with_its_limits(cell, value, asked, words, longer):
    settings = VIA.replaced(constraints={"min_duration": asked[0], "max_duration": asked[1]})
    bound = asked[value > asked[1]]
    advice = advised(cell, settings, {"duration": 100}, [duration(value, bound)], tried=100)
    assert words in advice and ("evaluate more" in advice) is longer


def test_the_closest_motion_has_one_violation_of_each_kind(cell):
    rejected, closest = {"collision": 1000, "current": 1000}, (CONTACT, DEEPER, CURRENT)
    sentence = message(cell, VIA, rejected, [CONTACT, CURRENT], closest=closest)
    breaks = sentence.partition("closest to feasible violates ")[2]
    assert breaks.count("collision of") == 1 and "link_1 and link_6" in breaks
    assert breaks.count("current of") == 1


def test_too_large_currents_at_home_are_reported(cell):
    limits = cell.drive_train.current_limit.tolist()
    limits[1] = 0.1
    weak = cell.with_values({"drive_train.current_limit": limits})
    words = r"at home: at rest there, .* of motor of joint_2: [\d.]+ A, must be at most 0\.08 A"
    with pytest.raises(NoExcitationError, match=words) as caught:
        problem_of(weak, VIA)
    assert re.search(r"correct \[drive_train\].*home_deg in \[campaign\]", str(caught.value))
    with pytest.raises(NoExcitationError, match=r"mean posture of the sines.*\[sines\] offset"):
        problem_of(weak, SINES.replaced(sines={"offset": "home"}))
    problem_of(weak, VIA.kinematic())
    folded = SINES.replaced(sines={"offset": [0.0, 90.0, -165.0, 0.0, 90.0, 0.0]})
    with pytest.raises(NoExcitationError, match=r"in the mean posture of the sines: collision of"):
        problem_of(cell, folded)


# Margins and weak directions of a motion


def swinging(cell: Cell, joints: list[int], frequency: float = 1.0) -> FourierSeries:
    """Small sines about home of some joints."""
    amplitude, frequencies = np.zeros((6, 1)), frequency * (1.0 + 0.3 * np.arange(6.0))[:, None]
    amplitude[joints] = 0.2
    return FourierSeries(cell.home, amplitude, frequencies, 12.0, 2.0)


def test_margins_name_the_motor_and_the_pair(cell):
    problem = problem_of(cell, preset("b"))
    motion = swinging(cell, [0, 1, 2])
    began = time.perf_counter()
    found = margins(cell, problem, motion)
    assert time.perf_counter() - began < 1.0
    currents, pair = found.split("; ")
    assert currents.startswith("current at most ") and "% of its limit (motor of joint_" in currents
    assert pair.startswith("nearest 0.") and "(link_" in pair
    assert margins(cell, problem_of(cell, preset("b").kinematic()), motion) == ""  # not checked

    # The checks agree: a slightly lower limit or wider margin is violated.
    share = float(currents.split()[3]) / 100.0
    checks = MotionChecks.of(cell)
    for factor, ok in ((share + 0.01, True), (share - 0.01, False)):
        limited = type(checks.currents)(
            **{**vars(checks.currents), "current_limit": factor * checks.currents.current_limit}
        )
        assert (not check_motion(motion, cell.joint_limits, currents=limited)) is ok


def test_the_nearest_pair_does_not_depend_on_the_margin(cell):
    narrow = cell.with_values({"workspace.margin": 0.01})
    motion = swinging(cell, [0, 1, 2])
    wide, found = (
        margins(each, problem_of(each, preset("b")), motion).partition("nearest ")[2]
        for each in (cell, narrow)
    )
    assert wide == found
    distance, (first, second) = float(found.split()[0]), re.findall(r"\((\S+), (.+)\)", found)[0]
    near = CollisionChecker(
        cell.urdf, replace(cell.workspace, margin=distance + 0.006), limits=cell.joint_limits
    )
    contact = near.deepest_contact(sampled(motion).position)
    assert contact is not None and (contact.first, contact.second) == (first, second)


def test_weakly_excited_parameters_are_named(cell):
    still = weakest(Objective(cell.model), swinging(cell, [0, 1, 2, 3, 4]))
    assert {"I6zz", "f0_6", "f1_6"} & set(still)
    names = cell.model.parameter_names
    chosen = [names.index(name) for name in ("f0_1", "f1_1", "f0_2", "f1_2")]
    objective = Objective(cell.model, parameters=np.array(sorted(chosen)))
    found = weakest(objective, swinging(cell, [0, 1]))
    assert found and set(found) <= {"f0_1", "f1_1", "f0_2", "f1_2"}
    assert {name[-1] for name in found[:2]} in ({"1"}, {"2"})  # the two of one joint
