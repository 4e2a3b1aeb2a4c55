"""Arrays and text matrices become archives: by key, by row or column, as programs write them."""

from __future__ import annotations

import io
import os
import resource
import signal
import struct
import tomllib
import zipfile
from pathlib import Path
from time import monotonic

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from scipy.io import savemat

from hil.errors import SourceError
from hil.importers import Robot
from hil.importers import arrays as array_files
from hil.importers.arrays import ArrayFile
from hil.importers.column_map import Format
from hil.importers.robot import _cell_text
from hil.importers.table import Table
from hil.recordings import open_recording
from identification import FrictionLaw
from tests.hil.simulated_logs import JOINTS, imported, three_joint_robot

Array = NDArray[np.float64]
Q = np.random.default_rng(5).normal(size=(40, 3))
TAU = np.random.default_rng(6).normal(size=(40, 3))
TIME = 0.01 * np.arange(40)


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    return three_joint_robot(tmp_path)


def read(source: Path, robot: Robot, **entries: object) -> dict[str, Array]:
    return imported(source, robot, **{"position": {}, **entries})


class TestArrays:
    @pytest.mark.parametrize("transposed", [False, True])
    def test_a_matrix_either_way_round(self, tmp_path, robot, transposed):
        q, tau = (Q.T, TAU.T) if transposed else (Q, TAU)
        np.savez(tmp_path / "a.npz", q=q, tau=tau)
        found = read(
            tmp_path / "a.npz", robot, position={"columns": "q"}, torque={"columns": "tau"}
        )
        assert np.array_equal(found["position"], Q)
        assert np.array_equal(found["torque"], TAU)

    def test_an_array_per_joint_by_pattern_or_name(self, tmp_path, robot):
        arrays = {f"q{j + 1}": Q[:, j] for j in range(3)} | dict(zip("abc", TAU.T, strict=True))
        np.savez_compressed(tmp_path / "a.npz", **arrays)
        found = read(
            tmp_path / "a.npz",
            robot,
            position={"columns": "q{}"},
            torque={"columns": ("c", "a", "b")},
        )
        assert np.array_equal(found["position"], Q)
        assert np.array_equal(found["torque"], TAU[:, [2, 0, 1]])

    def test_columns_of_one_matrix_by_index_time_among_them(self, tmp_path, robot):
        np.save(tmp_path / "a.npy", np.column_stack([TIME, Q, TAU]))
        found = read(
            tmp_path / "a.npy",
            robot,
            time={"column": 0, "array": "array"},
            position={"columns": (1, 2, 3)},
            torque={"columns": (4, 5, 6)},
        )
        assert np.array_equal(found["torque"], TAU)
        assert found["stamp"].tolist() == [10_000_000 * k for k in range(40)]

    @pytest.mark.parametrize(
        ("stamps", "unit"),
        [
            (1_700_000_000_123_456_000 + 10_000_000 * np.arange(40), "ns"),
            (np.datetime64("2024-05-01T12:00:00") + np.arange(40) * np.timedelta64(10, "ms"), "s"),
            (1.7e9 + TIME, "s"),
            (-3.0 + TIME[:, None], "s"),
            (1e12 + 10.0 * np.arange(40.0), "us"),
        ],
    )
    def test_stamps_of_any_kind(self, tmp_path, robot, stamps, unit):
        np.savez(tmp_path / "a.npz", q=Q, t=stamps)
        found = read(
            tmp_path / "a.npz",
            robot,
            position={"columns": "q"},
            time={"column": "t", "unit": unit},
        )
        elapsed = (found["stamp"] - found["stamp"][0]) * 1e-9
        scale = 1e-3 if unit == "us" else 1.0
        assert elapsed == pytest.approx(TIME * scale, abs=3e-7)  # of a float that counts from 1970

    def test_matlab_files(self, tmp_path, robot):
        savemat(tmp_path / "a.mat", {"q": Q.T, "t": TIME[None, :]})
        found = read(
            tmp_path / "a.mat",
            robot,
            position={"columns": "q"},
            time={"column": "t"},
        )
        assert np.array_equal(found["position"], Q)

    def test_matlab_text(self, tmp_path, robot):
        rows = ";\n  ".join(" ".join(f"{cell:.17e}" for cell in row) for row in Q)
        (tmp_path / "a.m").write_text(f"% a log\nT = [0.01];\nq = [ {rows} ]; % rad\n")
        found = read(tmp_path / "a.m", robot, position={"columns": "q"})
        assert np.array_equal(found["position"], Q)

    @pytest.mark.parametrize(
        ("arrays", "position", "sentence"),
        [
            ({"p": Q}, {"columns": "q"}, r"there is no array 'q'; its arrays are p \(40, 3\)"),
            ({"p": Q, "r": Q}, {}, "which of its arrays is not said; its arrays are p"),
            ({"p": Q[:3]}, {}, 'square matrix; say whether joints lie along "columns" or "rows"'),
            ({"p": Q[:, :2]}, {}, r"shape \(40, 2\), joints along its columns, and there are 3"),
            ({"p": Q}, {"columns": (0, 1, 7), "array": "p"}, r"'p' has no column 7; it has 3"),
            ({"p": Q.T}, {"columns": (0, 9, 1), "joints_along": "rows"}, "rows 0, 9, 1; it has 3"),
            ({"a": TIME, "b": TIME[1:]}, {"columns": ("a", "b", "a")}, "a 40, b 39, a 40"),
            ({"p": np.array(["x"])}, {}, "holds no array of numbers"),
        ],
    )
    def test_what_does_not_fit_is_refused_with_what_is_there(
        self,
        tmp_path,
        robot,
        arrays,
        position,
        sentence,
    ):
        np.savez(tmp_path / "a.npz", **arrays)
        with pytest.raises(SourceError, match=sentence):
            read(tmp_path / "a.npz", robot, position=position)

    def test_a_file_that_is_none_is_refused(self, tmp_path, robot):
        (tmp_path / "a.npz").write_bytes(b"PK\x03\x04 torn")
        with pytest.raises(SourceError, match=r"a\.npz: cannot be read .* save the arrays again"):
            read(tmp_path / "a.npz", robot)


