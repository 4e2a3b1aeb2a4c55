"""Parts of a batch: cache, keys, workers and tables."""

from __future__ import annotations

import csv
import json
import math
import re
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from isal.isal_zlib import crc32

from hil.batch.cache import (
    _HEAD,
    _MAGIC,
    CacheError,
    CacheLocation,
    code_digest,
    decoded,
    encoded,
)
from hil.batch.discovery import ArchiveRef, arm_digest
from hil.batch.run import (
    BUNDLE,
    Arm,
    BatchResult,
    Bundle,
    cached_bundle,
    settings_digest,
    split_bundles,
    sum_key,
)
from hil.batch.table import COLUMNS, write_tables
from hil.batch.workers import Unused, Workers
from hil.cell import Cell
from hil.cell.schema import PayloadTable, TorsionSpringTable
from hil.identify.prepared import Settings
from identification.selection.inner_prediction import Choice, Strength
from identification.signals.samples import Preprocessing
from identification.signals.smoothing import LowPassShape
from sim_fixtures.ns16 import CELL_PATH

from . import batch_work as work
from .arm_histories import cell, history, model, steady

KEY = "0123456789abcdef"


def a_ref(index):
    name = f"/data/one/archives/excitation_{index:03d}_a1.mcap"
    return ArchiveRef(name, f"{index:064x}", "excitation", "arm", "/data/one", index, "cell", "")


@given(st.permutations(range(40)))
def test_bundles_do_not_depend_on_the_order_of_archives(order):
    found = split_bundles([a_ref(k) for k in order])
    assert [len(one) for one in found] == [BUNDLE, BUNDLE, 40 - 2 * BUNDLE]
    assert [ref.index for one in found for ref in one] == list(range(40))


