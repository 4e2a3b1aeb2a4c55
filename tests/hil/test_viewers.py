"""Copies of archives for viewers, and the layouts that open them."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock
from xml.etree import ElementTree

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from typer.testing import CliRunner

from drivers.record import cycle_dtype
from hil.annotating import PREDICTED, annotate, annotated
from hil.archive import ArchiveWriter, open_archive
from hil.campaign import Campaign, design
from hil.cli import app
from hil.errors import InputError, NotAnArchiveError
from hil.identify import Identification, identify_campaign
from hil.identify.options import FIXED
from hil.progress import Silent
from sim_fixtures.ns16 import URDF_PATH
from tests.hil.fast_cell import fast_cell

VIEWERS = Path(__file__).parents[2] / "examples" / "viewers"
STATES = ("/joint_states", "/joint_states_commanded", PREDICTED)

Messages = Mapping[str, list[tuple[int, Any]]]


def messages(path: Path) -> Messages:
    """Log time [ns] and decoded message by topic, as another program reads them."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()], validate_crcs=True)
        for _, channel, message, decoded in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    return found


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    folder = tmp_path_factory.mktemp("viewers")
    cell = fast_cell(folder, repetitions=2)
    campaign = Campaign.create(folder / "campaign", cell, design(cell, Silent()))
    campaign.run(unrehearsed=True, durable=False)
    return campaign


@pytest.fixture(scope="module")
def found(campaign: Campaign) -> Identification:
    return identify_campaign(campaign.folder.root, Silent(), FIXED)


