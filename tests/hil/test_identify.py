"""From archives to a result: reads archives and nothing else."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hil.archive import Samples, write_samples
from hil.campaign import Campaign
from hil.errors import ArchiveError, InputError, OutputError
from hil.identify import Identification, Options, identify_archives, identify_campaign
from hil.importers import Robot
from hil.outcome import rewrite_report, write_outcome
from hil.progress import Silent
from hil.results import Results
from sim_fixtures.ns16 import URDF_PATH

PERIOD = 0.004


@pytest.fixture(scope="module")
def found(campaign: Campaign) -> Identification:
    return identify_campaign(campaign.folder.root, Silent())


def paths(campaign: Campaign) -> list[Path]:
    kinds = ("excitation", "validation", "standstill")
    return [path for kind in kinds for path in campaign.folder.completed(kind)]


def test_58_parameters_are_found_with_their_rows_of_table_2(found: Identification) -> None:
    ids = sorted(p.table2_id or 0 for p in found.results.parameters)
    assert ids == list(range(1, 59))


def test_nearly_all_planted_values_lie_within_three_standard_deviations(
    found: Identification,
) -> None:
    """Of 58 normal deviates more than 3 outside 3 sigma come once in 10^5 tries."""
    coverage = found.results.coverage
    assert coverage is not None
    assert coverage.within_3 >= 55


def test_held_out_torque_lies_inside_its_intervals(found: Identification) -> None:
    calibration = found.results.calibration
    assert calibration is not None
    assert calibration.inside >= 0.93
    assert None not in calibration.joint_inside


def test_the_planned_criteria_are_those_of_what_was_executed(found: Identification) -> None:
    """Over the same instants; stiction and noise of acceleration change columns by per mille."""
    planned, executed = found.results.excitation.planned, found.results.excitation.executed
    assert planned is not None
    assert executed.n_samples == pytest.approx(3 * planned.n_samples, abs=6)
    assert executed.log10_det == pytest.approx(planned.log10_det, abs=58 * np.log10(1.01))
    assert executed.coupling_index == pytest.approx(planned.coupling_index, rel=0.02)
    assert executed.scaled_condition == pytest.approx(planned.scaled_condition, rel=0.02)


def test_the_result_needs_the_archives_only(
    campaign: Campaign, found: Identification, tmp_path: Path
) -> None:
    """Moved elsewhere, without the folder around them, they give the same numbers."""
    moved = [Path(shutil.copy(path, tmp_path)) for path in paths(campaign)]
    again = identify_archives(moved, Silent(), name=found.results.name)
    # How the campaign was run stands in its folder's own files.
    assert found.results.conduct is not None
    assert again.results == found.results.model_copy(update={"conduct": None})


@pytest.mark.slow
def test_the_papers_way_of_filtering_finds_the_same_parameters(
    campaign: Campaign, found: Identification
) -> None:
    paper = identify_campaign(campaign.folder.root, Silent(), Options(method="paper"))
    assert paper.verdict.good, paper.verdict.line
    for ours, theirs in zip(found.results.parameters, paper.results.parameters, strict=True):
        both = np.hypot(ours.std, theirs.std)
        assert abs(ours.estimate - theirs.estimate) < 5.0 * both, ours.name


def test_the_outcome_is_all_of_one_generation_or_untouched(
    found: Identification, tmp_path: Path
) -> None:
    write_outcome(tmp_path, found, Silent())
    first = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert {"results.json", "report.html", "parameters.csv", "identified.urdf"} <= set(first)
    assert Results.load(tmp_path / "results.json").exports is not None
    (tmp_path / "report.html").unlink()
    (tmp_path / "report.html").mkdir()
    other = replace(found, results=found.results.model_copy(update={"name": "other"}))
    with pytest.raises(OutputError, match=r"report\.html is a folder"):
        write_outcome(tmp_path, other, Silent())
    del first["report.html"]
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()} == first


def test_results_that_no_page_can_be_drawn_from_are_named(
    found: Identification, tmp_path: Path
) -> None:
    write_outcome(tmp_path, found, Silent())
    results = tmp_path / "results.json"
    content = json.loads(results.read_text())
    content["judgement"]["effective_rows"].pop()
    results.write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"results\.json: holds what no page can be drawn from"):
        rewrite_report(tmp_path)


def test_results_survive_their_file(found: Identification, tmp_path: Path) -> None:
    found.results.save(tmp_path / "results.json")
    assert Results.load(tmp_path / "results.json") == found.results


def test_a_torn_repetition_is_used_up_to_its_last_whole_chunk_and_named(
    campaign: Campaign, tmp_path: Path
) -> None:
    moved = [Path(shutil.copy(path, tmp_path)) for path in paths(campaign)]
    moved[2].write_bytes(moved[2].read_bytes()[: moved[2].stat().st_size // 2])
    found = identify_archives(moved, Silent())
    doubts = " ".join(found.results.verdict.warnings)
    assert moved[2].name in doubts
    assert "could be read" in doubts


def test_archives_without_an_excitation_are_refused(campaign: Campaign, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no excitation"):
        identify_archives(campaign.folder.completed("validation"), Silent())
    with pytest.raises(InputError, match="names no completed excitation"):
        identify_campaign(tmp_path, Silent())


def test_one_file_must_not_be_fitted_and_predicted(campaign: Campaign, tmp_path: Path) -> None:
    first = campaign.folder.completed("excitation")[0]
    copy = Path(shutil.copy(first, tmp_path / "another_name.mcap"))
    with pytest.raises(InputError, match="holds the same as"):
        identify_archives([first, copy], Silent())


def test_archives_of_different_robots_are_not_mixed(campaign: Campaign, tmp_path: Path) -> None:
    other = imported(tmp_path / "other.mcap")
    first = campaign.folder.completed("excitation")[0]
    with pytest.raises(ArchiveError, match=r"other\.mcap.*carries another"):
        identify_archives([first, other], Silent())


def test_without_repetitions_the_result_says_what_was_not_looked_for(campaign: Campaign) -> None:
    one = [campaign.folder.completed("excitation")[0], *campaign.folder.completed("validation")]
    found = identify_archives(one, Silent())
    assert any("cannot be distinguished from noise" in doubt for doubt in found.verdict.warnings)


def test_a_stretch_at_rest_is_no_test_of_a_model(campaign: Campaign) -> None:
    """The end of a recording, at which the arm is held for 0.2 s, has no motion to predict."""
    found = identify_archives([paths(campaign)[0]], Silent(), Options(split=0.985))
    assert not found.verdict.good
    assert "tests nothing" in found.verdict.line


def imported(
    path: Path, names: tuple[str, ...] | None = None, *, torque: bool = True, **spoilt: object
) -> Path:
    """An imported recording of smooth sines on six joints, with something wrong."""
    robot = Robot.from_urdf(URDF_PATH)
    time = np.arange(2000) * PERIOD
    position = 0.3 * np.sin(np.outer(time, np.linspace(1.0, 2.0, 6)))
    torques = np.cos(np.outer(time, np.linspace(1.0, 2.0, 6)))
    stamp = np.rint(time * 1e9).astype(np.int64)
    for key, value in spoilt.items():
        if key == "nan":
            position[value] = np.nan
        elif key == "stuck":
            position[:, value] = 0.25  # type: ignore[call-overload]
        elif key == "repeat":
            stamp[value] = stamp[value - 1]  # type: ignore[index, operator]
        elif key == "fall":
            stamp[value] -= 10**9  # type: ignore[index]
        elif key == "noise":
            torques += value * np.random.default_rng(1).standard_normal(torques.shape)
    write_samples(
        path,
        Samples(stamp, position, None, torques if torque else None, None),
        joint_names=names or robot.joint_names,
        metadata={"kind": "imported"},
        attachments=robot.attachments(),
    )
    return path


@pytest.mark.parametrize(
    ("spoilt", "sentence"),
    [
        ({"nan": (700, 2)}, r"position of joint joint_3 is nan at sample 700"),
        ({"stuck": 4}, r"joint joint_5 is stuck"),
        ({"fall": 300}, r"clock falls back at sample 300"),
    ],
)
def test_a_bad_recording_is_refused_by_name(
    tmp_path: Path, spoilt: dict[str, object], sentence: str
) -> None:
    with pytest.raises(ArchiveError, match=r"bad\.mcap.*" + sentence):
        identify_archives([imported(tmp_path / "bad.mcap", **spoilt)], Silent())


def test_a_repeated_time_stamp_is_averaged_and_told(tmp_path: Path) -> None:
    found = identify_archives([imported(tmp_path / "twice.mcap", repeat=300)], Silent())
    assert any("1 samples had the time stamp" in note for note in found.results.notes)


def test_joints_in_another_order_than_the_urdfs_are_refused_by_name(tmp_path: Path) -> None:
    names = ("joint_2", "joint_1", "joint_3", "joint_4", "joint_5", "joint_6")
    with pytest.raises(ArchiveError, match=r"order\.mcap.*recorded in the order joint_2, joint_1"):
        identify_archives([imported(tmp_path / "order.mcap", names)], Silent())


def test_a_single_recording_is_split_and_the_split_is_called_what_it_is(tmp_path: Path) -> None:
    found = identify_archives([imported(tmp_path / "one.mcap")], Silent())
    assert any("temporal split" in doubt for doubt in found.results.verdict.warnings)
    assert [run.archive for run in found.results.validation] == ["one.mcap (last part)"]
    assert "unseen" not in found.verdict.line.split(":")[0]


def test_a_repetition_of_what_was_fitted_is_not_called_unseen(campaign: Campaign) -> None:
    found = identify_archives(campaign.folder.completed("excitation"), Silent())
    assert found.verdict.line.startswith("The model predicts a repetition of the fitted motion")


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_torque_without_noise_is_named(tmp_path: Path, noise: float) -> None:
    """It came through a low-pass, or was computed; a measured one has noise at all frequencies."""
    found = identify_archives([imported(tmp_path / "smooth.mcap", noise=noise)], Silent())
    assert found.results.judgement is not None
    named = [one.check for one in found.results.judgement.findings]
    assert ("torque bandwidth" in named) == (noise == 0.0)


def test_a_recording_without_torque_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ArchiveError, match=r"bare\.mcap.*no joint torques"):
        identify_archives([imported(tmp_path / "bare.mcap", torque=False)], Silent())
