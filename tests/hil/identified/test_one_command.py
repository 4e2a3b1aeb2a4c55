"""From a log and a URDF to a result in one command: the proposed map, refusals, the folder.

All recordings are simulated, but for those of the folder of real recordings.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from numpy.typing import NDArray

from hil.archive import open_archive
from hil.archive.recording_of_archive import open_recording
from hil.base import one_screen
from hil.base.errors import InputError, SourceError
from hil.base.output_folder import SOURCES, folder_beside, sources_text
from hil.importers.column_map import ColumnMap
from hil.importers.conclusions import ChannelMeaning, NameBasis, UnitBasis, UnusedChannels
from hil.importers.imported_robot import Robot
from hil.importers.log import import_log
from hil.importers.messages import sentence
from hil.importers.proposed_map import proposed_map
from hil.importers.recording_import import ImportOptions, import_recording
from hil.importers.rosbag2 import import_rosbag2
from hil.pipeline.sources import cell_of
from identification.signals.position_steps import position_jumps
from tests.hil.identified.command import hil
from tests.hil.importers.bag_messages import WHOLE, message
from tests.hil.importers.bags import DEFINITION, STATE, bag, mcap, state
from tests.hil.importers.moving_log import JOINTS, POSITION, SLOPE, TIME, TORQUE, URDF
from tests.hil.simulated_logs import urdf_path, write_moving_log
from tests.hil.simulated_logs import write_log as log

Floats = NDArray[np.float64]
COLUMNS: Mapping[str, Floats] = {"t": TIME, "q": POSITION, "v": SLOPE, "tau": TORQUE}


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    path = tmp_path / "three.urdf"
    path.write_text(URDF)
    return path


def moving(path: Path, *, seed: int = 0) -> Path:
    return write_moving_log(path, URDF, seed=seed)


class TestProposedMap:
    def test_names_of_columns_become_a_map(self, tmp_path: Path, urdf: Path) -> None:
        path = log(tmp_path / "a.csv", ["t", "q{}", "v{}", "tau{}"], *COLUMNS.values())
        proposal = proposed_map(path, Robot.from_urdf(urdf))
        assert proposal.columns == ColumnMap.model_validate(
            {
                "time": {"column": "t"},
                "position": {"columns": "q{}"},
                "velocity": {"columns": "v{}"},
                "torque": {"columns": "tau{}"},
            }
        )
        torque = ChannelMeaning("tau1 .. tau3", "torque", NameBasis.NAME, None, UnitBasis.CUSTOM)
        assert torque in proposal.concluded
        assert sentence(torque) == "tau1 .. tau3: torque, by the name; N.m assumed"

    def test_its_text_is_the_map(self, tmp_path: Path, urdf: Path) -> None:
        path = log(tmp_path / "a.csv", ["t", "q{}", "tau{}"], TIME, POSITION, TORQUE)
        proposal = proposed_map(path, Robot.from_urdf(urdf))
        (tmp_path / "map.toml").write_text(proposal.text)
        assert ColumnMap.load(tmp_path / "map.toml") == proposal.columns

    def test_units_tell_columns_of_one_name_apart(self, tmp_path: Path, urdf: Path) -> None:
        names = ["Zeit [ms]", "axis{} (deg)", "axis{} (Nm)"]
        path = log(tmp_path / "a.csv", names, 1e3 * TIME, np.degrees(POSITION), TORQUE)
        robot = Robot.from_urdf(urdf)
        proposal = proposed_map(path, robot)
        torque = "axis1 (Nm) .. axis3 (Nm)", "torque", NameBasis.UNIT, "N.m", UnitBasis.LOG
        assert ChannelMeaning(*torque) in proposal.concluded
        imported = import_recording(path, tmp_path / "a.mcap", lambda _: robot)
        columns = imported.archive.columns
        assert np.allclose(columns["position"], POSITION, rtol=0.0, atol=1e-8)

    @pytest.mark.parametrize(
        ("names", "columns"),
        [
            (["ms"], [1e3 * TIME]),
            (["t", "stamp"], [TIME, TIME]),
            (["elapsed_ms"], [1e3 * TIME]),
            (["secs", "nsecs"], [TIME // 0.5, np.rint(1e9 * (TIME % 0.5)) * 2.0]),
            (["Date", "Time"], [np.full(len(TIME), 20261112.0), TIME]),
        ],
    )
    def test_names_of_the_time(
        self, tmp_path: Path, urdf: Path, names: list[str], columns: list[Floats]
    ) -> None:
        """A unit, one time twice, seconds beside nanoseconds, a time of day beside its date."""
        head = [*names, "q{}", "rad_per_sec{}", "tau{}"]
        path = log(tmp_path / "a.csv", head, *columns, POSITION, SLOPE, TORQUE)
        imported = import_recording(path, tmp_path / "a.mcap", lambda _: Robot.from_urdf(urdf))
        stamp = imported.archive.columns["stamp"]
        scale = 2.0 if "nsecs" in names else 1.0
        assert np.allclose((stamp - stamp[0]) * 1e-9, scale * TIME, rtol=0.0, atol=1e-6)

    @pytest.mark.parametrize("pattern", ["{kind}_{joint}", "{joint}/{kind}"])
    def test_joints_in_names_put_columns_in_order(
        self, tmp_path: Path, urdf: Path, pattern: str
    ) -> None:
        order = [2, 0, 1]
        names = [
            pattern.format(kind=kind, joint=JOINTS[k]) for kind in ("pos", "effort") for k in order
        ]
        values = [quantity[:, k] for quantity in (POSITION, TORQUE) for k in order]
        path = log(tmp_path / "a.csv", ["time", *names], TIME, *values)
        proposal = proposed_map(path, Robot.from_urdf(urdf))
        assert proposal.columns.position.columns == pattern.format(kind="pos", joint="{}")
        bases = [each.basis for each in proposal.concluded if isinstance(each, ChannelMeaning)]
        assert NameBasis.JOINT in bases
        import_recording(path, tmp_path / "a.mcap", lambda _: Robot.from_urdf(urdf))
        columns = open_archive(tmp_path / "a.mcap").columns
        assert np.allclose(columns["torque"], TORQUE, rtol=0.0, atol=1e-7)

    def test_a_ready_map_whose_columns_are_there_is_used(self, tmp_path: Path, urdf: Path) -> None:
        names = ["IPOC", "AIPos.A{}", "GearTorque.A{}"]
        path = log(tmp_path / "a.csv", names, 1e3 * TIME, np.degrees(POSITION), TORQUE)
        proposal = proposed_map(path, Robot.from_urdf(urdf))
        assert proposal.columns == ColumnMap.load("kuka_rsi")
        stated = "AIPos.A{}: position, deg, as in the ready map kuka_rsi"
        assert stated in map(sentence, proposal.concluded)

    def test_arrays_are_found_and_others_listed(self, tmp_path: Path, urdf: Path) -> None:
        path = tmp_path / "a.npz"
        np.savez(path, times=TIME, positions=POSITION, torques=TORQUE, target_positions=POSITION)
        proposal = proposed_map(path, Robot.from_urdf(urdf))
        assert proposal.columns.torque is not None
        assert proposal.columns.torque.columns == "torques"
        assert proposal.concluded[-1] == UnusedChannels(("target_positions",))

    def test_arrays_with_the_time_beside_each(self, tmp_path: Path, urdf: Path) -> None:
        """As Simulink writes its structures with time."""
        signals = {
            name: {"time": TIME, "signals": {"values": values}}
            for name, values in (("q", POSITION), ("tau", TORQUE))
        }
        scipy.io.savemat(tmp_path / "a.mat", {"out": signals})
        proposal = proposed_map(tmp_path / "a.mat", Robot.from_urdf(urdf))
        assert proposal.columns.time is not None
        assert proposal.columns.time.column == "out.q.time"
        assert proposal.columns.position.columns == "out.q.signals.values"

    def test_channels_can_be_given(self, tmp_path: Path, urdf: Path) -> None:
        path = log(tmp_path / "a.csv", ["q{}", "load{}"], POSITION, TORQUE)
        chosen = {"torque": "load1,load2,load3"}
        proposal = proposed_map(path, Robot.from_urdf(urdf), chosen, sample_rate=250.0)
        assert proposal.columns.sample_rate == 250.0
        assert proposal.columns.torque is not None
        assert proposal.columns.torque.columns == ("load1", "load2", "load3")

    def test_columns_without_names_are_given_by_index(self, tmp_path: Path, urdf: Path) -> None:
        table = np.column_stack([TIME, POSITION, TORQUE])
        np.savetxt(tmp_path / "a.txt", table)
        chosen = {"time": "0", "position": "1,2,3", "torque": "4,5,6"}
        proposal = proposed_map(tmp_path / "a.txt", Robot.from_urdf(urdf), chosen)
        assert proposal.columns.position.columns == (1, 2, 3)


REFUSED: Mapping[str, tuple[list[str], list[Floats], str, str]] = {
    "two torques": (
        ["t", "q{}", "tau{}", "effort{}"],
        [TIME, POSITION, TORQUE, TORQUE],
        "tau1 .. tau3 and effort1 .. effort3 are all named as torque",
        "--columns 'torque=tau{}' or --columns 'torque=effort{}'",
    ),
    "two clocks": (
        ["t", "stamp", "q{}", "tau{}"],
        [TIME, 1.001 * TIME, POSITION, TORQUE],
        "t and stamp are all named as time",
        "--columns 'time=t' or --columns 'time=stamp'",
    ),
    "torque in ampere": (
        ["t", "q{}", "tau{} [A]"],
        [TIME, POSITION, TORQUE],
        "tau1 .. tau3 is named as torque, and A is not a unit of it",
        "--columns 'motor_current=tau{}'",
    ),
    "no torque": (
        ["t", "q{}", "v{}"],
        [TIME, POSITION, SLOPE],
        "no channel is named as torque",
        "record it",
    ),
    "unnamed torque": (
        ["t", "q{}", "load{}"],
        [TIME, POSITION, TORQUE],
        "load1 .. load3",
        "--columns 'torque=load{}'",
    ),
    "no time": (["q{}", "tau{}"], [POSITION, TORQUE], "named as time", "--sample-rate HZ"),
    "fewer columns than joints": (
        ["t", "q{}", "tau{}"],
        [TIME, POSITION[:, :2], TORQUE[:, :2]],
        "2 channels are named as position (q1 .. q2), and the URDF has 3 joints",
        "--locked ankle",
    ),
    "a column that is missing between others": (
        ["t", "q1", "q3", "tau1", "tau3"],
        [TIME, *POSITION.T[[0, 2]], *TORQUE.T[[0, 2]]],
        "2 channels are named as position (q1 .. q3), and the URDF has 3 joints",
        "by the numbers of the channels with --locked knee",
    ),
    "more columns than joints": (
        ["t", "q{}", "tau{}"],
        [TIME, np.tile(POSITION, 2), np.tile(TORQUE, 2)],
        "6 channels are named as position (q1 .. q6), and the URDF has 3 joints",
        "give the URDF of this arm, or the channels of its joints, such as "
        "--columns 'position=q1,q2,q3'",
    ),
    "current": (
        ["t", "q{}", "current{}"],
        [TIME, POSITION, TORQUE],
        "has motor currents and no joint torque",
        "torque_constant",
    ),
    "constant torque": (
        ["t", "q{}", "tau{}"],
        [TIME, POSITION, np.full_like(TORQUE, 5.0)],
        "the torque of each joint is constant (5, 5, 5)",
        "--columns",
    ),
    "too short": (
        ["t", "q{}", "tau{}"],
        [TIME[:100], POSITION[:100], TORQUE[:100]],
        "has 100 samples in 0.396 s",
        "record a motion",
    ),
    "one row": (
        ["t", "q{}", "tau{}"],
        [TIME[:1], POSITION[:1], TORQUE[:1]],
        "has 1 sample in 0 s",
        "record a motion",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_it_is_refused(tmp_path: Path, urdf: Path, case: str) -> None:
    names, columns, problem, remedy = REFUSED[case]
    path = log(tmp_path / "a.csv", names, *columns)
    before = sorted(tmp_path.iterdir())
    result = hil("identify", path, "--urdf", urdf)
    assert isinstance(result.exception, InputError)
    assert result.exception.exit_code == 2
    assert problem in str(result.exception)
    assert remedy in str(result.exception)
    assert result.exception.path == path
    assert sorted(tmp_path.iterdir()) == before


def test_a_remedy_works_when_typed(tmp_path: Path, urdf: Path) -> None:
    path = log(tmp_path / "a.csv", ["t", "q{}", "load{}"], TIME, POSITION, TORQUE)
    arguments = ("import", "log", path, "--urdf", urdf)
    assert "--columns 'torque=load{}'" in str(hil(*arguments).exception)
    result = hil(*arguments, "--columns", "torque=load{}")
    assert result.exit_code == 0, result.output
    columns = open_archive(tmp_path / "a.mcap").columns
    assert np.allclose(columns["torque"], TORQUE, rtol=0.0, atol=1e-6)


def test_files_without_quantities_get_the_lines_of_a_map(tmp_path: Path, urdf: Path) -> None:
    position = log(tmp_path / "pos_data.csv", ["Joint_{}"], POSITION)
    log(tmp_path / "curr_data.csv", ["Joint_{}"], TORQUE)
    with pytest.raises(SourceError) as refused:
        proposed_map(position, Robot.from_urdf(urdf))
    assert "Joint_1 .. Joint_3, which name no quantity" in refused.value.problem
    for line in ("sample_rate = HZ", '[position] file = "pos_data.csv"', "[drive] gear_ratio",
                 '[torque] file = "curr_data.csv" if it has N·m'):  # fmt: skip
        assert line in refused.value.remedy


def test_import_without_a_map_leaves_the_map(tmp_path: Path, urdf: Path) -> None:
    path = log(tmp_path / "a.csv", ["t", "q{}", "tau{}"], TIME, POSITION, TORQUE)
    result = hil("import", "log", path, "--urdf", urdf, "-o", tmp_path / "x.mcap")
    assert result.exit_code == 0, result.output
    assert "q1 .. q3: position" in result.output
    again = ("--map", tmp_path / "x.map.toml", "-o", tmp_path / "y.mcap")
    assert hil("import", "log", path, "--urdf", urdf, *again).exit_code == 0
    first, second = (open_archive(tmp_path / f"{name}.mcap").columns for name in "xy")
    assert all(np.array_equal(first[name], second[name]) for name in second)


def test_a_bag_needs_no_map(tmp_path: Path, urdf: Path) -> None:
    source = tmp_path / "x.db3"
    robot = Robot.from_urdf(urdf)
    bag(source, {"/joint_states": (STATE, WHOLE)})
    imported = import_recording(source, tmp_path / "a.mcap", lambda _: robot)
    import_rosbag2(source, tmp_path / "b.mcap", robot=robot)
    effort = "/joint_states/effort", "torque", NameBasis.MESSAGE, "N.m", UnitBasis.MESSAGE
    assert imported.concluded[2] == ChannelMeaning(*effort)
    first, second = (open_archive(tmp_path / f"{name}.mcap").columns for name in "ab")
    assert all(np.array_equal(first[name], second[name]) for name in second)


def test_a_bag_leaves_how_it_was_read(tmp_path: Path, urdf: Path) -> None:
    """Its map says the topic of two, the stamps and the content of the effort field."""
    source = tmp_path / "x.db3"
    bag(source, {"/arm": (STATE, WHOLE), "/gripper": (STATE, WHOLE[:20])})
    first = hil(
        "import", "log", source, "--urdf", urdf, "--topic", "/arm", "-o", tmp_path / "a.mcap"
    )
    assert first.exit_code == 0, (first.output, first.exception)
    text = (tmp_path / "a.map.toml").read_text()
    assert 'topic = "/arm"' in text
    assert 'clock = "header"' in text
    again = ("--map", tmp_path / "a.map.toml", "-o", tmp_path / "b.mcap")
    second = hil("import", "log", source, "--urdf", urdf, *again)
    assert second.exit_code == 0, (second.output, second.exception)
    columns = [open_archive(tmp_path / f"{name}.mcap").columns for name in "ab"]
    assert all(np.array_equal(columns[0][name], columns[1][name]) for name in columns[1])


@pytest.mark.long
def test_a_bag_is_identified_again_with_its_map(tmp_path: Path, urdf: Path) -> None:
    source = tmp_path / "x.db3"
    folder = tmp_path / "out"
    rows = np.loadtxt(moving(tmp_path / "a.csv"), delimiter=",", skiprows=1)
    stamps = (10**9 + np.rint(1e9 * rows[:, 0])).astype(int).tolist()
    messages = [
        (at, state(at, row[1:4], velocity=row[4:7], effort=row[7:], names=JOINTS)[1])
        for at, row in zip(stamps, rows, strict=True)
    ]
    bag(source, {"/joint_states": (STATE, messages)})
    result = hil("identify", source, "--urdf", urdf, "--output", folder)
    assert result.exit_code in (0, 5), (result.output, result.exception)
    again = ("--map", folder / "map.toml", "--output", tmp_path / "again")
    assert hil("identify", source, "--urdf", urdf, *again).exit_code == result.exit_code


def test_a_map_of_a_bag_with_a_wrong_entry(tmp_path: Path, urdf: Path) -> None:
    (tmp_path / "m.toml").write_text('[bag]\nclock = "sun"\n')
    bag(tmp_path / "x.db3", {"/joint_states": (STATE, WHOLE)})
    given = ("--urdf", urdf, "--map", tmp_path / "m.toml")
    refused = hil("import", "log", tmp_path / "x.db3", *given, "-o", tmp_path / "a.mcap")
    assert "bag.clock" in str(refused.exception)


class TestIdentify:
    @pytest.mark.long
    def test_json_is_all_that_is_printed_of_it(self, tmp_path: Path, urdf: Path) -> None:
        result = hil("identify", moving(tmp_path / "a.csv"), "--urdf", urdf, "--json")
        printed = json.loads(result.stdout)
        assert printed["folder"] == str(tmp_path / "a")
        assert Path(printed["report"]).exists()

    def test_a_log_and_a_urdf_are_enough(self, tmp_path: Path, urdf: Path) -> None:
        """One log fitted, one predicted; the folder holds what the next run needs."""
        first = moving(tmp_path / "a.csv")
        second = moving(tmp_path / "b.csv", seed=1)
        result = hil("identify", first, "--urdf", urdf, "--predict", second)
        assert result.exit_code == 0, (result.output, result.exception)
        folder = tmp_path / "a"
        report = folder / "report.html"
        shown = result.stdout.splitlines()
        assert (
            len(shown) <= one_screen.SCREEN_LINES
            and max(map(len, shown)) <= one_screen.SCREEN_COLUMNS
        )
        assert "fitted    a.csv: 3 joints" in result.output
        assert "predicted b.csv: 3 joints" in result.output
        before = (folder / "results.json").stat().st_mtime_ns
        everything = hil("identify", first, "--urdf", urdf, "--predict", second, "-v").output
        assert f"report: {report}" in everything
        assert "a.csv: tau1 .. tau3: torque, by the name; N.m assumed" in everything
        names = {path.name for path in folder.iterdir()}
        assert names >= {"a.mcap", "b.mcap", "map.toml", "results.json", "report.html", SOURCES}
        assert (folder / "results.json").stat().st_mtime_ns > before
        assert not (tmp_path / "a-2").exists()
        report.unlink()
        assert hil("report", folder).output.strip() == str(report) and report.exists()
        again = hil("identify", folder, "--output", tmp_path / "again")
        assert again.exit_code == 0
        verdicts = [run.stdout.splitlines()[0] for run in (result, again)]
        assert verdicts[0].startswith("Good for feed-forward") and verdicts[1] == verdicts[0]

    @pytest.mark.long
    def test_archives_get_a_folder_as_well(self, tmp_path: Path, urdf: Path) -> None:
        archive = tmp_path / "rec.mcap"
        columns = ColumnMap.model_validate(
            {
                "time": {"column": "t"},
                "position": {"columns": "q{}"},
                "torque": {"columns": "tau{}"},
            }
        )
        import_log(
            moving(tmp_path / "a.csv"), archive, robot=Robot.from_urdf(urdf), columns=columns
        )
        result = hil("identify", archive)
        assert result.exit_code in (0, 5), (result.output, result.exception)
        assert (tmp_path / "rec" / "report.html").exists()

    def test_a_log_without_its_arm_says_so(self, tmp_path: Path) -> None:
        path = log(tmp_path / "a.csv", ["t", "q{}", "tau{}"], TIME, POSITION, TORQUE)
        assert "add --urdf ARM.urdf" in str(hil("identify", path).exception)

    def test_archives_have_no_options_of_logs(self, tmp_path: Path) -> None:
        refused = hil("identify", tmp_path / "a.mcap", "--sample-rate", "100").exception
        assert "--sample-rate" in str(refused)
        assert "add --urdf ARM.urdf" in str(refused)


class TestOutputFolder:
    def test_it_is_renewed_for_the_same_log_only(self, tmp_path: Path) -> None:
        path = tmp_path / "a.csv"
        path.write_text("1")
        sources = sources_text([path], [])
        folder = folder_beside(path, sources)
        assert folder == tmp_path / "a"
        folder.mkdir()
        (folder / SOURCES).write_text(sources)
        assert folder_beside(path, sources_text([path], [])) == folder
        path.write_text("2")
        assert folder_beside(path, sources_text([path], [])) == tmp_path / "a-2"

    def test_a_folder_of_something_else_is_left_alone(self, tmp_path: Path) -> None:
        path = tmp_path / "a.csv"
        path.write_text("1")
        (tmp_path / "a").mkdir()
        (tmp_path / "a-2").write_text("notes")
        assert folder_beside(path, sources_text([path], [])) == tmp_path / "a-3"

    @pytest.mark.long
    def test_no_archive_replaces_the_recording(self, tmp_path: Path, urdf: Path) -> None:
        """A foreign MCAP file in the folder that was named for the results."""
        source = tmp_path / "x.mcap"
        effort = TORQUE - 20.0 * np.sin(POSITION)  # of bodies as well
        messages = [message(k, effort=effort) for k in range(len(WHOLE))]
        mcap(source, {"/joint_states": (STATE, DEFINITION, "cdr", messages)})
        content = source.read_bytes()
        result = hil("identify", source, "--urdf", urdf, "--output", tmp_path)
        assert "is the recording itself" in str(result.exception)
        assert source.read_bytes() == content


FINGER = """<link name="palm"/><joint name="palm_mount" type="fixed"><parent link="c"/>
<child link="palm"/></joint><link name="finger"><inertial><mass value="0.02"/>
<inertia ixx="1e-6" iyy="1e-6" izz="1e-6" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="finger_joint" type="prismatic"><parent link="palm"/><child link="finger"/>
<axis xyz="1 0 0"/><limit lower="0.01" upper="0.05" velocity="0.1" effort="20"/></joint></robot>"""


class TestGripperThatWasNotRecorded:
    """The URDF of an arm with its gripper, and a log of the arm."""

    @pytest.fixture
    def urdf(self, tmp_path: Path) -> Path:
        path = tmp_path / "gripping.urdf"
        path.write_text(URDF.replace("</robot>", FINGER.replace('"c"', f'"l{JOINTS[-1]}"')))
        return path

    def test_its_joints_are_fixed_within_their_range_and_said(
        self, tmp_path: Path, urdf: Path
    ) -> None:
        path = log(tmp_path / "a.csv", ["t", "q{}", "tau{}"], TIME, POSITION, TORQUE)
        imported = import_recording(path, tmp_path / "a.mcap", lambda _: Robot.from_urdf(urdf))
        locked = cell_of(imported.archive).file.robot.locked
        assert locked == {"finger_joint": pytest.approx(0.03)}
        said = "finger_joint: fixed at 0.03 m: a gripper that was not recorded"
        assert said in map(sentence, imported.concluded)

    def test_the_map_reads_the_log_again(self, tmp_path: Path, urdf: Path) -> None:
        path = log(tmp_path / "a.csv", ["t", "q{}", "tau{}"], TIME, POSITION, TORQUE)
        robot = Robot.from_urdf(urdf)
        first = import_recording(path, tmp_path / "a.mcap", lambda _: robot)
        (tmp_path / "map.toml").write_text(first.text or "")
        options = ImportOptions(tmp_path / "map.toml")
        import_recording(path, tmp_path / "b.mcap", lambda _: robot, options)
        read, again = (open_archive(tmp_path / f"{name}.mcap").columns for name in "ab")
        assert all(np.array_equal(read[name], again[name]) for name in again)

    def test_a_joint_of_the_arm_is_never_fixed(self, tmp_path: Path, urdf: Path) -> None:
        path = log(tmp_path / "a.csv", ["t", "q{}", "tau{}"], TIME, POSITION[:, :2], TORQUE[:, :2])
        with pytest.raises(SourceError, match="2 channels are named as position"):
            import_recording(path, tmp_path / "a.mcap", lambda _: Robot.from_urdf(urdf))

    def test_a_finger_that_a_bag_has_is_not_fixed(self, tmp_path: Path, urdf: Path) -> None:
        names = (*JOINTS, "finger_joint")
        both = [state(9 + 10**7 * k, [0.0] * 4, names=names, effort=[1.0] * 4) for k in range(9)]
        arm = [state(9 + 10**7 * k, [0.0] * 3, names=JOINTS, effort=[1.0] * 3) for k in range(9)]
        robot = Robot.from_urdf(urdf)
        for name, messages, joints in (("both", both, 4), ("arm", arm, 3)):
            source = bag(tmp_path / f"{name}.db3", {"/joint_states": (STATE, messages)})
            imported = import_recording(source, tmp_path / f"{name}.mcap", lambda _: robot)
            assert imported.archive.columns["position"].shape[1] == joints


REAL: Sequence[tuple[str, str]] = [
    ("kr300/A.csv", "kr300/robot.urdf"),
    ("lwr4/measurements_1.npz", "lwr4/kuka_lwr4.urdf"),
    ("gen3/b_sensor.csv", "gen3/robot.urdf"),
]


@pytest.mark.parametrize(("recording", "urdf"), REAL)
def test_real_logs_are_read_as_by_their_maps(
    tmp_path: Path, shared_data: Path, recording: str, urdf: str
) -> None:
    source = shared_data / recording
    robot = Robot.from_urdf(shared_data / urdf)
    import_recording(source, tmp_path / "a.mcap", lambda _: robot)
    columns = ColumnMap.load(source.parent / "map.toml")
    import_log(source, tmp_path / "b.mcap", robot=robot, columns=columns)
    first, second = (open_archive(tmp_path / f"{name}.mcap").columns for name in "ab")
    assert all(np.array_equal(first[name], second[name]) for name in second)


@pytest.mark.parametrize("bits", [10, 11, 12, 13])
def test_rounded_positions_of_a_repeating_log_do_not_jump(
    tmp_path: Path, shared_data: Path, bits: int
) -> None:
    folder = shared_data / "gen3"
    archive = tmp_path / "b.mcap"
    import_recording(
        folder / "a_sensor.csv", archive, lambda _: Robot.from_urdf(folder / "robot.urdf")
    )
    recording = open_recording(archive)
    resolution = np.ptp(recording.position, axis=0) / 2**bits
    coarse = np.rint(recording.position / resolution) * resolution
    assert position_jumps(replace(recording, position=coarse)) == []


def test_a_real_bag_is_read_with_file_and_urdf_alone(tmp_path: Path, shared_data: Path) -> None:
    source = shared_data / "ur10_unisa" / "ur10_exciting_trajectory.db3"
    robot = Robot.from_urdf(urdf_path("ur10_robot.urdf"))
    import_recording(source, tmp_path / "a.mcap", lambda _: robot)
    import_rosbag2(source, tmp_path / "b.mcap", robot=robot)
    first, second = (open_archive(tmp_path / f"{name}.mcap").columns for name in "ab")
    assert all(np.array_equal(first[name], second[name]) for name in second)


def test_a_real_motor_side_log_names_what_is_missing(shared_data: Path) -> None:
    folder = shared_data / "tx40"
    robot = Robot.from_urdf(folder / "tx40_mdh_modified.urdf")
    with pytest.raises(SourceError) as refused:
        proposed_map(folder / "pos_read_data.csv", robot)
    for part in ('[position] file = "pos_read_data.csv"', '[torque] file = "curr_data.csv"',
                 "sample_rate", 'side = "motor"', "gear_ratio"):  # fmt: skip
        assert part in refused.value.remedy
