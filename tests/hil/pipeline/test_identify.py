"""Identification from archives: sources, estimators, verdict, files of the result."""

from __future__ import annotations

import json
import re
import shutil
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from hil.archive import ImportedSamples, write_samples
from hil.base.errors import ArchiveError, InputError, OutputError
from hil.base.exit_status import ExitStatus
from hil.base.one_screen import SCREEN_COLUMNS, SCREEN_LINES
from hil.base.progress import Silent
from hil.campaign.identified_campaign import identify_campaign
from hil.cli import app
from hil.cli.verdict import as_json, finish, screen, sentences, table, whole
from hil.control.planted_arm import planted_values
from hil.importers.imported_robot import Robot
from hil.pipeline.estimating import estimate_with
from hil.pipeline.estimators import ESTIMATORS
from hil.pipeline.identification import identify_archives
from hil.pipeline.notes import (
    CompensatedDelay,
    DelayNotApplied,
    EstimatedDelay,
    UnrestrictedBodies,
    WhyNotApplied,
)
from hil.pipeline.options import FIXED, Options, friction_from
from hil.pipeline.prepared import _DelayChoice, decide, prepare_sources, renewed_delay, stated_delay
from hil.pipeline.sources import gather_sources
from hil.pipeline.summary import _delays
from hil.report.output_files import settings_result, write_outcome
from hil.results.error_columns import RMS_TITLE, error_columns
from hil.results.results import SCHEMA_VERSION, Results
from identification.errors import IdentificationError
from identification.estimators.consistent import SolverError
from identification.estimators.delay import DelayEstimate, UndeterminedDelay
from identification.model.friction import FrictionLaw
from identification.selection.questions import SuggestedDelay
from identification.selection.settings import Settings, Strength
from identification.signals.samples import Preprocessing
from identification.validation.purpose_messages import requirement
from sim_fixtures.ns16 import URDF_PATH
from tests.hil.simulated_logs import archive_of, simulate

pytestmark = pytest.mark.long

PERIOD = 0.004


def identified(*archives, **options):
    return identify_archives(archives, Silent(), Options(**options))


def paths(campaign):
    kinds = ("excitation", "validation", "standstill")
    return [path for kind in kinds for path in campaign.folder.completed(kind)]


def raiser(error):
    """Return a function that raises an error."""

    def function(*_, **__):
        raise error

    return function


@pytest.fixture(scope="module")
def identification(campaign):
    return identify_campaign(campaign.folder.root, Silent())


@pytest.fixture(scope="module")
def judgement(identification):
    return identification.results.judgement


def imported(path, names=None, *, torque=True, noise=0.0, **spoilt):
    """Write an imported recording of sines on six joints, with faults by name."""
    robot = Robot.from_urdf(URDF_PATH)
    time = np.arange(2000) * PERIOD
    position = 0.3 * np.sin(np.outer(time, np.linspace(1.0, 2.0, 6)))
    torques = np.cos(np.outer(time, np.linspace(1.0, 2.0, 6)))
    torques += noise * np.random.default_rng(1).standard_normal(torques.shape)
    stamp = np.rint(time * 1e9).astype(np.int64)
    for key, value in spoilt.items():
        if key == "nan":
            position[value] = np.nan
        elif key == "stuck":
            position[:, value] = 0.25
        elif key == "repeat":
            stamp[value] = stamp[value - 1]
        elif key == "fall":
            stamp[value] -= 10**9
    write_samples(
        path,
        ImportedSamples(stamp, position, None, torques if torque else None, None),
        joint_names=names or robot.joint_names,
        metadata={"kind": "imported"},
        attachments=robot.attachments(),
    )
    return path


