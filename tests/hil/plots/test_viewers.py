"""Content of an archive: `hil plot`, and layouts of viewers."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from typer.testing import CliRunner

from hil.archive import ImportedSamples, open_archive, write_samples
from hil.base.errors import ArchiveError, InputError
from hil.campaign import Campaign
from hil.cli import app
from hil.identified.annotate import PREDICTED, RESIDUAL
from hil.plots.archive_view import (
    ArchiveView,
    draw_archive,
    view_of,
)

pytestmark = pytest.mark.long

VIEWERS = Path(__file__).parents[3] / "examples" / "viewers"


@pytest.fixture
def excitation(campaign: Campaign) -> Path:
    return campaign.folder.completed("excitation")[0]


def test_every_quantity_of_every_joint_is_shown_with_its_peaks(
    excitation: Path, campaign: Campaign
) -> None:
    view = view_of(excitation)
    columns = open_archive(excitation).columns
    titles = ", ".join(quantity.title.partition(" [")[0] for quantity in view.quantities)
    assert titles == "position, speed, motor current, torque at the joint, following error"
    current = view.quantities[2]
    for joint, trace in enumerate(current.traces):
        assert trace.value.max() == columns["target_current"][:, joint].max()
        assert trace.value.min() == columns["target_current"][:, joint].min()
        assert trace.limits[1] == campaign.cell.drive_table.current_limit[joint]
    pendant = np.degrees(campaign.cell.controller_angles(columns["position"]))
    assert view.quantities[0].traces[1].value.max() == pytest.approx(pendant[:, 1].max())
    assert any(name == "MotionEnded" for _, name, _, _ in view.events)
    # In the unit of the controller's thresholds, by the drive train's own conversion.
    columns = open_archive(excitation).columns
    drives = campaign.cell.drive_train
    error = drives.motor_revolutions(columns["target_position"]) - drives.motor_revolutions(
        columns["position"]
    )
    traces = view_of(excitation).quantities[4].traces
    for joint, trace in enumerate(traces):
        assert np.nanmax(np.abs(trace.value)) == pytest.approx(np.abs(error[:, joint]).max())


def test_layouts_of_viewers_name_topics_and_fields_of_an_archive(excitation: Path) -> None:
    with excitation.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    fields = {
        channel.topic: summary.schemas[channel.schema_id].data.decode()
        for channel in summary.channels.values()
    }
    texts = {path.name: path.read_text("utf-8") for path in VIEWERS.iterdir()}
    drawn = re.findall(r'"(/\w+)\.(\w+)\[\d\]"', texts["foxglove.json"])
    drawn += re.findall(r'name="(/\w+)/\w+/(\w+)"', texts["plotjuggler.xml"])
    assert len(drawn) == 2 * 42
    fields |= dict.fromkeys((PREDICTED, RESIDUAL), fields["/joint_states"])
    assert all(re.search(rf"^\S+ {field}$", fields[topic], re.MULTILINE) for topic, field in drawn)
    panels = json.loads(texts["foxglove.json"])["configById"]
    named = {*panels["3D!arm"]["topics"], panels["RosOut!events"]["topicToRender"]}
    assert named <= set(fields)
    shown = re.findall(r"\"(/\w+(?:/\w+)*)\"", texts["rerun_blueprint.py"])
    assert set(shown) == set(fields) - {"/hil/cycle"}


def test_torque_has_the_sign_of_its_angle(excitation: Path, campaign: Campaign) -> None:
    """Torque times speed is the power of the joint in any frame; the page names its frame."""
    torque = open_archive(excitation).columns["torque"]
    sign = np.array(campaign.cell.drive_table.joint_sign)
    assert -1 in sign
    view = view_of(excitation)
    traces = {q.title.partition(" [")[0]: q.traces for q in view.quantities}
    for joint, trace in enumerate(traces["torque at the joint"]):
        shown = torque[:, joint] * sign[joint]
        assert (np.nanmin(trace.value), np.nanmax(trace.value)) == (shown.min(), shown.max())
    assert view.frame == "angles, speeds and torques as on the teach pendant"
    assert any(view.frame in text.get_text() for text in draw_archive(view).texts)


def test_one_sample_of_a_long_recording_is_not_lost(tmp_path: Path) -> None:
    """Six minutes at 500 Hz, in windows, with one spike and two stretches not recorded."""
    time = np.arange(0.0, 360.0, 0.002)
    time = time[(time < 100.0) | (time > 140.0)]
    time = time[(time < 170.0) | (time > 170.1)]
    position = 0.1 * np.sin(time)[:, np.newaxis]
    spike = np.zeros_like(position)
    spike[123_457] = 77.0
    path = tmp_path / "long.mcap"
    write_samples(
        path,
        ImportedSamples(np.rint(time * 1e9).astype(np.int64), position, torque=spike),
        joint_names=("only",),
        metadata={},
        attachments={},
    )
    view = view_of(path)
    (trace,) = view.quantities[-1].traces
    assert trace.value.size < 10_000
    at = trace.time[np.nanargmax(trace.value)]
    assert np.nanmax(trace.value) == 77.0
    assert at == pytest.approx(time[123_457], abs=1e-6)
    broken = np.flatnonzero(np.isnan(trace.time))
    assert trace.time[broken - 1] == pytest.approx([100.0, 170.0], abs=0.01)
    assert trace.time[broken + 1] == pytest.approx([140.0, 170.1], abs=0.01)
    assert view_of(path, start=200.0, stop=201.0).quantities[0].traces[0].value.size == 501


def test_a_part_of_the_time_and_some_joints(excitation: Path) -> None:
    view = view_of(excitation, start=1.0, stop=2.0, joints=("2", "joint_5"))
    assert view.joint_names == ("joint_2", "joint_5")
    for quantity in view.quantities:
        for trace in quantity.traces:
            assert np.nanmin(trace.time) >= 1.0 - 1e-9
            assert np.nanmax(trace.time) <= 2.0 + 1e-9
    with pytest.raises(InputError, match="choose one of joint_1"):
        view_of(excitation, joints=("7",))
    with pytest.raises(ArchiveError, match="without a sample in this interval"):
        view_of(excitation, start=1e4)


@pytest.mark.parametrize("name", ["a.png", "a.svg", "a.pdf"])
def test_a_picture_without_a_display(excitation: Path, name: str, tmp_path: Path) -> None:
    environment = {key: value for key, value in os.environ.items() if "DISPLAY" not in key}
    done = subprocess.run(
        [sys.executable, "-m", "hil", "plot", str(excitation), "-o", name, "--joint", "1"],
        cwd=tmp_path, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"{name}: repetition 1, attempt 1")
    content = (tmp_path / name).read_bytes()
    head = {"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}
    assert content.startswith(head[name.partition(".")[2]])


def test_the_header_counts_missed_packets(excitation: Path) -> None:
    """Also if none was missed, and not at all where they are not counted."""
    view = view_of(excitation)

    def header(view: ArchiveView) -> str:
        return " ".join(text.get_text() for text in draw_archive(view).texts)

    assert "packets: none missed" in header(view)
    assert "packets: missed at 1 place " in header(replace(view, gaps=np.array([1.0])))
    assert "missed" not in header(replace(view, gaps=None, events=()))


def test_json_has_the_peaks_and_other_files_are_refused(excitation: Path, tmp_path: Path) -> None:
    target = tmp_path / "x.png"
    result = CliRunner().invoke(app, ["plot", str(excitation), "-o", str(target), "--json"])
    assert result.exit_code == 0
    summary = json.loads(result.stdout)
    assert summary["picture"] == str(target)
    shares = summary["peak_share_of_limit"]["motor current [A]"]
    assert set(shares) == {f"joint_{k}" for k in range(1, 7)}
    assert all(0.0 < share < 1.0 for share in shares.values())
    (tmp_path / "no.mcap").write_bytes(b"no")
    result = CliRunner().invoke(app, ["plot", str(tmp_path / "no.mcap")])
    assert isinstance(result.exception, ArchiveError)
    result = CliRunner().invoke(app, ["plot", str(excitation), "-o", str(tmp_path / "x.gif")])
    assert isinstance(result.exception, InputError)
