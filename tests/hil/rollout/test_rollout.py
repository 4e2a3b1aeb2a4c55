"""Rollouts, ensembles and annotated archives of an identified campaign, from the command line."""

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from typer.testing import CliRunner

from hil.archive.schema import MEASURED
from hil.base.errors import HilError, InputError
from hil.campaign import Campaign
from hil.cli import app
from hil.identified.annotate import FOLDER, PREDICTED, RESIDUAL
from hil.pipeline import stored_identification
from hil.pipeline.identified_model import predicted_parts
from hil.report.chart_picture import draw_charts
from hil.report.output_files import REPORT
from hil.report.rollout_section import overview_charts, overview_legends
from hil.results.provenance import PARAMETERS_JSON, RESULTS
from hil.results.results import Results
from hil.results.rollout_result import ROLLOUT, ArmErrors, RolloutResult
from hil.rollout.torque_rollout import POLISHED
from identification.rollout.servo_by_torque import PositionServo
from identification.text import percentage
from tests import messages
from tests.hil.simulated_logs import simulate, urdf_path, write_log
from tests.identification.two_link import MODEL, URDF, four_sines, truth
from tests.near import near

pytestmark = pytest.mark.long

pytest.importorskip("mujoco", reason="the extra mujoco is not installed")


ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module")
def identified(tmp_path_factory, identified_campaign: Campaign) -> Path:
    copy = tmp_path_factory.mktemp("twin") / "campaign"
    shutil.copytree(identified_campaign.folder.root, copy)
    run("identify", copy, "-q")
    return copy


@pytest.fixture
def folder(identified: Path, tmp_path: Path) -> Path:
    """A campaign with the files of its identification, to change."""
    return Path(shutil.copytree(identified, tmp_path / "campaign"))


def run(*arguments: str):
    return CliRunner().invoke(app, [*map(str, arguments)])


def test_a_rollout_is_better_than_the_nominal_arm(folder: Path) -> None:
    done = run("rollout", folder, "--samples", "3", "--json")
    assert done.exit_code in (0, 5), done.output
    result = RolloutResult.load(folder / ROLLOUT)
    assert json.loads(done.stdout)["windows"] == result.windows
    assert result.ratio is not None
    assert result.ratio[2] <= 0.5  # at 0.5 s
    assert result.identified.unstable == 0
    assert "is better than the nominal one up to 1 s" in result.message
    assert all(np.isfinite(at).all() for at in result.identified.joints)
    assert "nan" not in (folder / ROLLOUT).read_text().lower()
    unstable = result.identified.model_copy(update={"unstable": result.windows - 1})
    message = result.model_copy(update={"identified": unstable}).message
    assert message.startswith("The identified arm does not follow the recorded motion")
    assert "better than the nominal" not in message