@pytest.fixture(scope="module")
def copies(found: Identification, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return annotate(found, tmp_path_factory.mktemp("output"), Silent())


@pytest.fixture(scope="module")
def seen(copies: list[Path]) -> Messages:
    return messages(next(path for path in copies if path.name == "validation_000_a1.mcap"))


class TestCopies:
    """Beside what was measured and commanded stands what the model predicts."""

    def test_each_archive_of_a_motion_has_one(
        self, copies: list[Path], found: Identification
    ) -> None:
        moving = {path.name for path in found.paths if "standstill" not in path.name}
        assert {path.name for path in copies} == moving

    def test_the_prediction_stands_beside_the_torque(
        self, seen: Messages, found: Identification
    ) -> None:
        """At the same instants, and as far from it as the results say."""
        torque = {time: np.array(state.effort) for time, state in seen["/joint_states"]}
        times, predicted = zip(*seen[PREDICTED], strict=True)
        error = np.array([torque[t] - one.effort for t, one in zip(times, predicted, strict=True)])
        usable, samples = found.unseen[0].usable, found.unseen[0]
        expected = samples.torque - samples.predicted_torque(
            found.cell.model, found.estimate.pooled.values
        )
        np.testing.assert_allclose(error[usable], expected[usable], atol=1e-9)

    def test_no_commanded_number_is_missing(self, seen: Messages) -> None:
        """The arm rests before the first set-point: the controller's own target stands there."""
        position = np.array([state.position for _, state in seen["/joint_states_commanded"]])
        velocity = np.array([state.velocity for _, state in seen["/joint_states_commanded"]])
        assert np.isfinite(position).all()
        assert np.isfinite(velocity).all()

    def test_times_are_those_of_the_day(self, campaign: Campaign, tmp_path: Path) -> None:
        """Where the archive knows it; a simulated one does not, and keeps its own."""
        archive = open_archive(campaign.folder.archives / "excitation_000_a1.mcap")
        n = len(archive.joint_names)
        prediction = {"time": np.array([0.0, 1.0]), "effort": np.zeros((2, n))}
        begins = []
        for day in (None, "2026-03-04T05:06:07+00:00", "someday"):
            entries = {**archive.header.entries, **({} if day is None else {"recorded_at": day})}
            header = type(archive.header).of(entries)
            path = tmp_path / "day.mcap"
            path.write_bytes(annotated(replace(archive, header=header), prediction))
            stamps = messages(path)[PREDICTED]
            assert stamps[1][0] - stamps[0][0] == 10**9
            assert stamps[0][0] == stamps[0][1].header.stamp.sec * 10**9 + (
                stamps[0][1].header.stamp.nanosec
            )
            begins.append(stamps[0][0])
        first = int(archive.columns["stamp"][0])
        assert begins == [first, 1_772_600_767 * 10**9, first]

    def test_they_are_no_archives(self, copies: list[Path]) -> None:
        """Nobody fits one recording twice."""
        with pytest.raises(NotAnArchiveError, match="no 'hil' metadata"):
            open_archive(copies[0])

    def test_a_folder_is_needed(self, campaign: Campaign) -> None:
        archive = str(campaign.folder.archives / "excitation_000_a1.mcap")
        with pytest.raises(InputError, match="--annotate: has no folder"):
            CliRunner().invoke(app, ["identify", archive, "--annotate"], catch_exceptions=False)


@pytest.fixture(scope="module")
def six(tmp_path_factory: pytest.TempPathFactory) -> Messages:
    """A copy of an archive of the NS 16."""
    path = tmp_path_factory.mktemp("six") / "move_000_a1.mcap"
    names = tuple(f"joint_{k}" for k in range(1, 7))
    rows = np.zeros(100, cycle_dtype(6))
    rows["cycle"] = np.arange(100)
    rows["commanded_position"] = rows["commanded_velocity"] = np.nan
    urdf = {"robot.urdf": URDF_PATH.read_bytes()}
    with ArchiveWriter(
        path, joint_names=names, period=0.002, metadata={}, attachments=urdf, durable=False
    ) as archive:
        archive.event(0, "MotionStarted", "off we go")
        archive.write(rows, np.ones((100, 6)))
        archive.close("completed")
    prediction = {"time": np.arange(0.1, 0.2, 0.002), "effort": np.ones((50, 6))}
    path.write_bytes(annotated(open_archive(path), prediction))
    return messages(path)


class TestLayouts:
    """Every topic and field that a layout names is in a copy of an arm of six joints."""

    def test_foxglove(self, six: Messages) -> None:
        layout = json.loads((VIEWERS / "foxglove.json").read_text())
        panels = layout["configById"]
        assert set(re.findall(r'"([\w ]+![\w]+)"', json.dumps(layout["layout"]))) == set(panels)
        paths = [path["value"] for panel in panels.values() for path in panel.get("paths", ())]
        assert len(paths) == 36
        for text in paths:
            topic, word, index = re.fullmatch(r"(/\w+)\.(\w+)\[(\d)\]", text).groups()  # type: ignore[union-attr]
            assert np.isfinite(getattr(six[topic][0][1], word)[int(index)])
        named = {*panels["3D!arm"]["topics"], panels["RosOut!events"]["topicToRender"]}
        assert named <= set(six)
        frames = [t.header.frame_id for t in six["/tf_static"][0][1].transforms]
        assert panels["3D!arm"]["followTf"] in frames

    def test_plotjuggler(self, six: Messages) -> None:
        """It calls the numbers of a JointState topic/joint/word."""
        root = ElementTree.parse(VIEWERS / "plotjuggler.xml").getroot()
        series = {
            f"{topic}/{joint}/{word}"
            for topic in STATES
            for word in ("position", "velocity", "effort")
            for joint, _ in zip(
                six[topic][0][1].name, getattr(six[topic][0][1], word), strict=False
            )
        }
        curves = [curve.get("name") for curve in root.iter("curve")]
        assert len(curves) == 36
        assert set(curves) <= series
        for splitter in root.iter("DockSplitter"):
            sizes = [float(size) for size in splitter.attrib["sizes"].split(";")]
            assert len(sizes) == int(splitter.attrib["count"]) == len(splitter.findall("DockArea"))
            assert sum(sizes) == pytest.approx(1.0)

    def test_rerun(self, six: Messages, monkeypatch: pytest.MonkeyPatch) -> None:
        """The library is not needed here: what is asked of it is looked at."""
        blueprint = MagicMock()
        monkeypatch.setitem(sys.modules, "rerun", MagicMock(blueprint=blueprint))
        monkeypatch.setitem(sys.modules, "rerun.blueprint", blueprint)
        source = (VIEWERS / "rerun_blueprint.py").read_text()
        exec(compile(source, "rerun_blueprint.py", "exec"), {})
        assert blueprint.Blueprint.return_value.save.call_args.args == ("hil", "arm.rbl")
        views = (blueprint.TimeSeriesView, blueprint.Spatial3DView, blueprint.TextLogView)
        named = [
            topic
            for view in views
            for call in view.call_args_list
            for topic in re.findall(r"(/\w[\w/]*)/\*\*", str(call.kwargs["contents"]))
        ]
        assert set(named) == set(six)
