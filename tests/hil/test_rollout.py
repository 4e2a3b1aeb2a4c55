"""Rollouts, ensembles and annotated archives of an identified campaign, from the command line."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from typer.testing import CliRunner

from hil.annotate import FOLDER, PREDICTED, RESIDUAL
from hil.archive.schema import MEASURED
from hil.campaign import Campaign
from hil.cli import app
from hil.errors import InputError
from hil.rollout_result import ROLLOUT, RolloutResult

pytestmark = pytest.mark.long

pytest.importorskip("mujoco", reason="the extra mujoco is not installed")


@pytest.fixture(scope="module")
def folder(tmp_path_factory, identified_campaign: Campaign) -> Path:
    copy = tmp_path_factory.mktemp("twin") / "campaign"
    shutil.copytree(identified_campaign.folder.root, copy)
    return copy


def run(*arguments: str):
    return CliRunner().invoke(app, [*map(str, arguments)])


def test_a_rollout_is_better_than_the_nominal_arm(folder: Path) -> None:
    done = run("rollout", folder, "--samples", "3", "--json")
    assert done.exit_code in (0, 5), done.output
    found = RolloutResult.load(folder / ROLLOUT)
    assert json.loads(done.stdout)["windows"] == found.windows
    assert found.ratio is not None
    assert found.ratio[2] <= 0.5  # at 0.5 s
    assert found.identified.unstable == 0
    assert "is better than the nominal one up to 1 s" in found.message
    assert all(np.isfinite(at).all() for at in found.identified.joints)
    assert "nan" not in (folder / ROLLOUT).read_text().lower()


@pytest.mark.parametrize(
    ("servo", "problem"),
    [
        ("fast", "'fast' is not a servo"),
        ("0,1,0", "is not a servo"),
        ("1000,10,9", "give a delay of 0 to 0.5 s"),
        ("nan,10,0", "is not a servo"),
    ],
)
def test_a_servo_needs_gains_and_a_delay(folder: Path, servo: str, problem: str) -> None:
    done = run("rollout", folder, "--servo", servo)
    assert isinstance(done.exception, InputError)
    assert problem in str(done.exception)


def test_an_ensemble_is_written_as_files_or_arrays(folder: Path, tmp_path: Path) -> None:
    done = run("export", folder, "--to", "mjcf", "--ensemble", "3", "-o", tmp_path / "arms")
    assert done.exit_code in (0, 5), done.output
    assert sorted(path.name for path in (tmp_path / "arms").iterdir()) == [
        "arm_1.xml", "arm_2.xml", "arm_3.xml"
    ]  # fmt: skip
    done = run("export", folder, "--to", "mjcf", "--ensemble", "3", "-o", tmp_path / "arms.npz")
    assert done.exit_code in (0, 5), done.output
    with np.load(tmp_path / "arms.npz", allow_pickle=False) as arrays:
        assert arrays["standard"].shape == (3, len(arrays["standard_names"]))


def test_an_estimator_without_posterior_has_no_ensemble(folder: Path, tmp_path: Path) -> None:
    done = run("export", folder, "--to", "mjcf", "--ensemble", "3", "--estimator", "wls",
               "-o", tmp_path / "arms")  # fmt: skip
    assert isinstance(done.exception, InputError)
    assert "the estimator wls has no posterior" in str(done.exception)


def test_annotated_copies_add_up_and_are_no_archives(folder: Path, tmp_path: Path) -> None:
    before = {path: path.read_bytes() for path in (folder / "archives").iterdir()}
    done = run("identify", folder, "-o", tmp_path, "--annotate")
    assert done.exit_code in (0, 5), done.output
    assert before == {path: path.read_bytes() for path in (folder / "archives").iterdir()}
    copies = sorted((tmp_path / FOLDER).glob("excitation*.mcap"))
    efforts: dict[str, dict[int, np.ndarray]] = {}
    with copies[0].open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        topics = [MEASURED, PREDICTED, RESIDUAL]
        for _, channel, message, state in reader.iter_decoded_messages(topics=topics):
            efforts.setdefault(channel.topic, {})[message.log_time] = np.array(state.effort)
    assert len(efforts[RESIDUAL]) > 100
    for stamp, residual in efforts[RESIDUAL].items():
        assert efforts[PREDICTED][stamp] + residual == pytest.approx(efforts[MEASURED][stamp])
    refused = run("identify", copies[0])
    assert isinstance(refused.exception, Exception)
    assert "not an archive" in str(refused.exception)


def test_annotated_copies_of_single_archives_lie_beside_them(folder: Path, tmp_path: Path) -> None:
    archive = next((folder / "archives").glob("excitation*.mcap"))
    shutil.copy(archive, tmp_path / "run.mcap")
    run("identify", tmp_path / "run.mcap", "--annotate")
    assert len([*(tmp_path / "run" / FOLDER).glob("*.mcap")]) == 1