def stored(kind: str) -> bytes:
    """A file with `t` and `q`."""
    file, arrays = io.BytesIO(), {"t": TIME, "q": Q}
    if kind == "npy":
        np.save(file, Q)
    elif kind == "npz":
        np.savez_compressed(file, **arrays)
    else:
        savemat(file, arrays, do_compression=kind == "compressed mat")
    return file.getvalue()


def opaque(name: str) -> bytes:
    """A variable of a .mat that only MATLAB can read, as it saves tables and strings."""
    flags = struct.pack("<IIII", 6, 8, 17, 0)  # an array of UINT32: the class of opaque objects
    text = struct.pack("<II", 1, len(name)) + name.encode().ljust(8, b"\0")
    return struct.pack("<II", 14, len(flags) + len(text)) + flags + text


LOG = {
    "t": TIME,
    "note": "a string",
    "joint": {"q": Q, "tau": TAU.T, "more": {"q": -Q}},
    "each": np.array([{"q": column} for column in Q.T], object),
}


class TestStructs:
    """A path such as `log.joint.q` reaches a field of a struct."""

    @pytest.mark.parametrize("packed", [False, True])
    @pytest.mark.parametrize(
        ("columns", "expected"),
        [("log.joint.q", Q), ("log.joint.more.q", -Q), ("log.joint.tau", TAU)],
    )
    def test_a_field_is_reached_by_its_path(self, tmp_path, robot, columns, expected, packed):
        savemat(tmp_path / "a.mat", {"log": LOG, "k": 3.0}, do_compression=packed)
        entries = {"time": {"column": "log.t"}}
        found = read(tmp_path / "a.mat", robot, position={"columns": columns}, **entries)
        assert np.array_equal(found["position"], expected)
        assert (found["stamp"] / 1e9) == pytest.approx(TIME)

    @pytest.mark.parametrize("name", ["log.each({}).q", "cells({})", "one({}).q"])
    def test_elements_count_from_one_as_in_matlab(self, tmp_path, robot, name):
        records = np.zeros((1, 3), [("q", object)])
        cells = np.empty(3, object)
        for joint in range(3):
            records[0, joint]["q"] = cells[joint] = Q[:, joint]
        savemat(tmp_path / "a.mat", {"log": LOG, "cells": cells, "one": records})
        found = read(tmp_path / "a.mat", robot, position={"columns": name})
        assert np.array_equal(found["position"], Q)

    def test_columns_of_a_field_by_index(self, tmp_path, robot):
        savemat(tmp_path / "a.mat", {"log": {"all": np.column_stack([TIME, Q])}})
        position = {"array": "log.all", "columns": (1, 2, 3)}
        assert np.array_equal(read(tmp_path / "a.mat", robot, position=position)["position"], Q)

    def test_dimensions_of_one_element_do_not_count(self, tmp_path, robot):
        """Simulink logs (1, joints, samples)."""
        savemat(tmp_path / "a.mat", {"log": {"signals": {"values": Q.T[None]}}})
        found = read(tmp_path / "a.mat", robot, position={"columns": "log.signals.values"})
        assert np.array_equal(found["position"], Q)

    @pytest.mark.parametrize(
        ("path", "sentence"),
        [
            ("log.joint.x", r"its arrays are log.joint.q \(40, 3\)"),
            ("log.joint", "its arrays are log.t"),
            ("log.note", r"its arrays are log.t \(1, 40\), log.joint.q"),
            ("other.q", r"its arrays are k \(1, 1\), log.t"),
        ],
    )
    def test_a_field_that_is_missing_is_named_with_those_there(
        self, tmp_path, robot, path, sentence
    ):
        savemat(tmp_path / "a.mat", {"log": LOG, "k": 3.0})
        with pytest.raises(
            SourceError, match=rf"a\.mat: position.columns: there is no array '{path}'; {sentence}"
        ):
            read(tmp_path / "a.mat", robot, position={"columns": path})

    @pytest.mark.parametrize("position", ["q", "log.joint.q"])
    def test_variables_that_only_matlab_reads_are_passed_over(self, tmp_path, robot, position):
        """scipy lists nothing of a file with one."""
        savemat(tmp_path / "a.mat", {"log": LOG, "q": Q})
        with (tmp_path / "a.mat").open("ab") as file:
            file.write(opaque("table"))
        found = read(tmp_path / "a.mat", robot, position={"columns": position})
        assert np.array_equal(found["position"], Q)

    def test_no_more_fields_are_read_than_anybody_logs(self, tmp_path, robot, monkeypatch):
        monkeypatch.setattr(array_files, "_MOST_FIELDS", 2)
        savemat(tmp_path / "a.mat", {"log": LOG})
        with pytest.raises(ValueError, match="more than 2 fields"):
            array_files._struct_fields(str(tmp_path / "a.mat"), ["log"])
        monkeypatch.setattr(array_files, "_MOST_FIELDS", 100)
        monkeypatch.setattr(array_files, "MOST_NUMBERS", 100)
        with pytest.raises(ValueError, match="too large"):
            array_files._struct_fields(str(tmp_path / "a.mat"), ["log"])