def imported_ur5(folder, time, late, still=0):
    """Import a UR5 at rest for `still` samples, then moving, with torques `late` by a time [s]."""
    made = simulate("ur5_robot.urdf", time, noise=0.3)
    lags = zip(np.broadcast_to(late, 6), made.torque.T, strict=True)
    torque = np.column_stack([np.interp(time - lag, time, column) for lag, column in lags])
    rows = slice(0 if still else 10, None)
    t = time[rows]
    q = made.position[rows]
    tau = torque[rows]
    before = t[0] + (time[1] - time[0]) * np.arange(-still, 0)
    noise = 0.3 * np.random.default_rng(1).standard_normal((still, 6))  # no frozen logger's rows
    q = np.concatenate([np.repeat(q[:1], still, axis=0), q])
    tau = np.concatenate([tau[0] + noise, tau])
    arrays = {"t": np.concatenate([before, t]), "q": q, "tau": tau}
    return archive_of(folder / "log.mcap", made.urdf, **arrays)


class TestCampaign:
    """Results of a campaign."""

    def test_has_58_parameters_near_the_planted_ones(self, identification):
        """More than 3 of 58 normal deviates beyond 3 sigma have a probability of 1e-5."""
        results = identification.results
        assert sorted(p.table2_id or 0 for p in results.parameters) == list(range(1, 59))
        assert results.coverage.within_3 >= 55
        # Held-out torque inside its 95 % intervals, within two standard deviations of the share.
        unsure = 2.0 * np.sqrt(0.95 * 0.05 / results.calibration.means)
        assert results.calibration.inside >= 0.95 - unsure
        assert None not in results.calibration.joint_inside

    def test_planned_criteria_are_those_that_were_executed(self, identification):
        """At equal times; stiction and noise change the columns by per mille."""
        planned = identification.results.excitation.planned
        executed = identification.results.excitation.executed
        assert executed.n_samples == pytest.approx(3 * planned.n_samples, abs=6)
        assert executed.log10_det == pytest.approx(planned.log10_det, abs=58 * np.log10(1.01))
        assert executed.coupling_index == pytest.approx(planned.coupling_index, rel=0.02)
        assert executed.scaled_condition == pytest.approx(planned.scaled_condition, rel=0.02)

    def test_needs_the_archives_only(self, campaign, identification, tmp_path):
        """Copied without their folder, they give the same numbers."""
        moved = [Path(shutil.copy(path, tmp_path)) for path in paths(campaign)]
        again = identify_archives(moved, Silent(), name=identification.results.name)
        # The conduct of the campaign is recorded in its folder.
        assert identification.results.conduct is not None
        assert again.results == identification.results.model_copy(update={"conduct": None})

    @pytest.mark.slow
    def test_has_the_same_parameters_by_the_papers_filters(self, campaign, identification):
        paper = identify_campaign(campaign.folder.root, Silent(), Options(method="paper"))
        assert paper.verdict.good, paper.verdict.line
        for ours, theirs in zip(
            identification.results.parameters, paper.results.parameters, strict=True
        ):
            both = np.hypot(ours.std, theirs.std)
            assert abs(ours.estimate - theirs.estimate) < 5.0 * both, ours.name

    def test_reports_a_failed_consistent_solution(self, campaign, monkeypatch):
        for name in ("check_consistency", "choose_essential"):
            failing = raiser(IdentificationError("the solver failed"))
            monkeypatch.setattr(f"hil.pipeline.validation.{name}", failing)
        without = identify_campaign(campaign.folder.root, Silent(), FIXED)
        warnings = without.results.verdict.warnings
        assert sum("the solver failed" in warning for warning in warnings) == 2
        assert without.results.consistency is without.results.essential is None


@pytest.mark.parametrize("wrong_by", [-0.35, 1.5])
def test_a_stated_delay_that_data_contradict_is_corrected(campaign, wrong_by):
    """In cycles; the interval allows for what is left."""
    sources = gather_sources(paths(campaign), 0.7)
    period = sources.cell.period
    right = sources.cell.file.controller.current_delay_cycles
    wrong = sources.cell.with_values({"controller.current_delay_cycles": right + wrong_by})
    chosen = decide(replace(sources, cell=wrong), Options(), Silent())
    assert any(isinstance(note, CompensatedDelay) for note in chosen.notes)
    error = chosen.settings.preprocessing.torque_delay - right * period
    uncertainty = np.sqrt(chosen.settings.delay_variance)
    assert 0.9e-4 < uncertainty < 0.3 * period  # an estimate in a closed loop has a bias
    assert abs(error) < 2.0 * uncertainty
    stated = Options(delay="stated")
    fixed = decide(replace(sources, cell=wrong), stated, Silent()).settings
    assert fixed.preprocessing.torque_delay == stated_delay(wrong)


