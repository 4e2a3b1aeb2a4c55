"""Import of logs of text and arrays, robots by DH parameters, warnings about column maps."""

from __future__ import annotations

import json
import os
import resource
import signal
import struct
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from time import monotonic
from typing import Any

import h5py
import numpy as np
import pinocchio as pin
import pytest
from click.testing import Result
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from scipy.io import savemat
from typer.testing import CliRunner

from hil.archive import ArchiveHeader, Findings, ImportedSamples, open_archive
from hil.archive.recording_of_archive import open_recording
from hil.base.errors import ArchiveWriteError, InputError, SourceError
from hil.cell import Cell
from hil.cell.nominal import nominal_of
from hil.cli import app
from hil.cli.imports import _names
from hil.importers import array_files as array_files
from hil.importers import matlab
from hil.importers.array_files import ArrayFile
from hil.importers.bag_map import BagMap
from hil.importers.column_map import UNITS, ColumnMap, Format, ready_map, ready_maps
from hil.importers.conclusions import StoppedJoint
from hil.importers.dh import Convention, urdf_of_dh
from hil.importers.imported_robot import Robot, _cell_text
from hil.importers.log import import_log
from hil.importers.messages import sentence as worded
from hil.importers.plausibility import examine
from hil.importers.recording_import import import_recording
from hil.importers.stamps import check_clock
from hil.importers.text_table import TextTable
from hil.pipeline.sources import cell_of
from identification import FrictionLaw
from identification.model.kinematics import chain_from_urdf
from tests import messages
from tests.hil.importers.bags import STATE, bag, state
from tests.hil.simulated_logs import (
    JOINTS,
    Simulated,
    column_map,
    simulate,
    three_joint_robot,
    urdf_path,
)
from tests.hil.simulated_logs import imported as read
from tests.identification import three_axes
from tests.near import near
from tests.tiers import quick_ones


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


