"""Precision to order: requirements as typed, what a motion promises, and the design command."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.base.errors import HilError, InputError
from hil.campaign.plan import validation_motions
from hil.cli import app
from hil.control.motion_checks import MotionChecks
from hil.design import DesignResult, load_settings, preset, problem_of
from hil.precision.forecast import PrecisionDesign, short_search
from hil.precision.predicted_variances import PredictedRows
from hil.precision.requirements import FORMS, Requirement, require_known, requirements_from
from identification.excitation import midpoints
from tests.hil.fast_cell import QUICK_GRADIENT, fast_cell

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    return fast_cell(tmp_path_factory.mktemp("cell"))


@pytest.fixture(scope="module")
def motions(cell):
    return [motion.trajectory for motion in validation_motions(cell, MotionChecks.of(cell))]


def promise(cell, motions, *texts: str) -> PrecisionDesign:
    return PrecisionDesign.of(cell, requirements_from(texts), motions, ())


class TestRequirements:
    def test_every_form_is_read_and_written_alike(self) -> None:
        for form in FORMS:
            (requirement,) = requirements_from(
                [form.replace("JOINT", "elbow").replace("PARAMETER", "I2m")]
            )
            assert requirements_from([str(requirement)]) == (requirement,)

    def test_they_are_separated_by_commas_or_options(self) -> None:
        expected = (
            Requirement("parameters", "", 0.05, True),
            Requirement("torque", "elbow", 2.0, False),
        )
        assert requirements_from(["parameters 5%, torque of elbow 2 Nm"]) == expected
        assert requirements_from(["parameters 5 %", "torque of elbow 2"]) == expected

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("everything 5%, parameters 5%, colour of arm 3%", "'colour of arm 3%' is not a known"),
            ("parameters", "is not a quantity with a number.*parameters 5 %"),
            (
                "everything 2",
                "has no per cent; write everything 5 %; write one or several of: param",
            ),
            ("parameters 5", "has no per cent; write parameters 5 %"),
            ("torque 2%", "has the unit %; write torque 2, in N·m"),
            ("torque 2 kg", "has the unit kg; write torque 2, in N·m"),
            ("parameters 0%", "no precision above zero"),
            ("parameters -1%", "no precision above zero"),
            ("parameters 5%, parameters 3%", "'parameters 3%' is required twice"),
            ("", "is not a quantity with a number"),
        ],
    )
    def test_others_are_refused_with_a_remedy(self, text: str, message: str) -> None:
        with pytest.raises(InputError, match=message):
            requirements_from([text])

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("torque of wrist 2", "names no joint of this arm; its joints are shoulder, elbow"),
            ("friction of wrist 5%", "names no joint of this arm; its joints are shoulder, elbow"),
            ("friction of the elbow 5%", "names no joint of this arm; similar are elbow"),
            ("I2M 5%", "names no parameter of this arm; similar are I2m"),
            ("gripper 5%", "no parameter .*; write one .*; its parameters are .*I2m"),
        ],
    )
    def test_joints_and_parameters_must_exist(self, cell, text: str, message: str) -> None:
        with pytest.raises(InputError, match=message):
            require_known(requirements_from([text]), cell.model)


class TestPromise:
    def test_repetitions_average_noise_not_model_errors(self, cell, motions) -> None:
        made = promise(cell, motions, "parameters 5%")
        noisy = replace(made, error=1e-3 * made.noise)
        wrong = replace(made, noise=1e-3 * made.error)
        for arm, share in ((noisy, 1.0 / 9.0), (wrong, 1.0)):
            one, nine = (variances(arm, motions[0], count) for count in (1, 9))
            np.testing.assert_allclose(nine.rows, share * one.rows, rtol=0.04)

    def test_they_average_no_bias_of_the_delay(self, cell, motions) -> None:
        """However many, 0.1 ms and what a stated delay of 0.6 cycles is worth beside it remain."""
        made = promise(cell, motions, "parameters 5%")
        noisy = replace(made, error=1e-6 * made.noise)
        some, many = (variances(noisy, motions[0], count) for count in (100, 10_000))
        np.testing.assert_allclose(many.rows, 0.01 * some.rows, rtol=0.02)
        np.testing.assert_allclose(many.delay, some.delay, rtol=0.02)

    def test_a_later_torque_moves_parameters_as_its_rate(self, cell, motions) -> None:
        """By least squares on a regressor that is computed apart, with the torque 0.1 ms later."""
        made = promise(cell, motions, "parameters 5%")
        motion = midpoints(motions[0])
        density = made.precision(1).density
        step = motion.time[1] - motion.time[0]
        blocks, columns = cell.model.regressor(motion)
        torque = cell.model.torque(made.values, motion)
        rate = np.gradient(torque, motion.time, axis=0)
        usable = cell.model.moving(motion.velocity)
        information = made.prior.copy()
        pull = np.zeros(len(made.values))
        left = 0.0
        for joint, (block, used) in enumerate(zip(blocks, columns, strict=True)):
            rows = np.zeros((len(torque), len(made.values)))
            rows[:, used] = block
            rows, rates = rows[usable[:, joint]], rate[usable[:, joint], joint]
            information += step * rows.T @ rows / density[joint]
            pull += step * rows.T @ rates / density[joint]
            left += step * rates @ rates / density[joint]
        moved = np.linalg.solve(information, pull)
        estimated = 1.0 / (left - pull @ moved) + (1e-4) ** 2
        stated = (0.6 * cell.period) ** 2 / 3.0
        expected = moved**2 / (1.0 / estimated + 1.0 / stated)
        found = PredictedRows.of(cell, motion, made.values, rigid=True).variances(
            np.eye(len(moved)), made.prior, density
        )
        # An estimate that can show the stated delay to be wrong is believed a little more.
        np.testing.assert_allclose(found.delay, expected, rtol=0.1)

    def test_gears_of_a_real_arm_may_be_elastic(self, cell, motions) -> None:
        made = promise(cell, motions, "torque 1")
        rigid, elastic = (
            variances(replace(made, rigid=rigid), motions[0], 1) for rigid in (True, False)
        )
        assert np.all(elastic.gears > rigid.gears)
        np.testing.assert_array_equal(elastic.rows, rigid.rows)

    def test_a_simulated_arm_has_the_noise_of_its_currents(self, cell, motions) -> None:
        """A current noise of 0.01 A rms and a resolution of 2 mA, in servo loops of 1 ms."""
        made = promise(cell, motions, "torque 1")
        current = 0.01**2 + 0.002**2 / 12.0
        expected = current * (np.array([0.5, 0.4]) * [100.0, 80.0]) ** 2 * 0.001
        np.testing.assert_allclose(made.noise, expected)
        real = promise(cell.with_values({"controller.transport": "udp"}), motions, "torque 1")
        assert "assumed, 3 %" in real.source
        assert not real.rigid
        assert np.all(real.error > made.error)

    def test_the_promised_repetitions_are_the_least(self, cell, motions) -> None:
        made = promise(cell, motions, "torque 2")
        noisy = replace(made, error=1e-3 * made.noise, noise=1e3 * made.noise)
        excitation = _Excitation(motions[0])
        (forecast,) = noisy.forecasts(excitation, 1)
        assert forecast.repetitions is not None and forecast.repetitions > 2
        halves = [noisy.forecasts(excitation, forecast.repetitions - k)[0].half for k in (0, 1)]
        assert halves[0] <= 2.0 < halves[1]

    def test_the_scale_of_the_torque_is_a_limit(self, tmp_path, motions) -> None:
        """Of absolute parameters: constants to 4 % leave at least 8 %; the remedy is named."""
        uncertain_cell = fast_cell(tmp_path).with_values({"drive_train.torque_uncertainty": 0.04})
        made = promise(uncertain_cell, motions, "parameters 5% absolute")
        (forecast,) = made.forecasts(_Excitation(motions[0]), 30)
        assert forecast.limit > 1.96 * 0.04
        message = forecast.message(30, made.scale)
        assert "no motion of this arm can meet it" in message
        assert "torque constants to 4 %" in message and "torque_uncertainty" in message

    def test_the_scale_is_no_error_in_units_of_the_arms_torque(self, tmp_path, motions) -> None:
        excitation = _Excitation(motions[0])
        halves = {}
        for uncertainty in (0.0, 0.04):
            cell = fast_cell(tmp_path).with_values({"drive_train.torque_uncertainty": uncertainty})
            made = promise(cell, motions, "parameters 5%, parameters 5 % absolute, torque 2")
            own, absolute, torque = made.forecasts(excitation, 2)
            halves[uncertainty] = own.half, absolute.half, torque.half
            assert own.limit == torque.limit == 0.0
        exact = halves[0.0]
        uncertain = halves[0.04]
        assert exact[0] == exact[1] == uncertain[0]
        assert uncertain[2] == exact[2]
        assert uncertain[1] > max(uncertain[0], 1.96 * 0.04)

    def test_a_precision_beyond_a_year_of_motion_is_refused(self, cell, motions) -> None:
        with pytest.raises(InputError, match=r"a year of motion leaves .*; a day leaves"):
            promise(cell, motions, "parameters 1e-9%")

    def test_a_motion_is_longer_where_a_short_one_is_too_short(self, cell, motions) -> None:
        """Intervals fall with the root of the time; there are as many via points per second.

        The motion is as long as 85 % of the required intervals take.
        """
        made = promise(cell, motions, "parameters 5%")
        short = short_search()
        rate = made.reference.information(made.precision(4).density)
        seconds = short.constraints.max_duration
        ratio = made.precision(4).ratios(seconds * rate).max()
        for share, longer in ((1.1 / 0.85, 1.0), (1.0 / 0.85 / 1.5, 2.25)):
            strict = promise(cell, motions, f"parameters {share * 5.0 * ratio}%")
            settings = strict.lengthened(short, 4)
            assert settings.via_points.n_via == pytest.approx(8 * longer, abs=1)
            length = settings.constraints.max_duration
            assert length / settings.via_points.n_via == pytest.approx(seconds / 8, rel=0.01)

    def test_friction_counts_in_both_directions_at_three_speeds(self, cell, motions) -> None:
        made = promise(cell, motions, "friction of elbow 5%")
        speed = max(np.abs(motion.extrema().velocity[1]) for motion in motions)
        coulomb, viscous = made.required.quantities.directions[:3, [-3, -1]].T
        np.testing.assert_allclose(coulomb, 1.0)
        np.testing.assert_allclose(viscous, np.array([0.25, 0.5, 1.0]) * speed, rtol=0.02)
        np.testing.assert_allclose(
            made.required.quantities.allowed[:3], 0.05 * (3.0 + 1.5 * viscous), rtol=1e-6
        )


def variances(made: PrecisionDesign, trajectory, repetitions: float):
    rows = PredictedRows.of(made.cell, midpoints(trajectory), made.values, rigid=made.rigid)
    density = made.precision(repetitions).density
    return rows.variances(made.required.quantities.directions, made.prior, density)


class _Excitation:
    """A motion in place of a design's."""

    def __init__(self, trajectory) -> None:
        self.trajectory = trajectory


