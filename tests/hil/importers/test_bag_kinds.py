"""Kinds of faults in bags: read rightly, or refused with a remedy that works when typed."""

from __future__ import annotations

import re
import shutil
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import zstandard
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.typesys import Stores, get_typestore
from typer.testing import CliRunner

from hil.archive import Archive, open_archive
from hil.base.errors import SourceError
from hil.cli import app
from hil.importers.imported_robot import Robot
from hil.importers.rosbag2 import import_rosbag2, recorded_joints
from tests import messages
from tests.hil.importers.bag_messages import PERIOD, STAMPS, WHOLE, Message, message
from tests.hil.importers.bags import DEFINITION, STATE, bag, mcap
from tests.hil.importers.moving_log import COUNT, JOINTS, POSITION, SLOPE, TIME, TORQUE, URDF
from tests.near import near
from tests.tiers import quick_ones


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    path = tmp_path / "three.urdf"
    path.write_text(URDF)
    return path


def ros_1_bag(
    path: Path,
    messages: Sequence[Message],
    compression: Ros1Writer.CompressionFormat | None = None,
) -> Path:
    """Write joint states of ROS 2 to a bag of ROS 1."""
    new = get_typestore(Stores.ROS2_HUMBLE)
    old = get_typestore(Stores.ROS1_NOETIC)
    kinds = (STATE, "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    state, header, clock = (old.types[kind] for kind in kinds)
    writer = Ros1Writer(path)
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        connection = writer.add_connection("/joint_states", STATE, typestore=old)
        for k, (received, data) in enumerate(messages):
            content = new.deserialize_cdr(data, STATE)
            stamp = content.header.stamp
            time = clock(sec=stamp.sec, nanosec=stamp.nanosec)
            converted = state(
                header=header(seq=k, stamp=time, frame_id=""), name=content.name,
                position=content.position, velocity=content.velocity, effort=content.effort,
            )  # fmt: skip
            writer.write(connection, received, old.serialize_ros1(converted, STATE))
    return path


class Typed:
    """What `hil import rosbag2` of these messages says and writes."""

    suffix = "db3"

    def __init__(self, urdf: Path, messages: Sequence[Message], *options: str) -> None:
        self.urdf = urdf
        self.folder = urdf.parent
        self.path = self.folder / f"bag.{self.suffix}"
        self.path.unlink(missing_ok=True)
        if self.suffix == "bag":
            ros_1_bag(self.path, messages)
        else:
            bag(self.path, {"/joint_states": (STATE, list(messages))})
        self.again(*options)

    def again(self, *options: str) -> Typed:
        self.output = self.folder / "out.mcap"
        arguments = ["import", "rosbag2", str(self.path), "--urdf", str(self.urdf), "--force"]
        result = CliRunner().invoke(app, [*arguments, "-o", str(self.output), *options])
        self.message = str(result.exception) if result.exception else result.output
        self.refused = result.exit_code != 0
        assert not result.exception or isinstance(result.exception, SourceError)
        return self

    @property
    def archive(self) -> Archive:
        assert not self.refused, self.message
        return open_archive(self.output)

    def options(self) -> list[str]:
        """The options that the message prints."""
        return re.search(r"--[a-z-]+(?: [a-z]+)?", self.message)[0].split()  # type: ignore[index]


def assert_right(archive: Archive, *, rows: slice = slice(None), tolerance: float = 1e-12) -> None:
    columns = archive.columns
    elapsed = (columns["stamp"] - columns["stamp"][0]) * 1e-9
    assert elapsed == near(TIME[rows] - TIME[rows][0], abs=1e-9)
    assert columns["position"] == near(POSITION[rows], abs=tolerance)
    assert columns["torque"] == near(TORQUE[rows], abs=1e3 * tolerance)


@pytest.fixture(params=quick_ones(["bag"], ["db3", "bag"]))
def each_kind(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bags of ROS 2 in a database, and of ROS 1."""
    monkeypatch.setattr(Typed, "suffix", request.param)


class TestRos1:
    @pytest.mark.parametrize("compression", Ros1Writer.CompressionFormat)
    def test_compressed(
        self, urdf: Path, compression: Ros1Writer.CompressionFormat, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(Typed, "suffix", "bag")
        bag = Typed(urdf, WHOLE)
        bag.path.unlink()
        ros_1_bag(bag.path, WHOLE, compression)
        assert_right(bag.again().archive)

    def test_one_that_was_not_closed_names_the_program_that_mends_it(
        self, urdf: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(Typed, "suffix", "bag")
        bag = Typed(urdf, WHOLE)
        content = bag.path.read_bytes()
        bag.path.write_bytes(content[: len(content) // 2])
        assert bag.again().refused
        assert "if its recorder was killed: rosbag reindex bag.bag" in bag.message


@pytest.mark.usefixtures("each_kind")
class TestPublishers:
    @pytest.mark.parametrize("options", [(), ("--lock-others",)])
    def test_joints_of_several_messages_are_merged_by_stamp(self, urdf, options) -> None:
        parts = [message(k, joints=j) for k in range(COUNT) for j in ((1, 0), (2,))]
        typed = Typed(urdf, parts, *options)
        assert_right(typed.archive)
        assert typed.archive.joint_names == JOINTS
        assert messages.MERGED_MESSAGES in typed.message
        assert recorded_joints(typed.path) == ("knee", "hip", "ankle")

    def test_of_other_stamps_they_are_interpolated(self, urdf) -> None:
        parts = [
            sent
            for k in range(COUNT)
            for sent in (
                message(k, joints=(0, 1)),
                message(k, joints=(2,), stamp=STAMPS[k] + PERIOD // 3),
            )
        ]
        shift = PERIOD / 3e9  # s
        archive = Typed(urdf, parts).archive
        expected = 0.9 * np.sin(2.0 * (TIME[1:] - shift) + 2)
        assert archive.columns["position"][:, 2] == near(expected, abs=1e-5)
        assert archive.columns["position"][:, 0] == near(POSITION[1:, 0], abs=1e-12)

    def test_a_joint_that_is_recorded_is_never_locked(self, urdf) -> None:
        """Also if it is too rare to be merged."""
        rare = [message(k) for k in range(0)]
        rare += [message(k, joints=(0, 1)) for k in range(COUNT)]
        rare += [message(k, joints=(2,)) for k in range(0, COUNT, 20)]
        typed = Typed(urdf, rare, "--lock-others")
        assert typed.refused
        assert "are in separate messages, for (ankle) up to 80 ms apart, where hip " in (
            typed.message
        )
        assert "(hip, knee) and (ankle)" in typed.message
        assert typed.again("--locked", "ankle=0.0").archive.joint_names == ("hip", "knee")

    def test_a_joint_that_is_nowhere_can_be_locked(self, urdf) -> None:
        typed = Typed(urdf, [message(k, joints=(0, 1)) for k in range(COUNT)])
        assert "joint ankle was not recorded; recorded are hip, knee" in typed.message
        assert "--lock-others" in typed.message
        assert typed.again("--lock-others").archive.joint_names == ("hip", "knee")
        assert typed.again("--locked", "ankle").archive.joint_names == ("hip", "knee")

    def test_a_second_publisher_of_zeros_is_named_and_left_out(self, urdf) -> None:
        zeros = np.zeros_like(POSITION)
        both = [
            sent
            for k in range(COUNT)
            for sent in (
                message(k),
                message(k, stamp=STAMPS[k] + PERIOD // 2, position=zeros, velocity=zeros,
                        effort=zeros, late=PERIOD // 2),
            )
        ]  # fmt: skip
        typed = Typed(urdf, both)
        assert_right(typed.archive)
        assert f"dropped {COUNT} of {2 * COUNT} messages that come from" in typed.message
        assert "second publisher" in typed.message

    @pytest.mark.parametrize("share", quick_ones([4], [1, 4]))
    def test_so_is_one_of_a_fixed_pose(self, urdf, share: int) -> None:
        pose = POSITION * 0.0 + (0.3, -0.4, 1.5)
        both = [
            sent
            for k in range(COUNT)
            for sent in (
                message(k),
                message(k, stamp=STAMPS[k] + PERIOD // 2, position=pose, late=PERIOD // 2),
            )[: 2 if k % share == 0 else 1]
        ]
        typed = Typed(urdf, both)
        assert_right(typed.archive)
        assert "all their positions are 0.3, -0.4, 1.5" in typed.message

    def test_samples_of_an_older_publisher_are_named(self, urdf) -> None:
        """And no unit, sign or gear for their velocities."""
        old = np.roll(POSITION, 40, axis=0)
        both = [
            sent
            for k in range(40, COUNT)
            for sent in (
                message(k),
                message(k, stamp=STAMPS[k] + PERIOD // 2, position=old, late=PERIOD // 2),
            )
        ]
        typed = Typed(urdf, both)
        (warning,) = typed.archive.header.findings.warnings
        assert "samples alternate between two sequences up to 0.2" in warning
        assert "two sources write these joints" in warning

    def test_a_pose_to_which_the_arm_returns_is_none(self, urdf) -> None:
        """It moves between two poses within a sample, as in a log of steps."""
        steps = POSITION * 0.0 + np.where(np.arange(COUNT) // 20 % 2, 0.5, -0.5)[:, None]
        typed = Typed(urdf, [message(k, position=steps) for k in range(COUNT)])
        assert typed.archive.n_samples == COUNT

    def test_contradicting_samples_of_one_stamp_are_refused(self, urdf) -> None:
        both = [sent for k in range(COUNT)
                for sent in (message(k), message(k, position=POSITION + 1.0))]  # fmt: skip
        typed = Typed(urdf, both)
        assert typed.refused
        assert "messages 0 and 1 have the same stamp and positions 1 rad or m apart" in (
            typed.message
        )
        assert f"{COUNT} such stamps" in typed.message

    def test_a_message_sent_twice_is_no_contradiction(self, urdf) -> None:
        assert not Typed(urdf, [sent for sent in WHOLE for _ in range(2)]).refused


@pytest.mark.usefixtures("each_kind")
class TestMissingQuantities:
    def test_the_joint_without_effort_is_named(self, urdf) -> None:
        effort = TORQUE.copy()
        effort[:, 1] = np.nan
        typed = Typed(urdf, [message(k, effort=effort) for k in range(COUNT)])
        assert typed.refused
        assert "effort: joint knee has no value in any message" in typed.message
        assert typed.options() == ["--effort", "ignore"]
        assert "torque" not in typed.again(*typed.options()).archive.columns

    def test_velocities_of_some_joints_are_left_out(self, urdf) -> None:
        velocity = SLOPE.copy()
        velocity[:, 1] = np.nan
        typed = Typed(urdf, [message(k, velocity=velocity) for k in range(COUNT)])
        assert "velocity" not in typed.archive.columns
        assert "velocity: not used, as no message has a value for knee" in typed.message


@pytest.mark.usefixtures("each_kind")
class TestClocks:
    def test_messages_that_changed_places_are_sorted_and_counted(self, urdf) -> None:
        messages = list(WHOLE)
        for k in (50, 200):
            received = [messages[k][0], messages[k + 1][0]]
            contents = [messages[k + 1][1], messages[k][1]]
            messages[k : k + 2] = list(zip(received, contents, strict=True))
        typed = Typed(urdf, messages)
        assert_right(typed.archive)
        assert "2 messages out of order: sorted by stamp" in typed.message

    def test_a_clock_set_back_is_refused_unless_the_bag_has_one(self, urdf) -> None:
        back = [message(k, stamp=STAMPS[k] - (10**9 if k >= 200 else 0)) for k in range(COUNT)]
        typed = Typed(urdf, back)
        assert typed.refused
        assert "older than the previous one" in typed.message
        assert typed.options() == ["--clock", "bag"]
        assert_right(typed.again(*typed.options()).archive)

    def test_first_messages_without_stamp_are_left_out(self, urdf) -> None:
        """Until the clock of a simulator is there; no gap of fifty years."""
        typed = Typed(urdf, [message(k, stamp=0 if k < 3 else None) for k in range(COUNT)])
        assert_right(typed.archive, rows=slice(3, None))
        assert "dropped: leading messages without a stamp (3)" in typed.message

    @pytest.mark.parametrize("first", quick_ones([100], [0, 100]))
    def test_a_clock_that_stands_still_is_named(self, urdf, first: int) -> None:
        stalled = [
            message(k, stamp=STAMPS[first] if first <= k < 300 or not first else None)
            for k in range(COUNT)
        ]
        typed = Typed(urdf, stalled)
        assert typed.refused
        assert re.search("stood still|have the same time", typed.message)
        assert typed.options() == ["--clock", "bag"]
        assert_right(typed.again(*typed.options()).archive)


class TestFiles:
    def folder(self, urdf: Path, *, named: int = 4) -> Path:
        """A bag of four parts, and metadata that name some."""
        folder = urdf.parent / "a bag #1?"
        folder.mkdir()
        for part in range(4):
            some = WHOLE[part * COUNT // 4 : (part + 1) * COUNT // 4]
            bag(folder / f"bag_{part}.db3", {"/joint_states": (STATE, some)})
        names = "".join(f"\n    - bag_{part}.db3" for part in range(named))
        (folder / "metadata.yaml").write_text(
            f"rosbag2_bagfile_information:\n  version: 5\n  relative_file_paths:{names}\n"
        )
        return folder

    def read(self, source: Path, urdf: Path) -> Archive:
        output = urdf.with_name("out.mcap")
        robot = Robot.from_urdf(urdf)
        return open_archive(import_rosbag2(source, output, robot=robot, force=True))

    @pytest.mark.long
    def test_a_split_bag_at_a_path_with_any_characters(self, urdf) -> None:
        assert_right(self.read(self.folder(urdf), urdf))

    def test_a_part_that_is_missing_is_named(self, urdf) -> None:
        folder = self.folder(urdf, named=6)
        with pytest.raises(SourceError, match=r"bag_4\.db3, bag_5\.db3: named in metadata") as no:
            self.read(folder, urdf)
        assert "to use one part alone, give its file: bag_0.db3" in str(no.value)
        assert self.read(folder / "bag_0.db3", urdf).n_samples == COUNT // 4
        (folder / "metadata.yaml").write_text("{")
        with pytest.raises(SourceError, match=r"metadata\.yaml: cannot be read"):
            self.read(folder, urdf)

    def test_a_part_beside_its_compressed_copy_is_read_once(self, urdf) -> None:
        folder = self.folder(urdf)
        packed = zstandard.compress((folder / "bag_2.db3").read_bytes())
        (folder / "bag_2.db3.zstd").write_bytes(packed)
        assert_right(self.read(folder, urdf))
        (folder / "bag_2.db3").unlink()
        assert_right(self.read(folder, urdf))

    def test_the_end_of_a_compressed_file_is_missing(self, urdf) -> None:
        path = urdf.with_name("mine.db3.zstd")
        whole = bag(urdf.with_name("whole.db3"), {"/joint_states": (STATE, WHOLE)}).read_bytes()
        path.write_bytes(zstandard.compress(whole[:5000]) + zstandard.compress(whole[5000:]))
        assert_right(self.read(path, urdf))
        path.write_bytes(path.read_bytes()[:-9])
        with pytest.raises(SourceError, match="ends within its compressed data; copy it again"):
            self.read(path, urdf)

    @pytest.mark.parametrize("suffix", ["db3", "mcap"])
    def test_errors_name_the_file_of_the_user(self, urdf, suffix: str) -> None:
        path = urdf.with_name(f"mine.{suffix}.zstd")
        path.write_bytes(zstandard.compress(b"no bag at all" * 99))
        with pytest.raises(SourceError) as refused:
            self.read(path, urdf)
        assert refused.value.path == path
        assert "part_" not in str(refused.value)

    def test_a_database_that_was_not_closed(self, urdf) -> None:
        """Its last messages are in the log beside it."""
        path = bag(urdf.with_name("live.db3"), {"/joint_states": (STATE, WHOLE[:300])})
        with closing(sqlite3.connect(path)) as database:
            database.execute("PRAGMA journal_mode=WAL")
            database.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (1, ?, ?)",
                                 WHOLE[300:])  # fmt: skip
            database.commit()
            copy = urdf.with_name("copy.db3")
            for end in ("", "-wal"):
                shutil.copy(f"{path}{end}", f"{copy}{end}")
        assert_right(self.read(copy, urdf))

    def test_a_bag_of_ros_1(self, urdf) -> None:
        path = ros_1_bag(urdf.with_name("old.bag"), WHOLE)
        assert_right(self.read(path, urdf))

    def test_a_truncated_mcap_names_what_recovers_it(self, urdf) -> None:
        path = mcap(urdf.with_name("x.mcap"), {"/js": (STATE, DEFINITION, "cdr", WHOLE)})
        path.write_bytes(path.read_bytes()[:-100])
        with pytest.raises(SourceError, match="mcap recover"):
            self.read(path, urdf)