def test_it_reads_what_was_identified(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Results and archives are there: no other identification, and the same figures."""
    anew = json.loads(run("rollout", folder, "--samples", "3", "--again", "--json").stdout)

    def identify(*_: object, **__: object) -> None:
        raise AssertionError("the parameters are there")

    monkeypatch.setattr(stored_identification, "identify_paths", identify)
    done = run("rollout", folder, "--samples", "3", "--json")
    assert done.exit_code in (0, 5), done.exception
    read = json.loads(done.stdout)
    assert read["parameters"] != ""
    assert anew["parameters"] == ""
    assert read["identified"]["joints"] == pytest.approx(
        np.array(anew["identified"]["joints"]), rel=1e-6
    )
    assert read["inside"] == pytest.approx(np.array(anew["inside"]), abs=0.02)


class TestFlangeErrorOfTheVerdict:
    """Computed from the torque error without a simulator, and simulated by MuJoCo."""

    FACTOR = 1.5
    HORIZON = 0.2  # s

    def require_alike(self, folder: Path) -> None:
        done = run("rollout", folder, "--samples", "3", "-q")
        assert done.exit_code in (0, 5), done.output
        rollout = RolloutResult.load(folder / ROLLOUT)
        simulated = rollout.identified.tool[rollout.horizons.index(self.HORIZON)]
        purposes = Results.load(folder / RESULTS).verdict.purposes
        (computed,) = [each.figure for each in purposes if each.name == "simulation"]
        assert simulated is not None and computed is not None
        assert simulated / self.FACTOR < computed < simulated * self.FACTOR

    def test_of_a_campaign(self, folder: Path) -> None:
        self.require_alike(folder)

    @pytest.mark.parametrize("noise", [1.0, 10.0])
    @pytest.mark.parametrize(
        ("urdf", "locked"),
        [("ur5_robot.urdf", ()), ("panda.urdf", ("panda_finger_joint1", "panda_finger_joint2"))],
    )
    def test_of_a_log(
        self, urdf: str, locked: tuple[str, ...], noise: float, tmp_path: Path
    ) -> None:
        made = simulate(urdf, np.arange(0.0, 12.0, 0.01), locked=locked, noise=noise)
        columns = (made.time, made.position, made.torque)
        log = write_log(tmp_path / "log.csv", ["t", "q{}", "tau{}"], *columns)
        run("identify", log, "--urdf", urdf_path(urdf), "-o", tmp_path / "out", "-q")
        self.require_alike(tmp_path / "out")


class TestSectionOfTheReport:
    def test_the_rollout_writes_it(self, folder: Path) -> None:
        assert "Simulated motion" not in (folder / REPORT).read_text()
        run("rollout", folder, "--samples", "3")
        page = (folder / REPORT).read_text()
        result = RolloutResult.load(folder / ROLLOUT)
        assert result.message in page
        assert "arms drawn from the posterior" in page
        assert page.count('<div class="panel" data-chart="rollout-') == len(result.joint_names) + 1
        section = page.split('<section id="rollout">')[1].split("</section>")[0]
        assert "nan" not in section.lower()
        assert section.count(">0.2</text>") >= len(result.joint_names)  # ticks at the horizons

    def test_the_picture_has_errors_and_shares(self, folder: Path) -> None:
        run("rollout", folder, "--samples", "3")
        found = RolloutResult.load(folder / ROLLOUT)
        errors, shares = overview_charts(found)
        of_identified = next(t for t in errors.plots[0].traces if t.name == "predicted")
        overall = [1e3 * found.identified.overall(k) for k in range(len(found.horizons))]
        assert of_identified.values == pytest.approx(overall)
        lines = {trace.name: trace.values for trace in shares.plots[0].traces}
        assert lines[found.joint_names[1]] == pytest.approx([100.0 * at[1] for at in found.inside])
        figure = draw_charts([[errors], [shares]], overview_legends(found))
        texts = [text.get_text() for axes in figure.axes for text in axes.get_legend().texts]
        assert texts[:3] == ["arms drawn from the posterior", "nominal model", "identified model"]
        assert texts[3:] == [*found.joint_names, "88 % to 99 %"]

    def test_it_counts_an_arm_that_explodes(self, folder: Path) -> None:
        run("rollout", folder, "--samples", "3")
        result = RolloutResult.load(folder / ROLLOUT)
        count = result.windows
        others = len(result.joint_names) - 1
        lost = ArmErrors(
            joints=[[np.pi] * (others + 1)] * len(result.horizons),
            tool=[None] * len(result.horizons),
            unstable=count,
            unstable_joints=[count, *[0] * others],
        )
        path = folder / ROLLOUT
        path.write_text(result.model_copy(update={"identified": lost}).to_json())
        run("report", folder)
        section = (folder / REPORT).read_text().split('<section id="rollout">')[1]
        section = section.split("</section>")[0]
        assert f"makes {count} of {count} windows unstable" in section
        assert f"unstable in {count} of {count} windows (first {result.joint_names[0]}" in section
        assert "nan" not in section.lower()

    def test_another_identification_removes_it(self, folder: Path) -> None:
        run("rollout", folder, "--samples", "3")
        run("identify", folder, "-q", "--friction", "coulomb,viscous,offset")
        run("report", folder)
        assert "Simulated motion" not in (folder / REPORT).read_text()

    def test_an_arm_of_the_rollout_is_not_that_of_the_report(self, folder: Path) -> None:
        done = run("rollout", folder, "--samples", "3", "--again", "-v")
        assert messages.NOT_IN_REPORT in done.output
        assert "Simulated motion" not in (folder / REPORT).read_text()


def test_no_predicted_part_is_shorter_than_a_window() -> None:
    """Of a short motion a tenth would continue what was fitted: the band was too narrow."""
    assert [predicted_parts(duration, 1.0) for duration in (1.5, 4.7, 7.0, 60.0)] == [2, 4, 7, 10]


def test_to_identify_imports_nothing_of_mujoco() -> None:
    script = "import hil.cli.identify, hil.report.output_files, sys; print('mujoco' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout == "False\n", done.stderr


def test_a_polish_is_judged_on_held_out_windows(folder: Path) -> None:
    done = run("rollout", folder, "--samples", "3", "--polish")
    assert done.exit_code in (0, 5), done.exception
    result = RolloutResult.load(folder / ROLLOUT)
    assert result.polish is not None
    assert result.polish.accepted == (result.polish.change < 0.0)
    assert (folder / POLISHED).exists() == result.polish.accepted
    verdict = "used." if result.polish.accepted else "not used."
    assert verdict in result.message
    assert f"held-out position error by {percentage(abs(np.expm1(result.polish.change)), 1)}" in (
        result.message
    )


def test_a_log_without_torque_and_command_is_named(tmp_path: Path) -> None:
    time = np.arange(0.0, 5.0, 0.01)
    log = tmp_path / "log.csv"
    urdf = ROOT / "examples" / "two_joints" / "robot.urdf"
    columns = np.column_stack([time, np.sin(time), np.cos(time)])
    np.savetxt(log, columns, delimiter=",", header="t,q1,q2", comments="")
    refused = run("identify", log, "--urdf", urdf)
    assert isinstance(refused.exception, HilError)
    assert "log.csv: torque: no channel is named as torque" in str(refused.exception)
    assert "commanded positions (--columns 'commanded_position=NAME{}')" in str(refused.exception)
    refused = run("rollout", log)
    assert isinstance(refused.exception, HilError)
    assert "log.csv: is not an MCAP file" in str(refused.exception)


def test_parameters_of_no_possible_arm_are_named(folder: Path) -> None:
    """Without a physically consistent arm in the files it is identified again, and says why."""
    path = folder / PARAMETERS_JSON
    path.write_text(json.dumps(json.loads(path.read_text()) | {"standard": None}))
    done = run("rollout", folder, "--samples", "3", "-v")
    assert "identified again" in done.output
    assert "it has no physically consistent parameters" in done.output


def with_links(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change each link of the physically consistent parameters in a folder."""
    path = folder / PARAMETERS_JSON
    content = json.loads(path.read_text())
    for link in content["standard"]["links"]:
        change(link)
    path.write_text(json.dumps(content))


def test_bodies_that_cannot_exist_are_named(folder: Path, tmp_path: Path) -> None:
    """They are no arm to simulate, to export or to draw around: it is identified again."""
    with_links(folder, lambda link: link.update(Izz=-0.5) if link["joint"] == "joint_5" else None)
    reason = "parameters.json cannot be used (the body of joint_5 cannot exist)"
    commands = {
        "rollout": ("--samples", "3", "-v", "-o", tmp_path / "out"),
        "export": ("--to", "urdf", "-o", tmp_path / "arm.urdf"),
        "export ": ("--to", "mjcf", "--ensemble", "3", "-o", tmp_path / "arms"),
    }
    for command, options in commands.items():
        done = run(command.strip(), folder, *options)
        assert done.exit_code in (0, 5), done.exception
        assert f"identified again: {reason}" in " ".join(done.output.split())


def test_an_arm_that_explodes_is_counted(folder: Path) -> None:
    """Bodies and rotors that can exist, too light for the recorded torque."""
    quantities = ("m", "mcx", "mcy", "mcz", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")

    def lighten(link: dict[str, Any]) -> None:
        for name in (*quantities, "rotor_inertia"):
            link[name] *= 1e-6

    with_links(folder, lighten)
    done = run("rollout", folder, "--samples", "3", "-v")
    assert done.exit_code in (0, 5), done.exception
    result = RolloutResult.load(folder / ROLLOUT)
    assert result.identified.unstable == result.windows
    assert f"identified: unstable in {result.windows} of {result.windows} windows" in done.output
    section = (folder / REPORT).read_text().split('<section id="rollout">')[1]
    for text in (done.output, (folder / ROLLOUT).read_text(), section.split("</section>")[0]):
        assert not re.search(r"\b(nan|inf)\b", text, re.IGNORECASE)


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


def test_gains_of_an_identified_servo_are_named(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stiff(_stretches: object, _step: float, joint_names: Sequence[str]) -> PositionServo:
        n = len(joint_names)
        return PositionServo(np.full(n, 2e4), np.full(n, 200.0), 0.004)

    monkeypatch.setattr("hil.rollout.torque_rollout.identify_servo", stiff)
    done = run("rollout", folder, "--servo", "identified", "--samples", "3")
    assert done.exit_code in (0, 5), done.output
    result = RolloutResult.load(folder / ROLLOUT)
    gains = re.search(r"gains (.*); delay [\d.]+ ms\)$", result.drive)
    assert gains, result.drive
    shown = gains[1].split("; ")
    assert [gain.split()[0] for gain in shown] == result.joint_names
    assert all(gain.endswith(" N·m/rad") for gain in shown)


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
        assert efforts[PREDICTED][stamp] + residual == near(efforts[MEASURED][stamp])
    refused = run("identify", copies[0])
    assert isinstance(refused.exception, Exception)
    assert "not an archive" in str(refused.exception)


def test_annotated_copies_of_single_archives_lie_beside_them(folder: Path, tmp_path: Path) -> None:
    archive = next((folder / "archives").glob("excitation*.mcap"))
    shutil.copy(archive, tmp_path / "run.mcap")
    run("identify", tmp_path / "run.mcap", "--annotate")
    assert len([*(tmp_path / "run" / FOLDER).glob("*.mcap")]) == 1


def test_a_model_that_must_not_be_relied_on_says_so(tmp_path: Path) -> None:
    """Torques whose map states the opposite sign: the rollout may be near, the model is not."""
    time = np.arange(0.0, 12.0, 0.004)
    motion = four_sines(time, 0.5)
    noise = np.random.default_rng(1).standard_normal((len(time), 4)) * [1e-5, 1e-5, 3.0, 0.2]
    torque = -MODEL.torque(truth(), motion)
    columns = np.column_stack([time, np.column_stack([motion.position, torque]) + noise])
    log, urdf, archive = (tmp_path / name for name in ("log.csv", "robot.urdf", "log.mcap"))
    np.savetxt(log, columns, delimiter=",", header="t,q1,q2,tau1,tau2", comments="")
    urdf.write_text(URDF)
    stated = tmp_path / "map.toml"
    stated.write_text(
        '[time]\ncolumn = "t"\n[position]\ncolumns = "q{}"\n[torque]\ncolumns = "tau{}"\n'
    )
    assert run("import", "log", log, "--urdf", urdf, "--map", stated, "-o", archive).exit_code == 0
    done = run("rollout", archive, "--samples", "3")
    assert done.exit_code == 5, done.exception
    assert messages.ALL_TORQUES_OPPOSITE in done.output
