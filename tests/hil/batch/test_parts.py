"""Parts of a batch: cache, keys and tables."""

from __future__ import annotations

import csv
import errno
import json
import math
import os
import re
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pyarrow import parquet

from hil.batch.archive_discovery import ArchiveRef, arm_digest
from hil.batch.archive_reduction import (
    ToReduce,
    _matrices,
    _triangles,
    cached_reduction,
    reduction_key,
    settings_digest,
)
from hil.batch.cache import HEADER, JSON, NPZ, NUMBERS, CacheError, CacheLocation, code_digest
from hil.batch.cluster import Cluster, ClusterTask, SkippedArchive, error_of
from hil.batch.estimates import BatchArm
from hil.batch.graph import ARCHIVES_PER_TASK, BatchResult, _Campaign
from hil.batch.table import COLUMNS, write_tables
from hil.cell import Cell
from hil.cell.schema import PayloadTable, TorsionSpringTable
from hil.pipeline.notes import StatedText
from identification.factor.factor import Factor
from identification.selection.averaging import AveragedBandwidth
from identification.selection.settings import Candidate, Choice, Settings, Strength
from identification.signals.samples import Preprocessing
from identification.signals.smoothing import LowPassShape
from sim_fixtures.ns16 import CELL_PATH
from tests.hil.arm_histories import cell, history, model, steady

KEY = "0123456789abcdef"
CANDIDATE = Candidate(
    bandwidth=20.0,
    velocity="position",
    friction=(("Coulomb", None), ("Stribeck", 0.1)),
    presliding=1e-4,
    tanh=None,
    ripple=(1, 2),
    springs=("elbow",),
    position_torques=("wrist",),
    excluded_rows=None,
    delay=1.0 / 3.0,
    low_pass=None,
    shape=LowPassShape(2),
    strength=Strength(),
)


def assert_intact(entry, content, arrays):
    assert entry[0] == content
    assert {name: array.tobytes() for name, array in entry[1].items()} == {
        name: array.tobytes() for name, array in arrays.items()
    }


def a_ref(index):
    name = f"/data/one/archives/excitation_{index:03d}_a1.mcap"
    return ArchiveRef(name, f"{index:064x}", "excitation", "arm", "/data/one", index, "cell", "")


@given(st.permutations(range(40)))
def test_partitions_do_not_depend_on_the_order_of_archives(order):
    refs = [a_ref(k) for k in order]
    partitions = _Campaign(refs[0].key, refs).partitions
    assert [len(part) for part in partitions] == [
        ARCHIVES_PER_TASK,
        ARCHIVES_PER_TASK,
        40 - 2 * ARCHIVES_PER_TASK,
    ]
    assert [wanted.ref.index for part in partitions for wanted in part] == list(range(40))


def test_sums_are_stored_without_loss_and_block_by_block():
    """In another order reading takes five times as long."""
    rows = np.random.default_rng(1).normal(size=(3, 4, 9))
    columns = (np.array([0, 1, 2]), np.array([1]))
    grams = tuple(rows[:, :k] @ rows[:, :k].transpose(0, 2, 1) for k in (4, 2))
    factor = Factor(grams, columns, np.full((3, 2), 9), ("a", "b", "c"))
    triangles = _triangles(factor)
    assert triangles.shape == (3, 10 + 3)
    assert triangles.flags.c_contiguous
    for matrices, expected in zip(_matrices(triangles, columns), grams, strict=True):
        np.testing.assert_array_equal(np.triu(matrices), np.triu(expected))
        np.testing.assert_array_equal(matrices, matrices.transpose(0, 2, 1))


