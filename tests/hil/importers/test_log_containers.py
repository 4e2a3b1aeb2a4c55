"""The same samples in JSON, in spreadsheets and compressed: read as from the table."""

from __future__ import annotations

import gzip
import json
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.archive import open_archive
from hil.base.errors import HilError
from hil.cli import app
from tests.hil.importers.moving_log import (
    COUNT,
    NAMES,
    POSITION,
    TIME,
    TORQUE,
    URDF,
    assert_right,
    text,
)
from tests.tiers import quick_ones

TABLE = np.column_stack([TIME, POSITION, TORQUE])
SAMPLES = [
    {"t": float(t), "q": q.tolist(), "tau": tau.tolist()}
    for t, q, tau in zip(TIME, POSITION, TORQUE, strict=True)
]
FLAT = [dict(zip(NAMES, row, strict=True)) for row in TABLE.tolist()]


def lines(samples: Sequence[Any]) -> str:
    return "".join(f"{json.dumps(sample)}\n" for sample in samples)


def stamped() -> Iterator[dict[str, Any]]:
    for sample, time in zip(SAMPLES, TIME, strict=True):
        stamp = {"sec": 1_700_000_000, "nanosec": round(1e9 * time)}
        yield {"header": {"stamp": stamp}, "q": sample["q"], "tau": sample["tau"]}


def of_two_kinds() -> Iterator[dict[str, Any]]:
    """Positions and torques in samples of their own, at the same times."""
    for sample in SAMPLES:
        yield {"t": sample["t"], "q": sample["q"]}
        yield {"t": sample["t"], "tau": sample["tau"]}


JSON: dict[str, tuple[str, str]] = {
    "a line for each sample": (".jsonl", lines(SAMPLES)),
    "lines with a number for each joint": (".ndjson", lines(FLAT)),
    "lines below .json": (".json", lines(SAMPLES)),
    "lines with empty ones between": (".jsonl", lines(SAMPLES).replace("\n", "\n\n")),
    "stamps with seconds and nanoseconds": (".jsonl", lines([*stamped()])),
    "positions and torques in lines of their own": (".jsonl", lines([*of_two_kinds()])),
    "a list of samples": (".json", json.dumps(SAMPLES)),
    "samples below notes": (".json", json.dumps({"robot": "three", "samples": SAMPLES})),
    "a list for each quantity": (
        ".json",
        json.dumps({"t": TIME.tolist(), "q": POSITION.tolist(), "tau": TORQUE.tolist()}),
    ),
    "as pandas by columns": (
        ".json",
        json.dumps(
            {
                name: {str(row): value for row, value in enumerate(column)}
                for name, column in zip(NAMES, TABLE.T.tolist(), strict=True)
            }
        ),
    ),
    "as pandas split": (
        ".json",
        json.dumps({"columns": NAMES, "index": [*range(COUNT)], "data": TABLE.tolist()}),
    ),
    "rows below their names": (".json", json.dumps([NAMES, *TABLE.tolist()])),
}


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    path = tmp_path / "three.urdf"
    path.write_text(URDF)
    return path


def imported(source: Path, urdf: Path, *options: object) -> str:
    """The refusal of an import, else ""; the archive is out.mcap."""
    output = source.with_name("out.mcap")
    line = ["import", "log", source, "--urdf", urdf, "--force", "-o", output, *options]
    result = CliRunner().invoke(app, [*map(str, line)])
    assert result.exit_code == 0 or isinstance(result.exception, HilError), result
    return "" if result.exit_code == 0 else str(result.exception)


def check(source: Path, without: Sequence[int] = ()) -> None:
    assert_right(open_archive(source.with_name("out.mcap")), without=without)


@pytest.mark.parametrize("packed", quick_ones([True], [False, True]))
@pytest.mark.parametrize("kind", JSON)
def test_samples_in_json(tmp_path: Path, urdf: Path, kind: str, *, packed: bool) -> None:
    suffix, content = JSON[kind]
    source = tmp_path / f"log{suffix}{'.gz' if packed else ''}"
    data = content.encode()
    source.write_bytes(gzip.compress(data) if packed else data)
    assert imported(source, urdf) == ""
    check(source)


