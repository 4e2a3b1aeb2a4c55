"""Options and entries of a map that messages of an import print, typed as printed."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.archive import Archive, open_archive
from hil.base.errors import SourceError
from hil.cli import app
from tests.hil.importers.bag_messages import WHOLE, message
from tests.hil.importers.bags import DEFINITION, STATE, bag, mcap, state
from tests.hil.importers.moving_log import (
    COUNT,
    JOINTS,
    NAMES,
    POSITION,
    RATE,
    SLOPE,
    TORQUE,
    URDF,
    rows,
    text,
)
from tests.near import near

MAP = '[time]\ncolumn = "t"\n[position]\ncolumns = "q{}"\n[torque]\ncolumns = "tau{}"\n'
OPTION = re.compile(r"--[a-z-]+(?: (?:[A-Z]+=[A-Z]+|/\w+|[A-Z]+|ignore))?")
ENTRY = re.compile(r'\[(\w+)\] (\w+)(?: = ("[^"]*"|\w+))?')


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    path = tmp_path / "three.urdf"
    path.write_text(URDF)
    return path


def typed(kind: str, source: Path, urdf: Path, *options: str) -> str:
    """The message with which an import refuses, else "" and a file out.mcap."""
    line = ["import", kind, str(source), "--urdf", str(urdf), "--force", "-o"]
    result = CliRunner().invoke(app, [*line, str(source.with_name("out.mcap")), *options])
    assert result.exit_code in (0, 2) or isinstance(result.exception, SourceError), result
    return "" if result.exit_code == 0 else f"{result.exception}{result.output}"


def read(source: Path) -> Archive:
    return open_archive(source.with_name("out.mcap"))


def assert_right(source: Path, *, torque: bool = True) -> None:
    columns = read(source).columns
    assert columns["position"] == near(POSITION, abs=1e-6)
    if torque:
        assert columns["torque"] == near(TORQUE, abs=1e-6)


def renamed(names: Sequence[str]) -> list[tuple[int, bytes]]:
    """The messages with joints of other names."""
    return [
        (stamp, state(stamp - 77, POSITION[k], velocity=SLOPE[k], effort=TORQUE[k], names=names)[1])
        for k, (stamp, _) in enumerate(WHOLE)
    ]


class TestBags:
    def test_a_topic_of_several(self, urdf: Path) -> None:
        source = urdf.with_name("two.db3")
        bag(source, {"/arm": (STATE, list(WHOLE)), "/gripper": (STATE, list(WHOLE[:20]))})
        (option,) = OPTION.findall(typed("rosbag2", source, urdf))
        assert option == "--topic /arm"
        assert typed("rosbag2", source, urdf, *option.split()) == ""
        assert_right(source)

    def test_joints_of_other_names(self, urdf: Path) -> None:
        source = urdf.with_name("other.db3")
        names = ("a", "b", "c")
        bag(source, {"/joint_states": (STATE, renamed(names))})
        refused = typed("rosbag2", source, urdf)
        assert "--rename RECORDED=URDF" in refused and "a, b, c" in refused
        pairs = zip(names, JOINTS, strict=True)
        options = [word for pair in pairs for word in ("--rename", "=".join(pair))]
        assert typed("rosbag2", source, urdf, *options) == ""
        assert_right(source)

    def test_a_joint_without_effort(self, urdf: Path) -> None:
        source = urdf.with_name("still.db3")
        effort = TORQUE.copy()
        effort[:, 1] = np.nan
        silent = [message(k, effort=effort) for k in range(COUNT)]
        bag(source, {"/joint_states": (STATE, silent)})
        refused = typed("rosbag2", source, urdf)
        assert "--effort ignore" in OPTION.findall(refused)
        assert typed("rosbag2", source, urdf, "--effort", "ignore") == ""
        assert_right(source, torque=False)

    def test_a_truncated_bag(self, urdf: Path) -> None:
        """The tool that the message names is Foxglove's, not ours."""
        source = mcap(urdf.with_name("cut.mcap"), {"/js": (STATE, DEFINITION, "cdr", WHOLE)})
        source.write_bytes(source.read_bytes()[:-100])
        assert "`mcap recover`" in typed("rosbag2", source, urdf)
        if shutil.which("mcap") is None:
            pytest.skip("the command mcap of Foxglove is not installed")
        whole = source.with_name("whole.mcap")
        subprocess.run(["mcap", "recover", source, "-o", whole], check=True)
        assert typed("rosbag2", whole, urdf) == ""
        assert_right(whole)