class TestThread:
    """In place of Dask, for few archives."""

    def test_does_not_import_dask(self):
        """Which takes half a second."""
        program = (
            "import sys\n"
            "from hil.batch.cluster import Cluster, ClusterTask\n"
            "with Cluster() as cluster:\n"
            "    results = cluster.results([ClusterTask('a', abs, (-3,))])\n"
            "print(results, 'distributed' in sys.modules)"
        )
        ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
        assert ran.stdout == "[3] False\n", ran.stderr

    def test_executes_in_order_and_passes_results_on(self):
        with Cluster() as cluster:
            three, five = (cluster.submit(ClusterTask("", abs, (-n,)), archives=1) for n in (3, 5))
            most = cluster.submit(ClusterTask("", max, ([three, five, 4],)), archives=1)
            power = cluster.submit(ClusterTask("", pow, (three, most)), archives=1)
            assert power.result() == 243
            assert error_of(power) is None

    def test_an_error_of_the_cache_is_that_of_all_that_need_the_task(self):
        def refused() -> None:
            raise CacheError(None, "it is full")

        with Cluster() as cluster:
            failed = cluster.submit(ClusterTask("", refused, ()), archives=1)
            for future in (failed, cluster.submit(ClusterTask("", abs, (failed,)), archives=1)):
                assert isinstance(error_of(future), CacheError)

    def test_is_waited_for_when_closed_and_begins_no_other_task(self):
        begun = threading.Event()
        go = threading.Event()
        with Cluster() as cluster:
            first = cluster.submit(
                ClusterTask("", lambda: begun.set() or go.wait(), ()), archives=1
            )
            second = cluster.submit(ClusterTask("", abs, (1,)), archives=1)
            begun.wait()
            threading.Timer(0.05, go.set).start()
        assert (first.done(), second.cancelled()) == (True, True)


