"""Campaigns that end when the required precision is reached, or when repetitions do not help."""

from __future__ import annotations

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.base.errors import ExecutionError, InputError
from hil.base.progress import Silent
from hil.campaign import Campaign
from hil.campaign.identified_campaign import identify_campaign
from hil.campaign.plan import design
from hil.campaign.precision_record import PrecisionLook, PrecisionRecord, Reached
from hil.campaign.reached_precision import (
    PrecisionMeter,
    further_repetitions,
    noise_shares,
    requirements_of,
)
from hil.campaign.record_messages import precision_line
from hil.cli import app
from hil.control.motion_watch import Stop
from identification.estimators.elasticity import ElasticTorque
from identification.factor.factor import Factor
from identification.reduction import reduction
from tests.hil.fast_cell import QUICK_GRADIENT, fast_cell, pass_rehearsal
from tests.messages import ALL_REQUIREMENTS_MET

pytestmark = pytest.mark.safety

LOOSE = ("parameters 50%", "torque 10")


class Heard(Silent):
    """Keeps what is said."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def say(self, text: str) -> None:
        self.lines.append(text)


def campaign_of(folder, **changes) -> Campaign:
    cell = fast_cell(folder, repetitions=6).with_values(
        {"simulation.friction_drift": 0.0} | changes
    )
    return Campaign.create(folder / "it", cell, design(cell, Silent()))


def run(campaign, *texts: str, stop: Stop | None = None, **choices) -> Heard:
    heard = Heard()
    required = requirements_of(campaign, texts)
    campaign.run(stop=stop, reporter=heard, unrehearsed=True, until_precise=required, **choices)
    return heard


@pytest.fixture(scope="module")
def met(tmp_path_factory):
    campaign = campaign_of(tmp_path_factory.mktemp("met"))
    return campaign, run(campaign, *LOOSE)


class TestEnd:
    def test_a_campaign_ends_after_two_repetitions_that_meet(self, met) -> None:
        """A single interval may be narrow by chance, so that two in a row must meet."""
        campaign, heard = met
        assert len(campaign.folder.completed("excitation")) == 2
        assert len(campaign.folder.completed("validation")) == 1
        assert campaign.precision.outcome == "met"
        assert [look.met for look in campaign.precision.looks] == [True, True]
        assert any(ALL_REQUIREMENTS_MET in line for line in heard.lines)

    def test_nothing_is_missing_then(self, met) -> None:
        campaign, _ = met
        assert campaign.missing() == []
        assert campaign.progress("excitation") == (2, 2)
        steps = {step.name: step for step in campaign.status().steps}
        assert steps["repetitions"].done
        assert "requirements are met" in steps["repetitions"].details[0]

    def test_the_last_look_is_what_identify_finds(self, met) -> None:
        """Settings that are chosen and errors of the model that are allowed for are the same.

        The delay by all repetitions is applied to the parameters to the first order.
        """
        campaign, _ = met
        identified = identify_campaign(campaign.folder.root, Silent()).estimation
        meter = PrecisionMeter(campaign, requirements_of(campaign, LOOSE))
        measured = meter.estimate(campaign.folder.completed("excitation")).estimate
        assert measured.names == identified.stated.names
        std = identified.stated.std
        np.testing.assert_allclose(measured.values / std, identified.stated.values / std, atol=0.05)
        np.testing.assert_allclose(measured.std, std, rtol=0.05)

    def test_a_look_reads_and_reduces_what_is_new(self, met, monkeypatch) -> None:
        campaign, _ = met
        meter = PrecisionMeter(campaign, requirements_of(campaign, LOOSE))
        paths = campaign.folder.completed("excitation")
        meter.measure(paths[:1])
        reduced: list[str] = []
        for owner, name in (
            (Factor, "by_time"), (ElasticTorque, "of"), (reduction, "form_factor"),
        ):  # fmt: skip
            original = getattr(owner, name)

            def noting(*arguments, name=name, original=original):
                reduced.append(name)
                return original(*arguments)

            monkeypatch.setattr(owner, name, noting)
        meter.measure(paths)
        assert reduced == ["form_factor", "of"]
        reduced.clear()
        meter.measure(paths)
        assert reduced == []

    def test_a_stricter_requirement_continues(self, met) -> None:
        campaign, _ = met
        run(campaign, "parameters 0.001%")
        assert campaign.precision.outcome in ("out of reach", "limit")
        assert len(campaign.folder.completed("excitation")) > 2

    def test_without_one_all_repetitions_are_run(self, tmp_path) -> None:
        campaign = campaign_of(tmp_path)
        campaign.run(unrehearsed=True)
        assert campaign.progress("excitation") == (6, 6)
        assert campaign.precision is None

    def test_a_stopped_run_is_resumed(self, tmp_path) -> None:
        campaign = campaign_of(tmp_path)
        stop = Stop()

        class Stopping(Heard):
            def say(self, text: str) -> None:
                super().say(text)
                stop.requested |= text.startswith("precision after 1 repetition:")

        required = requirements_of(campaign, LOOSE)
        with pytest.raises(ExecutionError):
            campaign.run(stop=stop, reporter=Stopping(), unrehearsed=True, until_precise=required)
        assert len(campaign.folder.completed("excitation")) == 1
        assert campaign.precision.outcome == "going on"
        again = Campaign.open(campaign.folder.root)
        run(again)  # with the requirements of the stopped run
        assert len(again.folder.completed("excitation")) == 2
        assert again.precision.outcome == "met"


def reached(half: float, more: int | None, text: str = "parameters 5 %") -> Reached:
    return Reached(text, "I2m", half, more)


class TestRecord:
    @pytest.mark.parametrize(
        ("halves", "more", "outcome"),
        [
            ((0.04,), (0,), "going on"),
            ((0.04, 0.06), (0, 1), "going on"),
            ((0.06, 0.04, 0.04), (1, 0, 0), "met"),
            ((0.07, 0.07, 0.07), (None, None, None), "out of reach"),
            ((0.07, 0.07, 0.07), (None, 30, 30), "out of reach"),
            ((0.07, 0.07), (None, None), "going on"),
            ((0.07, 0.06, 0.055, 0.052), (3, 3, 2, 1), "going on"),
            ((0.051, 0.051, 0.051), (None, 1, 1), "going on"),
            ((0.051, 0.051, 0.051, 0.051), (None, 1, 1, 1), "out of reach"),
            ((0.051, 0.051, 0.049, 0.051, 0.051), (None, 1, 0, 1, 1), "going on"),
        ],
    )
    def test_outcomes(self, halves, more, outcome) -> None:
        record = PrecisionRecord("hash", ("parameters 5 %",))
        for count, (half, further_) in enumerate(zip(halves, more, strict=True), 1):
            record = record.with_look(PrecisionLook(count, (reached(half, further_),)), limit=10)
        assert record.outcome == outcome

    def test_the_limit_ends_it(self) -> None:
        record = PrecisionRecord("hash", ("parameters 5 %",))
        for count in range(1, 5):
            record = record.with_look(PrecisionLook(count, (reached(0.06, 1),)), limit=4)
        assert record.outcome == "limit"

    def test_what_is_overdue_is_not_promised_again(self) -> None:
        """Twice as many repetitions as were predicted did not meet it: more of them will not."""
        record = PrecisionRecord("hash", ("parameters 5 %",))
        for count in (2, 3, 4):
            record = record.with_look(PrecisionLook(count, (reached(0.051, 1),)), limit=30)
        assert "which more repetitions do not improve enough" in precision_line(record)
        assert "another motion" in precision_line(record)

    def test_one_requirement_in_reach_continues(self) -> None:
        """The one that repetitions do not meet is no reason to leave the other unmet."""
        look = PrecisionLook(3, (reached(0.07, None), reached(3.0, 2, "torque 2 N·m")))
        assert PrecisionRecord("hash", ()).with_look(look, limit=10).outcome == "going on"

    def test_the_message_names_the_worst(self) -> None:
        look = PrecisionLook(4, (reached(0.071, 6), reached(1.0, 0, "torque 2 N·m")))
        record = PrecisionRecord("hash", ()).with_look(look, limit=30)
        assert (
            precision_line(record)
            == "precision after 4 repetitions: I2m 7.1 % of 5 %, about 6 more"
        )

    def test_it_survives_its_file(self, tmp_path) -> None:
        record = PrecisionRecord(
            "hash", ("parameters 5 %",), (PrecisionLook(1, (reached(0.07, None),)),)
        )
        record.save(tmp_path / "precision.json")
        assert PrecisionRecord.load(tmp_path / "precision.json", "hash") == record
        assert PrecisionRecord.load(tmp_path / "precision.json", "other") is None


class TestForecast:
    def test_noise_alone_falls_with_the_number_of_repetitions(self) -> None:
        assert further_repetitions(4, 2.0, 1.0) == 12
        assert further_repetitions(4, 0.9, 1.0) == 0

    def test_what_repeats_does_not(self) -> None:
        assert further_repetitions(4, 2.0, 0.5) is None
        assert further_repetitions(4, 1.1, 0.5) == 3  # (0.5 * 4 / 7 + 0.5) * 1.1**2 is below one
        assert further_repetitions(1, 2.0, np.nan) is None


class Repetition:
    """Scores (blocks, 1) of a repetition of a motion."""

    def __init__(self, scores: np.ndarray) -> None:
        self._scores = scores

    def __len__(self) -> int:
        return len(self._scores)

    def scores(self, *_: object) -> np.ndarray:
        return self._scores


class TestNoiseShare:
    BLOCKS = 2000

    def share(self, count: int, *, drift: float = 0.0) -> float:
        """Of repetitions with an error of 1 that repeats, noise of 0.5, and a drift of each."""
        random = np.random.default_rng(1)
        repeated = random.standard_normal((self.BLOCKS, 1))
        slope = random.standard_normal((self.BLOCKS, 1))
        repetitions = [
            Repetition(
                repeated
                + 0.5 * random.standard_normal((self.BLOCKS, 1))
                + drift * (k - 0.5 * (count - 1)) * slope
            )
            for k in range(count)
        ]
        (share,) = noise_shares(repetitions, np.ones(1), np.ones(1), np.ones((1, 1)))
        return float(share)

    @pytest.mark.parametrize("count", [2, 4, 10, 20])
    def test_it_is_that_of_the_mean_of_repetitions(self, count) -> None:
        assert self.share(count) == pytest.approx(0.25 / (count + 0.25), rel=0.15)

    def test_a_drift_is_no_noise(self) -> None:
        """Over ten repetitions it is as large as the noise, and from one to the next small."""
        assert self.share(10, drift=0.15) == pytest.approx(self.share(10), rel=0.15)


class TestRefusals:
    def test_without_requirements_the_command_says_what_to_add(self, tmp_path) -> None:
        campaign = campaign_of(tmp_path)
        with pytest.raises(InputError, match=r"states a precision.*--precision"):
            requirements_of(campaign, ())

    def test_unknown_joints_are_refused_before_anything_moves(self, tmp_path) -> None:
        campaign = campaign_of(tmp_path)
        with pytest.raises(InputError, match="names no joint"):
            run(campaign, "torque of wrist 2")
        assert campaign.folder.manifest() == []

    def test_precision_alone_is_refused(self, tmp_path) -> None:
        campaign = campaign_of(tmp_path)
        arguments = ["run", str(campaign.folder.root), "--precision", "parameters 5%"]
        with pytest.raises(InputError, match="add --until-precise"):
            CliRunner().invoke(app, arguments, catch_exceptions=False)


@pytest.fixture(scope="module")
def continued(met, tmp_path_factory):
    earlier, _ = met
    folder = tmp_path_factory.mktemp("next")
    (folder / "quick.toml").write_text(QUICK_GRADIENT)
    arguments = ["design", str(earlier.folder.cell), "--settings", str(folder / "quick.toml")]
    arguments += ["--given", str(earlier.folder.root), "--precision", ", ".join(LOOSE)]
    arguments += ["-o", str(folder / "it"), "--workers", "1"]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    campaign = Campaign.open(folder / "it")
    return campaign, run(campaign)


class TestEarlierRecordings:
    """A motion that `hil design --given` designed continues what was recorded before it."""

    def test_they_count_for_its_precision(self, continued, met) -> None:
        campaign, heard = continued
        before = met[0].folder.completed("excitation")
        required = requirements_of(campaign, ("parameters 20%",))
        paths = campaign.folder.completed("excitation")[:1]
        together = PrecisionMeter(campaign, required).estimate(paths)
        design_file = campaign.folder.root / "excitation.toml"
        aside = design_file.rename(design_file.with_suffix(".aside"))
        alone = PrecisionMeter(campaign, required).estimate(paths)
        aside.rename(design_file)
        assert np.all(together.estimate.samples > 1.5 * alone.estimate.samples)
        assert np.linalg.det(together.estimate.covariance) < np.linalg.det(
            alone.estimate.covariance
        )
        assert any(f"counts the {len(before)} earlier recordings" in line for line in heard.lines)

    def test_without_them_the_run_is_refused(self, continued, met) -> None:
        campaign, _ = continued
        earlier, _ = met
        aside = earlier.folder.root.with_name("moved")
        earlier.folder.root.rename(aside)
        try:
            with pytest.raises(InputError, match=str(earlier.folder.root)):
                run(campaign)
        finally:
            aside.rename(earlier.folder.root)


def test_the_command_prints_what_was_reached(tmp_path) -> None:
    campaign = campaign_of(tmp_path)
    pass_rehearsal(campaign.folder)
    arguments = ["run", str(campaign.folder.root), "--accept-dry-run", "--no-identify"]
    arguments += ["--until-precise", "--precision", ", ".join(LOOSE), "--json"]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    printed = json.loads(
        result.stdout.splitlines()[-1] if "\n}" not in result.stdout else result.stdout
    )
    assert "all requirements are met" in printed["precision"]
    assert printed["repetitions"] == [2, 2]
