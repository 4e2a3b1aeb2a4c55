"""Settings of designs, search problems of cells, and messages about motions."""

from __future__ import annotations

import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.base.toml_text import to_text
from hil.cell import AngleFrame, Cell
from hil.cli import app
from hil.design import METHODS, load_settings, preset, problem_of, search_settings
from hil.design.messages import NoExcitationError, advice_on_branches, no_excitation
from hil.design.settings import (
    FORMER_METHODS,
    SettingsError,
    preset_text,
    recorded_settings,
    settings_of,
)
from hil.new import cell_of_urdf
from identification.excitation import NoFeasibleMotionError, Violation
from identification.excitation.violation import WholeMotion
from identification.model.kinematics import chain_from_urdf
from sim_fixtures.ns16 import CELL_PATH
from tests import messages
from tests.hil.simulated_logs import urdf_path


@pytest.fixture(scope="module")
def cell() -> Cell:
    return Cell.load(CELL_PATH)


def test_presets_have_the_values_of_table_1():
    a = preset("a")
    b = preset("b")
    assert (a.search.population, a.search.generations) == (100, 120)
    assert (a.search.mutation, a.search.crossover, a.search.gradient) == (0.01, 0.7, 0)
    assert a.sines is not None and a.sines.harmonics == 3
    assert a.sines.fastest == [0.94, 2.38, 0.53, 0.44, 0.89, 0.44]
    assert a.sines.slowest == [0.314]
    assert (b.search.population, b.search.generations) == (150, 120)
    assert (b.search.mutation, b.search.crossover, b.search.gradient) == (0.01, 0.9, 0)
    assert b.search.weights == (0.7, 0.3)
    assert b.via_points is not None and b.via_points.n_via == 6


@pytest.mark.parametrize("method", METHODS)
def test_presets_are_files_with_all_constraints_on(method, tmp_path):
    path = tmp_path / "my.toml"
    settings = preset(method)
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
    """Every method can search both kinds of motion; sines have no gradient, only its criteria."""
    assert settings_of({"method": "b"}) == preset("b")
    assert settings_of({}) == preset("gradient")
    mine = settings_of({"method": "b", "via_points": {"n_via": 9}})
    assert mine.via_points.n_via == 9
    assert mine.via_points.fly == 0.5 and mine.search == preset("b").search
    sines = settings_of({"sines": {"harmonics": 5}})
    assert sines.method == "gradient" and sines.via_points is None
    assert sines.sines.harmonics == 5 and sines.sines.length == 20.0
    assert (sines.search.gradient, sines.search.weights) == (0, (0.75, 0.25))
    assert (sines.search.population, sines.search.generations) == (100, 120)
    a = settings_of({"method": "a", "via_points": {}})
    assert a.sines is None and a.via_points == preset("b").via_points


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("[search]\ngradient = 180\n[sines]", ["gradient = 180", "not [sines]", "make it 0"]),
        ('metod = "b"', ["metod", "is not a field", "valid fields", "method"]),
        ('method = "c"', ["method = 'c'", "known are: a, b, gradient"]),
        ("[search]\npopulation = 2", ["search.population = 2", "4 to 10000"]),
        ('[search]\npopulation = "24"', ["search.population = '24'", "4 to 10000"]),
        ('[constraints]\nclosed = "yes"', ["constraints.closed = 'yes'", "true or false"]),
        ("[search]\nweights = [0.7, 0.7]", ["search", "1.4", "add up to 1"]),
        ("[search]\nweights = [1.0]", ["search.weights", "log det"]),
        ("[via_points]\n[sines]", ["both", "[via_points]", "[sines]", "give one"]),
        ("[sines]\nramp = 0.04", ["sines", "a ramp of 0.04 s is too short", "0.05 s or longer"]),
        ("[sines]\nramp = 11.0", ["sines", "two ramps of 11 s", "20 s"]),
        ('[sines]\noffset = "nowhere"', ["sines.offset = 'nowhere'", '"middle"', '"home"']),
        ("[constraints]\nmin_duration = 30.0", ["min_duration = 30 s", "max_duration = 20 s"]),
        ("[[search]]\n", ["search", "is not a table", "a table [search]"]),
        (
            'method = "a"\n[constraints]\nmax_duration = 10.0',
            ["[sines] length = 20 s is not between [constraints] min_duration = 0 s and max_dur"],
        ),
        (
            '[objective]\nparameters = ["mc2y"]',
            ["objective.parameters", "a list of at least two names"],
        ),
        (
            'method = "front"',
            ["method = 'front'", "of version 0.1", "gradient replaced", "leave out method and [se"],
        ),
        ('method = "balanced"\n[sines]', ["method = 'balanced'", "leave out method and [search]"]),
        ("[search]\npolish = 6000", ["search.polish = 6000", "leave it out", "gradient = 180"]),
        ("[search\n", ["is not TOML", "--show-settings"]),
    ],
)
def test_invalid_settings_name_file_field_value_and_remedy(text, named, tmp_path):
    path = tmp_path / "my.toml"
    path.write_text(text)
    with pytest.raises(SettingsError) as caught:
        load_settings(path)
    text = str(caught.value)
    for word in ["my.toml", *named]:
        assert word in text
    for word in ("Value error", "value error", "dictionary", "instance of"):
        assert word not in text
    with pytest.raises(SettingsError, match=r"none\.toml: cannot be read.*give a TOML file"):
        load_settings(tmp_path / "none.toml")