class TestCache:
    CONTENT: Final = {"a": [1.5, "x"], "b": None}
    ARRAYS: Final = {"values": np.eye(7), "none": np.zeros((0, 3)), "counts": np.arange(3)}

    @pytest.mark.long
    @settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
    @given(st.data())
    def test_entries_with_one_wrong_bit_are_ignored(self, tmp_path, data):
        """Or they are as written, if the bit is one of those that a reader does not need."""
        cache = CacheLocation(str(tmp_path))
        place = "/data/a.mcap"
        cache.write(place, KEY, self.CONTENT, self.ARRAYS)
        path = cache.path(place, KEY)
        intact = path.read_bytes()
        assert_intact(cache.read(place, KEY), self.CONTENT, self.ARRAYS)
        bit = data.draw(st.integers(0, 8 * len(intact) - 1))
        damaged = bytearray(intact)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        entry = cache.read(place, KEY)
        if entry is not None:
            assert_intact(entry, self.CONTENT, self.ARRAYS)
        path.write_bytes(intact[: data.draw(st.integers(0, len(intact) - 1))])
        assert cache.read(place, KEY) is None

    @settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
    @given(st.data())
    def test_texts_with_a_wrong_bit_or_cut_short_are_ignored(self, tmp_path, data):
        cache = CacheLocation(str(tmp_path))
        place = "/data/a.mcap"
        cache.put(place, KEY, self.CONTENT)
        path = cache.path(place, KEY, JSON)
        intact = path.read_bytes()
        assert cache.get(place, KEY, dict) == self.CONTENT
        damaged = bytearray(intact)
        bit = data.draw(st.integers(0, 8 * len(intact) - 1))
        damaged[bit // 8] ^= 1 << bit % 8
        for content in (bytes(damaged), intact[: data.draw(st.integers(0, len(intact) - 1))]):
            path.write_bytes(content)
            assert cache.get(place, KEY, dict) is None

    @pytest.mark.parametrize("suffix", [NPZ, JSON])
    def test_entries_of_another_key_are_ignored(self, tmp_path, suffix):
        cache = CacheLocation(str(tmp_path))
        place = "/data/a.mcap"
        cache.write(place, KEY, self.CONTENT, {})
        cache.put(place, KEY, self.CONTENT)
        other = cache.path(place, KEY[::-1], suffix)
        other.parent.mkdir(parents=True)
        cache.path(place, KEY, suffix).rename(other)
        assert cache.read(place, KEY[::-1]) is None
        assert cache.get(place, KEY[::-1], dict) is None

    @pytest.mark.parametrize(
        ("content", "arrays"),
        [
            *(([{"gram": 3}], {}), (None, {}), ({"archives": [{}]}, {}), ("text", {})),
            (
                {"archives": [{"warnings": [], "blocks": 1}], "parameters": [], "units": []},
                {"counts": np.zeros((1, 2), np.intp)},
            ),
        ],
    )
    def test_forged_reductions_are_ignored(self, tmp_path, content, arrays):
        stated = Settings(Preprocessing())
        cache = CacheLocation(str(tmp_path))
        cache.write(a_ref(0).location, reduction_key([ToReduce(a_ref(0))], stated), content, arrays)
        assert cached_reduction([ToReduce(a_ref(0))], stated, cache) is None

    @pytest.mark.parametrize(
        ("layout", "numbers"),
        [
            ({"values": ["|O", [1]]}, np.zeros(8, np.uint8)),
            ({"values": ["|O", [1]]}, np.array([{"an": "object"}])),
            ({"values": ["<f8", [2]]}, np.zeros(8, np.uint8)),
            ({"values": [[["a", "|O"]], [1]]}, np.zeros(8, np.uint8)),
            ({"values": ["no type", [1]]}, np.zeros(8, np.uint8)),
            (["values"], np.zeros(8, np.uint8)),
        ],
    )
    def test_forged_arrays_are_not_read(self, tmp_path, layout, numbers):
        """Objects, of which a pickle would make some, and arrays that are not there."""
        cache = CacheLocation(str(tmp_path))
        place = "/data/a.mcap"
        np.savez(self.new(cache, place), **{HEADER: self.header(layout), NUMBERS: numbers})
        assert cache.read(place, KEY) is None

    def test_compressed_entries_are_not_read(self, tmp_path):
        """They may be a thousand times as large in memory."""
        cache = CacheLocation(str(tmp_path))
        place = "/data/a.mcap"
        header = self.header({"values": ["<f8", [100_000]]})
        arrays = {HEADER: header, NUMBERS: np.zeros(800_000, np.uint8)}
        np.savez(self.new(cache, place), **arrays)
        assert cache.read(place, KEY) is not None
        np.savez_compressed(cache.path(place, KEY), **arrays)
        assert cache.read(place, KEY) is None

    @staticmethod
    def header(layout):
        text = json.dumps({"key": KEY, "content": {}, "arrays": layout})
        return np.frombuffer(text.encode(), np.uint8)

    @staticmethod
    def new(cache, place):
        path = cache.path(place, KEY)
        path.parent.mkdir(parents=True)
        return path

    def test_entries_of_two_writers_are_intact(self, tmp_path):
        cache = CacheLocation(str(tmp_path))
        place = "/data/a.mcap"
        contents = [{"values": np.full(20_000, number)} for number in (1.0, 2.0)]

        def write(arrays):
            for _ in range(100):
                cache.write(place, KEY, {}, arrays)

        with ThreadPoolExecutor(2) as pool:
            writing = [pool.submit(write, arrays) for arrays in contents]
            entries = [cache.read(place, KEY) for _ in range(100)]
        assert all(future.exception() is None for future in writing)
        values = [entry[1]["values"] for entry in entries if entry is not None]
        assert {float(np.ptp(array)) for array in values} <= {0.0}
        files = [path.name for path in tmp_path.rglob("*") if path.is_file()]
        assert files == [f"{KEY}.npz"]

    def test_unwritable_folders_are_refused_with_a_remedy(self, tmp_path):
        (tmp_path / "file").write_text("")
        cache = CacheLocation(str(tmp_path / "file"))
        with pytest.raises(CacheError, match="--cache"):
            cache.put("/data/a.mcap", KEY, {})
        assert cache.get("/data/a.mcap", KEY, dict) is None

    def test_a_full_disk_is_reported_with_a_remedy(self, tmp_path, monkeypatch):
        def full(*_, **__):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        monkeypatch.setattr(np, "savez", full)
        cache = CacheLocation(str(tmp_path))
        with pytest.raises(CacheError, match=r"No space left.*make room, or choose another folder"):
            cache.write("/data/a.mcap", KEY, {}, {})
        assert not [path for path in tmp_path.rglob("*") if path.is_file()]

    def test_urls_are_cached_in_the_home(self, tmp_path, monkeypatch):
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        folder = CacheLocation().folder("https://host/line/a.mcap")
        assert folder.parent == tmp_path / "hil"

    def test_archives_of_a_folder_share_a_folder(self, tmp_path):
        here = str(tmp_path / "a.mcap")
        there = str(tmp_path / "b.mcap")
        for place in (CacheLocation(), CacheLocation(str(tmp_path / "elsewhere"))):
            assert place.folder(here) == place.folder(there)
            assert place.folder(here) != place.folder(str(tmp_path / "sub" / "a.mcap"))
        assert CacheLocation().folder(here) == tmp_path / ".hil-cache"
        (tmp_path / ".hil-cache").write_text("not a folder")
        assert tmp_path not in CacheLocation().folder(here).parents

    def test_settings_are_restored_exactly(self, tmp_path):
        stated = Settings(
            Preprocessing(torque_bandwidth=1.0 / 3.0, torque_shape=LowPassShape(2, causal=True)),
            friction={"presliding": 1e-4, "third": "none"},
            noise_variance=(1e-9 / 3.0,) * 6,
            strength=Strength(10.0, consistent=True),
            loading=(1.0 / 3.0, -2.0),
            choices=(Choice("rows", (CANDIDATE, CANDIDATE), (0.1, np.inf), 0),),
        )
        cache = CacheLocation(str(tmp_path))
        place = "/data/a.mcap"
        cache.put(place, KEY, stated)
        assert cache.get(place, KEY, Settings) == stated
        cache.put(place, KEY, {"velocity": "position", "torque_delay": 0.0})
        assert cache.get(place, KEY, Settings) is None


class TestDigests:
    @pytest.mark.parametrize(
        "name", ["batch/archive_discovery.py", "batch/graph.py", "signals/samples.py", "record.py"]
    )
    def test_that_of_the_programs_depends_on_each(self, name, monkeypatch):
        here = code_digest()
        read = Path.read_bytes

        def changed(path):
            return read(path) + (b"\n" if path.as_posix().endswith(name) else b"")

        monkeypatch.setattr(Path, "read_bytes", changed)
        assert code_digest.__wrapped__() != here

    def test_that_of_an_arm_ignores_payload_and_campaign(self):
        cell = Cell.load(CELL_PATH)
        digest = arm_digest(cell, b"drives")
        assert arm_digest(cell.with_campaign(repetitions=7), b"drives") == digest

        def changed(**robot):
            file = cell.file.model_copy(update={"robot": cell.file.robot.model_copy(update=robot)})
            return arm_digest(replace(cell, file=file), b"drives")

        spring = {"kind": "torsion_spring", "joint": "joint_2", "rest_deg": 0.0, "stiffness": 9.0}
        assert changed(payload=PayloadTable(mass=2.0, centre=[0.0, 0.0, 0.1])) == digest
        assert changed(gravity=[0.0, 1.0, -9.8]) != digest
        assert changed(elements=[TorsionSpringTable(**spring)]) != digest
        assert arm_digest(replace(cell, urdf=cell.urdf + "\n"), b"drives") != digest
        assert arm_digest(cell, b"other drives") != digest
        assert arm_digest(cell, b"drives", simulated=True) != digest

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
            replace(stated, hedge=AveragedBandwidth(14.0, 0.5)),
        ]
        assert len({settings_digest(settings) for settings in (stated, *others)}) == 1 + len(others)
        both = [ToReduce(a_ref(0)), ToReduce(a_ref(1))]
        assert reduction_key(both, stated) != reduction_key(both[::-1], stated)