def estimated(delay: float, std: float = 2e-4, *, significant: bool = False) -> DelayEstimate:
    return DelayEstimate(
        delay=delay, std=std, assumed=0.0, cycle=1e-3, interval_factor=2.0, reason=None,
        significant=significant,
    )  # fmt: skip


class TestDelayOfAController:
    """What is stated of it, and what the recordings show."""

    def choice(self, campaign, estimate, *, filtered: bool = False) -> _DelayChoice:
        sources = gather_sources(paths(campaign)[:1], 0.7)
        if filtered:  # imported torques: not those of a controller's currents
            (source,) = sources.training
            recording = replace(source.recording, motor_current=None)
            sources = replace(sources, training=(replace(source, recording=recording),))
        return _DelayChoice.of(estimate, sources, Settings(Preprocessing()), Options())

    def test_inside_the_interval_the_stated_one_is_kept(self, campaign):
        """Which ends at 0.4 ms: an estimate that differs by chance corrects nothing."""
        inside, outside = (self.choice(campaign, estimated(delay)) for delay in (3.9e-4, 4.1e-4))
        assert inside.assumed == 0.0 < outside.assumed
        assert not inside.suggested
        assert not any(isinstance(note, CompensatedDelay) for note in inside.notes)
        # The interval allows for what the estimate says.
        assert inside.errors[0.0] == pytest.approx(
            outside.errors[outside.assumed] + outside.assumed**2, rel=0.1
        )

    def test_estimates_count_alike_beyond_the_bound(self, campaign):
        below, above = (self.choice(campaign, estimated(delay)) for delay in (5.9e-4, 6.1e-4))
        assert above.assumed == pytest.approx(below.assumed, abs=3e-5)
        assert above.errors[above.assumed] == pytest.approx(below.errors[below.assumed], rel=0.05)

    def test_inner_prediction_decides_on_a_far_significant_one(self, campaign):
        choice = self.choice(campaign, estimated(2e-3, significant=True))
        assert choice.assumed == 0.0
        assert [delay.value for delay in choice.suggested] == [pytest.approx(2e-3, abs=1e-4)]
        assert choice.errors[0.0] > 1e-3**2  # as the estimate says

    def test_beside_a_low_pass_the_stated_one_is_kept_with_its_error(self, campaign):
        """The estimate may be the lag of the low-pass."""
        choice = self.choice(campaign, estimated(5e-4), filtered=True)
        combined = self.choice(campaign, estimated(5e-4))
        assert choice.assumed == 0.0 < combined.assumed
        assert choice.errors[0.0] == pytest.approx(
            combined.errors[combined.assumed] + combined.assumed**2
        )

    def test_what_was_kept_as_stated_stays_so(self, campaign):
        """In looks at more repetitions: with the error that these show."""
        sources = gather_sources(paths(campaign), 0.7)
        right = sources.cell.file.controller.current_delay_cycles
        wrong = sources.cell.with_values({"controller.current_delay_cycles": right + 1.5})
        sources = replace(sources, cell=wrong)
        decided = decide(sources, Options(), Silent()).settings
        stated = replace(
            decided.preprocessed(torque_delay=decided.stated_delay), delay_variance=1e-8
        )
        again = renewed_delay(sources, stated, Options())
        assert again.mean == stated.stated_delay
        assert again.variance > wrong.period**2


def test_other_recordings_renew_a_chosen_delay(campaign):
    """A look at more repetitions of a campaign: the delay is as if chosen from all of them."""
    sources = gather_sources(paths(campaign), 0.7)
    first = replace(sources, training=sources.training[:1])
    settings = decide(first, Options(), Silent()).settings
    by_all = decide(sources, Options(), Silent()).settings
    for recordings, chosen in ((first, settings), (sources, by_all)):
        again = renewed_delay(recordings, settings, Options())
        assert again.mean == pytest.approx(chosen.preprocessing.torque_delay)
        assert again.variance == pytest.approx(chosen.delay_variance)
    assert by_all.delay_variance != pytest.approx(settings.delay_variance)
    known = replace(settings, delay_variance=0.0)
    assert renewed_delay(sources, known, Options()).variance == 0.0


