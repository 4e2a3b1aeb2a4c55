"""Errors of the fit beside those of the prediction; and what is said where nothing is predicted."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer

from hil.cli.verdict import as_json, finish, table
from hil.errors import InputError
from hil.identify import Identification, Options, identify_archives
from hil.identify.prepared import prepare_sources
from hil.identify.sources import gather_sources
from hil.identify.surroundings import nominal_of, surroundings_of
from hil.importers import ColumnMap, Robot, import_log
from hil.progress import Silent
from hil.report import render_report
from tests.hil.simulated_logs import simulate

LATE = np.array([0.012, 0.012, 0.012, 0.004, 0.004, 0.004])  # s


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An imported UR5 whose torques lag by another time on the wrist than on the arm."""
    folder = tmp_path_factory.mktemp("log")
    time = np.arange(0.0, 16.0, 4e-3)
    made = simulate("ur5_robot.urdf", time, noise=0.3)
    torque = np.column_stack(
        [np.interp(time - late, time, one) for late, one in zip(LATE, made.torque.T, strict=True)]
    )
    np.savetxt(folder / "log.csv", np.column_stack([time, made.position, torque])[10:])
    (folder / "map.toml").write_text(
        "[time]\ncolumn = 0\n[position]\ncolumns = [1, 2, 3, 4, 5, 6]\n"
        "[torque]\ncolumns = [7, 8, 9, 10, 11, 12]\n"
    )
    return import_log(
        folder / "log.csv",
        folder / "log.mcap",
        robot=Robot.from_urdf(made.urdf),
        columns=ColumnMap.load(folder / "map.toml"),
    )


PLAIN = Options(torque_bandwidth=None, delay="auto")


@pytest.fixture(scope="module")
def split(log: Path) -> Identification:
    return identify_archives([log], Silent(), PLAIN)


@pytest.fixture(scope="module")
def whole(log: Path) -> Identification:
    return identify_archives([log], Silent(), replace(PLAIN, in_sample=True))


def test_the_error_of_the_fit_stands_beside_that_of_the_prediction(split: Identification) -> None:
    results = split.results
    assert results.judgement is not None and results.fitted is not None
    for joint, fitted in zip(results.judgement.joints, results.fitted.relative_error, strict=True):
        assert joint.fitted_relative == pytest.approx(fitted)
        assert joint.fitted_relative != joint.relative
    assert "fitted" in table(results)[0] and "in-sample" in results.fitted.words


class TestCalibration:
    """Held-out means of torque beside their 95 % intervals."""

    def test_the_intervals_of_held_out_torque_are_honest(self, split: Identification) -> None:
        """4.8 s of six axes, white noise: nine or ten block means each, all but a few inside."""
        found = split.results.calibration
        assert found is not None
        assert 54 <= found.means <= 60
        assert found.inside >= 0.9
        assert len(found.joint_inside) == len(found.half_width) == 6

    def test_the_line_stands_on_the_terminal_and_in_the_report(
        self, split: Identification, capsys: pytest.CaptureFixture[str]
    ) -> None:
        results = split.results
        assert results.calibration is not None
        line = results.calibration.words(results.joint_names)
        with suppress(typer.Exit):
            finish(results, json=False)
        assert line in " ".join(capsys.readouterr().err.split())
        assert line in render_report(results, split.series)
        assert json.loads(as_json(results))["calibration"]["means"] == results.calibration.means

    def test_the_joint_with_the_fewest_is_named(self, split: Identification) -> None:
        found = split.results.calibration
        assert found is not None
        shares = [1.0, 0.5, None, 1.0, 0.9, 1.0]
        words = found.model_copy(update={"joint_inside": shares, "inside": 0.88}).words("abcdef")
        assert words.startswith("88.0% of") and "50% of b" in words

    def test_nothing_held_out_is_nothing_said(self, whole: Identification) -> None:
        assert whole.results.calibration is None


def test_in_sample_everything_is_fitted_and_nothing_is_called_good(
    whole: Identification, split: Identification
) -> None:
    results = whole.results
    assert results.judgement is not None and results.fitted is not None
    assert results.judgement.in_sample and results.validation == [] and results.essential is None
    assert not results.verdict.good
    assert "in-sample" in results.verdict.line and "nothing held out" in results.verdict.line
    assert "unseen motion well" not in results.verdict.line
    assert results.excitation.executed.n_samples > split.results.excitation.executed.n_samples
    for joint, fitted in zip(results.judgement.joints, results.fitted.relative_error, strict=True):
        assert joint.relative == pytest.approx(fitted)
    assert "in-sample" in table(results)[0] and "relative" not in table(results)[0]


def test_nothing_can_be_held_out_where_all_is_fitted(log: Path) -> None:
    with pytest.raises(InputError, match="in-sample"):
        gather_sources([log], 0.7, [log], in_sample=True)


def test_delays_that_were_compensated_axis_by_axis_are_no_doubt(split: Identification) -> None:
    delays = split.results.delays
    assert delays is not None
    np.testing.assert_allclose(delays.applied, LATE, atol=1e-3)
    found = [one for one in split.verdict.findings if one.check == "delay"]
    assert [one.level for one in found] == ["good"]


def test_delays_that_were_not_are_one_doubt_with_its_remedy(log: Path) -> None:
    prepared = prepare_sources(gather_sources([log], 0.7), replace(PLAIN, delay=0.0), Silent())
    assert prepared.assumed_delay.tolist() == [0.0] * 6
    assert not any("delay" in note for note in prepared.notes)
    assert prepared.delays is not None
    assert np.nanmax(prepared.delays.delays) > 0.01


def test_a_urdf_with_masses_is_a_nominal_model_without_friction(split: Identification) -> None:
    nominal, judgement = nominal_of(split.cell), split.results.judgement
    assert nominal is not None and judgement is not None
    assert judgement.nominal is not None and "without friction" in judgement.nominal
    model = split.cell.model
    assert not nominal.values[model.base.rank :].any()
    for joint in judgement.joints:
        assert joint.nominal_relative is not None and joint.relative is not None
        assert joint.nominal_relative > 2.0 * joint.relative


def test_a_slip_of_an_encoder_is_the_reason_that_is_given(log: Path) -> None:
    prepared = prepare_sources(gather_sources([log], 0.7), PLAIN, Silent())
    source = prepared.sources.training[0]
    position = source.recording.position.copy()
    position[len(position) // 2 :, 2] += 0.02
    slipped = replace(source, recording=replace(source.recording, position=position))
    sources = replace(prepared.sources, training=(slipped,))
    estimate = identify_archives([log], Silent(), PLAIN).estimate.pooled
    jumps = surroundings_of([log], replace(prepared, sources=sources), estimate).jumps
    assert [jump.joint for jump in jumps] == [source.recording.joint_names[2]]


def test_a_script_reads_delays_and_undetermined_parameters(split: Identification) -> None:
    found = json.loads(as_json(split.results))
    assert found["undetermined"] == []
    np.testing.assert_allclose(found["delays"]["applied"], LATE, atol=1e-3)
    assert found["in_sample"] is False
    assert found["fitted"]["overall_relative_error"] > 0.0