def test_no_polish_is_left_out():
    """Files of version 0.1 state it, mostly as 0."""
    assert settings_of({"method": "b", "search": {"polish": 0}}) == preset("b")


@pytest.mark.parametrize("method", FORMER_METHODS)
@pytest.mark.parametrize("motion", ["via_points", "sines"])
def test_records_of_former_methods_are_read(tmp_path, method, motion):
    """Of a finished design: what it was to add to is needed later."""
    path = tmp_path / "excitation.toml"
    effort = {"population": 100, "generations": 150, "polish": 6000, "gradient": 0}
    objective = {"given": ["runs/mine"]}
    settings = {"method": method, "search": effort, "objective": objective, motion: {}}
    path.write_text(to_text({"format": "designed excitation", "settings": settings}, {}))
    recorded = recorded_settings(path)
    assert recorded.objective.given == ["runs/mine"]
    assert recorded.search.population == 100 and getattr(recorded, motion) is not None
    with pytest.raises(SettingsError, match="gradient replaced"):
        load_settings(path)


def test_motions_through_via_points_are_closed_by_default(cell):
    closed = problem_of(cell, preset("b")).genome
    np.testing.assert_array_equal(closed.home, cell.home)
    open_path = problem_of(cell, preset("b").kinematic())
    assert open_path.genome.home is None
    assert open_path.constraints.checker is None and open_path.constraints.currents is None
    assert open_path.genome.n_genes == (6 + 1) * 6  # K via points and a speed, for each joint


def test_frequencies_are_the_papers_or_those_of_the_limits(cell):
    """Offsets are in the frame of the limits; sines without a ramp need not rest."""
    settings = preset("a").kinematic()
    limits = cell.joint_limits
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


def test_named_parameters_are_in_the_criteria(cell):
    names = cell.model.parameter_names
    chosen = preset("b").kinematic().replaced(objective={"parameters": [names[9], names[2]]})
    np.testing.assert_array_equal(problem_of(cell, chosen).objective.parameters, [2, 9])


@pytest.mark.parametrize(
    ("method", "changes", "message"),
    [
        ("a", {"sines": {"fastest": [1.0, 2.0]}}, r"sines\.fastest.*2 entries.*6 joints.*joint_6"),
        # as it was written, in the angles of the teach pendant
        ("a", {"sines": {"offset": [0.0, 0.0, 120.0, 0.0, 90.0, 0.0]}},
         r"sines\.offset = \[0\.0, 0\.0, 120\.0.*joint_3 = 120 deg is outside its limits, -170 to"
         r" 110 deg \(teach pendant angles\)"),
        ("b", {"objective": {"parameters": ["I1yy", "m9"]}}, "'m9': is not a parameter.*I1yy"),
        ("b", {"objective": {"parameters": ["I1yy"] * 2}}, "named twice"),
    ],
)  # fmt: skip
def test_settings_that_do_not_fit_the_cell_are_refused(cell, method, changes, message):
    with pytest.raises(SettingsError, match=message):
        problem_of(cell, preset(method).kinematic().replaced(**changes))