class TestOutcome:
    """Files of a result."""

    def test_is_replaced_completely_or_not_at_all(self, identification, tmp_path):
        write_outcome(tmp_path, identification, Silent())
        first = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
        assert {"results.json", "report.html", "parameters.csv", "identified.urdf"} <= set(first)
        written = Results.load(tmp_path / "results.json")
        assert written == identification.results.model_copy(
            update={
                "exports": written.exports,
                "occasion": written.occasion,
                "settings": settings_result(identification),
            }
        )
        (tmp_path / "report.html").unlink()
        (tmp_path / "report.html").mkdir()
        other = replace(
            identification, results=identification.results.model_copy(update={"name": "other"})
        )
        with pytest.raises(OutputError, match=r"report\.html is a folder"):
            write_outcome(tmp_path, other, Silent())
        del first["report.html"]
        left = {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()}
        assert left == first

    @pytest.mark.parametrize(
        ("text", "sentence"),
        [
            ('{"schema_version": 1}', f"version 1; this program reads version {SCHEMA_VERSION}"),
            ("[1, 2", "cannot be read as a result"),
            (
                json.dumps({"schema_version": SCHEMA_VERSION, "name": 3}),
                "name: input should be a valid string; found '3'",
            ),
        ],
    )
    def test_of_another_version_is_refused(self, text, sentence, tmp_path):
        path = tmp_path / "results.json"
        path.write_text(text)
        with pytest.raises(InputError, match=sentence):
            Results.load(path)