class TestCache:
    @given(st.data())
    def test_entries_with_one_wrong_bit_are_ignored(self, data):
        content = {"a": [1.5, "x"], "values": np.eye(7), "none": [np.zeros((0, 3))]}
        intact = encoded(KEY, content)
        found = decoded(intact, KEY)
        assert found["a"] == [1.5, "x"]
        assert found["values"].tobytes() == np.eye(7).tobytes()
        assert found["none"][0].shape == (0, 3)
        bit = data.draw(st.integers(0, 8 * len(intact) - 1))
        damaged = bytearray(intact)
        damaged[bit // 8] ^= 1 << bit % 8
        assert decoded(bytes(damaged), KEY) is None
        assert decoded(intact[: data.draw(st.integers(0, len(intact) - 1))], KEY) is None
        assert decoded(intact, KEY[::-1]) is None

    @pytest.mark.parametrize(
        "array",
        [
            *({"array": "O", "shape": [1], "at": 0}, {"array": "(2,", "shape": [1], "at": 0}),
            *({"array": "f", "shape": [1 << 62, 4], "at": 0}, {"array": "f", "shape": 3, "at": 0}),
            *({"array": "f", "shape": [1], "at": -1}, {"array": ["a", "<f8"]}, {"array": "f"}),
        ],
    )
    def test_forged_arrays_with_valid_checksum_are_ignored(self, array):
        text = json.dumps({"key": KEY, "content": array}).encode()
        body = text + bytes(-len(text) % 8)
        assert decoded(_HEAD.pack(_MAGIC, len(text), crc32(body)) + body, KEY) is None

    @pytest.mark.parametrize("forged", [[{"gram": 3}], {"type": "Factor"}, Bundle(), None])
    def test_forged_sums_are_ignored(self, tmp_path, forged):
        settings, cache = Settings(Preprocessing()), CacheLocation(str(tmp_path))
        cache.put(a_ref(0).location, sum_key([a_ref(0)], settings), forged)
        assert cached_bundle([a_ref(0)], settings, cache) is None

    def test_entries_of_two_writers_are_intact(self, tmp_path):
        cache, place = CacheLocation(str(tmp_path)), "/data/a.mcap"
        contents = [np.full(20_000, number) for number in (1.0, 2.0)]
        with ThreadPoolExecutor(2) as pool:
            writing = [
                pool.submit(lambda c=one: [cache.put(place, KEY, c) for _ in range(100)])
                for one in contents
            ]
            found = [cache.get(place, KEY, np.ndarray) for _ in range(100)]
        assert all(one.exception() is None for one in writing)
        assert {float(np.ptp(one)) for one in found if one is not None} <= {0.0}
        assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == [KEY]

    def test_unwritable_folders_are_refused_with_a_remedy(self, tmp_path):
        (tmp_path / "file").write_text("")
        cache = CacheLocation(str(tmp_path / "file"))
        with pytest.raises(CacheError, match="--cache"):
            cache.put("/data/a.mcap", KEY, {})
        assert cache.get("/data/a.mcap", KEY, dict) is None

    def test_archives_of_a_folder_share_a_folder(self, tmp_path):
        here, there = str(tmp_path / "a.mcap"), str(tmp_path / "b.mcap")
        for place in (CacheLocation(), CacheLocation(str(tmp_path / "elsewhere"))):
            assert place.folder(here) == place.folder(there)
            assert place.folder(here) != place.folder(str(tmp_path / "sub" / "a.mcap"))
        assert CacheLocation().folder(here) == tmp_path / ".hil-cache"
        (tmp_path / ".hil-cache").write_text("not a folder")
        assert tmp_path not in CacheLocation().folder(here).parents

    def test_settings_are_restored_exactly(self, tmp_path):
        settings = Settings(
            Preprocessing(torque_bandwidth=1.0 / 3.0, torque_shape=LowPassShape(2, causal=True)),
            friction={"presliding": 1e-4, "third": "none"},
            noise_variance=(1e-9 / 3.0,) * 6,
            strength=Strength(10.0, consistent=True),
            loading=(1.0 / 3.0, -2.0),
            choices=(Choice("rows", ("slow", "rests"), (0.1, np.inf), 0),),
        )
        cache, place = CacheLocation(str(tmp_path)), "/data/a.mcap"
        cache.put(place, KEY, settings)
        assert cache.get(place, KEY, Settings) == settings
        cache.put(place, KEY, {"velocity": "position", "torque_delay": 0.0})
        assert cache.get(place, KEY, Settings) is None


class TestDigests:
    @pytest.mark.parametrize(
        "name", ["batch/discovery.py", "batch/run.py", "signals/samples.py", "record.py"]
    )
    def test_that_of_the_programs_depends_on_each(self, name, monkeypatch):
        here, read = code_digest(), Path.read_bytes

        def changed(path):
            return read(path) + (b"\n" if path.as_posix().endswith(name) else b"")

        monkeypatch.setattr(Path, "read_bytes", changed)
        assert code_digest.__wrapped__() != here

    def test_that_of_an_arm_ignores_payload_and_campaign(self):
        cell = Cell.load(CELL_PATH)
        own = arm_digest(cell, b"drives")
        assert arm_digest(cell.with_campaign(repetitions=7), b"drives") == own

        def changed(**robot):
            file = cell.file.model_copy(update={"robot": cell.file.robot.model_copy(update=robot)})
            return arm_digest(replace(cell, file=file), b"drives")

        spring = {"kind": "torsion_spring", "joint": "joint_2", "rest_deg": 0.0, "stiffness": 9.0}
        assert changed(payload=PayloadTable(mass=2.0, centre=[0.0, 0.0, 0.1])) == own
        assert changed(gravity=[0.0, 1.0, -9.8]) != own
        assert changed(elements=[TorsionSpringTable(**spring)]) != own
        assert arm_digest(replace(cell, urdf=cell.urdf + "\n"), b"drives") != own
        assert arm_digest(cell, b"other drives") != own
        assert arm_digest(cell, b"drives", simulated=True) != own

    def test_that_of_settings_ignores_those_of_the_estimate(self):
        stated = Settings(Preprocessing(torque_delay=0.002), noise_variance=(1e-9,) * 6)
        estimate = replace(
            stated, strength=Strength(10.0, consistent=True), choices=(Choice("rows", (), (), 0),)
        )
        assert settings_digest(stated) == settings_digest(estimate)
        others = [
            stated.preprocessed(velocity="measured"),
            stated.preprocessed(torque_delay=0.004),
            stated.preprocessed(torque_bandwidth=30.0),
            replace(stated, noise_variance=(1e-9 * (1 + 2e-16),) * 6),
            replace(stated, noise_variance=None),
            replace(stated, friction={"presliding": 1e-4}),
            replace(stated, delay_variance=1e-9),
            replace(stated, loading=(1.0, 2.0)),
        ]
        assert len({settings_digest(one) for one in (stated, *others)}) == 1 + len(others)
        assert sum_key([a_ref(0), a_ref(1)], stated) != sum_key([a_ref(1), a_ref(0)], stated)


class TestWorkers:
    def test_tasks_that_kill_their_process_do_not_affect_others(self, tmp_path):
        """A task whose process ends is run once more."""
        tasks, failing = work.tasks_with_failures(12, hang=5)
        tasks[9] = work.task(work.once, str(tmp_path / "ran"))
        finished = []
        with Workers(2, timeout=4.0) as workers:
            found = list(workers.results(tasks, finished.append))
        assert sum(finished) == 12
        work.check_failures(tasks, found, failing, {9: "again"})

    def test_closing_ends_tasks_at_work(self):
        begin = time.monotonic()
        with Workers(2) as workers:
            found = workers.results([work.task(work.number, 0), *[work.task(work.hang, 1)] * 20])
            assert next(found) == 0
        assert time.monotonic() - begin < 60.0


DOCS = Path(__file__).parents[2] / "docs" / "batch.md"


@cache
def result():
    one, other = history(steady, 2, seed=2)
    undetermined = one.std.copy()
    undetermined[3] = np.inf
    repetition = replace(
        one,
        level="repetition",
        archive='line "3", spring/\udcff.mcap',
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
        broken=(Unused("a/truncated.mcap", "its footer is missing"),),
        skipped=(Unused("a/slow.mcap", "holds a validation run"),),
        read=1,
        cached=0,
        code="c0de",
    )


def levels():
    return [*result().repetitions, *result().campaigns, *result().pooled]


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    """Rows of the tables by name."""
    found = {}
    for path in write_tables(tmp_path_factory.mktemp("tables"), result()):
        with path.open(encoding="utf-8", newline="") as file:
            found[path.stem] = list(csv.DictReader(file))
    return found


class TestTables:
    def test_have_a_row_per_estimate_and_parameter(self, tables):
        rows = tables["parameters"]
        columns = [
            (level.level, level.campaign, name, value, std)
            for level in levels()
            for name, value, std in zip(level.names, level.values, level.std, strict=True)
        ]
        for row, expected in zip(rows, columns, strict=True):
            found = (row["level"], row["campaign"], row["parameter"])
            assert (*found, float(row["value"]), float(row["std"])) == expected
        row, undetermined = rows[0], rows[3]
        half = levels()[0].interval_factor * float(row["std"])
        for end, sign in (("low", -1.0), ("high", 1.0)):
            assert float(row[end]) == pytest.approx(float(row["value"]) + sign * half)
        expected = {
            "archive": 'line "3", spring/?.mcap', "archive_sha256": "ab" * 32, "when": "",
            "settings": "settings", "code": "c0de", "estimator": "wls",
            "warnings": "stood still at first; two gaps",
        }  # fmt: skip
        assert expected.items() <= row.items()
        assert {"determined": "false", "std": "inf", "high": "inf"}.items() <= undetermined.items()
        assert re.search(r"\bhil \d", row["software"])
        assert row["arm"].endswith("-digest")

    def test_have_kinds_of_parameters_and_errors_of_all_joints(self, tables):
        rows = tables["parameters"]
        by_name = {row["parameter"]: (row["kind"], row["axis"]) for row in rows}
        assert by_name["f1_3"] == ("friction", "joint_3")
        assert by_name["mc2x"] == ("inertial", "")
        one = result().campaigns[0]
        weight = one.samples.astype(float)
        expected = math.sqrt((weight @ one.noise_std**2) / (weight @ one.torque_rms**2))
        campaign = next(row for row in rows if row["level"] == "campaign")
        assert datetime.fromisoformat(campaign["when"]) == datetime(2026, 1, 1, 8, tzinfo=UTC)
        assert float(campaign["relative_error"]) == pytest.approx(expected)
        assert math.isnan(float(campaign["unseen_relative_error"]))
        assert float(rows[-1]["unseen_relative_error"]) == pytest.approx(0.1)
        axes = tables["axes"]
        assert len(axes) == len(levels()) * model().n_joints
        assert float(axes[1]["error_std"]) == levels()[0].noise_std[1]
        assert [row["axis"] for row in axes[:6]] == list(model().joint_names)
        assert [tuple(row.values()) for row in tables["not_used"]] == [
            ("a/truncated.mcap", "broken", "its footer is missing"),
            ("a/slow.mcap", "skipped", "holds a validation run"),
        ]

    def test_are_replaced_atomically(self, tmp_path):
        write_tables(tmp_path, result())
        before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
        with pytest.raises(KeyError):
            write_tables(tmp_path, replace(result(), arms={}))
        assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before

    def test_have_the_documented_columns_and_no_other(self):
        text = DOCS.read_text(encoding="utf-8")
        for name, columns in COLUMNS.items():
            part = text.split(f"### `{name}`")[1].split("###")[0]
            rows = re.findall(r"^\| (`.+?`(?:, `.+?`)*) \|", part, flags=re.MULTILINE)
            assert re.findall(r"`(\w+)`", " ".join(rows)) == columns