def test_a_cell_without_drive_train_has_torque_limits_only():
    cell = Cell.load(CELL_PATH)
    start = cell.text.index("[nominal]")
    end = cell.text.index("[limits]")
    without = Cell.from_texts(cell.text[:start] + cell.text[end:], cell.urdf, cell.path)
    assert problem_of(without, preset("b").kinematic()).constraints.currents is None
    with pytest.raises(Exception, match=r"add a table \[nominal\]"):
        problem_of(without, preset("b"))


VIA = preset("b")
SINES = preset("a")


@pytest.mark.parametrize(
    ("settings", "rejected", "remedies"),
    [
        # kinds that exclude more than half, else the most frequent one
        (VIA, {"collision": 900, "current": 501}, {"range_share", "current limits"}),
        (VIA, {"collision": 900, "current": 500}, {"range_share"}),
        (VIA, {"collision": 400, "current": 450}, {"current limits"}),
        (VIA, {"duration": 900}, {"max_duration"}),
        (VIA, {}, {"more via points or fewer parameters"}),
        (SINES, {}, {"more harmonics"}),
    ],
)
def test_frequent_violations_have_remedies(cell, settings, rejected, remedies):
    nearest = {
        kind: Violation(kind, WholeMotion(), 0.01, 0.05, 1.0, (0.0,) * 6) for kind in rejected
    }
    unexciting = 1000 * (not rejected)
    error = NoFeasibleMotionError(rejected, nearest, tried=1000, unexciting=unexciting)
    text = str(no_excitation(error, AngleFrame.of(cell), None, settings))
    advice = text.partition("Possible changes: ")[2]
    possible_remedies = {"range_share", "current limits", "max_duration"} | remedies
    assert {word for word in possible_remedies if word in advice} == remedies


def test_too_large_currents_at_home_are_reported(cell):
    limits = cell.drive_train.current_limit.tolist()
    limits[1] = 0.1
    weak = cell.with_values({"drive_train.current_limit": limits})
    message = r"at home: at rest there, .* of motor of joint_2: [\d.]+ A, must be at most 0\.08 A"
    with pytest.raises(NoExcitationError, match=message) as caught:
        problem_of(weak, VIA)
    assert re.search(r"correct \[drive_train\].*home_deg in \[campaign\]", str(caught.value))
    with pytest.raises(NoExcitationError, match=r"mean posture of the sines.*\[sines\] offset"):
        problem_of(weak, SINES.replaced(sines={"offset": "home"}))
    problem_of(weak, VIA.kinematic())
    folded = SINES.replaced(sines={"offset": [0.0, 90.0, -165.0, 0.0, 90.0, 0.0]})
    with pytest.raises(NoExcitationError, match=messages.COLLISION_IN_MEAN_POSTURE):
        problem_of(cell, folded)


def test_a_tree_of_two_arms_is_advised_to_move_one(cell: Cell) -> None:
    """Of a joint on the base, then two arms of two and one joints."""
    assert advice_on_branches(cell.model.chain) is None
    names = ("turn", "left_1", "left_2", "right_1")
    tree = replace(cell.model.chain, joint_names=names, parents=np.array([-1, 0, 1, 0]))
    advice = advice_on_branches(tree)
    assert advice is not None
    assert "the 4 joints form 2 arms, with the last joints left_2, right_1" in advice
    assert "`hil new --urdf ARM.urdf --fix right_1`" in advice


def test_the_advice_to_move_one_arm_works_when_typed(tmp_path: Path) -> None:
    baxter = urdf_path("baxter.urdf")
    fixed = cell_of_urdf(baxter, {}, moved=True)
    assert fixed.urdf is not None
    advice = advice_on_branches(chain_from_urdf(fixed.urdf)) or ""
    (command,) = re.findall(r"`hil (.*)`", advice)
    arguments = shlex.split(command.replace("ARM.urdf", str(baxter)))
    result = CliRunner().invoke(app, [*arguments, "-o", str(tmp_path / "cell.toml")])
    assert result.exit_code == 0, result.output
    assert "cell.toml: 7 joints (left_s0, " in result.output.replace("\n", " ")
