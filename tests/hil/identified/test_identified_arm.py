"""`hil.identify(...)`: the pipeline of the command, as an object. All recordings are simulated."""

from __future__ import annotations

import inspect
import json
import pickle
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from matplotlib.figure import Figure
from typer.testing import CliRunner

import hil
from hil.base.errors import InputError, SourceError
from hil.cli import app
from hil.importers.text_table import TextTable
from hil.report.figures import joints_of, torque_charts
from hil.results.results import Results
from tests.hil.browser import OpenedPage, chromium
from tests.hil.importers.moving_log import URDF
from tests.hil.simulated_logs import write_moving_log
from tests.tiers import quick_ones


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log, another motion of the same arm, and its URDF."""
    place = tmp_path_factory.mktemp("logs")
    (place / "three.urdf").write_text(URDF)
    write_moving_log(place / "a.csv", URDF)
    write_moving_log(place / "b.csv", URDF, seed=1)
    return place


@pytest.fixture(scope="module")
def result(folder: Path) -> Any:
    return hil.identify(folder / "a.csv", urdf=folder / "three.urdf", predict=str(folder / "b.csv"))


class TestResult:
    def test_the_verdict_is_of_the_other_motion(self, result: Any) -> None:
        assert result.verdict.good
        assert result.verdict.line.startswith("Good for feed-forward (0.1 % of the torque left")
        assert result.verdict.line in repr(result)
        assert len(repr(result)) < 400

    def test_parameters_are_a_table_with_intervals(self, result: Any) -> None:
        """Coulomb friction of 0.4 N·m and viscous friction of 0.2 N·m·s/rad were planted."""
        table = result.parameters
        columns = ["meaning", "body", "joint", "estimate", "low", "high", "unit", "known"]
        assert list(table.columns[:8]) == columns
        friction = table.loc[["f0_1", "f0_2", "f0_3", "f1_1", "f1_2", "f1_3"]]
        truth = np.repeat([0.4, 0.2], 3)
        assert ((friction["low"] < truth) & (truth < friction["high"])).all()
        assert list(table.loc["f0_1", ["unit", "joint", "known"]]) == ["N·m", "hip", "yes"]
        assert [*table.index] == [parameter.name for parameter in result.results.parameters]

    def test_prediction_is_the_torque_that_was_simulated(self, result: Any) -> None:
        """Of Newton and Euler with the friction that was planted, at 100 random states."""
        model = pin.buildModelFromXML(URDF)
        data = model.createData()
        rng = np.random.default_rng(5)
        q, v, a = rng.uniform(-1.0, 1.0, (3, 100, 3)) * np.array([1.0, 3.0, 10.0])[:, None, None]
        rigid = np.array([pin.rnea(model, data, *row) for row in zip(q, v, a, strict=True)])
        truth = rigid + 0.4 * np.sign(v) + 0.2 * v
        error = result.predict(q, v, a) - truth
        assert np.linalg.norm(error) < 0.01 * np.linalg.norm(truth)
        single = [result.predict(*row) for row in zip(q, v, a, strict=True)]
        np.testing.assert_allclose(single, result.predict(q, v, a), rtol=0.0, atol=1e-9)

    def test_prediction_of_another_number_of_joints_is_refused(self, result: Any) -> None:
        with pytest.raises(ValueError, match="shape"):
            result.predict([0.0, 0.0], [0.0, 0.0], [0.0, 0.0])

    def test_the_model_of_pinocchio_has_friction_and_the_same_torque(self, result: Any) -> None:
        model = result.model
        assert isinstance(model, pin.Model)
        q, v, a = (np.array(row) for row in ([0.3, -0.5, 0.2], [1.0, -2.0, 0.5], [3.0, 1.0, -8.0]))
        dry = np.asarray(model.friction)
        assert np.allclose(dry, 0.4, atol=0.02)
        assert np.allclose(model.upperDryFrictionLimit, dry)
        torque = pin.rnea(model, model.createData(), q, v, a)  # armature included
        torque += np.asarray(model.damping) * v + dry * np.sign(v)
        assert np.allclose(torque, result.predict(q, v, a), rtol=1e-3, atol=0.02)

    def test_a_figure_has_torque_and_error_of_each_joint(self, result: Any) -> None:
        """As the report has, from the same description."""
        axes = result.plot().axes
        assert [panel.get_title() for panel in axes[::2]] == ["hip", "knee", "ankle"]
        charts = torque_charts(result.identification.series, joints_of(result.results))
        described = [
            trace.values for chart in charts for plot in chart.plots for trace in plot.traces
        ]
        drawn = [line.get_ydata() for panel in axes for line in panel.lines]
        assert len(drawn) == 3 * (3 + 2)  # measured, identified, nominal; two errors
        for values, line in zip(described, drawn, strict=True):
            np.testing.assert_array_equal(line, values)

    def test_a_plot_is_of_some_joints_at_a_size_with_its_series(self, result: Any) -> None:
        plot = result.plot(["knee", 2], size=(6.0, 3.0))
        assert [*plot.figure.get_size_inches()] == [6.0, 3.0]
        assert [panel.get_title() for panel in plot.axes[::2]] == ["knee", "ankle"]
        assert [*plot.series["measured"].columns] == ["knee", "ankle"]
        drawn = plot.axes[0].lines[0].get_ydata()
        np.testing.assert_array_equal(plot.series["measured", "knee"], drawn)
        assert plot.png().startswith(b"\x89PNG")

    def test_a_plot_goes_into_somebody_elses_axes(self, result: Any) -> None:
        figure = Figure()
        left, right = figure.subplots(1, 2)
        plot = result.plot(["hip", "knee"], axes=[left, right])
        assert plot.figure is figure
        assert len(left.lines) == len(right.lines) == 3
        assert left.get_ylabel() == "torque [N·m]"

    @pytest.mark.parametrize("joints", ["wrist", 3, [0, -1]])
    def test_a_plot_of_another_joint_is_refused(self, result: Any, joints: Any) -> None:
        with pytest.raises(InputError, match="there is no joint"):
            result.plot(joints)

    def test_it_can_be_pickled(self, result: Any) -> None:
        again = pickle.loads(pickle.dumps(result))
        state = [0.1, 0.2, 0.3]
        assert again.verdict == result.verdict
        np.testing.assert_array_equal(
            again.predict(state, state, state), result.predict(state, state, state)
        )

    @pytest.mark.long
    def test_a_notebook_shows_it(self, result: Any, tmp_path: Path) -> None:
        page = tmp_path / "cell.html"
        text = result._repr_html_()
        page.write_text(f"<meta charset=utf-8>{text}")
        assert result.verdict.line in text
        assert "a.csv: tau1 .. tau3: torque, by the name" in text
        with chromium() as browser:
            opened = OpenedPage(browser, page)
            assert opened.page.locator("img").evaluate("image => image.naturalWidth") > 500
            assert opened.page.locator("tbody tr").count() == 3  # joints
            assert opened.errors == []

    @pytest.mark.long
    def test_names_of_channels_are_no_markup(self, folder: Path, tmp_path: Path) -> None:
        text = (folder / "a.csv").read_text().replace("tau", "<b>tau", 3)
        (tmp_path / "x.csv").write_text(text)
        result = hil.identify(tmp_path / "x.csv", urdf=folder / "three.urdf",
                              reading=hil.ImportOptions(chosen={"torque": "<b>tau{}"}))  # fmt: skip
        assert "<b>" not in result._repr_html_()
        assert "&lt;b&gt;tau{}" in result._repr_html_()


class TestWhatWasRead:
    """Report and `results.json` say what is not as the log has it."""

    @pytest.mark.long
    def test_exchanged_torques_are_named(self, folder: Path, tmp_path: Path) -> None:
        import pandas

        frame = pandas.read_csv(folder / "a.csv")
        frame[["tau1", "tau2"]] = frame[["tau2", "tau1"]].to_numpy()
        arm = hil.identify(frame, urdf=folder / "three.urdf")
        place = arm.save(tmp_path / "exchanged")
        (read,) = Results.load(place / "results.json").recordings
        assert (read.file, read.use) == ("recording.csv", "fitted")
        assert any("torque columns belong to" in change for change in read.changes), read.changes
        assert any(line.startswith("tau1 .. tau3: torque") for line in read.channels)
        assert read.changes[0] in (place / "report.html").read_text()

    def test_a_log_that_is_given_twice_is_named(self, folder: Path, tmp_path: Path) -> None:
        """Not the archive in memory that was made of it."""
        log = folder / "a.csv"
        with pytest.raises(InputError, match=r"a\.csv: was given twice"):
            hil.identify([log, log], urdf=folder / "three.urdf")
        copy = shutil.copy(log, tmp_path / "copy.csv")
        with pytest.raises(InputError, match=r"copy\.csv: is a copy of a\.csv"):
            hil.identify([log, copy], urdf=folder / "three.urdf")

    def test_a_log_that_is_right_has_no_changes(self, result: Any) -> None:
        assert [read.use for read in result.results.recordings] == ["fitted", "predicted"]
        assert [read.changes for read in result.results.recordings] == [[], []]


class TestSaved:
    def test_nothing_is_written_before(self, folder: Path, result: Any) -> None:
        assert result.verdict.good
        assert sorted(path.name for path in folder.iterdir()) == ["a.csv", "b.csv", "three.urdf"]

    @pytest.mark.long
    def test_it_is_what_the_command_writes(self, folder: Path, result: Any, tmp_path: Path) -> None:
        saved = result.save(tmp_path / "python")
        arguments = ("identify", "a.csv", "--urdf", "three.urdf", "--predict", "b.csv", "--quiet")
        command_line = [str(folder / word) if "." in word else word for word in arguments]
        done = CliRunner().invoke(app, [*command_line, "--output", str(tmp_path / "command")])
        assert done.exit_code == 0, done.output
        assert saved == tmp_path / "python"
        for name in ("a.mcap", "b.mcap", "map.toml", "sources.json", "report_series.npz"):
            files = [tmp_path / place / name for place in ("python", "command")]
            assert files[0].read_bytes() == files[1].read_bytes(), name
        parts = [Results.load(tmp_path / place / "results.json") for place in ("python", "command")]
        assert parts[0].parameters == parts[1].parameters
        assert parts[0].verdict == parts[1].verdict
        assert {path.name for path in saved.iterdir()} == {
            path.name for path in (tmp_path / "command").iterdir()
        }

    @pytest.mark.long
    def test_without_a_folder_it_is_that_of_the_log(self, folder: Path, tmp_path: Path) -> None:
        log = tmp_path / "a.csv"
        log.write_bytes((folder / "a.csv").read_bytes())
        result = hil.identify([log, folder / "b.csv"], urdf=folder / "three.urdf")
        assert result.save() == tmp_path / "a"
        assert result.save() == tmp_path / "a"  # renewed
        again = hil.identify(tmp_path / "a")
        assert again.verdict.line == result.verdict.line
        assert hil.identify(
            tmp_path / "a" / "a.mcap", predict=tmp_path / "a" / "b.mcap"
        ).verdict.good

    @pytest.mark.long
    def test_the_archive_is_in_memory_until_it_is_saved(
        self, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Nor is a temporary file written."""
        monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "no such folder"))
        result = hil.identify(folder / "a.csv", urdf=folder / "three.urdf")
        (archive,) = result.identification.paths
        assert not archive.exists()
        place = result.save(tmp_path / "saved")
        assert (place / archive.name).is_file()

    def test_the_log_is_parsed_once(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        parsed = []
        read = TextTable.read
        monkeypatch.setattr(
            TextTable, "read", lambda path, *how: parsed.append(path) or read(path, *how)
        )
        hil.identify(folder / "a.csv", urdf=folder / "three.urdf")
        assert parsed == [folder / "a.csv"]


@pytest.fixture(scope="module")
def saved(result: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of results."""
    return result.save(tmp_path_factory.mktemp("saved") / "arm")


@pytest.fixture(scope="module")
def loaded(saved: Path) -> Any:
    return hil.load(saved)


class TestLoaded:
    """A folder of `hil identify`, without identifying again."""

    def test_it_is_what_was_identified(self, result: Any, loaded: Any) -> None:
        assert isinstance(loaded, hil.IdentifiedArm)
        assert repr(loaded) == repr(result)
        assert loaded.parameters.equals(result.parameters)
        assert loaded.verdict == result.verdict
        assert loaded.channels == result.channels
        q, v, a = np.random.default_rng(1).uniform(-1.0, 1.0, (3, 20, 3))
        np.testing.assert_array_equal(loaded.predict(q, v, a), result.predict(q, v, a))
        rigid = [pin.rnea(each.model, each.model.createData(), q[0], v[0], a[0])
                 for each in (loaded, result)]  # fmt: skip
        np.testing.assert_allclose(*rigid, rtol=1e-9)

    def test_a_remark_on_its_recordings_is_none_of_its_verdict(
        self, saved: Path, result: Any, tmp_path: Path
    ) -> None:
        place = tmp_path / "arm"
        shutil.copytree(saved, place)
        content = json.loads((place / "results.json").read_text())
        content["verdict"]["warnings"].append("a.mcap: the clock jumps")
        (place / "results.json").write_text(json.dumps(content))
        loaded = hil.load(place)
        assert loaded.verdict == result.verdict
        assert loaded.results.remarks == ["a.mcap: the clock jumps"]

    @pytest.mark.long
    def test_its_plot_and_its_page_are_the_same(self, result: Any, loaded: Any) -> None:
        assert loaded.plot().series.equals(result.plot().series)
        assert loaded._repr_html_() == result._repr_html_()

    def test_nothing_is_estimated(self, saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.delattr("hil.pipeline.identification.estimate_with")
        assert hil.load(saved).verdict.good

    def test_its_files_can_be_saved_elsewhere(
        self, saved: Path, loaded: Any, tmp_path: Path
    ) -> None:
        place = loaded.save(tmp_path / "copy")
        assert {file.name for file in place.iterdir()} == {file.name for file in saved.iterdir()}
        assert hil.load(place).parameters.equals(loaded.parameters)

    def test_an_archive_that_was_exchanged_is_refused(self, saved: Path, tmp_path: Path) -> None:
        place = tmp_path / "arm"
        shutil.copytree(saved, place)
        shutil.copyfile(place / "b.mcap", place / "a.mcap")
        with pytest.raises(InputError, match="its archives are not the ones that were identified"):
            hil.load(place)

    def test_a_folder_without_results_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match=r"there is no results.json.*hil identify"):
            hil.load(tmp_path)


@pytest.fixture(scope="module")
def of_file(folder: Path) -> Any:
    return hil.identify(folder / "a.csv", urdf=folder / "three.urdf")


class TestDataFrame:
    """A table in memory is a log."""

    @pytest.mark.parametrize("indexed", quick_ones([True], [False, True]))
    @pytest.mark.long
    def test_it_gives_what_its_file_gives(
        self,
        folder: Path,
        of_file: Any,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        indexed: bool,
    ) -> None:
        import pandas

        frame = pandas.read_csv(folder / "a.csv")
        if indexed:
            frame = frame.set_index(frame.columns[0])
        identified = hil.identify(frame, urdf=folder / "three.urdf")
        assert identified.verdict == of_file.verdict
        assert identified.parameters.equals(of_file.parameters)
        monkeypatch.chdir(tmp_path)
        assert identified.save().resolve() == tmp_path / "recording"
        assert hil.load(tmp_path / "recording").verdict.good

    def test_one_may_be_predicted_from_another(self, folder: Path) -> None:
        import pandas

        frames = [pandas.read_csv(folder / name) for name in ("a.csv", "b.csv")]
        identified = hil.identify(frames[0], urdf=folder / "three.urdf", predict=frames[1])
        assert [path.name for path in identified.predicted] == ["recording-2.csv"]


class TestRefused:
    def test_a_log_without_its_arm(self, folder: Path) -> None:
        with pytest.raises(InputError, match="needs the description of its arm"):
            hil.identify(folder / "a.csv")

    def test_two_descriptions(self, folder: Path) -> None:
        robot = hil.Robot.from_urdf(folder / "three.urdf")
        with pytest.raises(InputError, match="exclude each other"):
            hil.identify(folder / "a.csv", urdf=folder / "three.urdf", robot=robot)

    def test_no_recording(self) -> None:
        with pytest.raises(InputError, match="there is no recording"):
            hil.identify([])

    def test_a_log_that_leaves_a_quantity_open(self, folder: Path, tmp_path: Path) -> None:
        text = (folder / "a.csv").read_text().replace("tau", "load", 3)
        (tmp_path / "x.csv").write_text(text)
        with pytest.raises(SourceError, match="--columns 'torque=load"):
            hil.identify(tmp_path / "x.csv", urdf=folder / "three.urdf")


def test_identify_is_a_plain_function() -> None:
    assert inspect.isfunction(hil.identify) and type(hil) is ModuleType
    names = [*inspect.signature(hil.identify).parameters]
    assert names[:2] == ["recordings", "urdf"]
    public = [name for name in dir(hil) if not name.startswith("_")]
    assert {"identify", "IdentifiedArm", "ImportOptions"} <= {*public}
    assert len(public) == len({*public}) and not {"Any", "import_module"} & {*public}


def test_import_hil_loads_no_library() -> None:
    libraries = "{'numpy', 'pinocchio', 'pandas', 'matplotlib', 'scipy', 'hil.pipeline'}"
    code = f"import sys, hil; sys.exit(bool({libraries} & sys.modules.keys()))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