class TestSources:
    """Archives that are fitted, predicted, or refused."""

    def test_truncated_are_used_to_the_last_complete_chunk(self, campaign, tmp_path):
        moved = [Path(shutil.copy(path, tmp_path)) for path in paths(campaign)]
        moved[2].write_bytes(moved[2].read_bytes()[: moved[2].stat().st_size // 2])
        warnings = " ".join(identify_archives(moved, Silent()).results.verdict.warnings)
        assert moved[2].name in warnings
        assert "could be read" in warnings

    def test_that_do_not_belong_together_are_refused(self, campaign, tmp_path):
        first = campaign.folder.completed("excitation")[0]
        copy = Path(shutil.copy(first, tmp_path / "another_name.mcap"))
        with pytest.raises(InputError, match="no excitation"):
            identified(*campaign.folder.completed("validation"))
        with pytest.raises(InputError, match="has no completed excitation"):
            identify_campaign(tmp_path, Silent())
        with pytest.raises(InputError, match="is a copy of"):
            identified(first, copy)
        with pytest.raises(InputError, match="omit --fit-all"):
            gather_sources([first], 0.7, [first], in_sample=True)
        with pytest.raises(ArchiveError, match=r"other\.mcap.*has another"):
            identified(first, imported(tmp_path / "other.mcap"))

    def test_at_rest_are_no_test(self, campaign):
        """At the end of a recording the arm rests for 0.2 s."""
        identification = identified(paths(campaign)[0], split=0.985)
        assert not identification.verdict.good
        assert "moved for less than" in identification.verdict.line

    @pytest.mark.parametrize(
        ("spoilt", "sentence"),
        [
            ({"nan": (700, 2)}, r"position of joint joint_3 is nan at sample 700"),
            ({"torque": False}, "neither joint torques"),
            (
                {"names": tuple(f"joint_{j}" for j in (2, 1, 3, 4, 5, 6))},
                "the recorded joints are joint_2, joint_1",
            ),
        ],
    )
    def test_that_are_invalid_are_refused_by_name(self, tmp_path, spoilt, sentence):
        with pytest.raises(ArchiveError, match=r"bad\.mcap.*" + sentence):
            identified(imported(tmp_path / "bad.mcap", **spoilt))

    def test_with_a_joint_that_never_moves_are_identified(self, tmp_path):
        """Its torque holds its load; a model that knows nothing of its motion is not good."""
        identification = identified(imported(tmp_path / "standing.mcap", stuck=4))
        assert not identification.verdict.good
        errors = identification.results.fitted.all_rows_joint_errors
        assert np.isfinite(np.delete(errors, 4)).all()

    @pytest.mark.parametrize("spoilt", [{"repeat": 300}, {"fall": 300}])
    def test_with_one_wrong_stamp_are_read_at_even_times(self, tmp_path, spoilt):
        whole = identified(imported(tmp_path / "whole.mcap"))
        identification = identified(imported(tmp_path / "one.mcap", **spoilt))
        assert any("used: even times" in note for note in identification.results.notes)
        errors = [
            each.results.validation[0].all_rows_relative_error for each in (whole, identification)
        ]
        assert errors[1] < 1.01 * errors[0]

    def test_alone_are_split(self, tmp_path):
        identification = identified(imported(tmp_path / "one.mcap"))
        assert any(
            "the rest was predicted" in warning
            for warning in identification.results.verdict.warnings
        )
        assert [run.archive for run in identification.results.validation] == [
            "one.mcap (last part)"
        ]
        assert "unseen" not in identification.verdict.line.split(":")[0]

    def test_that_repeat_the_fitted_motion_are_not_unseen(self, campaign):
        identification = identified(*campaign.folder.completed("excitation"))
        line = "Judged on a repetition of the fitted motion"
        assert line in identification.verdict.line

    def test_show_how_fast_a_simulation_was_tested(self, campaign):
        identification = identified(*campaign.folder.completed("excitation"))
        purpose = next(
            each for each in identification.verdict.purposes if each.name == "simulation"
        )
        (held_out,) = identification.prepared.held_out
        fastest = np.abs(held_out.motion.velocity).max()
        assert 0.9 * fastest < purpose.references["speed"] <= fastest
        assert re.search(r"tested up to [\d.]+ rad/s and [\d.]+ rad/s²", requirement(purpose))

    @pytest.mark.parametrize("noise", [0.0, 0.01])
    def test_with_a_noiseless_torque_are_not_called_filtered(self, tmp_path, noise):
        identification = identified(imported(tmp_path / "smooth.mcap", noise=noise))
        named = [finding.check for finding in identification.results.judgement.findings]
        assert "torque bandwidth" not in named


class TestJudgement:
    """Numbers behind a verdict: in `results.json`, on the terminal and in the report."""

    def test_compares_joints_with_limit_and_other_models(self, judgement, identification):
        assert [joint.joint for joint in judgement.joints] == identification.results.joint_names
        for joint in judgement.joints:
            assert joint.share_of_limit == pytest.approx(joint.rms / joint.limit)
            # An error of r of the torque leaves at most 1 - r² unexplained of what varies in it.
            assert joint.explained <= 1.0 - joint.relative**2 + 1e-12
            # Nominal links, rotors and friction are wrong by 10 to 20 %, those of the simulated
            # controller's model by 5 to 10 %; what was found is not.
            assert joint.nominal_relative > 2.0 * joint.relative
            assert 0.01 < joint.controller_relative < 0.15

    def test_is_a_table_sentences_and_json(self, identification, judgement):
        rows = table(identification.results, everything=True)
        lines = sentences(identification.results)
        titles = [
            column.title for column in error_columns(identification.results.judgement, limits=True)
        ]
        assert rows[0].split() == " ".join(["joint", RMS_TITLE, *titles]).split()
        names = (*identification.results.joint_names, "all")
        for row, name in zip(rows[1:], names, strict=True):
            assert row.startswith(name) and row.count("%") == (5 if name == "all" else 6)
        for finding in judgement.findings:
            assert sum(finding.words in line for line in lines) == 1
        read = json.loads(as_json(identification.results))
        verdict = identification.results.verdict
        assert (read["good"], read["line"]) == (verdict.good, verdict.line)
        assert {finding["check"] for finding in read["findings"]} >= {"excitation", "delay"}
        assert len(read["joints"]) == 6
        assert read["in_sample"] is False and read["undetermined"] == []

    def test_is_one_screen_that_begins_with_its_line(self, identification):
        shown = screen(identification.results, (Path("out"), Path("out/report.html")))
        assert len(shown) <= SCREEN_LINES and max(map(len, shown)) <= SCREEN_COLUMNS
        text = " ".join(" ".join(shown).split())
        assert text.startswith(identification.results.verdict.line)
        assert len(whole(identification.results)) > len(shown)

    @pytest.mark.parametrize("good", [True, False])
    def test_begins_with_its_line_and_ends_with_a_status(self, identification, good, capsys):
        verdict = identification.results.verdict.model_copy(update={"good": good})
        with nullcontext() if good else pytest.raises(typer.Exit) as left:
            finish(identification.results.model_copy(update={"verdict": verdict}), json=False)
        assert good or left.value.exit_code == ExitStatus.NEGATIVE_RESULT
        printed = capsys.readouterr()
        assert " ".join(printed.out.split()).startswith(verdict.line)
        assert printed.err == ""


@pytest.fixture(scope="module")
def prepared(campaign):
    """Rows in sliding motion only, without velocity reversals."""
    sources = gather_sources(paths(campaign), 0.7)
    return prepare_sources(sources, Options(exclude_rows="slow"), Silent())


def torque_share(difference, factor):
    """Return the largest torque of a difference of parameters (p,), relative to the measured."""
    gram = factor.gram
    squares = np.einsum("i,jik,k->j", difference, gram[:, :-1, :-1], difference)
    return np.sqrt(squares / gram[:, -1, -1]).max()


@pytest.fixture(scope="module")
def estimations(prepared):
    return {name: estimate_with(prepared, Options(estimator=name), Silent()) for name in ESTIMATORS}


class TestEstimators:
    """Every estimator on one campaign, with its warnings."""

    @pytest.mark.parametrize("name", ESTIMATORS)
    def test_find_the_planted_arm(self, name, estimations, prepared):
        """Compared by torque on the fitted motion."""
        estimation = estimations[name]
        pooled = estimation.result.pooled
        error = pooled.values - planted_values(prepared.sources.cell)
        assert torque_share(error, estimation.result.factor) < 0.005
        # Expected by chance: 0.03 of 58, and three of a single motion.
        assert np.count_nonzero(np.abs(error) / pooled.std > 3.5) <= 3
        assert estimation.estimator == name
        assert len(estimation.result.values) == len(prepared.fitted)

    @pytest.mark.parametrize("name", ["auto", "wls", "ols", "prior", "consistent"])
    def test_refit_of_all_rows_is_the_estimate(self, name, estimations):
        """So that the calibration is that of the estimator; others need the samples."""
        estimation = estimations[name]
        values = (
            estimation.with_prior.estimate.values
            if name == "prior"
            else estimation.result.pooled.values
        )
        difference = estimation.refit(estimation.result.factor) - values
        assert torque_share(difference, estimation.result.factor) < 1e-4

    def test_need_commands_as_instruments(self, prepared):
        sources = prepared.sources
        training = tuple(
            replace(source, recording=replace(source.recording, commanded_position=None))
            for source in sources.training
        )
        without = replace(prepared, sources=replace(sources, training=training))
        with pytest.raises(InputError, match=r"--estimator iv.*no commanded positions.*use --est"):
            estimate_with(without, Options(estimator="iv"), Silent())

    def test_without_a_consistent_solution_any_bodies_are_allowed(self, prepared, monkeypatch):
        """The reason is a warning."""
        free = replace(prepared.settings, strength=Strength(consistent=False))
        expected = estimate_with(replace(prepared, settings=free), Options(), Silent())
        failing = raiser(SolverError("no solution was found"))
        monkeypatch.setattr("identification.reduction.posterior.consistent_values", failing)
        restricted = replace(prepared.settings, strength=Strength(consistent=True))
        estimation = estimate_with(replace(prepared, settings=restricted), Options(), Silent())
        np.testing.assert_array_equal(
            estimation.result.pooled.values, expected.result.pooled.values
        )
        assert UnrestrictedBodies("no solution was found") in estimation.warnings


def test_a_stribeck_speed_below_the_recorded_ones_is_refused(campaign):
    """Its coefficient would be arbitrary: 58 % of error on held-out motion, or infinite torques."""
    options = Options(friction={"stribeck": 1e-4}, estimator="wls", exclude_rows="rests")
    with pytest.raises(InputError, match=r"stribeck.*slower than twice .* larger speed"):
        prepare_sources(gather_sources(paths(campaign), 0.7), options, Silent())


def test_a_friction_law_may_grow_with_the_load():
    law = FrictionLaw.from_table(friction_from("coulomb,viscous,load"))
    assert law.symbols == ("f0", "f1", "fl")


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("coulomb,tanh=", "'tanh=' needs a value above zero"),
        ("coulomb=2", "'coulomb' takes no value"),
        ("stribeck=0.1,stribeck=0.2", "'stribeck=0.2' repeats a term"),
        ("quadratic,cubic", "'cubic' repeats a term or excludes it"),
        ("coulomb,third", "'third' is not a friction term"),
    ],
)
def test_a_friction_law_is_refused_by_its_term(text, problem):
    with pytest.raises(InputError, match=problem):
        friction_from(text)