DOCS = Path(__file__).parents[3] / "docs" / "batch.md"


@cache
def result():
    first, other = history(steady, 2, seed=2)
    covariance = first.estimate.covariance.copy()
    covariance[3, 3] = np.inf
    names = (first.estimate.names[3],)
    open_estimate = replace(first.estimate, covariance=covariance, undetermined=names)
    repetition = replace(
        first,
        level="repetition",
        archive='line "3", spring/\udcff.mcap',
        sha256="ab" * 32,
        estimate=open_estimate,
        when="",
        warnings=(StatedText("stood still at first"), StatedText("two gaps")),
    )
    pooled = replace(first, level="pooled", campaign="", unseen_rms=0.1 * first.torque_rms)
    return BatchResult(
        estimator="wls",
        arms={"digest": BatchArm("digest", cell())},
        repetitions=(repetition,),
        campaigns=(first, other),
        pooled=(replace(pooled, unseen_torque_rms=first.torque_rms),),
        siblings=(),
        broken=(SkippedArchive("a/truncated.mcap", "its footer is missing"),),
        skipped=(SkippedArchive("a/slow.mcap", "holds a validation run"),),
        read=1,
        cached=0,
        code="c0de",
    )


def levels():
    return [*result().repetitions, *result().campaigns, *result().pooled]


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    """Rows of the tables by name."""
    rows = {}
    for path in write_tables(tmp_path_factory.mktemp("tables"), result()):
        if path.suffix != ".csv":
            continue
        with path.open(encoding="utf-8", newline="") as file:
            rows[path.stem] = list(csv.DictReader(file))
    return rows


