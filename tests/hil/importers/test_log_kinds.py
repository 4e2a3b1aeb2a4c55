"""Kinds of faults in logs: read rightly, or refused with a remedy that works when typed."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.archive import open_archive
from hil.base.errors import SourceError
from hil.importers.column_map import ColumnMap
from hil.importers.imported_robot import Robot
from hil.importers.log import import_log
from hil.importers.plausibility import whole_turns
from identification.model.joint_ranges import JointRanges
from tests.hil.importers.moving_log import (
    COUNT,
    JOINTS,
    NAMES,
    POSITION,
    RATE,
    SLOPE,
    TIME,
    TORQUE,
    URDF,
    Floats,
    assert_right,
    imported,
    rows,
    text,
)
from tests.near import near


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    path = tmp_path / "three.urdf"
    path.write_text(URDF)
    return path


def comma(value: float) -> str:
    return f"{value:.6f}".replace(".", ",")


def grouped(value: float, mark: str, decimal: str) -> str:
    return f"{value:,.3f}".replace(",", "_").replace(".", decimal).replace("_", mark)


MILLISECONDS = {"column": "t", "unit": "ms"}
UNITS_BELOW = [NAMES, ["s", "rad", "rad", "rad", "Nm", "Nm", "Nm"]]
DEGREES_BELOW = [NAMES, ["[ms]", *["[°]"] * 3, *["[N m]"] * 3]]
IN_DEGREES = rows(
    time=[f"{1e3 * t:.3f}" for t in TIME],
    position=np.degrees(POSITION),
    cell=lambda value: f"{value:.9f}",
)


def dates(form: str, mark: str = ".") -> list[str]:
    """Stamps from one second before 08:00:00."""
    stamps = np.datetime64("2026-11-12T07:59:59") + np.rint(1e6 * TIME).astype("m8[us]")
    return [
        stamp.strftime(form).replace("{f}", f"{mark}{stamp.microsecond:06d}")
        for stamp in stamps.tolist()
    ]


def with_row(place: int, *lines: str) -> str:
    """The text with lines in place of one row."""
    content = text().splitlines()
    return "\n".join([*content[:place], *lines, *content[place + 1 :]]) + "\n"


def with_lines(place: int, *lines: str) -> str:
    content = text().splitlines()
    return "\n".join([*content[:place], *lines, *content[place:]]) + "\n"


PREAMBLE = "Recorder;V2.1\nDate;12.11.2026\nRate;250\n\n"
HEAD = ",".join(NAMES)
READ: dict[str, tuple[str | bytes, dict[str, Any]]] = {
    "as it should be": (text(), {}),
    "an empty line": (with_lines(50, ""), {}),
    "an empty line below each": (text().replace("\n", "\n\n"), {}),
    "zeros at the end, as a disk leaves them": (text() + 512 * "\0", {}),
    "notes above": ("".join(f"a {k} b\n" for k in range(300)) + "\n" + text(), {}),
    "units in the second line": (text(head=UNITS_BELOW), {}),
    "units in the second line that are not those of the SI": (
        text(IN_DEGREES, head=DEGREES_BELOW), {},
    ),
    "units in brackets in the names": (
        text(IN_DEGREES, head=[["t [ms]", "q1 [deg]", "q2 [deg]", "q3 [deg]", *NAMES[4:]]]), {},
    ),
    "degrees by their name": (
        text(IN_DEGREES), {"position": {"columns": "q{}", "unit": "degrees"}, "time": MILLISECONDS},
    ),
    "per cent of a rated torque": (
        text(rows(torque=TORQUE / [0.5, 1.0, 2.0], cell=lambda value: f"{value:.9f}")),
        {"torque": {"columns": "tau{}", "unit": "%", "rated": (50.0, 100.0, 200.0)}},
    ),
    "columns named by joint": (
        text(head=[["t", *(f"pos {j}" for j in JOINTS), *(f"{j}_effort" for j in JOINTS)]]),
        {"position": {"columns": "pos {}"}, "torque": {"columns": "{}_effort"}},
    ),
    "quoted": (text([[f'"{cell}"' for cell in row] for row in rows()]), {}),
    "quoted with decimal commas": (
        text([[f'"{cell.replace(".", ",")}"' for cell in row] for row in rows()]), {},
    ),
    "in apostrophes": (text([[f"'{cell}'" for cell in row] for row in rows()]), {}),
    "as text of a spreadsheet": (text([[f'="{cell}"' for cell in row] for row in rows()]), {}),
    "types below the units": (
        text(IN_DEGREES, head=[*DEGREES_BELOW, ["LTIME", *["LREAL"] * 6]]), {},
    ),
    "rows that changed places": (
        text([*rows()[:50], *reversed(rows()[50:52]), *rows()[52:]]), {},
    ),
    "a preamble, an empty line and decimal commas": (
        PREAMBLE + text(rows(time=[comma(t) for t in TIME], cell=comma), delimiter=";"), {},
    ),
    "the head once more": (with_lines(101, HEAD), {}),
    "preamble and head once more": (
        PREAMBLE + text(rows()[:100], delimiter=";") + PREAMBLE
        + text(rows()[100:], delimiter=";"), {},
    ),
    "comments, an empty line and the head once more": (
        "# scope 1\n" + text(rows()[:100]) + "\n# scope 1\n\n" + text(rows()[100:]), {},
    ),
    "names in a comment": ("# " + text(), {}),
    "ISO 8601": (text(rows(time=dates("%Y-%m-%dT%H:%M:%S{f}"))), {}),
    "ISO 8601 with a zone": (text(rows(time=dates("%Y-%m-%d %H:%M:%S{f}+01:00"))), {}),
    "day, month, year and a decimal comma": (
        text(rows(time=dates("%d.%m.%Y %H:%M:%S{f}", ","), cell=comma), delimiter=";"), {},
    ),
    "month, day, year": (text(rows(time=dates("%m/%d/%Y %H:%M:%S{f}"))), {}),
    "year of two digits": (text(rows(time=dates("%d.%m.%y %H:%M:%S{f}"))), {}),
    "time of day": (text(rows(time=dates("%H:%M:%S{f}"))), {}),
    "time of day past midnight": (
        text(rows(time=[f"{int(s) // 3600 % 24:02d}:{int(s) // 60 % 60:02d}:{s % 60:09.6f}"
                        for s in (86_399.5 + TIME).tolist()])), {},
    ),
    "UTF-16": (text(delimiter="\t").encode("utf-16"), {}),
    "UTF-16 without a mark": (text(delimiter="\t").encode("utf-16-be"), {}),
    "a degree sign in Latin-1": (
        text(IN_DEGREES, head=[["t [ms]", "q1 [°]", "q2 [°]", "q3 [°]", *NAMES[4:]]])
        .encode("latin-1"), {},
    ),
    "points between thousands": (
        text(rows(time=[grouped(9e5 + 1e3 * t, ".", ",") for t in TIME], cell=comma),
             delimiter=";"), {"time": MILLISECONDS},
    ),
    "apostrophes between thousands": (
        text(rows(time=[grouped(9e5 + 1e3 * t, "'", ".") for t in TIME]), delimiter=";"),
        {"time": MILLISECONDS},
    ),
    "spaces between thousands": (
        text(rows(time=[grouped(9e5 + 1e3 * t, " ", ",") for t in TIME], cell=comma),
             delimiter="\t"), {"time": MILLISECONDS},
    ),
    "nanoseconds of the epoch": (
        text(rows(time=[1_700_000_000_000_000_000 + round(1e9 * t) for t in TIME])), {},
    ),
    "milliseconds that nothing states": (text(rows(time=[f"{1e3 * t:.3f}" for t in TIME])), {}),
    "a first stamp of zero": (
        text(rows(time=[0, *(1_700_000_000 + t for t in TIME[1:].tolist())])), {},
    ),
    "32 bits of microseconds": (
        text(rows(time=[(2**32 - 900_000 + round(1e6 * t)) % 2**32 for t in TIME])), {},
    ),
    "signed 32 bits of microseconds": (
        text(rows(time=[(2**31 - 900_000 + round(1e6 * t) + 2**31) % 2**32 - 2**31
                        for t in TIME])), {"time": {"column": "t", "unit": "us"}},
    ),
    "16 bits of milliseconds, as seconds": (
        text(rows(time=[f"{(65.0 + t) % 65.536:.3f}" for t in TIME])), {},
    ),
    "degrees that nothing states": (
        text(rows(position=np.degrees(POSITION), cell=lambda value: f"{value:.9f}")), {},
    ),
}  # fmt: skip
FIRST_IS_MISSING = ("a first stamp of zero",)


class TestRead:
    @pytest.mark.parametrize("kind", READ)
    def test_samples_are_right(self, tmp_path: Path, urdf: Path, kind: str) -> None:
        content, changes = READ[kind]
        archive = imported(tmp_path / "log.csv", content, urdf, **changes)
        assert_right(archive, without=(0,) if kind in FIRST_IS_MISSING else ())

    def test_what_was_concluded_is_said(self, tmp_path: Path, urdf: Path) -> None:
        for kind, sentence in {
            "degrees that nothing states": "position: no unit is stated; read as degrees",
            "milliseconds that nothing states": "time: no unit is stated; read as ms",
            "32 bits of microseconds": "a 32-bit counter of us wrapped once and was unwrapped",
            "the head once more": "dropped: repeated header lines (1)",
            "rows that changed places": "time: one row out of order: sorted by stamp",
            "a first stamp of zero": "dropped: leading rows with time 0 (1)",
            "units in the second line that are not those of the SI": "position: in deg, as the fi",
        }.items():
            content, changes = READ[kind]
            archive = imported(tmp_path / "log.csv", content, urdf, **changes)
            assert any(sentence in line for line in archive.header.findings.lines), kind

    def test_velocities_in_degrees_that_nothing_states(self, tmp_path: Path, urdf: Path) -> None:
        columns = np.column_stack([TIME, POSITION, np.degrees(SLOPE), TORQUE])
        names = [*NAMES[:4], "v1", "v2", "v3", *NAMES[4:]]
        body = [[repr(cell) for cell in row] for row in columns.tolist()]
        archive = imported(
            tmp_path / "log.csv", text(body, head=[names]), urdf, velocity={"columns": "v{}"}
        )
        assert archive.columns["velocity"] == near(SLOPE, abs=1e-12)

    def test_rows_of_a_second_publisher_are_left_out(self, tmp_path: Path, urdf: Path) -> None:
        """As a bag that was exported to text has them."""
        other = [f"{t + 0.5 / RATE:.6f},0.3,-0.4,1.5,0,0,0" for t in TIME.tolist()]
        lines = [line for pair in zip(text().splitlines()[1:], other, strict=True) for line in pair]
        archive = imported(tmp_path / "log.csv", "\n".join([HEAD, *lines]) + "\n", urdf)
        assert_right(archive)
        said = (
            f"dropped {COUNT} of {2 * COUNT} rows that come from a second publisher: all their"
            " positions are 0.3, -0.4, 1.5"
        )
        assert said in archive.header.findings.lines

    def test_a_stated_unit_is_not_overruled(self, tmp_path: Path, urdf: Path) -> None:
        content, _ = READ["degrees that nothing states"]
        position = {"columns": "q{}", "unit": "rad"}
        with pytest.raises(SourceError, match="leaves the limits of the URDF") as refused:
            imported(tmp_path / "log.csv", content, urdf, position=position)
        unit = re.search(r'write \[position\] unit = "(\w+)"', str(refused.value))
        assert unit is not None
        position["unit"] = unit[1]
        assert_right(imported(tmp_path / "log.csv", content, urdf, position=position))

    def test_degrees_from_0_to_360_are_within_the_limits(self, tmp_path: Path, urdf: Path) -> None:
        """Whether a joint passes 0 or stays beyond 180 throughout."""
        degrees = np.degrees(POSITION - np.array([0.0, 0.0, 1.5])) % 360.0
        content = text(rows(position=degrees, cell=lambda value: f"{value:.9f}"))
        archive = imported(tmp_path / "log.csv", content, urdf)
        assert archive.columns["position"] == near(np.radians(degrees), abs=1e-9)
        findings = archive.header.findings
        assert any(
            "position: no unit is stated; read as degrees" in line for line in findings.lines
        )
        assert not any("limits" in warning for warning in findings.warnings)

    def test_angles_that_contain_others_are_their_own(self, tmp_path: Path, urdf: Path) -> None:
        """The ankle is stated to the ground, and less half the hip."""
        recorded = POSITION.copy()
        recorded[:, 2] += POSITION[:, 1] - 0.5 * POSITION[:, 0]
        position = {"columns": "q{}", "coupled": [[3, 2, 1.0], [3, 1, -0.5]]}
        content = text(rows(position=recorded, cell=lambda value: f"{value:.9f}"))
        assert_right(imported(tmp_path / "log.csv", content, urdf, position=position))
        for terms, sentence in (
            ([[4, 1, 1.0]], "there are 3 joints, not 4; number them from 1"),
            ([[2, 1, 1.0], [1, 2, 1.0]], "the angles do not determine the joints"),
        ):
            position = {"columns": "q{}", "coupled": terms}
            with pytest.raises(SourceError, match=sentence):
                imported(tmp_path / "log.csv", content, urdf, position=position)

    @pytest.mark.parametrize("encoding", ["ISO-8859-1", "UTF-16", "UTF-8"])
    def test_a_urdf_in_another_encoding(self, tmp_path: Path, urdf: Path, encoding: str) -> None:
        content = '<?xml version="1.0" encoding="{}"?><!-- Größe -->' + URDF
        urdf.write_bytes(content.format(encoding).encode(encoding))
        archive = imported(tmp_path / "log.csv", text(), urdf)
        assert "Größe" in archive.text("robot.urdf")
        assert_right(archive)


# What is refused, and the remedy that the message prints


NOT_A_NUMBER = ["-1.#IND", "nan(ind)", "#N/A", "1.#QNAN", "NULL", "error", "#NUM!", "n/a", "inf"]
HOLES = {cell: with_row(50, f"0.196,{cell},1,1,1,1,1") for cell in NOT_A_NUMBER} | {
    "a note between the rows": with_lines(51, "operator pressed stop"),
    "a time that is none": with_row(50, "later,1,1,1,1,1,1"),
    "a row cut short": with_row(50, "0.196,1"),
}
GROUPED = text(rows(time=[f"{1000 + 4 * k:,}" for k in range(COUNT)]), delimiter=";")
OTHER_REMEDIES: dict[str, tuple[str, dict[str, Any], str]] = {
    "thousands that are not certain": (GROUPED, {"time": MILLISECONDS}, "thousands"),
}
TYPED = re.compile(r'\[(\w+)\] (\w+) = ("[^"]*"|true|\d+)')


def remedy(message: str) -> dict[str, dict[str, Any]]:
    """The entries of a column map that a message prints."""
    entries: dict[str, dict[str, Any]] = {}
    for table, key, value in TYPED.findall(message):
        entries.setdefault(table, {})[key] = True if value == "true" else value.strip('"')
    return entries


class TestRemedies:
    @pytest.mark.parametrize("kind", HOLES)
    def test_rows_without_numbers_are_left_out(self, tmp_path: Path, urdf: Path, kind: str) -> None:
        with pytest.raises(SourceError, match=r"line 5\d ") as refused:
            imported(tmp_path / "log.csv", HOLES[kind], urdf)
        entries = remedy(str(refused.value))
        assert entries == {"format": {"missing": "drop"}}
        archive = imported(tmp_path / "log.csv", HOLES[kind], urdf, **entries)
        assert_right(archive, without=() if "note" in kind else (49,))
        assert any(
            "rows with a missing number (1 of" in line for line in archive.header.findings.lines
        )

    @pytest.mark.parametrize("cut", [1, 3, 9, 20])
    def test_a_last_row_that_is_cut_off_is_left_out(
        self, tmp_path: Path, urdf: Path, cut: int
    ) -> None:
        """In its cells, or within its last number: no line end follows."""
        archive = imported(tmp_path / "log.csv", text()[: -1 - cut], urdf)
        assert_right(archive, without=(COUNT - 1,))
        assert any("truncated last row" in line for line in archive.header.findings.lines)

    def test_a_last_row_without_a_line_end_is_whole(self, tmp_path: Path, urdf: Path) -> None:
        assert_right(imported(tmp_path / "log.csv", text()[:-1], urdf))

    @pytest.mark.parametrize("kind", OTHER_REMEDIES)
    def test_entries_of_the_map(self, tmp_path: Path, urdf: Path, kind: str) -> None:
        content, changes, key = OTHER_REMEDIES[kind]
        with pytest.raises(SourceError) as refused:
            imported(tmp_path / "log.csv", content, urdf, **changes)
        entries = remedy(str(refused.value))
        assert key in entries["format"]
        assert_right(imported(tmp_path / "log.csv", content, urdf, **changes, **entries))

    def test_a_column_that_only_counts(self, tmp_path: Path, urdf: Path) -> None:
        """It is no clock: neither seconds nor milliseconds are concluded."""
        content = text(rows(time=range(COUNT)))
        with pytest.raises(SourceError, match="counts the rows"):
            imported(tmp_path / "log.csv", content, urdf)
        assert_right(imported(tmp_path / "log.csv", content, urdf, time=None, sample_rate=RATE))

    def test_per_cent_of_what(self, tmp_path: Path, urdf: Path) -> None:
        content = text(head=[[*NAMES[:4], "tau1 [%]", "tau2 [%]", "tau3 [%]"]])
        with pytest.raises(SourceError, match=r"add to \[torque\]: rated = "):
            imported(tmp_path / "log.csv", content, urdf)
        torque = {"columns": "tau{}", "rated": (100.0, 100.0, 100.0)}
        assert_right(imported(tmp_path / "log.csv", content, urdf, torque=torque))

    @pytest.mark.parametrize("cell", ["", "nan", "#N/A"])
    @pytest.mark.parametrize("missing", [{}, {"format": {"missing": "drop"}}])
    def test_the_joint_without_torque_is_named(
        self, tmp_path: Path, urdf: Path, cell: str, missing: dict[str, Any]
    ) -> None:
        content = text([[*row[:5], cell, *row[6:]] for row in rows()])
        with pytest.raises(SourceError, match=r"joint knee has no number in any row") as refused:
            imported(tmp_path / "log.csv", content, urdf, **missing)
        assert "leave out [torque]" in str(refused.value)
        archive = imported(tmp_path / "log.csv", content, urdf, torque=None, **missing)
        assert archive.columns["position"] == near(POSITION, abs=1e-6)

    def test_samples_of_one_stamp_that_are_apart_are_named(
        self, tmp_path: Path, urdf: Path
    ) -> None:
        """No unit is suspected of their speeds."""
        other = [[row[0], *(f"{float(q) + 1.0:.6f}" for q in row[1:4]), *row[4:]] for row in rows()]
        both = [row for pair in zip(rows(), other, strict=True) for row in pair]
        archive = imported(tmp_path / "log.csv", text(both), urdf)
        (line,) = archive.header.findings.warnings
        assert "up to 1 rad apart (400 such stamps)" in line

    @pytest.mark.parametrize("back", [0.5, 3600.0, 5.0])
    def test_a_clock_that_was_set_back_is_refused(
        self, tmp_path: Path, urdf: Path, back: float
    ) -> None:
        time = np.where(np.arange(COUNT) < 200, TIME, TIME - back)
        with pytest.raises(SourceError, match="older than the previous one"):
            imported(tmp_path / "log.csv", text(rows(time=time.tolist())), urdf)

    def test_every_row_dropped_is_no_recording(self, tmp_path: Path, urdf: Path) -> None:
        odd = [
            [cell if 1 + k % 6 != place else "x" for place, cell in enumerate(row)]
            for k, row in enumerate(rows())
        ]
        content = text(odd)
        with pytest.raises(SourceError, match="has a missing number in every row"):
            imported(tmp_path / "log.csv", content, urdf, format={"missing": "drop"})

    def test_a_quotation_mark_that_is_not_closed(self, tmp_path: Path, urdf: Path) -> None:
        content = with_row(50, '0.196,"1,1,1,1,1,1')
        with pytest.raises(SourceError, match="line 51 has a quotation mark that is not closed"):
            imported(tmp_path / "log.csv", content, urdf)

    @pytest.mark.parametrize("content", [b"\x7fELF\0\0\1\2\3" * 50, b"", b"\n\n", b"a,b\n"])
    def test_what_is_no_table(self, tmp_path: Path, urdf: Path, content: bytes) -> None:
        with pytest.raises(SourceError, match=r"cannot be read|has no row of numbers|no column"):
            imported(tmp_path / "log.csv", content, urdf)


# The cases that were made for this project, beside this checkout


@pytest.fixture
def cases(shared_data: Path) -> Path:
    folder = shared_data.parent / "cases" / "logs"
    if not folder.is_dir():
        pytest.skip("the cases (../shared/cases/logs) are not beside this checkout")
    return folder


CASES = [
    "units_row", "quoted", "iso_time", "header_repeated_in_the_middle", "msvc_nan", "utf16",
    "latin1_header", "thousands", "uint32_us_wrap",
]  # fmt: skip


def read_case(
    folder: Path, cases: Path, stem: str, entries: Mapping[str, Any]
) -> dict[str, Floats]:
    """The samples of a case by its map, with some entries changed."""
    columns = ColumnMap.load(cases / f"{stem}.toml")
    columns = ColumnMap.model_validate({**columns.model_dump(exclude_unset=True), **entries})
    out = folder / f"{stem}.mcap"
    robot = Robot.from_urdf(cases / "arm.urdf")
    import_log(cases / f"{stem}.csv", out, robot=robot, columns=columns)
    return dict(open_archive(out).columns)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Path], dict[str, Floats]]:
    """The samples of the file that has nothing special, read once."""
    folder = tmp_path_factory.mktemp("plain")
    return cache(lambda cases: read_case(folder, cases, "plain", {}))


@pytest.mark.parametrize("name", CASES)
def test_cases_have_the_samples_of_plain(
    tmp_path: Path, cases: Path, plain: Callable[[Path], dict[str, Floats]], name: str
) -> None:
    expected = plain(cases)
    try:
        samples = read_case(tmp_path, cases, name, {})
    except SourceError as error:
        samples = read_case(tmp_path, cases, name, remedy(str(error)))
        line = int(re.search(r"line (\d+)", str(error))[1])  # type: ignore[index]
        expected = {key: np.delete(array, line - 2, axis=0) for key, array in expected.items()}
    elapsed = samples["stamp"] - samples["stamp"][0]
    assert np.abs(elapsed - expected["stamp"] + expected["stamp"][0]).max() < 1000  # ns
    for quantity in ("position", "torque"):
        assert samples[quantity] == near(expected[quantity], abs=2e-6)


@pytest.mark.parametrize(
    ("low", "turns"),
    [(-0.5, 0), (0.04 - 3.0, 0), (5.5, -1), (-6.9, 1), (11.8, -2), (-19.4, 3)],
)
def test_whole_turns_bring_a_joint_nearest_to_its_limits(low: float, turns: int) -> None:
    limits = JointRanges(*(np.array([value]) for value in (-3.0, 3.0, 1.0, 1.0)))
    joint = np.array([low])
    angle = whole_turns(joint, joint + 0.5, limits, np.array([True]), 3)
    assert angle == near(2.0 * np.pi * turns)
    assert not whole_turns(joint, joint + 0.5, limits, np.array([False]), 3)