Q = VALUES[:, 1:4]
TAU = VALUES[:, 4:]
TIME = VALUES[:, 0]
WIDE = np.random.default_rng(7).normal(size=(20, 5))
QUOTED = '# made by hand\n% 2020\n\n"t", "q1", "q2", "q3", "a", "b", "c"'
TURNED = ("ankle", "hip", "knee")
Q_TAU = {"position": {"columns": "q"}, "torque": {"columns": "tau"}}
TABLE = {"position": {"columns": (1, 2, 3)}, "torque": {"columns": (4, 5, 6)}}
FILES = {"position": {"files": "q_{}.txt", "columns": (1,)}, "torque": {"files": "tau{}.dat"}}
ROWS = {"array": "all", "joints_along": "rows"}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Logs of `Q`, `TAU` and `TIME`, and of the five columns of `WIDE`."""
    root = tmp_path_factory.mktemp("logs")
    log(root / "a.csv", VALUES, HEADER)
    log(root / "quoted.txt", VALUES, QUOTED)
    log(root / "short.csv", VALUES[:-1], HEADER)
    log(root / "from0.csv", Q, "q0,q1,q2")
    for first in (0, 1):
        log(root / f"wide{first}.csv", WIDE, ",".join(f"q{k + first}" for k in range(5)))
    for name in ("run", "wide"):
        (root / name).mkdir()
    for joint in range(3):
        run = root / "run"
        number = joint + 1
        np.savetxt(run / f"q_{number}.txt", VALUES[:, [0, number]], fmt="%.17g")
        np.savetxt(run / f"tau{joint}.dat", TAU[:, joint], fmt="%.17g")
        np.savetxt(run / f"late_{number}.txt", VALUES[:, [0, number]] + [0.001 * joint, 0.0])
        np.save(run / f"q{number}.npy", Q[:, joint])
        log(run / f"{number}.csv", VALUES[:, [0, number]], f"t,angle{number}")
    np.savetxt(run / "t.txt", TIME)
    np.savetxt(run / "short.dat", TAU[:5, 0])
    for k in range(4):
        np.savetxt(root / "wide" / f"q{k}.txt", WIDE[:, k])
    np.save(root / "all.npy", VALUES)
    joints = {f"q{j + 1}": Q[:, j] for j in range(3)} | dict(zip("abc", TAU.T, strict=True))
    for name, content in {
        "upright": {"q": Q, "tau": TAU},
        "flat": {"q": Q.T, "tau": TAU.T},
        "joints": joints,
        "from0": {f"q{k}": Q[:, k] for k in range(3)},
        "rows": {"all": np.vstack([TAU.T, Q.T]), "t": TIME},
        "wide": {f"q{k}": WIDE[:, k] for k in range(4)},
        "square": {"p": Q[:3]},
        "narrow": {"p": Q[:, :2]},
        "lengths": {"a": TIME, "b": TIME[1:]},
        "text": {"p": np.array(["x"])},
    }.items():
        np.savez_compressed(root / f"{name}.npz", **content)  # type: ignore[arg-type]
    return root


def columns_of(columns: object) -> dict[str, object]:
    return {"position": {"columns": columns}}


READ: list[tuple[str, dict[str, Any], NDArray[np.float64], NDArray[np.float64] | None]] = [
    *(
        ("a.csv", {**columns_of(columns), "torque": {"columns": "tau{}"}}, Q, TAU)
        for columns in ("q{}", ("q1", "q2", "q3"), (1, 2, 3), ("q1", 2, "q3"))
    ),
    ("quoted.txt", {}, Q, None),
    ("a.csv", {"joints": TURNED}, Q[:, [1, 2, 0]], None),
    ("wide1.csv", {"joints": ("ext", "ankle", "knee", "hip", "ext_2")}, WIDE[:, [3, 2, 1]], None),
    ("wide1.csv", columns_of(("q2", "q3", "q5")), WIDE[:, [1, 2, 4]], None),
    ("from0.csv", {}, Q, None),
    ("from0.npz", {}, Q, None),
    *((f"run{file}", FILES, Q, TAU) for file in ("", "/q_1.txt", "/t.txt")),
    ("run", {"position": {"files": "q{}.npy"}}, Q, None),
    ("run", {"position": {"files": "{}.csv", "columns": "angle{}"}}, Q, None),
    (
        "run",
        {"position": {"files": ("q_3.txt", "q_1.txt", "q_2.txt"), "columns": (1,)},
         "joints": TURNED},
        Q, None,
    ),
    ("run", {**FILES, "time": {"column": 0}}, Q, TAU),
    ("run", {**FILES, "time": {"file": "t.txt"}}, Q, TAU),
    ("upright.npz", Q_TAU, Q, TAU),
    ("flat.npz", Q_TAU, Q, TAU),
    ("joints.npz", {"torque": {"columns": ("c", "a", "b")}}, Q, TAU[:, [2, 0, 1]]),
    ("all.npy", {**TABLE, "time": {"column": 0, "array": "array"}}, Q, TAU),
    ("rows.npz", {"position": {"columns": (3, 4, 5), **ROWS}, "time": {"column": "t"}}, Q, None),
]  # fmt: skip
REFUSED: list[tuple[str, dict[str, Any], str]] = [
    ("a.csv", columns_of("pos{}"),
     "no column 'pos1' for hip, joint 1 of 3.*there are t, q1, q2.*--lock-others"),
    ("a.csv", {"torque": {"columns": (4, 5, 9)}}, "torque.columns: there is no column 9"),
    ("a.csv", {"torque": {"columns": (4, 5)}}, "has 2 entries; one for each of the joints hip"),
    ("a.csv", {"joints": ("a", "b", "c")}, "names the joints a, b, c; the robot's joints are hip"),
    ("a.csv", {"drive": {"gear_ratio": (1, 0, 2)}}, "one of the joints is moved by no motor"),
    ("a.csv", {"torque": {"columns": "tau{}", "file": "t.csv"}}, r"t\.csv: cannot be read"),
    ("a.csv", {"torque": {"columns": "tau{}", "file": "short.csv"}},
     "differ in length: position 20, torque 19"),
    ("run", {**FILES, "position": {"files": "late_{}.txt", "columns": (1,)}, "time": {"column": 0}},
     r"late_2\.txt: time: has other times than late_1\.txt"),
    *(("run", {"position": position}, sentence) for position, sentence in (
        ({"files": "q_{}.txt"}, r"q_1\.txt: .*shape \(20, 2\), expected one column"),
        ({"files": "p{}.txt"}, r"position.files: there is no file 'p1.txt' for hip, joint 1"),
        ({"files": ("q_1.txt",)}, "position.files: has 1 entries; one for each of the joints"),
        ({"files": ("tau0.dat", "tau1.dat", "short.dat")}, "tau1.dat 20, short.dat 5"),
        ({}, r'run: position.file: is a folder; give a file in it: file = "q.txt"'),
    )),
    *((f"wide{k}.csv", {}, rf"columns: 5 columns are called 'q{{}}' \(q{k} to q{k + 4}\).* 3 joints"
       ": hip.*joints.*list 3") for k in (0, 1)),
    ("wide.npz", {}, r"4 columns are called 'q\{\}' \(q0 to q3\)"),
    ("wide", {"position": {"files": "q{}.txt"}}, r"4 files are called 'q\{\}.txt'"),
    ("rows.npz", {"position": {"columns": (4, 5, 6), **ROWS}}, "'all' has no row 6; it has 6"),
    ("square.npz", columns_of("q"), r"there is no array 'q'; its arrays are p \(3, 3\)"),
    ("upright.npz", {"position": {}}, "the name of the array is missing; its arrays are q"),
    ("square.npz", {"position": {}},
     'square matrix; state whether joints are along "columns" or "rows"'),
    ("narrow.npz", {"position": {}}, r"shape \(20, 2\), joints along its columns, and there are 3"),
    ("narrow.npz", {"position": {"columns": (0, 1, 7), "array": "p"}}, "no column 7; it has 2"),
    ("lengths.npz", columns_of(("a", "b", "a")), "a 20, b 19, a 20"),
    ("text.npz", {"position": {}}, "has no array of numbers"),
]  # fmt: skip


class TestMaps:
    @pytest.mark.parametrize(("source", "entries", "position", "torque"), READ)
    def test_columns_files_and_arrays_are_found(
        self, place, robot, source, entries, position, torque
    ):
        columns = read(place / source, robot, **entries)
        assert np.array_equal(columns["position"], position)
        assert ("torque" in columns) == (torque is not None)
        if torque is not None:
            assert np.array_equal(columns["torque"], torque)
        if "time" in entries:
            assert columns["stamp"] / 1e9 == near(TIME)
        assert "motor_current" not in columns

    @pytest.mark.parametrize(("source", "entries", "sentence"), REFUSED)
    def test_a_map_that_does_not_fit_is_refused(self, place, robot, source, entries, sentence):
        with pytest.raises(SourceError, match=sentence):
            read(place / source, robot, **entries)
        assert not (place / source).with_suffix(".mcap").exists()


TIMES = [
    ("s", ["1700000000.123456789", "1700000000.123556790"], [0, 100001]),
    ("ms", ["0", "0.5"], [0, 500_000]),
    ("us", ["1e6", "1000001"], [0, 1000]),
    ("ns", ["1700000000123456789", "1700000000123456791"], [0, 2]),
    ("s", ["-0.025", "0.05"], [0, 75_000_000]),
    ("s", ["0", "0.01", "0.013", "0.5", "0.5001"],
     [0, 10_000_000, 13_000_000, 500_000_000, 500_100_000]),
]  # fmt: skip


class TestTime:
    def test_a_sample_rate_counts_samples(self, file, robot):
        read(file, robot, sample_rate=3000.0)
        time = open_recording(file.with_suffix(".mcap")).time
        assert np.array_equal(time, np.arange(20) * (1 / 3000.0))

    @pytest.mark.parametrize(("unit", "times", "expected"), TIMES)
    def test_a_time_column_is_exact_to_the_nanosecond(self, tmp_path, robot, unit, times, expected):
        lines = [f"{time},1,2,{row}" for row, time in enumerate(times)]
        (tmp_path / "a.csv").write_text("t,q1,q2,q3\n" + "\n".join(lines))
        stamp = read(tmp_path / "a.csv", robot, time={"column": "t", "unit": unit})["stamp"]
        assert (stamp - stamp[0]).tolist() == expected
        time = open_recording(tmp_path / "a.mcap").time
        assert time == pytest.approx([1e-9 * value for value in expected], abs=1e-16)


class TestUnitsAndGears:
    def test_units_are_converted_to_si(self, file, robot):
        columns = read(
            file,
            robot,
            position={"columns": "q{}", "unit": "deg", "scale": (1, -1, 2)},
            motor_current={"columns": "tau{}", "unit": "mA"},
        )
        expected = np.radians(VALUES[:, 1:4]) * [1, -1, 2]
        assert columns["position"] == near(expected, rel=1e-15)
        assert columns["motor_current"] == near(VALUES[:, 4:] / 1000)
        assert "torque" not in columns
        assert 3000 * UNITS["velocity"]["rpm"] == near(2 * np.pi * 50)

    def test_motor_side_is_converted_with_power_conserved(self, tmp_path, robot):
        """Expected values are computed ratio by ratio."""
        q, qd, tau_motor = np.random.default_rng(8).normal(size=(3, 30, 3))
        n1 = 100.0
        n2 = -80.0
        n3 = 50.0
        n32 = 25.0

        def motor(x):
            return np.column_stack([n1 * x[:, 0], n2 * x[:, 1], n3 * x[:, 2] + n32 * x[:, 1]])

        back = read(
            log(tmp_path / "m.csv", np.hstack([motor(q), motor(qd), tau_motor])),
            robot,
            position={"columns": (0, 1, 2), "side": "motor"},
            velocity={"columns": (3, 4, 5), "side": "motor"},
            torque={"columns": (6, 7, 8), "side": "motor"},
            drive={"gear_ratio": (n1, n2, n3), "coupling": ((3, 2, n32),),
                   "joint_offset": (0.5, 0.0, -0.5)},
        )  # fmt: skip
        assert back["position"] == near(q + np.array([0.5, 0.0, -0.5]), rel=1e-12)
        assert back["velocity"] == near(qd, rel=1e-12)
        power_motors = np.sum(tau_motor * motor(qd), axis=1)
        assert np.sum(back["torque"] * qd, axis=1) == near(power_motors, rel=1e-9)
        assert back["torque"][:, 1] == near(n2 * tau_motor[:, 1] + n32 * tau_motor[:, 2])
        assert cell_of(open_archive(tmp_path / "m.mcap")).model.coupling is not None

    def test_constants_and_gears_follow_the_joints_of_the_log(self, file, robot):
        drive = {"gear_ratio": (100, -80, 50), "torque_constant": (0.1, 0.2, 0.3)}
        columns = read(file, robot, motor_current={"columns": "tau{}"}, drive=drive)
        assert np.array_equal(columns["motor_current"], VALUES[:, 4:])
        assert columns["torque"] == near(VALUES[:, 4:] * [10.0, -16.0, 15.0])
        columns = read(
            file,
            robot,
            position={"columns": "q{}", "side": "motor"},
            joints=("ankle", "hip", "knee"),
            drive={"gear_ratio": (10, 20, 40), "joint_offset": (1, 2, 3)},
        )
        expected = (VALUES[:, 1:4] / [10, 20, 40] + [1, 2, 3])[:, [1, 2, 0]]
        assert columns["position"] == near(expected)


class TestBadInput:
    @pytest.mark.parametrize(
        ("line", "problem"),
        [
            ("0.1,1,x,3,4,5,6", "'x' in column q2, not a number"),
            ("0.1,1", "nothing in column q2"),
            ("0.1,1,inf,3,4,5,6", "'inf' in column q2"),
            ("nan,1,2,3,4,5,6", "'nan' for the time"),
            (",1,2,3,4,5,6", "nothing for the time"),
        ],
    )
    def test_an_invalid_cell_is_named_by_line(self, file, robot, line, problem):
        lines = file.read_text().splitlines()
        file.write_text("\n".join([*lines[:11], line, *lines[12:]]))
        with pytest.raises(SourceError, match=f"line 12 has {problem}"):
            read(file, robot, time={"column": "t"})

    def test_unusable_files_are_refused(self, tmp_path, file, robot):
        (tmp_path / "b.csv").write_text("t,q1\n")
        with pytest.raises(SourceError, match="has no row of numbers"):
            read(tmp_path / "b.csv", robot)
        # The column without a name may be the first or the last.
        longer = log(tmp_path / "c.csv", VALUES, "t,q1,q2,q3")
        with pytest.raises(SourceError, match=r"4 names .* rows of 7 numbers; name every column"):
            read(longer, robot)


class TestMapFile:
    RATE = "sample_rate = 5\n"
    POSITION = "[position]\ncolumns = 'q{}'\n"
    COUPLED = "[drive]\ngear_ratio = [1, 1]\ncoupling = [[2, 2, 1.0]]\n"

    @pytest.mark.parametrize(
        ("text", "sentence"),
        [
            (RATE, "position: is missing"),
            (POSITION, "either a time column or sample_rate; see the column map in docs"),
            (f"{RATE}{POSITION}unit = 'furlong'\n", "'furlong' is not a unit"),
            (f"{RATE}{POSITION}side = 'motor'\n", "drive.gear_ratio is needed"),
            (f"{RATE}[position]\ncolumns = [-1]\n", r"position.columns\[0\]: .* must be a name"),
            (f"{RATE}{POSITION}scale = 0.0\n", "scale is 0, .*; see the column map in docs"),
            (f"{RATE}[position]\nfiles = 'q.txt'\n", "position.files has no {} for the joint"),
            (f"{RATE}{POSITION}file = 'q'\nfiles = 'q{{}}'\n", "so it has neither file"),
            ("sample_rate = \n", "cannot be read"),
            (f"{RATE}{POSITION}{COUPLED}", "another joint"),
        ],
    )
    def test_an_invalid_one_is_refused_by_field(self, tmp_path, text, sentence):
        (tmp_path / "map.toml").write_text(text)
        with pytest.raises(SourceError, match=sentence) as refused:
            ColumnMap.load(tmp_path / "map.toml")
        assert "map.toml" in str(refused.value)


# Arrays and text matrices


Floats = NDArray[np.float64]


def read_arrays(source: Path, robot: Robot, **entries: object) -> dict[str, Floats]:
    return read(source, robot, **{"position": {}, **entries})


class TestArrays:
    @pytest.mark.parametrize(
        ("stamps", "unit"),
        [
            (1_700_000_000_123_456 + 10_000 * np.arange(20), "us"),
            (np.datetime64("2024-05-01T12:00:00") + np.arange(20) * np.timedelta64(10, "ms"), "s"),
            (-3.0 + TIME[:, None], "s"),
            (1e6 + 10.0 * np.arange(20.0), "ms"),
        ],
    )
    def test_stamps_of_any_kind(self, tmp_path, robot, stamps, unit):
        np.savez(tmp_path / "a.npz", q=Q, t=stamps)
        time = {"column": "t", "unit": unit}
        columns = read(tmp_path / "a.npz", robot, position={"columns": "q"}, time=time)
        elapsed = (columns["stamp"] - columns["stamp"][0]) * 1e-9
        assert elapsed == near(TIME, abs=1e-9)

    def test_matlab_files_and_text(self, tmp_path, robot):
        savemat(tmp_path / "a.mat", {"q": Q.T, "t": TIME[None, :]})
        entries = {"position": {"columns": "q"}, "time": {"column": "t"}}
        columns = read(tmp_path / "a.mat", robot, **entries)
        assert np.array_equal(columns["position"], Q)
        rows = ";\n  ".join(" ".join(f"{cell:.17e}" for cell in row) for row in Q)
        (tmp_path / "a.m").write_text(f"% a log\nT = [0.01];\nq = [ {rows} ]; % rad\n")
        columns = read_arrays(tmp_path / "a.m", robot, position={"columns": "q"})
        assert np.array_equal(columns["position"], Q)


def opaque(name: str) -> bytes:
    """Return a variable of a .mat that only MATLAB can read, as it saves tables and strings."""
    flags = struct.pack("<IIII", 6, 8, 17, 0)  # an array of UINT32: the class of opaque objects
    text = struct.pack("<II", 1, len(name)) + name.encode().ljust(8, b"\0")
    return struct.pack("<II", 14, len(flags) + len(text)) + flags + text


LOG = {
    "t": TIME,
    "note": "a string",
    "joint": {"q": Q, "tau": TAU.T, "more": {"q": -Q}},
    "each": np.array([{"q": column} for column in Q.T], object),
}


RECORDS = np.zeros((1, 3), [("q", object)])
CELLS = np.empty(3, object)
for _joint in range(3):
    RECORDS[0, _joint]["q"] = CELLS[_joint] = Q[:, _joint]
LOG |= {"cells": CELLS, "records": RECORDS, "signals": {"values": Q.T[None]}}
STRUCTS = {
    "log.joint.q": Q,
    "log.joint.more.q": -Q,
    "log.joint.tau": TAU,
    "log.each({}).q": Q,  # numbered from 1
    "log.cells({})": Q,
    "log.records({}).q": Q,
    "log.signals.values": Q,  # (1, joints, samples), as Simulink logs
}


class TestStructs:
    @pytest.mark.parametrize("columns", STRUCTS)
    def test_field_by_path(self, tmp_path, robot, columns):
        savemat(tmp_path / "a.mat", {"log": LOG, "k": 3.0}, do_compression=True)
        entries = {"time": {"column": "log.t"}}
        arrays = read_arrays(tmp_path / "a.mat", robot, position={"columns": columns}, **entries)
        assert np.array_equal(arrays["position"], STRUCTS[columns])
        assert (arrays["stamp"] / 1e9) == near(TIME)

    def test_columns_of_a_field(self, tmp_path, robot):
        savemat(tmp_path / "a.mat", {"log": {"all": np.column_stack([TIME, Q])}})
        position = {"array": "log.all", "columns": (1, 2, 3)}
        assert np.array_equal(read(tmp_path / "a.mat", robot, position=position)["position"], Q)

    def test_missing_field_is_named_with_the_others(self, tmp_path, robot):
        savemat(tmp_path / "a.mat", {"log": LOG, "k": 3.0})
        problem = "position.columns: there is no array 'log.joint.x'; its arrays are .*log.joint.q"
        with pytest.raises(SourceError, match=rf"a\.mat: {problem} \(20, 3\)"):
            read_arrays(tmp_path / "a.mat", robot, position={"columns": "log.joint.x"})

    @pytest.mark.parametrize("position", ["q", "log.joint.q"])
    def test_variables_that_only_matlab_reads_are_ignored(self, tmp_path, robot, position):
        """scipy lists nothing of a file with one."""
        savemat(tmp_path / "a.mat", {"log": LOG, "q": Q})
        with (tmp_path / "a.mat").open("ab") as file:
            file.write(opaque("table"))
        arrays = read_arrays(tmp_path / "a.mat", robot, position={"columns": position})
        assert np.array_equal(arrays["position"], Q)

    def test_number_of_elements_is_limited(self, tmp_path, robot, monkeypatch):
        monkeypatch.setattr(array_files, "MAX_ELEMENTS", 50)
        savemat(tmp_path / "a.mat", {"log": LOG})
        with pytest.raises(SourceError, match="too large to be read in one piece"):
            read_arrays(tmp_path / "a.mat", robot, position={"columns": "log.joint.q"})


def save_73(path: Path, **values: object) -> Path:
    """A .mat as MATLAB 7.3 writes it: HDF5 behind 512 bytes, arrays transposed, cells as links."""
    with h5py.File(path, "w", userblock_size=512) as file:
        refs = file.create_group("#refs#")

        def put(group: h5py.Group, name: str, value: object) -> None:
            if isinstance(value, dict):
                inner = group.create_group(name)
                inner.attrs["MATLAB_class"] = np.bytes_("struct")
                for key, member in value.items():
                    put(inner, key, member)
            elif isinstance(value, list):
                names = [f"{name}{k}" for k in range(len(value))]
                for key, member in zip(names, value, strict=True):
                    put(refs, key, member)
                data = np.array([[refs[key].ref] for key in names], h5py.ref_dtype)
                group.create_dataset(name, data=data).attrs["MATLAB_class"] = np.bytes_("cell")
            else:
                data = np.atleast_2d(np.asarray(value, np.float64)).T
                dataset = group.create_dataset(name, data=data)
                dataset.attrs["MATLAB_class"] = np.bytes_("double")

        for name, value in values.items():
            put(file, name, value)
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    return path


class TestMatlab73:
    @pytest.mark.parametrize("columns", ["q", "log.q", "log.each({})"])
    def test_arrays_structs_and_cells(self, tmp_path, robot, columns):
        log = {"q": Q.T, "each": [column[:, None] for column in Q.T]}
        path = save_73(tmp_path / "a.mat", q=Q, t=TIME, log=log)
        arrays = read(path, robot, position={"columns": columns}, time={"column": "t"})
        assert np.array_equal(arrays["position"], Q)
        assert arrays["stamp"] / 1e9 == near(TIME)

    def test_a_file_without_contents_is_refused(self, tmp_path, robot):
        head = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
        empty = b"\x89HDF\r\n\x1a\n" + bytes(2000)
        (tmp_path / "a.mat").write_bytes(head.ljust(512, b"\0") + empty)
        with pytest.raises(
            SourceError, match=r"a\.mat: its data are lost: .* 2000 bytes that are all zero"
        ):
            read_arrays(tmp_path / "a.mat", robot)


class TestUntrustedFiles:
    @pytest.mark.parametrize("compressed", [False, True])
    def test_damaged_files_raise_no_other_error(self, tmp_path, compressed):
        rng = np.random.default_rng(1)
        path = tmp_path / "a.mat"
        savemat(path, {"t": TIME, "q": Q}, do_compression=compressed)
        intact = path.read_bytes()
        refused = 0
        for _ in range(40):
            data = bytearray(intact)
            data[rng.integers(min(len(data), 400))] = rng.integers(256)
            path.write_bytes(data[: rng.integers(len(data) // 2, len(data) * 2)])
            try:
                file = ArrayFile(path)
                for name in file.names:
                    file.matrix(name, "position")
            except SourceError:
                refused += 1
        assert refused > 0

    def test_a_file_that_crashes_scipy_is_refused(self, tmp_path, robot):
        savemat(tmp_path / "a.mat", {"t": np.arange(4.0)})
        data = bytearray((tmp_path / "a.mat").read_bytes())
        data[176] = 0  # invalid type of the numbers
        (tmp_path / "a.mat").write_bytes(data)
        with pytest.raises(SourceError, match=r"cannot be read \(it is damaged\)"):
            read_arrays(tmp_path / "a.mat", robot, position={"columns": "t"})
        savemat(tmp_path / "b.mat", {"q": Q})
        assert np.array_equal(read_arrays(tmp_path / "b.mat", robot)["position"], Q)

    def test_only_arrays_of_the_map_are_read_with_limited_size(self, tmp_path, robot):
        path = tmp_path / "a.npz"
        forged = {"descr": "<f8", "fortran_order": False}
        np.savez(path, q=Q, o=np.array([print], object), few=np.array([1, 2j]))
        with zipfile.ZipFile(path, "a") as archive:
            with archive.open("bomb.npy", "w") as bomb:
                np.lib.format.write_array_header_1_0(bomb, forged | {"shape": (10**12, 3)})
            np.save(tmp_path / "q.npy", Q)
            archive.writestr("truncated.npy", (tmp_path / "q.npy").read_bytes()[:-1])
        assert np.array_equal(read_arrays(path, robot, position={"columns": "q"})["position"], Q)
        for name, sentence in {
            "bomb": "too large to be read in one piece; save the log in parts",
            "truncated": "cannot be read",
            "o": "there is no array 'o'",
            "few": "there is no array 'few'",
        }.items():
            with pytest.raises(SourceError, match=sentence):
                read_arrays(path, robot, position={"columns": name})
        with (tmp_path / "a.npy").open("wb") as file:
            np.lib.format.write_array_header_1_0(file, forged | {"shape": (10**7, 3)})
        np.save(tmp_path / "b.npy", np.array([print] * 3, object), allow_pickle=True)
        (tmp_path / "b.npz").write_bytes(b"PK\x03\x04 truncated")
        for name in ("a.npy", "b.npy", "b.npz"):
            with pytest.raises(SourceError, match=f"{name}: cannot be read .* save the arrays"):
                read_arrays(tmp_path / name, robot)

    def test_unclosed_brackets_take_linear_time(self, tmp_path, robot):
        (tmp_path / "a.m").write_text("a=[" * 100_000 + "a" * 100_000)
        begin = monotonic()
        with pytest.raises(SourceError, match="no array of numbers"):
            read_arrays(tmp_path / "a.m", robot)
        assert monotonic() - begin < 5.0


@pytest.mark.parametrize("name", ['a"\\', "\udc80rob", ""])
def test_any_name_of_a_file_or_joint_gives_a_valid_cell_file(name: str) -> None:
    text = _cell_text(name, FrictionLaw(), (0, 0, np.nan), {name: 0.5})
    cell = tomllib.loads(text.encode().decode())
    assert cell["cell"]["name"] == (name.replace("\udc80", "?") or "robot")
    assert list(cell["robot"]["locked"].values()) == [0.5]


class TestTextMatrices:
    def test_channels_along_lines_with_their_names(self, tmp_path, robot):
        rows = [("time", TIME), *((f"q{j + 1}", Q[:, j]) for j in range(3))]
        lines = [" ".join([name, *(repr(float(v)) for v in values)]) for name, values in rows]
        (tmp_path / "a.txt").write_text("\n".join(lines))
        time = {"column": "time"}
        form = {"transposed": True}
        arrays = read(tmp_path / "a.txt", robot, time=time, format=form)
        assert np.array_equal(arrays["position"], Q)

    @pytest.mark.long
    @given(
        values=arrays(np.float64, (7, 3), elements=st.floats(-1e6, 1e6, width=32)),
        delimiter=st.sampled_from([",", ";", "\t", " ", "|", "  ", "; "]),
        decimal=st.sampled_from([".", ","]),
        exponent=st.sampled_from(["e", "E", "D", "d"]),
        header=st.booleans(),
        ends=st.sampled_from(["\n", "\r\n"]),
    )
    def test_any_delimiter_decimal_mark_exponent_and_header(
        self, tmp_path_factory, values, delimiter, decimal, exponent, header, ends
    ):
        assume("," not in delimiter or decimal == ".")
        table = str.maketrans({"e": exponent, ".": decimal})
        lines = [delimiter.join(f"{cell:.16e}".translate(table) for cell in row) for row in values]
        if header:
            lines.insert(0, delimiter.join(["q1", "q2", "q3"]))
        path = tmp_path_factory.mktemp("any") / "q.txt"
        path.write_bytes(ends.join(lines).encode())
        table = TextTable.read(path, Format())
        assert np.array_equal(table.numbers([0, 1, 2], "position"), values)
        assert table.names == (("q1", "q2", "q3") if header else ())

    def test_empty_lines_are_named_or_skipped_on_request(self, tmp_path, robot):
        lines = [" ".join(map(repr, row)) for row in Q.tolist()]
        (tmp_path / "q.txt").write_text("\n".join([*lines[:9], "", *lines[9:]]))
        with pytest.raises(SourceError, match=r"line 10 is empty.*skip_empty = true.*skip_rows"):
            read_arrays(tmp_path / "q.txt", robot)
        (tmp_path / "q.txt").write_text("\n\n".join(["", "q1 q2 q3", *lines, " "]))
        arrays = read_arrays(tmp_path / "q.txt", robot, format={"skip_empty": True})
        assert np.array_equal(arrays["position"], Q)

    @pytest.mark.parametrize("hole", ["nan", "NULL"])
    def test_rows_with_missing_numbers_are_dropped_on_request(self, tmp_path, robot, hole):
        lines = [",".join(map(repr, row)) for row in np.column_stack([TIME, Q]).tolist()]
        lines[7] = f"0.07,{hole},1,2"
        (tmp_path / "a.csv").write_text("\n".join(["t,q1,q2,q3", *lines]))
        time = {"column": "t"}
        with pytest.raises(SourceError, match=r"line 9 has .* in column q1"):
            read(tmp_path / "a.csv", robot, time=time)
        columns = read(tmp_path / "a.csv", robot, time=time, format={"missing": "drop"})
        assert np.array_equal(columns["position"], np.delete(Q, 7, axis=0))
        assert 70_000_000 not in columns["stamp"]

    @pytest.mark.parametrize("suffix", [".csv", ".npz"])
    @pytest.mark.parametrize(("column", "named"), [(0, "time"), (2, "position|q2")])
    def test_holes_of_time_and_quantities_name_the_remedy(
        self, tmp_path, robot, suffix, column, named
    ):
        """A missing time, in a file of any kind, is a hole like a missing number."""
        rows = np.column_stack([TIME, Q])
        path = tmp_path / f"a{suffix}"
        rows[7, column] = np.nan
        if suffix == ".npz":
            np.savez(path, t=rows[:, 0], q=rows[:, 1:])
            entries = {"time": {"column": "t"}, "position": {"columns": "q"}}
        else:
            lines = [",".join(map(repr, row)) for row in rows.tolist()]
            path.write_text("\n".join(["t,q1,q2,q3", *lines]))
            entries = {"time": {"column": "t"}}
        with pytest.raises(SourceError, match=named) as refused:
            read(path, robot, **entries)
        assert 'missing = "drop"' in str(refused.value)
        columns = read(path, robot, format={"missing": "drop"}, **entries)
        assert np.array_equal(columns["position"], np.delete(Q, 7, axis=0))
        assert len(columns["stamp"]) == len(Q) - 1


def test_joints_are_those_of_the_robot_or_locked(tmp_path, robot):
    columns = np.column_stack([Q[:, 2], np.full(20, 9.0), Q[:, :2]])
    np.savez(tmp_path / "a.npz", q=columns, two=Q[:, :2])
    position = {"columns": "q", "scale": (2.0, 1.0, 1.0, 1.0), "offset": (0.5, 0, 0, 0)}
    joints = (JOINTS[2], "gripper", *JOINTS[:2])
    read_columns = read(tmp_path / "a.npz", robot, joints=joints, position=position)
    expected = np.column_stack([Q[:, :2], 2.0 * (Q[:, 2] + 0.5)])
    assert read_columns["position"] == near(expected)
    entries = {"joints": JOINTS[:2], "position": {"columns": "two"}}
    with pytest.raises(SourceError, match="--locked NAME, or all: --lock-others"):
        read(tmp_path / "a.npz", robot, **entries)
    locked = Robot.from_urdf(tmp_path / "three.urdf", locked={"ankle": 0.3})
    assert np.array_equal(read(tmp_path / "a.npz", locked, **entries)["position"], Q[:, :2])


def test_child_process_has_limited_memory_also_after_a_restart() -> None:
    pid = matlab._in_child(os.getpid)
    os.kill(pid, signal.SIGKILL)
    assert matlab._readers[0].connection.poll(5.0)
    assert matlab._in_child(resource.getrlimit, resource.RLIMIT_AS) == (2**33, 2**33)
    assert matlab._in_child(os.getpid) != pid


# Robots by Denavit-Hartenberg parameters


DH_HEADER = "joint,type,a,alpha,d,theta_offset"
MIXED = (
    ("turn", "revolute", 0.2, 0.7, 0.4, 0.3),
    ("slide", "prismatic", -0.1, -1.2, 0.15, 1.1),
    ("elbow", "revolute", 0.05, 3.0, 0.0, -2.0),
    ("wrist", "revolute", 0.0, -0.4, -0.3, 0.0),
)
UR5 = """joint,type,a,alpha_deg,d,theta_offset
shoulder_pan_joint,revolute,0,90,0.089159,0
shoulder_lift_joint,revolute,-0.425,0,0,0
elbow_joint,revolute,-0.39225,0,0,0
wrist_1_joint,revolute,0,90,0.10915,0
wrist_2_joint,revolute,0,-90,0.09465,0
wrist_3_joint,revolute,0,0,0.0823,0
"""
PANDA = """# manufacturer's table, convention of Craig
joint;type;a_mm;alpha_deg;d_mm;theta_offset_deg
panda_joint1;revolute;0;0;333;0
panda_joint2;revolute;0;-90;0;0
panda_joint3;revolute;0;90;316;0
panda_joint4;revolute;82.5;90;0;0
panda_joint5;revolute;-82.5;-90;384;0
panda_joint6;revolute;0;90;0;0
panda_joint7;revolute;88;90;0;0
"""


def dh_table(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def dh_text(rows: tuple[tuple[object, ...], ...]) -> str:
    return "\n".join([DH_HEADER, *(",".join(map(str, row)) for row in rows)]) + "\n"


def about_z(angle: float, along: float) -> Floats:
    c = np.cos(angle)
    s = np.sin(angle)
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, along], [0, 0, 0, 1.0]])


def about_x(angle: float, along: float) -> Floats:
    c = np.cos(angle)
    s = np.sin(angle)
    return np.array([[1, 0, 0, along], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1.0]])


def flange(convention: Convention, q: Floats) -> Floats:
    """Forward kinematics of MIXED, row by row."""
    place = np.eye(4)
    for (_, kind, a, alpha, d, offset), value in zip(MIXED, q, strict=True):
        turns = kind == "revolute"
        z = about_z(offset + value * turns, d + value * (not turns))
        x = about_x(alpha, a)
        place = place @ (z @ x if convention == "standard" else x @ z)
    return place


def placement(model: pin.Model, q: Floats, frame: str) -> Floats:
    """Return a frame of a URDF in its base; joints without limits have cosine and sine."""
    joints = zip(model.joints[1:], q, strict=True)
    full = np.concatenate(
        [[np.cos(angle), np.sin(angle)] if joint.nq == 2 else [angle] for joint, angle in joints]
    )
    data = model.createData()
    pin.framesForwardKinematics(model, data, full)
    return np.array(data.oMf[model.getFrameId(frame)].homogeneous)


class TestDhKinematics:
    @pytest.mark.parametrize("convention", ["standard", "modified"])
    def test_equals_product_of_row_transforms(self, tmp_path: Path, convention: Convention) -> None:
        path = dh_table(tmp_path / "dh.csv", dh_text(MIXED))
        model = pin.buildModelFromXML(urdf_of_dh(path, convention))
        for q in np.random.default_rng(2).uniform(-3.0, 3.0, (20, 4)):
            assert placement(model, q, "flange") == pytest.approx(flange(convention, q), abs=1e-12)

    def test_ur5_equals_its_urdf(self, tmp_path: Path) -> None:
        """Standard convention; base and tool frames differ by constant transforms."""
        ours = pin.buildModelFromXML(urdf_of_dh(dh_table(tmp_path / "ur5.csv", UR5), "standard"))
        theirs = pin.buildModelFromUrdf(str(urdf_path("ur5_robot.urdf")))
        base = about_z(np.pi, 0.0)
        tools = []
        for q in np.random.default_rng(3).uniform(-3.0, 3.0, (10, 6)):
            there = base @ placement(theirs, q, "tool0")
            tools.append(np.linalg.solve(there, placement(ours, q, "flange")))
        assert np.ptp(tools, axis=0).max() < 1e-3  # m; the URDF rounds its lengths

    def test_panda_equals_its_urdf(self, tmp_path: Path) -> None:
        """Modified convention, with lengths in mm and angles in degrees."""
        path = dh_table(tmp_path / "panda.csv", PANDA)
        ours = pin.buildModelFromXML(urdf_of_dh(path, "modified"))
        theirs = pin.buildModelFromUrdf(str(urdf_path("panda.urdf")))
        for q in np.random.default_rng(4).uniform(-1.0, 1.0, (10, 7)):
            expected = placement(theirs, np.append(q, [0.0, 0.0]), "panda_link7")
            assert placement(ours, q, "link_7") == pytest.approx(expected, abs=1e-9)

    def test_gives_no_nominal_model(self, tmp_path: Path) -> None:
        """The table has no masses."""
        path = dh_table(tmp_path / "dh.csv", dh_text(MIXED))
        robot = Robot.from_urdf(path, convention="standard")
        cell = Cell.from_texts(robot.cell, robot.urdf, Path("cell.toml"))
        assert robot.joint_names == ("turn", "slide", "elbow", "wrist")
        assert not cell.model.nominal.any()
        assert nominal_of(cell) is None


class TestDhErrors:
    @pytest.mark.parametrize(
        ("text", "sentence"),
        [
            ("", r"has no row of a joint; write joint,type,a,alpha,d,theta_offset"),
            ("joint,type,a,alpha,d\nj,revolute,0,0,0\n", "header: has no column theta_offset"),
            (
                f"{DH_HEADER},alpha_deg\nj,revolute,0,0,0,0,9\n",
                "header: has columns alpha and alpha_",
            ),
            (f"{DH_HEADER}\nj,spherical,0,0,0,0\n", "type: line 2 has 'spherical'; write rev"),
            (f"{DH_HEADER}\nj,revolute,0,90,0,0\n", "alpha: line 2 has '90'.*column alpha_deg"),
            (f"{DH_HEADER}\nj,revolute,400,0,0,0\n", "a: line 2 has '400'.*call the column a_mm"),
            (f"{DH_HEADER}\nj,revolute,0,nan,0,\n", "alpha: line 2 has 'nan'"),
            (
                f"{DH_HEADER}\nj,revolute,0,0,0,0\nj,revolute,0,0,0,0\n",
                "joint: line 3 has 'j'; give each",
            ),
        ],
    )
    def test_name_line_field_and_remedy(self, tmp_path: Path, text: str, sentence: str) -> None:
        with pytest.raises(InputError, match=r"dh\.csv: cannot be read"):
            urdf_of_dh(tmp_path / "dh.csv", "standard")
        with pytest.raises(InputError, match=rf"dh\.csv: {sentence}"):
            urdf_of_dh(dh_table(tmp_path / "dh.csv", text), "standard")

    @pytest.mark.parametrize(
        ("options", "sentence"),
        [
            (["--dh", "dh.csv"], "--convention: is not given; --dh needs standard"),
            (["--dh", "dh.csv", "--urdf", "r.urdf"], "--urdf and --dh: exclude each other"),
        ],
    )
    def test_options_that_do_not_fit(
        self, options: list[str], sentence: str, tmp_path: Path
    ) -> None:
        output = tmp_path / "cell.toml"
        result = CliRunner().invoke(app, ["new", *options, "-o", str(output)])
        assert isinstance(result.exception, InputError)
        assert sentence in str(result.exception)


class TestDhCommands:
    def test_new_writes_a_cell_and_its_urdf(self, tmp_path: Path) -> None:
        path = dh_table(tmp_path / "panda.csv", PANDA)
        arguments = ["new", "--dh", str(path), "--convention", "modified", "--json"]
        result = CliRunner().invoke(app, [*arguments, "-o", str(tmp_path / "cell.toml")])
        assert result.exit_code == 0, result.output
        summary = json.loads(result.output)
        assert summary["joints"] == [f"panda_joint{j}" for j in range(1, 8)]
        assert "limits.lower_deg" in summary["unknown"]
        assert any("no masses" in note for note in summary["notes"])
        cell = tomllib.loads((tmp_path / "cell.toml").read_text())
        assert cell["cell"]["urdf"] == "cell.urdf"
        chain = chain_from_urdf((tmp_path / "cell.urdf").read_text())
        assert list(chain.joint_names) == summary["joints"]
        assert path.read_text() == PANDA

    def test_a_log_is_imported_with_it(self, tmp_path: Path) -> None:
        """As with a URDF; joints that were not recorded can be locked."""
        time = np.arange(200) / 100.0
        q = np.sin(time[:, None] * [1.0, 2.0, 3.0])
        np.savez(tmp_path / "log.npz", t=time, q=q)
        (tmp_path / "map.toml").write_text(
            'joints = ["turn", "elbow", "wrist"]\n[time]\ncolumn = "t"\n[position]\ncolumns = "q"\n'
        )
        path = dh_table(tmp_path / "dh.csv", dh_text(MIXED))
        arguments = ["import", "log", str(tmp_path / "log.npz"), "-o", str(tmp_path / "log.mcap")]
        arguments += ["--map", str(tmp_path / "map.toml"), "--dh", str(path), "--lock-others"]
        result = CliRunner().invoke(app, [*arguments, "--convention", "modified"])
        assert result.exit_code == 0, result.exception
        assert "locked: slide at 0 m" in result.output
        archive = open_archive(tmp_path / "log.mcap")
        assert archive.joint_names == ("turn", "elbow", "wrist")
        assert np.array_equal(archive.columns["position"], q)


# Warnings about the column map and the robot


DEGREES = 57.29578


@pytest.fixture(scope="module")
def arm() -> Simulated:
    return simulate("ur5_robot.urdf", np.arange(0.0, 20.0, 0.01))


@pytest.fixture(scope="module")
def panda() -> Simulated:
    """An arm whose joints have different ranges."""
    fingers = ("panda_finger_joint1", "panda_finger_joint2")
    return simulate("panda.urdf", np.arange(0.0, 20.0, 0.01), locked=fingers)


def warnings(
    arm: Simulated, *, position=1.0, velocity=1.0, torque=1.0, clock=1.0, order=None, masses=True
) -> list[str]:
    stamp = np.rint(arm.time * clock * 1e9).astype(np.int64)
    columns = slice(None) if order is None else list(order)
    samples = ImportedSamples(
        stamp,
        arm.position * position,
        velocity=arm.velocity[:, columns] * velocity,
        torque=arm.torque * torque,
    )
    robot = Robot.from_urdf(arm.urdf, recorded=arm.joint_names)
    nominal = robot.nominal_torque() if masses else None
    found = examine(samples, arm.joint_names, robot.urdf, nominal=nominal)
    return list(map(worded, found.warnings))


def factors(warning: str) -> dict[str, float]:
    """Return the factors of the velocities that a warning lists, by joint."""
    parts = warning.partition(":")[0].partition(" times ")[2].split(", ")
    return {name: float(factor) for factor, name in (part.split(" for ") for part in parts)}


ORDER = [0, 1, 2, 5, 4, 3, 6]
ERRORS = {
    "degrees": ({"position": DEGREES}, "read as degrees, none would"),
    "degrees of rad": ({"position": 1 / DEGREES}, "no joint moves further than"),
    "no velocity": ({"velocity": 0.0}, "does not follow its position"),
    "torque": ({"torque": 1000.0}, "its limit in the URDF is 150 N·m: check its unit"),
    "slow clock": ({"clock": 1e3}, "0.1 samples per second are unusual"),
    "fast clock": ({"clock": 1e-3}, "100000 samples per second are unusual"),
    "order": (
        {"order": (1, 2, 0, 3, 4, 5)},
        "in the order shoulder_lift_joint, elbow_joint, shoulder_pan_joint, wrist_1_joint, "
        "wrist_2_joint, wrist_3_joint by 0 %",
    ),
}


class TestWarnings:
    def test_correct_logs_have_none(self, arm: Simulated, panda: Simulated) -> None:
        assert warnings(arm) == []
        assert warnings(panda) == []

    @pytest.mark.parametrize("what", ERRORS)
    def test_error_is_named(self, arm: Simulated, what: str) -> None:
        error, sentence = ERRORS[what]
        sentences = warnings(arm, **error)
        assert any(sentence in warning for warning in sentences), sentences

    def test_a_joint_with_one_reading_is_named_unless_it_was_held(self, arm: Simulated) -> None:
        stamp = np.rint(arm.time * 1e9).astype(np.int64)
        standing = np.where(np.arange(6) == 2, 0.4, arm.position)
        samples = ImportedSamples(stamp, standing, torque=arm.torque)
        robot = Robot.from_urdf(arm.urdf, recorded=arm.joint_names)

        def findings(held_joints: Sequence[str] = ()) -> list[str]:
            result = examine(samples, arm.joint_names, robot.urdf, held_joints=held_joints)
            return list(map(worded, result.warnings))

        (sentence,) = findings()
        assert sentence.startswith("the position of elbow_joint is the same in all")
        assert findings([arm.joint_names[2]]) == []

    @pytest.mark.parametrize(("last", "is_named"), [(0.5, True), (0.05, False)])
    def test_a_joint_that_stands_at_the_end_is_named(
        self, arm: Simulated, last: float, is_named: bool
    ) -> None:
        """A servo stands for a moment at every turning point."""
        stamp = np.rint(arm.time * 1e9).astype(np.int64)
        first = round((1.0 - last) * len(arm.time))
        position = arm.position.copy()
        position[first:, 1] = position[first, 1]
        samples = ImportedSamples(stamp, position, commanded_position=arm.position)
        robot = Robot.from_urdf(arm.urdf, recorded=arm.joint_names)
        result = examine(samples, arm.joint_names, robot.urdf)
        stopped = [found for found in result.warnings if isinstance(found, StoppedJoint)]
        assert [found.joint for found in stopped] == [arm.joint_names[1]] * is_named

    def test_the_limit_of_a_slide_is_a_force(self) -> None:
        urdf = """<robot name="lift"><link name="base"/><link name="cart"/>
        <joint name="slide" type="prismatic"><parent link="base"/><child link="cart"/>
        <limit lower="-1" upper="1" effort="100" velocity="10"/></joint></robot>"""
        time = np.linspace(0.0, 10.0, 1001)
        position = 0.5 * np.sin(time)[:, None]
        stamp = np.rint(time * 1e9).astype(np.int64)
        result = examine(ImportedSamples(stamp, position, torque=1e4 * position), ["slide"], urdf)
        assert any("limit in the URDF is 100 N:" in worded(found) for found in result.warnings)

    def test_velocities_have_factors_by_joint(self, arm: Simulated, panda: Simulated) -> None:
        for factor in (DEGREES, -1.0):
            (sentence,) = warnings(panda, velocity=factor)
            expected = dict.fromkeys(panda.joint_names, factor)
            assert factors(sentence) == pytest.approx(expected, rel=1e-2)
        (sentence,) = warnings(arm, velocity=np.array([1.0, 3.0, 1.0, 1.0, 1.0, 0.2]))
        expected = {arm.joint_names[1]: 3.0, arm.joint_names[5]: 0.2}
        assert factors(sentence) == pytest.approx(expected, rel=1e-2)

    def test_repeated_stamps_do_not_question_the_order(self, arm: Simulated) -> None:
        """Half of the messages have the stamp of the one before."""
        assert warnings(replace(arm, time=np.repeat(arm.time[::2], 2))) == []

    def test_positions_in_degrees_order_or_zero(self, panda: Simulated) -> None:
        """The ranges of joints 4 and 6 of this arm exclude each other."""
        (sentence, *others) = warnings(panda, position=DEGREES, velocity=DEGREES)
        assert sentence.startswith(messages.EVERY_ROW_LEAVES_LIMITS)
        assert messages.NONE_AS_DEGREES in sentence
        assert all("degrees" in other for other in others)
        sentences = warnings(replace(panda, position=panda.position[:, ORDER]))
        names = ", ".join(panda.joint_names[j] for j in ORDER)
        assert f"in the order {names}, none would" in sentences[0]
        sentences = warnings(replace(panda, position=panda.position + 20.0 * (np.arange(7) == 3)))
        assert messages.CHECK_UNIT_SIGN_ZERO in sentences[0]
        assert "order" not in sentences[0]


TOO_SMALL = "the torques are too small for this arm: measured over "
TOO_LARGE = "the torques are too large for this arm: measured over "


class TestSizeOfTorques:
    def test_another_order_of_magnitude_is_named(self, arm: Simulated, panda: Simulated) -> None:
        """Against the masses of the URDF, whatever its effort limits are."""
        for robot in (arm, panda):
            (sentence,) = warnings(robot, torque=1e-3)
            assert sentence.startswith(f"{TOO_SMALL}the torques of the URDF's masses")
            assert "N·m read as mN·m would be 1000 times too small" in sentence
            *limits, sentence = warnings(robot, torque=1e3)
            assert sentence.startswith(f"{TOO_LARGE}the torques of the URDF's masses")
            assert all("its limit in the URDF" in limit for limit in limits)

    def test_without_masses_the_effort_limits_are_the_measure(self, arm: Simulated) -> None:
        (sentence,) = warnings(arm, torque=1e-3, masses=False)
        assert sentence.startswith(f"{TOO_SMALL}the effort limits of the URDF")
        assert warnings(arm, masses=False) == []

    @pytest.mark.parametrize("factor", [0.2, 5.0])
    def test_gains_and_friction_within_an_order_are_not_doubted(
        self, panda: Simulated, factor: float
    ) -> None:
        assert not any("for this arm" in line for line in warnings(panda, torque=factor))

    def test_equal_masses_are_placeholders(self, tmp_path: Path, panda: Simulated) -> None:
        assert three_joint_robot(tmp_path).nominal_torque() is None
        assert Robot.from_urdf(panda.urdf, recorded=panda.joint_names).nominal_torque() is not None


def typed(arguments: Sequence[str]) -> tuple[int, str]:
    """Exit status and all output of the program."""
    done = subprocess.run([sys.executable, "-m", "hil", *arguments], capture_output=True, text=True)
    return done.returncode, done.stdout + done.stderr


class TestReplacing:
    """`hil import log` onto an archive that exists, and of a log that cannot be right."""

    @pytest.fixture
    def command(self, panda: Simulated, tmp_path: Path) -> list[str]:
        np.savez(tmp_path / "log.npz", q=panda.position, d=np.degrees(panda.position), t=panda.time)
        for name in "qd":
            text = f'[position]\ncolumns = "{name}"\nunit = "rad"\n[time]\ncolumn = "t"\n'
            (tmp_path / f"{name}.toml").write_text(
                f"joints = {json.dumps(panda.joint_names)}\n{text}"
            )
        arguments = ["import", "log", str(tmp_path / "log.npz"), "-o", str(tmp_path / "a.mcap")]
        return [*arguments, "--urdf", str(panda.urdf), "--lock-others", "--map"]

    def test_a_folder_that_is_missing_is_made(self, command: list[str], tmp_path: Path) -> None:
        place = tmp_path / "new" / "a.mcap"
        arguments = [*command, str(tmp_path / "q.toml"), "-o", str(place), "--force"]
        assert CliRunner().invoke(app, arguments).exit_code == 0
        assert open_archive(place).header.purpose

    @pytest.mark.long
    def test_only_with_force(self, command: list[str], tmp_path: Path) -> None:
        right = [*command, str(tmp_path / "q.toml")]
        assert typed(right)[0] == 0
        before = (tmp_path / "a.mcap").read_bytes()
        status, shown = typed(right)
        assert status == 2
        assert "exists already" in shown
        assert "--force" in shown
        status, shown = typed([*right, "--force", "--kind", "validation"])
        assert status == 0, shown
        assert open_archive(tmp_path / "a.mcap").header.purpose == "validation"
        assert (tmp_path / "a.mcap").read_bytes() != before
        assert sorted(path.suffix for path in tmp_path.iterdir()) == [
            ".mcap",
            ".npz",
            ".toml",
            ".toml",
        ]

    @pytest.mark.long
    def test_never_by_one_without_a_row_within_the_limits(
        self, command: list[str], tmp_path: Path
    ) -> None:
        assert typed([*command, str(tmp_path / "q.toml")])[0] == 0
        before = (tmp_path / "a.mcap").read_bytes()
        wrong = [*command, str(tmp_path / "d.toml"), "--force"]
        status, shown = typed(wrong)
        assert status == 2
        assert "every row leaves the limits of the URDF" in shown
        assert 'write [position] unit = "deg"' in shown
        assert (tmp_path / "a.mcap").read_bytes() == before
        status, shown = typed([*wrong, "--outside-limits"])
        assert status == 0
        assert "warning: as mapped, every row leaves" in shown

    def test_never_the_recording_itself(self, panda: Simulated, tmp_path: Path) -> None:
        np.savez(tmp_path / "log.npz", q=panda.position)
        before = (tmp_path / "log.npz").read_bytes()
        robot = Robot.from_urdf(panda.urdf, recorded=panda.joint_names)
        with pytest.raises(ArchiveWriteError, match="is the recording itself"):
            import_log(
                tmp_path / "log.npz",
                tmp_path / "log.npz",
                robot=robot,
                columns=column_map(position={"columns": "q"}),
                force=True,
            )
        assert (tmp_path / "log.npz").read_bytes() == before


class TestClock:
    def stamps(self, *seconds: float) -> NDArray[np.int64]:
        return np.rint(np.array(seconds) * 1e9).astype(np.int64)

    @pytest.mark.parametrize(
        "seconds",
        [
            *(np.arange(50) / rate for rate in (10.0, 5e4)),
            (3.0,),
            (0.0, 0.01, 0.01, 0.02),
        ],
    )
    def test_usual_rates_single_stamps_and_repeats_are_valid(
        self, seconds: Sequence[float]
    ) -> None:
        check_clock(self.stamps(*seconds), Path("x"))

    @pytest.mark.parametrize(
        ("seconds", "sentence"),
        [
            (range(0, 1000, 10), r"x: time: has 0\.1 samples .* would give 100 samples per second"),
            ((0.0, 0.01, 0.02, 0.005, 0.015),
             r"sample 3 is 0\.015 s older than the previous one \(1 such steps\)"),
            ((3.0, 3.0, 3.0), "all 3 samples have the same time"),
        ],
    )  # fmt: skip
    def test_slow_backward_and_constant_are_refused(
        self, seconds: Sequence[float], sentence: str
    ) -> None:
        with pytest.raises(SourceError, match=sentence):
            check_clock(self.stamps(*seconds), Path("x"))

    def test_the_file_with_the_times_is_named(self, arm: Simulated, tmp_path: Path) -> None:
        np.savetxt(tmp_path / "q.txt", arm.position)
        np.savetxt(tmp_path / "t.txt", 1e3 * arm.time)
        time = {"column": 0, "file": "t.txt", "unit": "s"}
        entries = {"time": time, "position": {"file": "q.txt"}}
        with pytest.raises(SourceError, match=r"t\.txt: time: has 0\.1 samples"):
            read(tmp_path, Robot.from_urdf(arm.urdf), **entries)
        assert not tmp_path.with_suffix(".mcap").exists()


class TestImportCommand:
    def test_findings_are_printed_and_archived(self, arm: Simulated, tmp_path: Path) -> None:
        np.savez(tmp_path / "log.npz", q=np.degrees(arm.position), t=arm.time)
        (tmp_path / "map.toml").write_text(
            '[time]\ncolumn = "t"\n[position]\ncolumns = "q"\nunit = "rad"\n'  # a wrong unit
        )
        arguments = ["import", "log", str(tmp_path / "log.npz"), "-o", str(tmp_path / "log.mcap")]
        arguments += ["--map", str(tmp_path / "map.toml"), "--urdf", str(arm.urdf)]
        arguments += ["--outside-limits"]
        result = CliRunner().invoke(app, [*arguments, "--kind", "validation"])
        assert result.exit_code == 0
        assert "2000 samples in 19.99 s, 100 Hz" in result.stdout
        assert "warning: as mapped" in result.stdout
        assert 'write [position] unit = "deg"' in result.stdout
        header = open_archive(tmp_path / "log.mcap").header
        assert header.purpose == "validation"
        assert any("deg" in warning for warning in header.findings.warnings)
        assert json.loads(header.entries["source"]) == ["log.npz"]
        text = (tmp_path / "map.toml").read_text()
        (tmp_path / "map.toml").write_text(f"outside_limits = true\n{text}")
        by_map = [each for each in arguments if each != "--outside-limits"]
        assert CliRunner().invoke(app, [*by_map, "--force"]).exit_code == 0, "the map states it"

    def test_an_earlier_archive_gives_its_warnings_too(self) -> None:
        """Its metadata have another name for them."""
        stored = json.dumps({"lines": ["a"], "doubts": ["b"]})
        entries = {"kind": "imported", "joint_names": '["a"]', "attachments": "[]"}
        findings = ArchiveHeader.of({**entries, "findings": stored}).findings
        assert findings == Findings(lines=("a",), warnings=("b",))


LOADED = "torque-constants a.mcap --loaded b.mcap --mass 4"
INVALID = {
    "torque-constants a.mcap --delay nan": "--delay",
    "torque-constants a.mcap --delay 20": "--delay",
    "torque-constants a.mcap --loaded a.mcap --mass 4": "listed twice",
    f"{LOADED} --inertia=-1,0,0,-1,0,-1": "no body",
    f"{LOADED} --inertia=1,0,0,1,0,3": "no body",
    "import log a.csv -o a.mcap --map m.toml --cell c.toml --friction none": "not a friction term",
    "import log a.csv -o a.mcap --map m.toml --urdf r.urdf --cell c.toml": (
        "--urdf and --cell: exclude each other"
    ),
}


@pytest.mark.parametrize("arguments", INVALID)
def test_invalid_options_are_refused(arguments: str) -> None:
    result = CliRunner().invoke(app, arguments.split())
    assert result.exit_code != 0
    assert INVALID[arguments] in str(result.exception) + result.output


class TestRobotOptions:
    """Options of the robot, of both importers."""

    URDF = ("--urdf", str(Path(__file__).parents[2] / "identification" / "two_link.urdf"))
    LOCKED = (*URDF, "--lock-others")

    @pytest.fixture
    def place(self, tmp_path: Path) -> Path:
        time = np.arange(200) / 100.0
        q = np.sin(time)
        tau = np.sin(2.0 * time)
        rows = np.column_stack([time, q, tau])
        np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header="t,q1,tau1", comments="")
        messages = [
            state(round(t * 1e9) + 1, [angle], names=["elbow"], effort=[1.0])
            for t, angle in zip(time.tolist(), q.tolist(), strict=True)
        ]
        bag(tmp_path / "bag.db3", {"/js": (STATE, messages)})
        (tmp_path / "map.toml").write_text(
            'joints = ["elbow"]\n[time]\ncolumn = "t"\n[position]\ncolumns = "q{}"\n'
            '[torque]\ncolumns = "tau{}"\n'
        )
        return tmp_path

    def run(self, place: Path, kind: str, *options: str) -> Result:
        source = ["log.csv", "--map", str(place / "map.toml")] if kind == "log" else ["bag.db3"]
        arguments = ["import", kind, str(place / source[0]), *source[1:]]
        return CliRunner().invoke(app, [*arguments, "-o", str(place / "o.mcap"), *options])

    def refused(self, place: Path, kind: str, *options: str) -> str:
        error = self.run(place, kind, *options).exception
        assert isinstance(error, InputError)
        return str(error)

    @pytest.mark.parametrize("kind", ["log", "rosbag2"])
    def test_other_joints_are_locked_on_request(self, place: Path, kind: str) -> None:
        assert "--lock-others" in self.refused(place, kind, *self.URDF)
        result = self.run(place, kind, *self.LOCKED)
        assert result.exit_code == 0, result.exception
        assert "locked: shoulder at 0 rad" in result.output
        assert open_archive(place / "o.mcap").joint_names == ("elbow",)

    def test_the_names_of_columns_say_which_others_are_locked(self, place: Path) -> None:
        log = place / "named.csv"
        rows = (place / "log.csv").read_text().splitlines()[1:]
        log.write_text("\n".join(["t,q_elbow,tau_elbow", *rows]))
        urdf = place / "three.urdf"
        urdf.write_text(three_axes.urdf().replace("knee", "elbow"))

        def looked(*options: str) -> Result:
            return CliRunner().invoke(app, ["look", str(log), "--urdf", str(urdf), *options])

        assert "with --lock-others" in str(looked().exception)
        result = looked("--lock-others", "-o", str(place / "named.toml"))
        assert result.exit_code == 0, result.exception
        assert "q_elbow" in result.output
        # With which it is read again, also where the look says that something is otherwise.
        assert 'joints = ["elbow"]' in (place / "named.toml").read_text()

    @pytest.mark.long
    def test_joints_of_a_bag_are_renamed(self, place: Path) -> None:
        (place / "bag.db3").unlink()
        messages = [state(10**7 * k, [0.1 * k], names=["j2"]) for k in range(9)]
        bag(place / "bag.db3", {"/js": (STATE, messages)})
        refused = self.refused(place, "rosbag2", *self.LOCKED)
        assert "recorded are j2" in refused
        assert "--rename RECORDED=URDF" in refused
        assert "--rename" in self.refused(place, "rosbag2", *self.LOCKED, "--rename", "j2")
        result = self.run(place, "rosbag2", *self.LOCKED, "--rename", "j2=elbow")
        assert result.exit_code == 0, result.exception
        assert open_archive(place / "o.mcap").joint_names == ("elbow",)

    def test_a_number_in_both_names_renames_all_joints(self, place: Path) -> None:
        """And only joints of the URDF stand in the map that is kept."""
        (place / "bag.db3").unlink()
        text = Path(self.URDF[1]).read_text()
        text = text.replace('"shoulder"', '"arm_joint1"').replace('"elbow"', '"arm_joint2"')
        (place / "arm.urdf").write_text(text)
        names = ["fer_joint1", "fer_joint2"]
        messages = [state(10**7 * k, [0.1 * k, 0.2 * k], names=names) for k in range(9)]
        bag(place / "bag.db3", {"/js": (STATE, messages)})
        imported = import_recording(
            place / "bag.db3",
            place / "o.mcap",
            lambda _: Robot.from_urdf(place / "arm.urdf"),
            bag=BagMap(rename=_names(["fer_joint{}=arm_joint{}"])),
        )
        assert imported.archive.joint_names == ("arm_joint1", "arm_joint2")
        assert imported.bag.rename == {"fer_joint1": "arm_joint1", "fer_joint2": "arm_joint2"}

    @pytest.mark.parametrize("pair", ["fer_joint{}=arm_joint", "fer{}=", "fer"])
    def test_a_pair_of_names_needs_its_number_in_both(self, pair: str) -> None:
        with pytest.raises(InputError, match=r"is not a pair.*fer_joint\{\}=panda_joint\{\}"):
            _names([pair])

    def test_locking_others_needs_joint_names_in_the_map(self, place: Path) -> None:
        text = (place / "map.toml").read_text()
        (place / "map.toml").write_text(text.replace('joints = ["elbow"]\n', ""))
        refused = self.refused(place, "log", *self.LOCKED)
        assert "map.toml: joints: does not name the recorded joints" in refused

    @pytest.mark.parametrize("kind", quick_ones(["log"], ["log", "rosbag2"]))
    def test_gravity_and_friction_law(self, place: Path, kind: str) -> None:
        """The default law is offset, Coulomb and viscous."""
        for options, gravity, third, offset in [
            ((), [0.0, 0.0, -9.81], "none", True),
            (("--gravity", "0", "-1.62", "3"), [0.0, -1.62, 3.0], "none", True),
            (("--friction", "coulomb,cubic"), [0.0, 0.0, -9.81], "cubic", False),
        ]:
            result = self.run(place, kind, *self.LOCKED, *options)
            assert result.exit_code == 0, result.exception
            robot = tomllib.loads(open_archive(place / "o.mcap").text("cell.toml"))["robot"]
            assert robot["gravity"] == gravity
            assert (robot["friction"]["third"], robot["friction"]["offset"]) == (third, offset)
            (place / "o.mcap").unlink()
        refused = self.refused(place, kind, *self.LOCKED, "--gravity", "0", "nan", "0")
        assert "robot.gravity" in refused


READY = {
    "ur_rtde": ("timestamp", "actual_q_{}", "actual_current_{}", 1.0, 1.0, "motor_current", " "),
    "franka": ("time", "state.q[{}]", "state.tau_J[{}]", 1e3, 1.0, "torque", ","),
    "franka_2017": ("duration", "q[{}]", "tau_J[{}]", 1e3, 1.0, "torque", ", "),
    "kuka_rsi": ("IPOC", "AIPos.A{}", "GearTorque.A{}", 1e3, DEGREES, "torque", ","),
    "ros_joint_states": (
        "field.header.stamp", "field.position{}", "field.effort{}", 1e9, 1.0, "torque", ","
    ),
}  # fmt: skip
VELOCITIES = {
    "ur_rtde": "actual_qd_{}",
    "franka": "state.dq[{}]",
    "franka_2017": "dq[{}]",
    "ros_joint_states": "field.velocity{}",
}


class TestReadyMaps:
    """Maps of common logs, by name."""

    def test_each_is_tested(self) -> None:
        assert set(ready_maps()) == set(READY)

    @pytest.mark.parametrize("name", READY)
    def test_a_log_with_the_columns_of_its_maker(
        self, name: str, robot: Robot, tmp_path: Path
    ) -> None:
        time, q, tau, per_second, per_rad, quantity, delimiter = READY[name]
        first = 1 if name == "kuka_rsi" else 0
        patterns = [q, *([VELOCITIES[name]] if name in VELOCITIES else []), tau]
        titles = [
            time,
            *(text.replace("{}", str(j + first)) for text in patterns for j in range(3)),
        ]
        arrays = [TIME * per_second, Q * per_rad, *([Q] if len(patterns) == 3 else []), TAU]
        body = [delimiter.join(map(repr, row)) for row in np.column_stack(arrays).tolist()]
        path = tmp_path / "log.csv"
        if name == "ros_joint_states":  # with texts, as `rostopic echo -p` writes them
            titles = ["%time", "field.header.frame_id", "field.name0", *titles]
            body = [f"17,base link,hip,{line}" for line in body]
        path.write_text("\n".join([delimiter.join(titles), *body]) + "\n")
        columns = ColumnMap.load(name)
        import_log(path, tmp_path / "a.mcap", robot=robot, columns=columns, outside_limits=True)
        stored = open_archive(tmp_path / "a.mcap").columns
        assert stored["position"] == near(Q)
        assert stored["motor_current" if quantity == "motor_current" else "torque"] == (
            pytest.approx(TAU)
        )
        assert np.diff(stored["stamp"]) == near(1e7, abs=300)

    @pytest.mark.long
    def test_listed_and_printed(self) -> None:
        listing = CliRunner().invoke(app, ["import", "maps"]).stdout
        assert all(name in listing for name in READY)
        assert CliRunner().invoke(app, ["import", "maps", "franka"]).stdout == ready_map("franka")
        assert typed(["import", "maps", "frank"])[0] == 2
