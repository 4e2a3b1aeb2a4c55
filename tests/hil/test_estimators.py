"""`hil identify --estimator ...`: every estimator on one campaign, and what is said beside it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import cast
from xml.etree import ElementTree

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.campaign import Campaign
from hil.cell import Cell
from hil.cli import app
from hil.errors import InputError
from hil.identify import Options
from hil.identify.cad_prior import FRICTION_SHARE, cad_prior
from hil.identify.estimating import NARROWEST, Estimation, estimate_with, widely_smoothed
from hil.identify.options import ESTIMATORS, Estimator
from hil.identify.prepared import Prepared, prepare_sources
from hil.identify.sources import gather_sources
from hil.identify.summary import uncertainty_result
from hil.progress import Silent
from hil.results import SCHEMA_VERSION, Results
from hil.simulation import planted_values
from identification.estimators.consistent import SolverError
from identification.estimators.prior import GaussianPrior
from identification.estimators.shrinkage import Shrinkage


def archives(campaign: Campaign) -> list[Path]:
    kinds = ("excitation", "validation", "standstill")
    return [path for kind in kinds for path in campaign.folder.completed(kind)]


@pytest.fixture(scope="module")
def prepared(campaign: Campaign) -> Prepared:
    """Rows that slide: how friction turns round at reversals is not asked here."""
    sources = gather_sources(archives(campaign), 0.7)
    return prepare_sources(sources, Options(standstill="slow"), Silent())


@pytest.fixture(scope="module")
def estimations(prepared: Prepared) -> dict[Estimator, Estimation]:
    return {name: estimate_with(prepared, Options(estimator=name), Silent()) for name in ESTIMATORS}


@pytest.fixture(scope="module")
def written(campaign: Campaign, tmp_path_factory: pytest.TempPathFactory) -> Results:
    """What `hil identify --estimator huber --json` leaves in a folder."""
    folder = tmp_path_factory.mktemp("huber")
    command = ["identify", str(campaign.folder.root), "--estimator", "huber", "--json"]
    ran = CliRunner().invoke(app, [*command, "--output", str(folder)])
    assert ran.exit_code == 0, ran.output
    assert json.loads(ran.stdout)["good"] is True
    assert "How it was estimated" in (folder / "report.html").read_text()
    results = Results.load(folder / "results.json")
    assert results.exports is not None
    assert all((folder / name).exists() for name in results.exports.written)
    return results


# What they find


@pytest.mark.parametrize("name", ESTIMATORS)
def test_every_estimator_finds_the_planted_arm(
    name: Estimator, estimations: dict[Estimator, Estimation], prepared: Prepared
) -> None:
    """In torque on the fitted motion, where all parameters count by what they do."""
    found = estimations[name]
    truth = planted_values(prepared.sources.cell)
    error = found.result.pooled.values - truth
    gram = found.result.factor.gram
    squares = np.einsum("i,jik,k->j", error, gram[:, :-1, :-1], error)
    assert np.sqrt(squares / gram[:, -1, -1]).max() < 0.005
    assert found.estimator == name
    assert len(found.result.repetitions) == len(prepared.fitted)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_its_standard_deviations_hold_the_truth(
    name: Estimator, estimations: dict[Estimator, Estimation], prepared: Prepared
) -> None:
    pooled = estimations[name].result.pooled
    distance = np.abs(pooled.values - planted_values(prepared.sources.cell)) / pooled.std
    assert np.count_nonzero(distance > 3.5) <= 3  # of 58, by chance 0.03; three of one motion


def test_the_methods_say_which_is_which(estimations: dict[Estimator, Estimation]) -> None:
    said = {name: found.result.pooled.method for name, found in estimations.items()}
    said.pop("auto")  # which is one of the others, or between two
    assert len(set(said.values())) == len(said)
    for name, word in (
        ("wls", "weighted"), ("ols", "ordinary"), ("huber", "Huber"), ("tukey", "Tukey"),
        ("prior", "prior"), ("consistent", "consistent"), ("iv", "instrumental"),
    ):  # fmt: skip
        assert word in said[cast(Estimator, name)]


def test_held_out_motion_is_reduced_recording_by_recording(
    estimations: dict[Estimator, Estimation], prepared: Prepared
) -> None:
    held_out = estimations["wls"].held_out
    rows = [one.samples.sum() for one in held_out]
    assert rows == [int(samples.usable.sum()) for samples in prepared.held_out]


# What is said beside


def test_noise_in_the_regressor_is_tested_for_wherever_commands_were_recorded(
    estimations: dict[Estimator, Estimation],
) -> None:
    for found in estimations.values():
        assert not isinstance(found.endogeneity, str)
        assert 0.0 <= found.endogeneity.p_value <= 1.0
        # The bias of so good an encoder is no doubt about the result.
        assert not any("biased" in doubt for doubt in found.warnings)


def test_where_no_command_was_recorded_it_is_said_that_this_was_not_tested(
    prepared: Prepared,
) -> None:
    found = estimate_with(uncommanded(prepared), Options(), Silent())
    assert isinstance(found.endogeneity, str)
    assert "could not be tested: the recordings hold no commanded positions" in found.endogeneity
    with pytest.raises(InputError, match=r"--estimator iv.*no commanded positions.*use --est"):
        estimate_with(uncommanded(prepared), Options(estimator="iv"), Silent())


def uncommanded(prepared: Prepared) -> Prepared:
    sources = prepared.sources
    training = tuple(
        replace(source, recording=replace(source.recording, commanded_position=None))
        for source in sources.training
    )
    return replace(prepared, sources=replace(sources, training=training))


def test_noisy_positions_are_smoothed_wider_for_instruments(prepared: Prepared) -> None:
    narrow = replace(
        prepared,
        fitted=tuple(
            replace(samples, position_bandwidth=np.full(6, 8.0)) for samples in prepared.fitted
        ),
    )
    model = prepared.sources.cell.model
    for samples in widely_smoothed(model, narrow):
        np.testing.assert_allclose(samples.position_bandwidth, NARROWEST, rtol=0.05)
    wide = replace(
        prepared,
        fitted=tuple(
            replace(samples, position_bandwidth=np.full(6, 40.0)) for samples in prepared.fitted
        ),
    )
    assert widely_smoothed(model, wide) == wide.fitted


# The prior


def test_the_prior_comes_from_the_urdf_and_the_nominal_table(cell: Cell) -> None:
    prior = cad_prior(cell)
    assert isinstance(prior, GaussianPrior)
    model, table = cell.model, cell.nominal
    place = model.parameter_names.index("f0_3")
    assert prior.mean[place] == table.coulomb[2]
    assert prior.std[place] == pytest.approx(FRICTION_SHARE * table.coulomb[2])
    np.testing.assert_allclose(prior.mean, cell.nominal_values(), rtol=1e-12)
    assert np.isfinite(prior.std[: model.base.rank]).all()


def test_a_urdf_without_inertia_gives_no_prior_and_says_so(cell: Cell) -> None:
    empty = replace(cell, urdf=without_inertia(cell.urdf))
    words = cad_prior(empty)
    assert isinstance(words, str)
    assert "no inertia" in words


def without_inertia(urdf: str) -> str:
    root = ElementTree.fromstring(urdf)
    for link in root.iter("link"):
        for inertial in link.findall("inertial"):
            link.remove(inertial)
    return ElementTree.tostring(root, encoding="unicode")


def test_each_parameter_says_whether_it_was_learned_from_the_data(written: Results) -> None:
    for parameter in written.parameters:
        assert parameter.prior_std is not None and parameter.prior_ratio is not None
        assert parameter.learned == (parameter.prior_ratio < 0.5)
        assert not parameter.undetermined
    assert written.estimator.prior is not None
    assert "20 %" in written.estimator.prior


# Results and the command line


def test_the_posterior_is_reported_as_such(estimations: dict[Estimator, Estimation]) -> None:
    uncertainty = uncertainty_result(estimations["prior"])
    assert uncertainty.reported == "posterior"
    assert uncertainty.phase_clustered is None
    assert uncertainty.posterior == estimations["prior"].result.pooled.std.tolist()
    assert uncertainty_result(estimations["wls"]).reported == "phase_clustered"


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"estimator": "lms"}, "estimator: 'lms' is no estimator; use auto, wls"),
        ({"method": "papers"}, "method: 'papers' is no method; use default, paper"),
        ({"smoother": "kalman"}, "smoother: 'kalman' is no smoother; use spline, butterworth"),
        ({"split": 1.5}, "split: 1.5 is no share; give one between 0 and 1"),
    ],
)
def test_options_are_checked_by_name(wrong: dict[str, object], sentence: str) -> None:
    with pytest.raises(InputError) as caught:
        Options(**wrong)  # type: ignore[arg-type]
    assert sentence in str(caught.value)


def test_the_command_writes_results_of_the_estimator(written: Results) -> None:
    assert written.estimator.name == "huber"
    assert "Huber" in written.uncertainty.method
    assert written.endogeneity is not None
    assert written.exports is not None and written.exports.written


@pytest.mark.slow
def test_what_is_named_to_be_predicted_is_not_fitted(campaign: Campaign, tmp_path: Path) -> None:
    first, last, *_ = campaign.folder.completed("excitation")
    command = ["identify", str(first), "--predict", str(last), "--output", str(tmp_path), "-q"]
    CliRunner().invoke(app, command)
    results = Results.load(tmp_path / "results.json")
    assert results.repetitions == [first.name]
    assert [run.archive for run in results.validation] == [last.name]


@pytest.mark.parametrize("delay", ["soon", "nan", "0.7", "inf"])
def test_a_delay_that_is_none_is_refused(delay: str) -> None:
    ran = CliRunner().invoke(app, ["identify", "a.mcap", "--delay", delay])
    assert ran.exit_code != 0
    assert isinstance(ran.exception, InputError)
    assert "--delay" in str(ran.exception)
    assert "or auto" in str(ran.exception)


def test_results_of_another_version_are_refused_with_what_to_do(tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    path.write_text(json.dumps({"schema_version": 1, "name": "old"}))
    with pytest.raises(
        InputError, match=rf"version 1; this program reads version {SCHEMA_VERSION}"
    ):
        Results.load(path)
    path.write_text("[1, 2")
    with pytest.raises(InputError, match="cannot be read as a result"):
        Results.load(path)
    path.write_text(json.dumps({"schema_version": SCHEMA_VERSION, "name": 3}))
    with pytest.raises(InputError, match="name: input should be a valid string; found '3'"):
        Results.load(path)


class TestAutomaticEstimator:
    def test_without_a_consistent_solution_it_is_least_squares(
        self,
        prepared: Prepared,
        estimations: dict[Estimator, Estimation],
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        """Data that no machine fits are estimated all the same, and the reason stands beside it."""

        def none(*_: object) -> None:
            raise SolverError("no solution was found")

        monkeypatch.setattr("hil.identify.estimating.consistent_centre", none)
        settings = replace(prepared.settings, shrinkage=Shrinkage(0.1))
        found = estimate_with(replace(prepared, settings=settings), Options(), Silent())
        expected = estimations["wls"].result.pooled.values
        np.testing.assert_array_equal(found.result.pooled.values, expected)
        assert any("least squares is reported" in one for one in found.warnings)