def test_a_line_of_json_that_is_cut_off_is_left_out(tmp_path: Path, urdf: Path) -> None:
    source = tmp_path / "log.jsonl"
    source.write_text(lines(SAMPLES)[:-20])
    assert imported(source, urdf) == ""
    check(source, without=(COUNT - 1,))
    found = open_archive(tmp_path / "out.mcap").header.findings.lines
    assert any("truncated last row" in line for line in found)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ("{", "it is not JSON"),
        ('{"t": 0}\n[}\n{"t": 1}\n', "its line 2 is not JSON"),
        ('{"t": 0, "q": [1, 2]}\n{"t": 1, "q": [1]}\n', "q has lists of different lengths"),
        ("[[1, 2], [3]]", "rows of different lengths"),
        ('{"robot": "three"}', "has no array of numbers"),
        ("[]", "has no array of numbers"),
        ("null", "has no array of numbers"),
        ("[" * 100_000, "nested too deep"),
    ],
)
def test_other_json_is_refused(tmp_path: Path, urdf: Path, content: str, problem: str) -> None:
    source = tmp_path / "log.json"
    source.write_text(content)
    assert problem in imported(source, urdf)


def test_json_of_another_name_is_told_its_name(tmp_path: Path, urdf: Path) -> None:
    source = tmp_path / "log.txt"
    source.write_text(lines(SAMPLES))
    assert "mv log.txt log.json" in imported(source, urdf)
    source.rename(tmp_path / "log.json")
    assert imported(tmp_path / "log.json", urdf) == ""
    check(source)


def test_a_compressed_table(tmp_path: Path, urdf: Path) -> None:
    source = tmp_path / "log.csv.gz"
    source.write_bytes(gzip.compress(text().encode()))
    assert imported(source, urdf) == ""
    check(source)


