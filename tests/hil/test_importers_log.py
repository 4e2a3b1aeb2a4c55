"""Logs of text in columns become archives: by name, pattern or index, units, gears, refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from hil.archive import open_archive
from hil.errors import SourceError
from hil.importers import ColumnMap, Robot, import_log
from hil.importers.column_map import UNITS
from hil.recordings import open_recording
from tests.hil.simulated_logs import column_map, three_joint_robot
from tests.hil.simulated_logs import imported as read


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    return three_joint_robot(tmp_path)


def log(path: Path, values: NDArray[np.float64], header: str = "", delimiter: str = ",") -> Path:
    lines = [header] if header else []
    lines += [delimiter.join(repr(float(value)) for value in row) for row in values]
    path.write_text("\n".join(lines) + "\n")
    return path


VALUES = np.random.default_rng(0).normal(size=(20, 7))
HEADER = "t,q1,q2,q3,tau1,tau2,tau3"
VALUES[:, 0] = 0.01 * np.arange(20)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return log(tmp_path / "a.csv", VALUES, HEADER)


class TestColumns:
    @pytest.mark.parametrize("position", ["q{}", ("q1", "q2", "q3"), (1, 2, 3), ("q1", 2, "q3")])
    def test_by_pattern_name_and_index(self, file, robot, position):
        found = read(file, robot, position={"columns": position}, torque={"columns": "tau{}"})
        assert np.array_equal(found["position"], VALUES[:, 1:4])
        assert np.array_equal(found["torque"], VALUES[:, 4:])
        assert "motor_current" not in found

    def test_comments_and_quotes_before_the_data(self, tmp_path, robot):
        header = '# made by hand\n% 2020\n\n"t", "q1", "q2", "q3", "a", "b", "c"'
        found = read(log(tmp_path / "a.txt", VALUES, header), robot)
        assert np.array_equal(found["position"], VALUES[:, 1:4])

    def test_joints_in_another_order(self, tmp_path, robot):
        """Velocities too."""
        file = log(tmp_path / "a.csv", VALUES, "t,q1,q2,q3,v1,v2,v3")
        velocity = {"columns": "v{}", "unit": "deg/s"}
        found = read(file, robot, velocity=velocity, joints=("ankle", "hip", "knee"))
        assert np.array_equal(found["position"], VALUES[:, [2, 3, 1]])
        assert found["velocity"] == pytest.approx(np.radians(VALUES[:, [5, 6, 4]]), rel=1e-15)


class TestTime:
    def test_a_sample_rate_counts_samples(self, file, robot):
        columns = column_map(sample_rate=3000.0)
        path = import_log(file, file.with_suffix(".mcap"), robot=robot, columns=columns)
        assert np.array_equal(open_recording(path).time, np.arange(20) * (1 / 3000.0))

    @pytest.mark.parametrize(
        ("unit", "times", "expected"),
        [
            ("s", ["1700000000.123456789", "1700000000.123556790"], [0, 100001]),
            ("ms", ["0", "0.5"], [0, 500_000]),
            ("us", ["1e6", "1000001"], [0, 1000]),
            ("ns", ["1700000000123456789", "1700000000123456791"], [0, 2]),
            ("s", ["-0.025", "0.05"], [0, 75_000_000]),
            ("s", ["0", "0.01", "0.013", "0.5", "0.5001"],
             [0, 10_000_000, 13_000_000, 500_000_000, 500_100_000]),
        ],
    )  # fmt: skip
    def test_a_time_column_is_exact_to_the_nanosecond(self, tmp_path, robot, unit, times, expected):
        lines = [f"{time},1,2,{row}" for row, time in enumerate(times)]
        (tmp_path / "a.csv").write_text("t,q1,q2,q3\n" + "\n".join(lines))
        columns = column_map(time={"column": "t", "unit": unit})
        path = import_log(tmp_path / "a.csv", tmp_path / "a.mcap", robot=robot, columns=columns)
        stamp = open_archive(path).columns["stamp"]
        assert (stamp - stamp[0]).tolist() == expected
        assert open_recording(path).time.tolist() == pytest.approx(
            [1e-9 * value for value in expected], abs=1e-16
        )


class TestUnitsAndGears:
    def test_units_are_converted_to_si(self, file, robot):
        found = read(
            file,
            robot,
            position={"columns": "q{}", "unit": "deg", "scale": (1, -1, 2)},
            motor_current={"columns": "tau{}", "unit": "mA"},
        )
        expected = np.radians(VALUES[:, 1:4]) * [1, -1, 2]
        assert found["position"] == pytest.approx(expected, rel=1e-15)
        assert found["motor_current"] == pytest.approx(VALUES[:, 4:] / 1000)
        assert "torque" not in found
        assert 3000 * UNITS["velocity"]["rpm"] == pytest.approx(2 * np.pi * 50)

    def test_motor_side_goes_to_joint_side_with_power_preserved(self, tmp_path, robot):
        """Made from joint values by an independent way: ratio by ratio, coupling by hand."""
        q, qd, tau_motor = np.random.default_rng(8).normal(size=(3, 30, 3))
        n1, n2, n3, n32 = 100.0, -80.0, 50.0, 25.0

        def motor(x):
            return np.column_stack([n1 * x[:, 0], n2 * x[:, 1], n3 * x[:, 2] + n32 * x[:, 1]])

        back = read(
            log(tmp_path / "m.csv", np.hstack([motor(q), motor(qd), tau_motor])),
            robot,
            position={"columns": (0, 1, 2), "side": "motor"},
            velocity={"columns": (3, 4, 5), "side": "motor"},
            torque={"columns": (6, 7, 8), "side": "motor"},
            drive={
                "gear_ratio": (n1, n2, n3),
                "coupling": ((3, 2, n32),),
                "joint_offset": (0.5, 0.0, -0.5),
            },
        )
        assert back["position"] == pytest.approx(q + np.array([0.5, 0.0, -0.5]), rel=1e-12)
        assert back["velocity"] == pytest.approx(qd, rel=1e-12)
        power_motors = np.sum(tau_motor * motor(qd), axis=1)
        assert np.sum(back["torque"] * qd, axis=1) == pytest.approx(power_motors, rel=1e-9)
        assert back["torque"][:, 1] == pytest.approx(n2 * tau_motor[:, 1] + n32 * tau_motor[:, 2])

    def test_torque_constants_make_torques_of_currents(self, file, robot):
        drive = {"gear_ratio": (100, -80, 50), "torque_constant": (0.1, 0.2, 0.3)}
        found = read(file, robot, motor_current={"columns": "tau{}"}, drive=drive)
        assert np.array_equal(found["motor_current"], VALUES[:, 4:])
        assert found["torque"] == pytest.approx(VALUES[:, 4:] * [10.0, -16.0, 15.0])

    def test_gears_follow_the_joints_of_the_log(self, file, robot):
        found = read(
            file,
            robot,
            position={"columns": "q{}", "side": "motor"},
            joints=("ankle", "hip", "knee"),
            drive={"gear_ratio": (10, 20, 40), "joint_offset": (1, 2, 3)},
        )
        expected = (VALUES[:, 1:4] / [10, 20, 40] + [1, 2, 3])[:, [1, 2, 0]]
        assert found["position"] == pytest.approx(expected)


class TestBadInput:
    @pytest.mark.parametrize(
        ("entries", "sentence"),
        [
            (
                {"position": {"columns": "pos{}"}},
                "no column 'pos1' for hip, joint 1 of 3.*--lock-others.*its columns are t, q1, q2",
            ),
            ({"torque": {"columns": (4, 5, 9)}}, r"torque.columns: there is no column 9"),
            ({"torque": {"columns": (4, 5)}}, "has 2 entries; one for each of the joints hip"),
            ({"torque": {"columns": "tau"}}, "no place for the joint's number"),
            ({"joints": ("a", "b", "c")}, "names the joints a, b, c; the robot's joints are hip"),
            ({"drive": {"gear_ratio": (1, 2)}}, "drive.gear_ratio: has 2 entries"),
            ({"drive": {"gear_ratio": (1, 0, 2)}}, "would not be moved by any motor"),
            ({"time": {"column": "time"}}, "time: there is no column 'time'"),
            ({"torque": {"columns": "tau{}", "file": "t.csv"}}, r"t\.csv: cannot be read"),
        ],
    )
    def test_a_map_that_does_not_fit_is_refused_with_what_would(
        self, file, robot, entries, sentence
    ):
        with pytest.raises(SourceError, match=sentence):
            read(file, robot, **entries)
        assert not file.with_suffix(".mcap").exists()

    @pytest.mark.parametrize(
        ("line", "sentence"),
        [
            ("0.1,1,x,3,4,5,6", "line 12 has 'x' in column q2, not a number"),
            ("0.1,1", "line 12 has nothing in column q2, not a number"),
            ("0.1,1,,3,4,5,6", "line 12 has nothing in column q2"),
            ("0.1,1,nan,3,4,5,6", "line 12 has 'nan' in column q2, not a number"),
            ("0.1,1,inf,3,4,5,6", "line 12 has 'inf' in column q2, not a number"),
        ],
    )
    def test_a_cell_that_is_no_number_is_named_by_line_and_column(
        self, file, robot, line, sentence
    ):
        lines = file.read_text().splitlines()
        file.write_text("\n".join([*lines[:11], line, *lines[12:]]))
        with pytest.raises(SourceError, match=sentence):
            read(file, robot)

    @pytest.mark.parametrize("time", ["", "soon", "nan", "inf"])
    def test_a_time_that_is_no_number_is_named(self, tmp_path, robot, time):
        (tmp_path / "a.csv").write_text(f"t,q1,q2,q3\n0,1,2,3\n{time},1,2,3\n")
        with pytest.raises(SourceError, match=r"time: line 3 has ('.*'|nothing) for the time"):
            read(tmp_path / "a.csv", robot, time={"column": "t"})

    def test_rows_longer_than_the_header_are_refused(self, tmp_path, robot):
        """Which of the numbers have no name cannot be known: the first, as pandas writes them?"""
        file = log(tmp_path / "a.csv", VALUES, "t,q1,q2,q3")
        with pytest.raises(SourceError, match=r"4 names .* rows of 7 numbers; give the others"):
            read(file, robot)

    def test_files_of_different_length_are_refused(self, tmp_path, file, robot):
        log(tmp_path / "tau.csv", VALUES[:-1], HEADER)
        with pytest.raises(SourceError, match="differ in length: position 20, torque 19"):
            read(file, robot, torque={"columns": "tau{}", "file": "tau.csv"})

    def test_a_file_without_numbers_is_refused(self, tmp_path, robot):
        (tmp_path / "a.csv").write_text("t,q1\n")
        with pytest.raises(SourceError, match="has no row of numbers"):
            read(tmp_path / "a.csv", robot)


QUANTITIES = {
    "position": {"files": "q_{}.txt", "columns": (1,)},
    "torque": {"files": "tau{}.dat"},
}


class TestFilePerJoint:
    """Quantities with one file per joint, beside the log or in the folder that is named."""

    @pytest.fixture
    def folder(self, tmp_path):
        place = tmp_path / "run"
        place.mkdir()
        for joint in range(3):
            np.savetxt(place / f"q_{joint + 1}.txt", VALUES[:, [0, joint + 1]], fmt="%.17g")
            np.savetxt(place / f"tau{joint}.dat", VALUES[:, joint + 4], fmt="%.17g")
        np.savetxt(place / "t.txt", VALUES[:, 0])
        return place

    @pytest.mark.parametrize("source", [".", "q_1.txt", "t.txt"])
    def test_a_pattern_names_them(self, folder, robot, source):
        """Counted from 1, or from 0 where they are."""
        columns = column_map(**QUANTITIES)
        path = import_log(folder / source, folder / "a.mcap", robot=robot, columns=columns)
        archive = open_archive(path)
        assert np.array_equal(archive.columns["position"], VALUES[:, 1:4])
        assert np.array_equal(archive.columns["torque"], VALUES[:, 4:])
        assert "q_2.txt" in archive.header.entries["source"]

    def test_a_list_names_them_in_any_order(self, folder, robot):
        position = {"files": ("q_3.txt", "q_1.txt", "q_2.txt"), "columns": (1,)}
        found = read(folder, robot, position=position, joints=("ankle", "hip", "knee"))
        assert np.array_equal(found["position"], VALUES[:, 1:4])

    def test_each_may_call_its_column_by_the_joint(self, folder, robot):
        for joint in range(3):
            header = f"t,angle{joint + 1}"
            log(folder / f"{joint + 1}.csv", VALUES[:, [0, joint + 1]], header)
        found = read(folder, robot, position={"files": "{}.csv", "columns": "angle{}"})
        assert np.array_equal(found["position"], VALUES[:, 1:4])

    def test_arrays_have_a_file_each_as_well(self, folder, robot):
        for joint in range(3):
            np.save(folder / f"q{joint + 1}.npy", VALUES[:, joint + 1])
        found = read(folder, robot, position={"files": "q{}.npy"})
        assert np.array_equal(found["position"], VALUES[:, 1:4])

    def test_the_time_stands_in_each_of_them_or_in_its_own(self, folder, robot):
        for time in ({"column": 0}, {"file": "t.txt"}):
            columns = column_map(**QUANTITIES, time=time)
            path = import_log(folder, folder / "a.mcap", robot=robot, columns=columns)
            assert open_recording(path).time == pytest.approx(VALUES[:, 0])
            path.unlink()

    def test_joints_with_clocks_of_their_own_are_refused(self, folder, robot):
        np.savetxt(folder / "q_2.txt", VALUES[:, [0, 2]] + [0.001, 0.0])
        with pytest.raises(SourceError, match=r"q_2\.txt: time: has other times than q_1\.txt"):
            read(folder, robot, **QUANTITIES, time={"column": 0})

    @pytest.mark.parametrize(
        ("position", "sentence"),
        [
            ({"files": "q_{}.txt"}, r"q_1\.txt: .*shape \(20, 2\), where one column is wanted"),
            ({"files": "p{}.txt"}, r"position.files: there is no file 'p1.txt' for hip, joint 1"),
            ({"files": ("q_1.txt",)}, "position.files: has 1 entries; one for each of the joints"),
            ({"files": ("t.txt", "q_1.txt", "nowhere.txt"), "columns": (0,)}, "nowhere.txt: cann"),
            ({"files": "q_{}.txt", "columns": (0, 1)}, "position.columns: has 2 entries"),
            ({"files": ("tau0.dat", "tau1.dat", "short.dat")}, "tau1.dat 20, short.dat 5"),
            ({}, r'run: position.file: is a folder; name a file in it: file = "q.txt"'),
        ],
    )
    def test_what_does_not_fit_is_named(self, folder, robot, position, sentence):
        np.savetxt(folder / "short.dat", VALUES[:5, 4])
        with pytest.raises(SourceError, match=sentence):
            read(folder, robot, position=position)

    @pytest.mark.parametrize(
        ("position", "sentence"),
        [
            ({"files": "q.txt"}, "position.files has no place for the joint's number"),
            ({"files": "q{}.txt", "file": "q.txt"}, "position has files, so it has neither file"),
        ],
    )
    def test_a_map_that_contradicts_itself_is_refused(self, position, sentence):
        with pytest.raises(ValueError, match=sentence):
            column_map(position=position)


class TestMoreColumnsThanJoints:
    """Which of them are the joints has to be said."""

    WIDE = np.random.default_rng(7).normal(size=(20, 5))

    @pytest.mark.parametrize("first", [0, 1])
    def test_they_are_refused_with_the_two_ways_out(self, tmp_path, robot, first):
        header = ",".join(f"q{k + first}" for k in range(5))
        file = log(tmp_path / "a.csv", self.WIDE, header)
        expected = rf"5 columns are called 'q{{}}' \(q{first} to q{first + 4}\).* 3 joints: hip"
        with pytest.raises(SourceError, match=f"position.columns: {expected}.*joints.*list of 3"):
            read(file, robot)

    def test_so_are_files_and_arrays(self, tmp_path, robot):
        np.savez(tmp_path / "a.npz", **{f"q{k}": self.WIDE[:, k] for k in range(4)})
        with pytest.raises(SourceError, match=r"4 columns are called 'q\{\}' \(q0 to q3\)"):
            read(tmp_path / "a.npz", robot)
        for k in range(4):
            np.savetxt(tmp_path / f"q{k}.txt", self.WIDE[:, k])
        with pytest.raises(SourceError, match=r"4 files are called 'q\{\}.txt'"):
            read(tmp_path, robot, position={"files": "q{}.txt"})

    def test_the_map_may_name_all_joints_or_the_columns(self, tmp_path, robot):
        file = log(tmp_path / "a.csv", self.WIDE, "q1,q2,q3,q4,q5")
        ways = [
            ({"joints": ("ext", "ankle", "knee", "hip", "ext_2")}, [3, 2, 1]),
            ({"position": {"columns": ("q2", "q3", "q5")}}, [1, 2, 4]),
        ]
        for entries, expected in ways:
            assert np.array_equal(read(file, robot, **entries)["position"], self.WIDE[:, expected])
            file.with_suffix(".mcap").unlink()

    def test_logs_count_from_zero_where_they_do(self, tmp_path, robot):
        np.savez(tmp_path / "a.npz", **{f"q{k}": self.WIDE[:, k] for k in range(3)})
        for source in (tmp_path / "a.npz", log(tmp_path / "b.csv", self.WIDE[:, :3], "q0,q1,q2")):
            assert np.array_equal(read(source, robot)["position"], self.WIDE[:, :3])


class TestMapFile:
    def test_reads_toml(self, tmp_path):
        (tmp_path / "map.toml").write_text(
            'sample_rate = 5000.0\n[position]\ncolumns = "Joint_{}"\nside = "motor"\n'
            "[drive]\ngear_ratio = [32.0, 45]\ncoupling = [[2, 1, 32.0]]\n"
        )
        loaded = ColumnMap.load(tmp_path / "map.toml")
        assert loaded.drive.coupling == ((2, 1, 32.0),)
        assert loaded.position.side == "motor"

    RATE = "sample_rate = 5\n"
    POSITION = "[position]\ncolumns = 'q{}'\n"
    COUPLED = "[drive]\ngear_ratio = [1, 1]\ncoupling = [[2, 2, 1.0]]\n"

    @pytest.mark.parametrize(
        ("text", "sentence"),
        [
            (RATE, "position: is missing"),
            (POSITION, "either a time column or sample_rate"),
            (f"{RATE}{POSITION}unit = 'inch'\n", "'inch' is no unit"),
            (f"{RATE}[position]\ncolumn = 'q{{}}'\n", "position.column"),
            (f"sample_rate = -5\n{POSITION}", "sample_rate: must be a number"),
            (f"{RATE}{POSITION}side = 'motor'\n", "drive.gear_ratio is needed"),
            (f"{RATE}[position]\ncolumns = -1\n", "position.columns: must be a name"),
            (f"{RATE}[position]\nscale = 'x'\n", "position.scale: must be a number"),
            (f"{RATE}position = 3\n", "position: must be a table"),
            (f"{RATE}[position]\nfiles = 3\n", "position.files: must be a name with"),
            ("sample_rate = \n", "cannot be read"),
            (f"{RATE}{POSITION}scale = 0.0\n", "position.scale"),
            (f"{RATE}{POSITION}{COUPLED}", "another joint"),
        ],
    )
    def test_a_bad_one_is_refused_by_field(self, tmp_path, text, sentence):
        (tmp_path / "map.toml").write_text(text)
        with pytest.raises(SourceError, match=sentence) as refused:
            ColumnMap.load(tmp_path / "map.toml")
        assert "map.toml" in str(refused.value)


def test_tx40_positions_and_torques_in_two_files(tmp_path: Path, shared_data: Path) -> None:
    """A real arm, motor side, with a mechanical coupling of axes 5 and 6."""
    folder = shared_data / "tx40"
    (tmp_path / "map.toml").write_text(
        """sample_rate = 5000.0
        [position]
        columns = "Joint_{}"
        side = "motor"
        [torque]
        file = "curr_data.csv"
        columns = "Joint_{}"
        side = "motor"
        [drive]
        gear_ratio = [32.0, 32.0, 45.0, -48.0, 45.0, 32.0]
        coupling = [[6, 5, 32.0]]
        joint_offset = [0.0, -1.5707963267948966, 1.5707963267948966, 0.0, 0.0, 0.0]
        """
    )
    path = import_log(
        folder / "pos_read_data.csv",
        tmp_path / "tx40.mcap",
        robot=Robot.from_urdf(folder / "tx40_mdh_modified.urdf"),
        columns=ColumnMap.load(tmp_path / "map.toml"),
    )
    recording = open_recording(path).checked()
    motor = np.loadtxt(folder / "pos_read_data.csv", delimiter=",", skiprows=1)
    torque = np.loadtxt(folder / "curr_data.csv", delimiter=",", skiprows=1)
    assert recording.position.shape == (45000, 6)
    assert recording.time[-1] == pytest.approx(44999 / 5000)
    q = motor / [32.0, 32.0, 45.0, -48.0, 45.0, 32.0]
    q[:, 5] -= q[:, 4]
    q += [0.0, -np.pi / 2, np.pi / 2, 0.0, 0.0, 0.0]
    assert recording.position == pytest.approx(q, abs=1e-12)
    assert recording.torque[:, 3] == pytest.approx(-48.0 * torque[:, 3])
    assert recording.torque[:, 4] == pytest.approx(45.0 * torque[:, 4] + 32.0 * torque[:, 5])