class TestTables:
    def test_have_a_row_per_estimate_and_parameter(self, tables):
        rows = tables["parameters"]
        columns = [
            (level.level, level.campaign, name, value, std)
            for level in levels()
            for name, value, std in zip(
                level.estimate.names, level.estimate.values, level.estimate.std, strict=True
            )
        ]
        for row, expected in zip(rows, columns, strict=True):
            key = (row["level"], row["campaign"], row["parameter"])
            assert (*key, float(row["value"]), float(row["std"])) == expected
        row = rows[0]
        undetermined = rows[3]
        half = levels()[0].estimate.interval_factor * float(row["std"])
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
        estimated = result().campaigns[0]
        weight = estimated.estimate.samples.astype(float)
        noise = estimated.estimate.noise_std
        expected = math.sqrt((weight @ noise**2) / (weight @ estimated.torque_rms**2))
        campaign = next(row for row in rows if row["level"] == "campaign")
        assert datetime.fromisoformat(campaign["when"]) == datetime(2026, 1, 1, 8, tzinfo=UTC)
        assert float(campaign["relative_error"]) == pytest.approx(expected)
        assert math.isnan(float(campaign["unseen_relative_error"]))
        assert float(rows[-1]["unseen_relative_error"]) == pytest.approx(0.1)
        axes = tables["axes"]
        assert len(axes) == len(levels()) * model().n_joints
        assert float(axes[1]["error_std"]) == levels()[0].estimate.noise_std[1]
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

    def test_in_parquet_have_the_rows_of_csv_with_their_types(self, tmp_path, tables):
        write_tables(tmp_path, result())
        for name, rows in tables.items():
            table = parquet.read_table(tmp_path / f"{name}.parquet")
            assert table.column_names == list(COLUMNS[name])
            assert table.num_rows == len(rows)
            for column in COLUMNS[name]:
                values = table[column].to_pylist()
                if isinstance(values[0], float | int | str) and column != "determined":
                    assert [*map(str, values)] == [row[column] for row in rows]
        parameters = parquet.read_table(tmp_path / "parameters.parquet").to_pylist()
        repetition = levels()[0].estimate
        row = parameters[3]
        assert row["value"] == repetition.values[3]
        assert (row["std"], row["determined"], row["when"]) == (math.inf, False, None)
        assert row["archive"] == 'line "3", spring/?.mcap'
        assert row["archives"] == levels()[0].repetitions
        campaign = next(row for row in parameters if row["level"] == "campaign")
        assert campaign["when"] == datetime(2026, 1, 1, 8, tzinfo=UTC)

    def test_have_the_documented_columns_and_no_other(self):
        text = DOCS.read_text(encoding="utf-8")
        for name, columns in COLUMNS.items():
            part = text.split(f"### `{name}`")[1].split("###")[0]
            rows = re.findall(r"^\| (`.+?`(?:, `.+?`)*) \|", part, flags=re.MULTILINE)
            assert re.findall(r"`(\w+)`", " ".join(rows)) == columns
