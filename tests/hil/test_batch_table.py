"""The tables of a batch, as other programs read them."""

from __future__ import annotations

import csv
import json
import math
import re
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.batch import table
from hil.batch.table import TABLES, write_tables
from hil.batch.types import Arm, BatchResult, Broken, LevelEstimate

from .arm_histories import cell, history, model, steady

DOCS = Path(__file__).parents[2] / "docs" / "batch.md"
ODD_NAME = 'line "3", spring/\udcff.mcap'


@cache
def result() -> BatchResult:
    one, other = history(steady, 2, seed=2)
    undetermined = one.std.copy()
    undetermined[3] = np.inf
    repetition = replace(
        one,
        level="repetition",
        archive=ODD_NAME,
        sha256="ab" * 32,
        covariance=None,
        std=undetermined,
        undetermined=(one.names[3],),
        when="",
        warnings=("stood still at first", "two gaps"),
    )
    pooled = replace(one, level="pooled", campaign="", unseen_rms=0.1 * one.torque_rms)
    return BatchResult(
        estimator="wls",
        arms={"digest": Arm("digest", cell())},
        repetitions=(repetition,),
        campaigns=(one, other),
        pooled=(replace(pooled, unseen_torque_rms=one.torque_rms),),
        broken=(Broken("a/torn.mcap", "its footer is missing"),),
        skipped=(Broken("a/slow.mcap", "holds a validation run"),),
        read=1,
        cached=0,
        code="c0de",
    )


def levels() -> list[LevelEstimate]:
    found = result()
    return [*found.repetitions, *found.campaigns, *found.pooled]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("tables")
    write_tables(path, result())
    return path


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_each_estimate_has_a_row_per_parameter_with_its_numbers_to_the_bit(folder: Path) -> None:
    rows = rows_of(folder / "parameters.csv")
    expected = [
        (level.level, level.campaign, name, value, std)
        for level in levels()
        for name, value, std in zip(level.names, level.values, level.std, strict=True)
    ]
    found = [
        (row["level"], row["campaign"], row["parameter"], float(row["value"]), float(row["std"]))
        for row in rows
    ]
    assert found == expected


def test_a_row_says_how_sure_it_is_and_where_it_comes_from(folder: Path) -> None:
    rows = rows_of(folder / "parameters.csv")
    row, undetermined = rows[0], rows[3]
    half = levels()[0].interval_factor * float(row["std"])
    assert float(row["low"]) == pytest.approx(float(row["value"]) - half)
    assert float(row["high"]) == pytest.approx(float(row["value"]) + half)
    found = (undetermined["determined"], undetermined["std"], undetermined["high"])
    assert found == ("false", "inf", "inf")
    assert row["archive"] == 'line "3", spring/?.mcap'
    assert row["archive_sha256"] == "ab" * 32
    assert (row["settings"], row["code"], row["estimator"]) == ("settings", "c0de", "wls")
    assert re.search(r"\bhil \d", row["software"])
    assert row["warnings"] == "stood still at first; two gaps"
    assert row["arm"] == "NS 16-digest" or row["arm"].endswith("-digest")


def test_friction_is_of_an_axis_and_inertia_of_none(folder: Path) -> None:
    rows = {row["parameter"]: row for row in rows_of(folder / "parameters.csv")}
    assert (rows["f1_3"]["kind"], rows["f1_3"]["axis"]) == ("friction", "joint_3")
    assert (rows["mc2x"]["kind"], rows["mc2x"]["axis"]) == ("inertial", "")


def test_the_relative_error_is_over_all_joints(folder: Path) -> None:
    rows = rows_of(folder / "parameters.csv")
    one = result().campaigns[0]
    weight = one.samples.astype(float)
    expected = math.sqrt((weight @ one.noise_std**2) / (weight @ one.torque_rms**2))
    campaign = next(row for row in rows if row["level"] == "campaign")
    assert float(campaign["relative_error"]) == pytest.approx(expected)
    assert math.isnan(float(campaign["unseen_relative_error"]))
    assert float(rows[-1]["unseen_relative_error"]) == pytest.approx(0.1)


def test_each_estimate_has_a_row_per_axis(folder: Path) -> None:
    rows = rows_of(folder / "axes.csv")
    assert len(rows) == len(levels()) * model().n_joints
    assert float(rows[1]["error_std"]) == levels()[0].noise_std[1]
    assert [row["axis"] for row in rows[:6]] == list(model().joint_names)


def test_what_was_not_used_is_listed_with_the_reason(folder: Path) -> None:
    assert rows_of(folder / "not_used.csv") == [
        {"path": "a/torn.mcap", "kind": "broken", "reason": "its footer is missing"},
        {"path": "a/slow.mcap", "kind": "skipped", "reason": "holds a validation run"},
    ]


def test_parquet_has_the_same_rows_with_types(folder: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    for one in TABLES:
        read: Any = parquet.read_table(folder / f"{one.name}.parquet")
        assert read.column_names == list(one.columns)
        plain = rows_of(folder / f"{one.name}.csv")
        typed = read.to_pylist()
        assert len(plain) == len(typed)
        for text, row in zip(plain, typed, strict=True):
            assert all(same(text[name], row[name]) for name in one.csv_columns), text


def same(text: str, value: object) -> bool:
    match value:
        case None:
            return text == ""
        case bool():
            return text == str(value).lower()
        case float():
            return float(text) == value or (math.isnan(float(text)) and math.isnan(value))
        case datetime():
            return datetime.fromisoformat(text) == value
        case _:
            return text == str(value)


def test_parquet_carries_covariances_and_times(folder: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    read: Any = parquet.read_table(folder / "parameters.parquet")
    rows = [row for row in read.to_pylist() if row["level"] == "campaign"][: model().n_parameters]
    np.testing.assert_array_equal(
        [row["covariance"] for row in rows], result().campaigns[0].covariance
    )
    assert rows[0]["when"] == datetime(2026, 1, 1, 8, tzinfo=UTC)
    assert read.column("covariance").to_pylist()[0] is None
    facts = json.loads(read.schema.metadata[b"hil"])
    assert facts["schema_version"] == table.SCHEMA_VERSION
    assert facts["code"] == "c0de"


def test_rows_are_written_in_portions(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    monkeypatch.setattr(table, "_PORTION", 7)
    write_tables(tmp_path, result())
    path = "parameters.parquet"
    assert parquet.ParquetFile(tmp_path / path).num_row_groups > 1
    portions, whole = (parquet.read_table(at / path).to_pylist() for at in (tmp_path, folder))
    assert repr(portions) == repr(whole)


def test_without_pyarrow_there_is_csv(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table, "has_parquet", lambda: False)
    written = write_tables(tmp_path, result())
    assert [path.name for path in written] == [f"{one.name}.csv" for one in TABLES]


def test_a_table_that_cannot_be_finished_leaves_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_tables(tmp_path, result())
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    bad = replace(result(), arms={})
    with pytest.raises(KeyError):
        write_tables(tmp_path, bad)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_every_column_is_documented_and_no_other() -> None:
    text = DOCS.read_text(encoding="utf-8")
    for one in TABLES:
        part = text.split(f"### `{one.name}`")[1].split("###")[0]
        rows = re.findall(r"^\| (`.+?`(?:, `.+?`)*) \|", part, flags=re.MULTILINE)
        assert re.findall(r"`(\w+)`", " ".join(rows)) == list(one.columns)