def test_the_command_writes_results_of_the_estimator(campaign, tmp_path):
    command = ["identify", str(campaign.folder.root), "--estimator", "huber", "--json"]
    ran = CliRunner().invoke(app, [*command, "--output", str(tmp_path)])
    assert ran.exit_code == 0, ran.output
    assert json.loads(ran.stdout)["good"] is True
    assert "Condition number" in (tmp_path / "report.html").read_text()
    written = Results.load(tmp_path / "results.json")
    assert written.estimator.name == "huber"
    assert "Huber" in written.uncertainty.method
    assert written.exports.written
    assert all((tmp_path / name).exists() for name in written.exports.written)
    for parameter in written.parameters:
        assert parameter.prior_std is not None
        assert parameter.learned == (parameter.prior_ratio < 0.5)
        assert not parameter.undetermined
    assert "20 %" in written.estimator.prior


# One imported recording: split, or all of it fitted

LATE = np.full(6, 0.012)  # s
UNFILTERED = Options(torque_bandwidth=None, delay="auto")


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """An imported UR5 whose torques lag."""
    return imported_ur5(tmp_path_factory.mktemp("log"), np.arange(0.0, 16.0, 4e-3), LATE)


@pytest.fixture(scope="module")
def split(log):
    return identify_archives([log], Silent(), UNFILTERED)


