"""What a verdict rests on: in results.json, on the terminal and in the report."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer

import hil.identify.surroundings
from hil.archive import Archive, open_archive
from hil.campaign import Campaign
from hil.cell import Cell
from hil.cli.verdict import NOT_GOOD, as_json, finish, sentences, table
from hil.identify import Identification, Options, identify_campaign
from hil.identify.prepared import prepare_sources
from hil.identify.sources import gather_sources
from hil.identify.surroundings import controller_error, torque_limits
from hil.progress import Silent
from hil.report.page import judgement_context
from hil.results import JudgementResult

TWO_LINK = Path(__file__).parents[1] / "identification" / "two_link.urdf"
_REST = ("explains", "nominal", "controller")


@pytest.fixture(scope="module")
def found(campaign: Campaign) -> Identification:
    return identify_campaign(campaign.folder.root, Silent())


@pytest.fixture(scope="module")
def judgement(found: Identification) -> JudgementResult:
    assert found.results.judgement is not None
    return found.results.judgement


def test_every_joint_is_compared_with_its_limit_and_the_other_models(
    judgement: JudgementResult, found: Identification
) -> None:
    assert [joint.joint for joint in judgement.joints] == found.results.joint_names
    for joint in judgement.joints:
        assert joint.limit is not None and joint.share_of_limit is not None
        assert joint.share_of_limit == pytest.approx(joint.rms / joint.limit)
        assert joint.relative is not None and joint.explained is not None
        # An error of r of the torque leaves at most 1 - r² unexplained of what varies in it.
        assert joint.explained <= 1.0 - joint.relative**2 + 1e-12
        assert joint.nominal_relative is not None


def test_the_simulated_controllers_model_is_off_by_what_was_planted(
    judgement: JudgementResult,
) -> None:
    """Its links, rotors and friction are wrong by 5 to 10 %, and so is its torque, about."""
    errors = [joint.controller_relative for joint in judgement.joints]
    assert all(error is not None and 0.01 < error < 0.15 for error in errors)


def test_identification_gains_over_the_nominal_model(judgement: JudgementResult) -> None:
    """Nominal links, rotors and friction are wrong by 10 to 20 %; what was found is not."""
    for joint in judgement.joints:
        assert joint.nominal_relative is not None and joint.relative is not None
        assert joint.nominal_relative > 2.0 * joint.relative


def test_a_model_current_of_zeros_is_no_model(
    campaign: Campaign, cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = campaign.folder
    paths = [*folder.completed("excitation"), *folder.completed("validation")]
    prepared = prepare_sources(gather_sources(paths, 0.7), Options(), Silent())
    sources, samples = prepared.sources.held_out, prepared.held_out
    assert controller_error(paths, cell, sources, samples) is not None

    def silent(path: Path, fields: tuple[str, ...]) -> Archive:
        archive = open_archive(path, fields=fields)
        zeros = np.zeros_like(archive.columns["model_current"])
        return replace(archive, columns={**archive.columns, "model_current": zeros})

    monkeypatch.setattr(hil.identify.surroundings, "open_archive", silent)
    assert controller_error(paths, cell, sources, samples) is None


def test_torque_limits_of_a_drive_train_are_gear_times_constant_times_current(cell: Cell) -> None:
    drive = cell.drive_table
    limits = torque_limits(cell)
    assert limits is not None
    gear = np.abs(drive.gear_ratio)
    np.testing.assert_allclose(
        limits, gear * np.array(drive.torque_constant) * np.array(drive.current_limit)
    )


@pytest.mark.parametrize(
    ("efforts", "expected"), [(("12", "0"), (12.0, np.nan)), (("0", "0"), None)]
)
def test_without_a_drive_train_they_are_the_urdfs_efforts(
    efforts: tuple[str, str], expected: tuple[float, float] | None
) -> None:
    urdf = TWO_LINK.read_text()
    for effort in efforts:
        urdf = urdf.replace('effort="100"', f'effort="{effort}"', 1)
    bare = Cell.from_texts('[cell]\nname = "two"\nurdf = "two_link.urdf"\n', urdf, TWO_LINK)
    found = torque_limits(bare)
    if expected is None:
        assert found is None
    else:
        np.testing.assert_array_equal(found, expected)


def test_the_table_has_a_row_per_joint_and_no_empty_column(found: Identification) -> None:
    rows = table(found.results)
    assert len(rows) == 1 + len(found.results.joint_names)
    assert rows[0].split() == ["joint", "RMS", "error", "relative", "fitted", "of", "limit", *_REST]
    for row, name in zip(rows[1:], found.results.joint_names, strict=True):
        assert row.startswith(name) and row.count("%") == 6
    assert len({len(row) for row in rows}) == 1


def test_every_finding_is_said_once(found: Identification, judgement: JudgementResult) -> None:
    said = sentences(found.results)
    for finding in judgement.findings:
        assert sum(finding.words in line for line in said) == 1


def test_json_holds_verdict_findings_and_figures(found: Identification) -> None:
    read = json.loads(as_json(found.results))
    assert read["good"] is found.results.verdict.good
    assert read["line"] == found.results.verdict.line
    assert {finding["check"] for finding in read["findings"]} >= {"excitation", "delay"}
    assert len(read["joints"]) == 6


@pytest.mark.parametrize("good", [True, False])
def test_the_line_comes_last_and_the_status_tells(
    found: Identification, good: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    verdict = found.results.verdict.model_copy(update={"good": good})
    results = found.results.model_copy(update={"verdict": verdict})
    if good:
        finish(results, json=False)
    else:
        with pytest.raises(typer.Exit) as left:
            finish(results, json=False)
        assert left.value.exit_code == NOT_GOOD
    assert capsys.readouterr().out == verdict.line + "\n"


def test_the_page_shows_the_worst_findings_first_and_a_figure_per_joint(
    found: Identification,
) -> None:
    judgement = found.results.judgement
    assert judgement is not None
    context = judgement_context(found.results)
    levels = [finding.level for finding in judgement.worst_first]
    assert levels == sorted(levels, key=["wrong", "doubtful", "information", "good"].index)
    for kind in ("speed_panels", "position_panels", "autocorrelation_panels"):
        assert [panel.title for panel in context[kind]] == found.results.joint_names
    drawn = [context[name] for name in context if name.endswith("panels")]
    identifiers = [panel.svg for panels in drawn for panel in panels]
    assert len(set(identifiers)) == len(identifiers)


def test_results_without_a_judgement_have_no_such_section(found: Identification) -> None:
    old = found.results.model_copy(update={"judgement": None})
    assert judgement_context(old) == {}
    assert table(old) == []


def test_the_judgement_survives_the_file(found: Identification, tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    found.results.save(path)
    assert type(found.results).load(path).judgement == found.results.judgement