class TestCommand:
    def test_a_design_states_what_it_promises(self, cell, tmp_path: Path) -> None:
        (tmp_path / "my.toml").write_text(QUICK_GRADIENT)
        out = tmp_path / "out"
        arguments = ["design", str(cell.path), "--settings", str(tmp_path / "my.toml")]
        arguments += ["--precision", "parameters 5%, torque 5", "-o", str(out), "--workers", "1"]
        result = CliRunner().invoke(app, arguments, catch_exceptions=False)
        assert result.exit_code == 0, result.output
        assert "torque error: of the simulated arm: its current noise" in result.output
        assert "parameters 5 %: " in result.output
        assert "torque 5 N·m: torque of shoulder " in result.output
        promised = DesignResult.load(out).data["precision"]
        assert [entry["requirement"] for entry in promised] == ["parameters 5 %", "torque 5 N·m"]
        requirements = load_settings(out / "excitation.toml").objective.precision
        assert requirements == ["parameters 5 %", "torque 5 N·m"]

    def test_json_has_the_promise(self, cell, tmp_path: Path) -> None:
        arguments = ["design", str(cell.path), "--quick", "--precision", "friction 5%", "--json"]
        result = CliRunner().invoke(
            app, [*arguments, "-o", str(tmp_path / "o"), "--workers", "1"], catch_exceptions=False
        )
        (entry,) = json.loads(result.stdout)["precision"]
        assert entry["requirement"] == "friction 5 %"
        assert 0.0 < entry["half"] < 0.05
        assert entry["repetitions"] == 2  # as many are always run

    def test_a_motion_for_a_payload_lasts_ten_seconds_at_most(self, cell, tmp_path: Path) -> None:
        out = tmp_path / "out"
        stated = ["--payload-mass", "2", "--payload-centre=-0.05,0,0.2"]
        arguments = ["design", str(cell.path), "--for", "payload", *stated]
        arguments += ["-o", str(out), "--workers", "1"]
        result = CliRunner().invoke(app, arguments, catch_exceptions=False)
        assert result.exit_code == 0, result.output
        following = " ".join(["--payload NAME", *stated, "--rehearse"])
        screen = result.output.replace("\\\n", "")  # as a shell joins a command that goes on
        assert f"next: hil run {out} {following}" in screen.replace("\n", " ")
        assert "mass of payload 1 %: mass " in result.output
        assert "after 2 repetitions" in result.output
        design = DesignResult.load(out)
        assert design.excitation.trajectory.duration <= 10.0
        assert design.data["precision"][0]["half"] > 0.0

    @pytest.mark.parametrize("more", [[], ["--for", "payload"]])
    def test_arm_and_payload_need_different_motions(self, cell, tmp_path: Path, more) -> None:
        mixed = "mass of payload 1%, parameters 5%"
        arguments = ["design", str(cell.path), "--precision", mixed, *more]
        with pytest.raises(InputError, match=r"add --for payload, with no other requirement"):
            CliRunner().invoke(app, [*arguments, "-o", str(tmp_path / "o")], catch_exceptions=False)

    def test_a_search_for_another_centre_is_no_continuation(self, cell, tmp_path: Path) -> None:
        """The journal has scores of motions checked with the payload that was stated."""
        arguments = ["design", str(cell.path), "--for", "payload", "--payload-mass", "2"]
        arguments += ["-o", str(tmp_path / "o"), "--workers", "1"]
        CliRunner().invoke(app, arguments, catch_exceptions=False)
        arguments += ["--payload-centre", "0, 0, 0.3", "--resume"]
        with pytest.raises(HilError, match="robot"):
            CliRunner().invoke(app, arguments, catch_exceptions=False)

    def test_a_payload_that_the_arm_cannot_hold_is_refused(self, cell, tmp_path: Path) -> None:
        arguments = ["design", str(cell.path), "--for", "payload", "--payload-mass", "400"]
        with pytest.raises(HilError, match=r"begin at home: .* A.*correct the payload, "):
            CliRunner().invoke(app, [*arguments, "-o", str(tmp_path / "o")], catch_exceptions=False)

    def test_a_centre_without_a_payload_is_refused(self, cell, tmp_path: Path) -> None:
        arguments = ["design", str(cell.path), "--payload-centre", "0,0,0.2"]
        with pytest.raises(InputError, match=r"--payload-centre: .*add --for payload"):
            CliRunner().invoke(app, [*arguments, "-o", str(tmp_path / "o")], catch_exceptions=False)

    def test_methods_without_gradient_are_refused(self, cell, tmp_path) -> None:
        arguments = ["design", str(cell.path), "--method", "b", "--precision", "parameters 5%"]
        with pytest.raises(InputError, match="choose the method gradient"):
            CliRunner().invoke(app, [*arguments, "-o", str(tmp_path / "o")], catch_exceptions=False)
        assert not (tmp_path / "o").exists()


def test_settings_with_requirements_need_what_they_stand_for(cell) -> None:
    settings = preset("gradient").replaced(objective={"precision": ["parameters 5%"]})
    with pytest.raises(InputError, match=r"objective.precision: .*PrecisionDesign"):
        problem_of(cell, settings)