def log(urdf: Path, content: str, columns: str = MAP, *options: str) -> str:
    source = urdf.with_name("log.csv")
    source.write_text(content)
    source.with_name("map.toml").write_text(columns)
    return typed("log", source, urdf, "--map", str(source.with_name("map.toml")), *options)


def with_entries(refused: str, **values: str) -> str:
    """The map with the entries that a message prints, in their tables."""
    tables: dict[str, list[str]] = {}
    for table, key, value in ENTRY.findall(refused):
        tables.setdefault(table, []).append(f"{key} = {value or values[key]}\n")
    lines = MAP
    for table, entries in tables.items():
        head = f"[{table}]\n"
        added = head + "".join(entries)
        lines = lines.replace(head, added) if head in lines else added + lines
    return lines


class TestLogs:
    def test_fewer_names_than_columns(self, urdf: Path) -> None:
        content = text(head=[NAMES[:5]])
        refused = log(urdf, content)
        assert "[format] header = false and skip_rows" in refused
        counted = (
            "[format]\nheader = false\nskip_rows = 1\n[time]\ncolumn = 0\n"
            "[position]\ncolumns = [1, 2, 3]\n[torque]\ncolumns = [4, 5, 6]\n"
        )
        assert log(urdf, content, counted) == ""
        assert_right(urdf.with_name("log.csv"))

    def test_per_cent(self, urdf: Path) -> None:
        head = [[*NAMES[:4], *(f"{name} [%]" for name in NAMES[4:])]]
        content = text(rows(torque=TORQUE / 0.5), head=head)
        refused = log(urdf, content)
        assert "add to [torque]: rated = [...]" in refused
        columns = MAP.replace('"tau{}"\n', '"tau{}"\nrated = [50.0, 50.0, 50.0]\n')
        assert log(urdf, content, columns) == ""
        assert_right(urdf.with_name("log.csv"))

    def test_positions_outside_the_limits(self, urdf: Path) -> None:
        content = text(rows(position=POSITION + 7.0))
        (option,) = OPTION.findall(log(urdf, content))
        assert option == "--outside-limits"
        assert log(urdf, content, MAP, option) == ""
        columns = read(urdf.with_name("log.csv")).columns
        assert columns["position"] == near(POSITION + 7.0, abs=1e-6)

    def test_a_counter_for_a_time(self, urdf: Path) -> None:
        content = text(rows(time=range(COUNT)))
        refused = log(urdf, content)
        assert "counts the rows from 0; state the rate" in refused
        columns = MAP.replace('[time]\ncolumn = "t"\n', f"sample_rate = {RATE}\n")
        assert log(urdf, content, columns) == ""
        assert_right(urdf.with_name("log.csv"))

    def test_an_empty_line_where_no_time_tells_what_is_missing(self, urdf: Path) -> None:
        content = text().replace("\n", "\n\n", 5)
        columns = MAP.replace('[time]\ncolumn = "t"\n', f"sample_rate = {RATE}\n")
        refused = log(urdf, content, columns)
        assert "line 4 is empty" in refused
        assert "[format] skip_empty = true" in refused
        assert log(urdf, content, f"{columns}[format]\nskip_empty = true\n") == ""
        assert_right(urdf.with_name("log.csv"))
        assert "--drop-missing" in refused
        without_map = ["--sample-rate", str(RATE), "--drop-missing"]
        assert typed("log", urdf.with_name("log.csv"), urdf, *without_map) == ""
        assert_right(urdf.with_name("log.csv"))

    def test_an_output_that_exists(self, urdf: Path) -> None:
        source = urdf.with_name("log.csv")
        assert log(urdf, text()) == ""
        line = f"import log {source} --urdf {urdf} --map {urdf.with_name('map.toml')} -o"
        arguments = [*shlex.split(line), str(source.with_name("out.mcap"))]
        refused = CliRunner().invoke(app, arguments)
        (option,) = OPTION.findall(str(refused.exception))
        assert option == "--force"
        assert CliRunner().invoke(app, [*arguments, option]).exit_code == 0