class TestDamageAndMalice:
    @pytest.mark.parametrize("kind", ["npz", "npy", "mat", "compressed mat"])
    def test_a_damaged_file_is_read_or_refused_with_one_sentence(self, tmp_path, kind):
        rng, whole = np.random.default_rng(1), stored(kind)
        path = tmp_path / f"a.{kind.split()[-1]}"
        refused = 0
        for _ in range(40):
            data = bytearray(whole)
            data[rng.integers(min(len(data), 400))] = rng.integers(256)
            path.write_bytes(data[: rng.integers(len(data) // 2, len(data) * 2)])
            try:
                file = ArrayFile.read(path)
                for name in file.stored:
                    file.matrix(name, "position")
            except SourceError:
                refused += 1
        assert refused > 0

    def test_a_file_that_kills_scipy_does_not_kill_the_import(self, tmp_path, robot):
        savemat(tmp_path / "a.mat", {"t": np.arange(4.0)})
        data = bytearray((tmp_path / "a.mat").read_bytes())
        data[176] = 0  # the type of the numbers: MATLAB has none of that number
        (tmp_path / "a.mat").write_bytes(data)
        with pytest.raises(SourceError, match=r"cannot be read \(it is damaged\)"):
            read(tmp_path / "a.mat", robot, position={"columns": "t"})
        savemat(tmp_path / "b.mat", {"q": Q})
        assert np.array_equal(read(tmp_path / "b.mat", robot)["position"], Q)

    def test_only_what_the_map_names_is_read_and_no_more_than_fits(self, tmp_path, robot):
        """Zeros pack well: a small file can hold more than any memory."""
        path = tmp_path / "a.npz"
        np.savez(path, q=Q, o=np.array([print], object), few=np.array([1, 2j]))
        with zipfile.ZipFile(path, "a") as archive, archive.open("bomb.npy", "w") as bomb:
            head = {"descr": "<f8", "fortran_order": False, "shape": (10**12, 3)}
            np.lib.format.write_array_header_1_0(bomb, head)
        with zipfile.ZipFile(path, "a") as archive:
            archive.writestr("torn.npy", stored("npy")[:-1])
        assert np.array_equal(read(path, robot, position={"columns": "q"})["position"], Q)
        for name, sentence in {
            "bomb": "too large to be read at once; save the log in parts",
            "torn": "cannot be read",
            "o": "there is no array 'o'",
            "few": "there is no array 'few'",
        }.items():
            with pytest.raises(SourceError, match=sentence):
                read(path, robot, position={"columns": name})

    def test_a_npy_that_says_more_than_it_holds_is_refused(self, tmp_path, robot):
        with (tmp_path / "a.npy").open("wb") as file:
            head = {"descr": "<f8", "fortran_order": False, "shape": (10**7, 3)}
            np.lib.format.write_array_header_1_0(file, head)
        with pytest.raises(SourceError, match="cannot be read"):
            read(tmp_path / "a.npy", robot)

    def test_objects_are_not_unpickled(self, tmp_path, robot):
        np.save(tmp_path / "a.npy", np.array([print] * 3, object), allow_pickle=True)
        with pytest.raises(SourceError, match=r"a\.npy"):
            read(tmp_path / "a.npy", robot)

    def test_brackets_without_end_are_quickly_found_out(self, tmp_path, robot):
        (tmp_path / "a.m").write_text("a=[" * 100_000 + "a" * 100_000)
        begin = monotonic()
        with pytest.raises(SourceError, match="no array of numbers"):
            read(tmp_path / "a.m", robot)
        assert monotonic() - begin < 5.0


@pytest.mark.parametrize("name", ["rob\x7f", "\U0001f916arm", 'a"\\', "\udc80rob", ""])
def test_any_name_of_a_file_or_joint_makes_a_cell_file(name: str) -> None:
    text = _cell_text(name, FrictionLaw(), (0, 0, np.nan), True, {name: 0.5})
    cell = tomllib.loads(text.encode().decode())
    assert cell["cell"]["name"] == (name.replace("\udc80", "?") or "robot")
    assert list(cell["robot"]["locked"].values()) == [0.5]


class TestTextMatrices:
    @pytest.mark.parametrize("transposed", [False, True])
    def test_one_file_per_quantity_without_header(self, tmp_path, robot, transposed):
        for name, values in (("q", Q), ("tau", TAU)):
            np.savetxt(tmp_path / f"{name}.txt", values.T if transposed else values, fmt="%.17e")
        found = read(tmp_path / "q.txt", robot, torque={"file": "tau.txt"})
        assert np.array_equal(found["position"], Q)
        assert np.array_equal(found["torque"], TAU)

    def test_channels_along_lines_with_their_names(self, tmp_path, robot):
        rows = [("time", TIME), *((f"q{j + 1}", Q[:, j]) for j in range(3))]
        lines = [" ".join([name, *(repr(float(v)) for v in values)]) for name, values in rows]
        (tmp_path / "a.txt").write_text("\n".join(lines))
        found = read(
            tmp_path / "a.txt",
            robot,
            time={"column": "time"},
            position={"columns": "q{}"},
            format={"transposed": True},
        )
        assert np.array_equal(found["position"], Q)

    @given(
        values=arrays(np.float64, (7, 3), elements=st.floats(-1e6, 1e6, width=32)),
        delimiter=st.sampled_from([",", ";", "\t", " ", "|", "  ", "; "]),
        decimal=st.sampled_from([".", ","]),
        exponent=st.sampled_from(["e", "E", "D", "d"]),
        header=st.booleans(),
        ends=st.sampled_from(["\n", "\r\n"]),
    )
    def test_whatever_is_written_is_read(
        self, tmp_path_factory, values, delimiter, decimal, exponent, header, ends
    ):
        assume("," not in delimiter or decimal == ".")
        lines = [
            delimiter.join(f"{cell:.16e}".replace("e", exponent) for cell in row).replace(
                ".", decimal
            )
            for row in values
        ]
        if header:
            lines.insert(0, delimiter.join(["q1", "q2", "q3"]))
        path = tmp_path_factory.mktemp("any") / "q.txt"
        path.write_bytes(ends.join(lines).encode())
        table = Table.read(path, Format())
        assert np.array_equal(table.numbers([0, 1, 2], "position"), values)
        assert table.names == (("q1", "q2", "q3") if header else ())

    def test_an_empty_line_between_numbers_is_named(self, tmp_path, robot):
        lines = [" ".join(map(repr, row)) for row in Q.tolist()]
        (tmp_path / "q.txt").write_text("\n".join([*lines[:9], "", *lines[9:]]))
        with pytest.raises(SourceError, match=r"line 10 is empty; .*skip_empty = true.*skip_rows"):
            read(tmp_path / "q.txt", robot)

    @pytest.mark.parametrize("header", [[], ["q1 q2 q3"], ["q1 q2 q3", ""]])
    def test_empty_lines_are_left_out_on_demand(self, tmp_path, robot, header):
        lines = [" ".join(map(repr, row)) + "\n" for row in Q.tolist()]
        (tmp_path / "q.txt").write_text("\n".join(["", *header, *lines, " ", ""]))
        found = read(tmp_path / "q.txt", robot, format={"skip_empty": True})
        assert np.array_equal(found["position"], Q)

    @pytest.mark.parametrize("hole", ["nan", "", "NULL", "-"])
    def test_rows_with_holes_are_left_out_on_demand(self, tmp_path, robot, hole):
        lines = [",".join(map(repr, [t, *row])) for t, row in zip(TIME, Q.tolist(), strict=True)]
        lines = [line.replace("np.float64(", "").replace(")", "") for line in lines]
        lines[7] = f"0.07,{hole},1,2"
        (tmp_path / "a.csv").write_text("\n".join(["t,q1,q2,q3", *lines]))
        entries = {"time": {"column": "t"}, "position": {"columns": "q{}"}}
        with pytest.raises(SourceError, match=r"line 9 has .* in column q1"):
            read(tmp_path / "a.csv", robot, **entries)
        found = read(tmp_path / "a.csv", robot, **entries, format={"missing": "drop"})
        assert np.array_equal(found["position"], np.delete(Q, 7, axis=0))
        assert 70_000_000 not in found["stamp"]


def test_joints_of_the_log_that_the_robot_has_not_are_left_out(tmp_path, robot):
    more = np.column_stack([Q[:, 2], np.full(40, 9.0), Q[:, :2]])
    np.savez(tmp_path / "a.npz", q=more)
    found = read(
        tmp_path / "a.npz",
        robot,
        joints=(JOINTS[2], "gripper", *JOINTS[:2]),
        position={"columns": "q", "scale": (2.0, 1.0, 1.0, 1.0), "offset": (0.5, 0, 0, 0)},
    )
    assert found["position"][:, :2] == pytest.approx(Q[:, :2])
    assert found["position"][:, 2] == pytest.approx(2.0 * (Q[:, 2] + 0.5))


def test_a_joint_that_was_not_recorded_has_to_be_locked(tmp_path, robot):
    np.savez(tmp_path / "a.npz", q=Q[:, :2])
    with pytest.raises(SourceError, match="--locked NAME, or all: --lock-others"):
        read(tmp_path / "a.npz", robot, joints=JOINTS[:2], position={"columns": "q"})
    path = tmp_path / "two.urdf"
    path.write_text(robot.urdf)
    locked = Robot.from_urdf(path, locked={"ankle": 0.3})
    found = read(tmp_path / "a.npz", locked, joints=JOINTS[:2], position={"columns": "q"})
    assert np.array_equal(found["position"], Q[:, :2])
    assert open_recording(tmp_path / "a.mcap").joint_names == JOINTS[:2]


def test_the_process_that_reads_for_us_never_takes_all_memory_also_when_it_is_another() -> None:
    pid = array_files._elsewhere(os.getpid)
    os.kill(pid, signal.SIGKILL)
    assert array_files._readers[0].connection.poll(5.0)
    assert array_files._elsewhere(resource.getrlimit, resource.RLIMIT_AS) == (2**33, 2**33)
    assert array_files._elsewhere(os.getpid) != pid