def test_a_compressed_table_that_is_cut_off(tmp_path: Path, urdf: Path) -> None:
    source = tmp_path / "log.csv.gz"
    data = gzip.compress(text().encode(), mtime=0)
    source.write_bytes(data[: len(data) // 2])
    assert "zcat log.csv.gz > part.csv" in imported(source, urdf)


# Spreadsheets


def cell(place: str, value: object) -> str:
    if isinstance(value, str):
        return f'<c r="{place}" t="inlineStr"><is><t>{value}</t></is></c>'
    return f'<c r="{place}"><v>{value!r}</v></c>'


def sheet(rows: Sequence[Sequence[object]]) -> str:
    lines = (
        f'<row r="{number}">'
        + "".join(cell(f"{chr(65 + place)}{number}", value) for place, value in enumerate(row))
        + "</row>"
        for number, row in enumerate(rows, 1)
    )
    space = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
    return f'<worksheet xmlns="{space}"><sheetData>{"".join(lines)}</sheetData></worksheet>'


def workbook(path: Path, **sheets: Sequence[Sequence[object]]) -> Path:
    """The smallest workbook of Office with these sheets."""
    space = "http://schemas.openxmlformats.org"
    names = "".join(
        f'<sheet name="{name}" sheetId="{k}" r:id="r{k}"/>' for k, name in enumerate(sheets, 1)
    )
    targets = "".join(
        f'<Relationship Id="r{k}" Target="worksheets/sheet{k}.xml" '
        f'Type="{space}/officeDocument/2006/relationships/worksheet"/>'
        for k in range(1, len(sheets) + 1)
    )
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr(
            "xl/workbook.xml",
            f'<workbook xmlns="{space}/spreadsheetml/2006/main" '
            f'xmlns:r="{space}/officeDocument/2006/relationships"><sheets>{names}</sheets>'
            "</workbook>",
        )
        office = f'Type="{space}/officeDocument/2006/relationships/officeDocument"'
        packed.writestr(
            "_rels/.rels",
            f'<Relationships xmlns="{space}/package/2006/relationships">'
            f'<Relationship Id="r1" Target="xl/workbook.xml" {office}/></Relationships>',
        )
        packed.writestr(
            "xl/_rels/workbook.xml.rels",
            f'<Relationships xmlns="{space}/package/2006/relationships">{targets}</Relationships>',
        )
        for number, rows in enumerate(sheets.values(), 1):
            packed.writestr(f"xl/worksheets/sheet{number}.xml", sheet(rows))
    return path


ROWS: list[list[object]] = [[*NAMES], *TABLE.tolist()]
UNITS: list[object] = ["s", *["rad"] * 3, *["Nm"] * 3]


@pytest.mark.parametrize(
    "rows", [ROWS, [["Test 4"], [], ROWS[0], UNITS, *ROWS[1:]]], ids=["plain", "title and units"]
)
def test_the_largest_sheet_of_a_spreadsheet_is_read(
    tmp_path: Path, urdf: Path, rows: list[list[object]]
) -> None:
    source = workbook(tmp_path / "log.xlsx", Notes=[["made by", "nobody"]], Log=rows)
    assert imported(source, urdf) == ""
    check(source)


def test_of_two_sheets_the_map_names_one(tmp_path: Path, urdf: Path) -> None:
    other = [ROWS[0], *([t, *(0.5 * np.array(row)).tolist()] for t, *row in ROWS[1:])]
    source = workbook(tmp_path / "log.xlsx", First=other, Second=ROWS)
    refused = imported(source, urdf)
    assert '[format] sheet = "First" or [format] sheet = "Second"' in refused
    entries = tmp_path / "map.toml"
    entries.write_text('[format]\nsheet = "Second"\n')
    assert imported(source, urdf, "--map", entries) == ""
    check(source)
    entries.write_text('[format]\nsheet = "Third"\n')
    assert "its sheets are First, Second" in imported(source, urdf, "--map", entries)


def test_a_damaged_spreadsheet_is_refused(tmp_path: Path, urdf: Path) -> None:
    source = workbook(tmp_path / "log.xlsx", Log=ROWS)
    data = source.read_bytes()
    for damaged in (data[: len(data) // 2], data.replace(b"xl/worksheets", b"xl/worksheetz")):
        source.write_bytes(damaged)
        assert "copy it again" in (refused := imported(source, urdf)) or "as CSV" in refused


# A map of some entries

DEGREES = [[t, *np.degrees(row[:3]).tolist(), *row[3:]] for t, *row in TABLE.tolist()]


class TestSomeEntriesOfAMap:
    """What they do not state is proposed."""

    @pytest.fixture
    def source(self, tmp_path: Path) -> Path:
        return tmp_path / "log.csv"

    def test_they_go_before_what_is_proposed(self, source: Path, urdf: Path) -> None:
        body = [[f"{value:.9f}" for value in row] for row in DEGREES]
        source.write_text(text(body))
        entries = source.with_name("some.toml")
        entries.write_text('[position]\nunit = "deg"\n[torque]\nscale = 1.0\n')
        assert imported(source, urdf, "--map", entries) == ""
        check(source)
        again = source.with_name("out.map.toml")
        assert 'unit = "deg"' in again.read_text()
        assert imported(source, urdf, "--map", again) == ""
        check(source)

    def test_they_may_name_channels(self, source: Path, urdf: Path) -> None:
        head = [["clock", "a1", "a2", "a3", "b1", "b2", "b3"]]
        source.write_text(text(head=head))
        entries = source.with_name("some.toml")
        entries.write_text(
            'sample_rate = 250\n[torque]\ncolumns = "b{}"\n[format]\nmissing = "drop"\n'
        )
        assert "no channel is named as position" in imported(source, urdf, "--map", entries)
        entries.write_text(
            'time.column = "clock"\nposition.columns = ["a1", "a2", "a3"]\ntorque.columns = "b{}"\n'
        )
        assert imported(source, urdf, "--map", entries) == ""
        check(source)

    @pytest.mark.parametrize(
        ("entries", "field"),
        [
            ('[torque]\nunit = "furlong"\n', "not a unit of torque"),
            ("[toruqe]\nscale = 2.0\n", "toruqe"),
            ("[format]\nskip_rows = -1\n", "format.skip_rows"),
            ('[velocity]\nside = "motor"\n', ""),
        ],
    )
    def test_a_wrong_entry_is_named(
        self, source: Path, urdf: Path, entries: str, field: str
    ) -> None:
        source.write_text(text())
        path = source.with_name("some.toml")
        path.write_text(entries)
        refused = imported(source, urdf, "--map", path)
        assert refused.startswith(str(path))
        assert field in refused