@pytest.mark.parametrize(
    ("wide", "applied", "stated"),
    [(True, 0.004, 0.004), (True, 0.0, None), (False, 0.002, 0.002)],
    ids=["wide interval", "not applied", "lag of a low-pass"],
)
def test_a_delay_that_was_applied_is_in_the_results(wide, applied, stated):
    """Also one with an interval too wide to be called determined, or without an estimate."""
    estimate = DelayEstimate(
        delay=0.004, std=1e-3, assumed=0.0, cycle=1e-3, interval_factor=2.0,
        reason=UndeterminedDelay.WIDE_INTERVAL, significant=True,
    )  # fmt: skip
    prepared = SimpleNamespace(
        delays=estimate if wide else None,
        assumed_delay=applied,
        settings=SimpleNamespace(stated_delay=0.0),
        sources=SimpleNamespace(cell=SimpleNamespace(joint_names=("a", "b"))),
    )
    delays = _delays(prepared)
    assert (delays.found, delays.applied) == ([stated] * 2, [applied] * 2)


@pytest.mark.parametrize("reason", [UndeterminedDelay.WIDE_INTERVAL, None])
def test_a_delay_that_predicts_no_better_is_not_applied(reason):
    """One with a wide interval stays suspected: inner prediction does not speak against it."""
    estimate = DelayEstimate(
        delay=0.004, std=1e-3, assumed=0.0, cycle=1e-3, interval_factor=2.0, reason=reason,
        significant=True,
    )  # fmt: skip
    suggested = (SuggestedDelay(estimate.delay, estimate.determined),)
    choice = _DelayChoice(estimate, 0.0, suggested, (EstimatedDelay(estimate),))
    left, (note,) = choice.confirmed_by(Preprocessing(torque_delay=0.0))
    assert left is (estimate if reason else None)
    filtered = Preprocessing(torque_delay=0.0, torque_bandwidth=5.0)
    assert choice.confirmed_by(filtered)[0] is None
    why = WhyNotApplied.UNDETERMINED if reason else WhyNotApplied.PREDICTS_WORSE
    assert note == DelayNotApplied(estimate, why)


