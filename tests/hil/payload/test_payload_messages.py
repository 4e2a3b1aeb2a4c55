"""A payload in words: what it says follows from its values."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from hil.base.errors import InputError
from hil.payload.payload_found import (
    BareCheck,
    CorrectMapScale,
    EstimateConstants,
    NextStep,
    PayloadFound,
    PlainStep,
    ScaledTorque,
)
from hil.payload.payload_messages import (
    controller_commands,
    outside_lines,
    payload_as_json,
    payload_lines,
    step_lines,
)
from hil.pipeline.notes import RepairedArchive
from hil.pipeline.torque_scale import ScaleSource, TorqueScale
from identification.estimators.payload_estimate import NAMES, PayloadEstimate
from identification.factor.estimation_method import TimeBlocks
from identification.hypotheses.gravity_direction import GravityDirection
from identification.model.pseudo_inertia import Body
from identification.validation.finding import Finding

BODY = Body(4.0, np.array([0.0, 0.09, 0.12]), np.diag([0.01, 0.02, 0.015]))
HALVES = np.array([0.1, *[0.002] * 3, *[0.001] * 6])
SOUND = BareCheck(("one", "two"), None, ())
WALL = GravityDirection(np.array([0.0, 0.0, -9.81]), np.array([0.0, -9.81, 0.0]), 0.04)
SILENT = Finding("no torque", "wrong", "resolve the torque", joints=(1,))
STEPS: dict[NextStep, str] = {
    PlainStep.CHECK_CONSTANTS: "repeat with --check mass=KG",
    PlainStep.RECORD_BARE: "record the same motion without it",
    ScaledTorque(0.8, 5.0): "too large by a factor of 0.800 if the load weighs 5 kg",
    CorrectMapScale(1.25): "scale = 1.2500 times the present one",
}
LOAD = dict(zip(NAMES[:4], (5.0, 0.0, 0.09, 0.12), strict=True))
COMMAND = EstimateConstants((Path("a.mcap"),), (Path("b c.mcap"),), "tool0", LOAD)


def found(check: BareCheck = SOUND, undetermined: tuple[str, ...] = ()) -> PayloadFound:
    values = np.array([4.0, 0.0, 0.09, 0.12, 0.01, 0.02, 0.015, 0.0, 0.0, 0.0])
    intervals = np.column_stack([values - HALVES, values + HALVES])
    estimate = PayloadEstimate(
        values, BODY, intervals, (0.6, 0.58, 0.62), undetermined, (), TimeBlocks(96, 0.125)
    )
    return PayloadFound(
        estimate=estimate,
        body=BODY,
        frame="tool0",
        gravity=9.81,
        bare=("a.mcap",),
        loaded=("b.mcap",),
        scale=TorqueScale(np.array([0.03, 0.03]), by_currents=True, source=ScaleSource.DATA_SHEET),
        bare_check=check,
        typed=((Path("a.mcap"),), (Path("b.mcap"),)),
        with_currents=True,
        warnings=(),
    )


class TestExpected:
    def test_a_value_outside_has_its_interval(self) -> None:
        (outside,) = found().outside({"mass": 5.0, "cz": 0.121})
        assert (outside.figure.name, outside.expected) == ("mass", 5.0)
        assert outside_lines([outside]) == ["mass 5 kg is outside the 95 % interval 3.9 to 4.1 kg"]

    def test_another_name_is_refused(self) -> None:
        with pytest.raises(InputError, match="'size' is not a property"):
            found().outside({"size": 1.0})

    def test_without_a_known_mass_the_constants_are_checked(self) -> None:
        assert found().next_steps({"cz": 0.2}) == (PlainStep.CHECK_CONSTANTS,)

    def test_what_was_recorded_decides_the_step(self) -> None:
        """Currents show torque constants if the arm was recorded bare as well."""
        by_torque = replace(found(), with_currents=False)
        by_model = replace(found(), bare=())
        scaled = ScaledTorque(0.8, 5.0)
        assert by_torque.next_steps({"mass": 5.0}) == (scaled, CorrectMapScale(1.25))
        assert by_model.next_steps({"mass": 5.0}) == (scaled, PlainStep.RECORD_BARE)

    def test_the_known_load_has_expected_mass_and_found_centre(self) -> None:
        _, step = found().next_steps({"mass": 5.0, "cx": 0.01})
        assert isinstance(step, EstimateConstants)
        assert step.load["mass"] == 5.0
        assert [step.load[name] for name in NAMES[1:4]] == [0.01, 0.09, 0.12]
        assert step.load["Iyy"] == pytest.approx(1.25 * 0.02)

    def test_an_inertia_that_is_not_determined_is_no_part_of_it(self) -> None:
        _, step = found(undetermined=NAMES[4:]).next_steps({"mass": 5.0})
        assert isinstance(step, EstimateConstants)
        assert step.load.keys() == {*NAMES[:4]}

    @pytest.mark.parametrize(("step", "words"), STEPS.items(), ids=list(STEPS.values()))
    def test_each_step_has_words(self, step: NextStep, words: str) -> None:
        (line,) = step_lines([step])
        assert words in line

    def test_torque_constants_are_estimated_by_a_command(self) -> None:
        (line,) = step_lines([COMMAND])
        assert line.endswith(
            ": hil torque-constants a.mcap --loaded 'b c.mcap' --mass 5"
            " --centre=0.0000,0.0900,0.1200 --frame tool0"
        )

    def test_every_step_is_tried(self) -> None:
        assert {*map(type, STEPS), EstimateConstants} == {*get_args(NextStep)}
        assert {*PlainStep} < STEPS.keys()


class TestDoubts:
    def test_another_mounting_leaves_no_settings(self) -> None:
        on_wall = found(replace(SOUND, mounting=WALL))
        document = payload_as_json(on_wall)
        assert on_wall.is_doubtful
        assert controller_commands(on_wall) == document["controllers"] == {}
        assert "with gravity (0.00, -9.81, 0.00) m/s²" in document["mounting"]
        assert "90° from the declared" in document["mounting"]
        assert any(
            line == f"The mounting is doubtful: {document['mounting']}. No controller settings."
            for line in payload_lines(on_wall)
        )

    def test_what_is_certain_forbids_settings_and_the_rest_warns(self) -> None:
        certain = found(replace(SOUND, findings=(SILENT,)))
        uncertain = found(replace(SOUND, findings=(replace(SILENT, level="doubtful"),)))
        (line,) = payload_as_json(certain)["otherwise"]
        assert certain.is_doubtful and not uncertain.is_doubtful
        assert line.startswith("the measured torque of two is zero")
        assert payload_as_json(certain)["warnings"] == []
        assert payload_as_json(uncertain)["warnings"] == [line]
        assert f"warning: {line}" in payload_lines(uncertain)

    def test_a_note_of_both_recordings_is_written_once(self) -> None:
        both = replace(found(), warnings=(RepairedArchive(), RepairedArchive()))
        assert payload_as_json(both)["warnings"] == ["data were lost when it was repaired"]


def test_figures_that_are_not_determined_have_no_value() -> None:
    document = payload_as_json(found(undetermined=("cx",)))
    assert document["figures"]["cx"]["value"] is None
    assert document["figures"]["cz"] == {
        "value": 0.12,
        "interval": [pytest.approx(0.118), pytest.approx(0.122)],
        "unit": "m",
    }
    assert any(
        "is at ?, 90.0, 120.0 mm" in line for line in payload_lines(found(undetermined=("cx",)))
    )