def test_inner_prediction_decides_on_an_unconfirmed_delay(log):
    """They are predicted without a prior, badly with any delay where the motion is poor."""
    sources = gather_sources([log], 0.7)
    estimate = replace(estimated(2e-3), unconfirmed=True)
    choice = _DelayChoice.of(estimate, sources, Settings(Preprocessing()), Options())
    assert choice.suggested == (SuggestedDelay(2e-3, determined=False),)
    applied, notes = choice.confirmed_by(Preprocessing(torque_delay=2e-3))
    assert applied.significant and isinstance(notes[-1], CompensatedDelay)
    refused, (note,) = choice.confirmed_by(Preprocessing())
    assert not refused.significant
    assert note == DelayNotApplied(estimate, WhyNotApplied.PREDICTS_NO_BETTER)
    wide = replace(estimate, reason=UndeterminedDelay.WIDE_INTERVAL)
    assert not _DelayChoice.of(wide, sources, Settings(Preprocessing()), Options()).suggested


def test_delays_of_the_torque_are_compensated(log, split):
    """A stated one is applied, and another reported."""
    np.testing.assert_allclose(split.results.delays.applied, LATE, atol=1e-3)
    applied = json.loads(as_json(split.results))["delays"]["applied"]
    np.testing.assert_allclose(applied, LATE, atol=1e-3)
    delay_findings = [finding for finding in split.verdict.findings if finding.check == "delay"]
    assert [finding.level for finding in delay_findings] == ["doubtful"]
    options = replace(UNFILTERED, delay=0.0)
    prepared = prepare_sources(gather_sources([log], 0.7), options, Silent())
    assert prepared.assumed_delay == 0.0
    assert not any(isinstance(note, EstimatedDelay) for note in prepared.notes)
    assert prepared.delays.delay > 0.01


def test_nothing_is_called_good_in_sample(log, split):
    results = identify_archives([log], Silent(), replace(UNFILTERED, in_sample=True)).results
    assert results.judgement.in_sample
    assert results.validation == [] and results.essential is results.calibration is None
    assert not results.verdict.good
    line = results.verdict.line
    assert "in-sample" in line and "no motion was held out" in line
    assert "unseen motion well" not in line
    more = results.excitation.executed
    fewer = split.results.excitation.executed
    assert more.n_samples > fewer.n_samples
    relative = [joint.relative for joint in results.judgement.joints]
    assert relative == pytest.approx(results.fitted.relative_error)
    assert "fitted" in table(results)[0] and "in motion" not in table(results)[0]


# The arm of the log starts without acceleration, which no rigid body does: slow rows are left out.
SLOW = replace(
    FIXED, friction={"presliding": 1e-4, "third": "none"}, delay=0.0, exclude_rows="slow"
)


def test_series_of_figures_have_fitted_rows_and_friction(tmp_path):
    """A second of rest is displayed and not fitted; friction data lie around the law."""
    log = imported_ur5(tmp_path, np.arange(0.0, 10.0, 8e-3), 0.0, 250)
    rested = identify_archives([log], Silent(), SLOW)
    series = rested.series
    first = np.argmax(series.excitation_fitted.any(axis=1))
    assert 0.9 < series.excitation_time[first] - series.excitation_time[0] < 1.1
    assert 0.3 < series.excitation_fitted.mean() < 1.0
    assert set(np.unique(series.example_used)) <= {0.0, 1.0}
    for j, noise in enumerate(rested.results.noise_std):
        drawn = np.isfinite(series.friction_speed[:, j])
        assert drawn.sum() > 100
        speed = series.friction_speed[drawn, j]
        torque = series.friction_torque[drawn, j]
        law = np.interp(speed, series.law_speed[:, j], series.law_torque[:, j])
        assert np.std((torque - law)[np.abs(speed) > 0.05]) < 2.0 * noise
