"""Parts of the batch by themselves: the cache, sums, keys, workers."""

from __future__ import annotations

import json
import os
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from isal.isal_zlib import crc32

from hil.batch.cache import (
    _HEAD,
    _MAGIC,
    Store,
    Where,
    arm_digest,
    code_digest,
    decoded,
    encoded,
    settings_digest,
    sum_key,
)
from hil.batch.factors import BUNDLE, bundles, cached
from hil.batch.types import ArchiveRef, Broken, CacheError
from hil.batch.workers import ArchiveTask, LocalWorkers, TreeSum
from hil.cell import Cell
from hil.cell.schema import PayloadTable, RobotTable, TorsionSpringTable
from hil.identify.settings import Settings
from identification.estimators.shrinkage import Shrinkage
from identification.selection.inner_prediction import Choice
from identification.signals.samples import Preprocessing
from identification.signals.smoothing import LowPassShape
from sim_fixtures.ns16 import CELL_PATH

KEY = "0123456789abcdef"


def a_ref(index: int, campaign: str = "/data/one") -> ArchiveRef:
    name = f"{campaign}/archives/excitation_{index:03d}_a1.mcap"
    return ArchiveRef(name, f"{index:064x}", "excitation", "arm", campaign, index, "cell", "motion")


class TestTreeSum:
    @given(st.lists(st.none() | st.floats(-1e6, 1e6), max_size=600))
    def test_adds_runs_of_eight_then_their_sums(self, terms: list[float | None]) -> None:
        """To the last bit, whoever adds which run."""
        expected = terms
        while len(expected) > 1:
            runs = [expected[k : k + 8] for k in range(0, len(expected), 8)]
            present = [[term for term in run if term is not None] for run in runs]
            expected = [None if not run else sum(run[1:], run[0]) for run in present]
        total = expected[0] if terms else None
        assert TreeSum(terms).result() == total
        far = TreeSum[float]()
        for k in range(0, len(terms), 8):
            far.add(TreeSum(terms[k : k + 8]).result(), 1)
        assert far.result() == total

    def test_holds_one_sum_per_level(self) -> None:
        sums = TreeSum(1.0 for _ in range(8**4 + 5))
        assert len(sums._levels) == 5
        assert sums.result() == 8**4 + 5


@given(st.permutations(range(40)))
def test_bundles_do_not_depend_on_the_order_of_archives(order: list[int]) -> None:
    found = bundles([a_ref(k) for k in order])
    assert [len(one) for one in found] == [BUNDLE, BUNDLE, 40 - 2 * BUNDLE]
    assert [ref.index for one in found for ref in one] == list(range(40))


class TestCache:
    @given(st.data())
    def test_an_entry_with_one_wrong_bit_is_none(self, data: st.DataObject) -> None:
        content = {"a": [1.5, "x"], "values": np.arange(7.0), "none": [np.zeros((0, 3))]}
        whole = encoded(KEY, content)
        found = decoded(whole, KEY)
        assert found["a"] == [1.5, "x"]
        assert found["values"].tobytes() == np.arange(7.0).tobytes()
        assert found["none"][0].shape == (0, 3)
        bit = data.draw(st.integers(0, 8 * len(whole) - 1))
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << bit % 8
        assert decoded(bytes(damaged), KEY) is None
        assert decoded(whole[: data.draw(st.integers(0, len(whole) - 1))], KEY) is None
        assert decoded(whole, KEY[::-1]) is None

    @pytest.mark.parametrize(
        "array",
        [
            *({"array": "O", "shape": [1], "at": 0}, {"array": "(2,", "shape": [1], "at": 0}),
            *({"array": "f", "shape": [1 << 62, 4], "at": 0}, {"array": "f", "shape": 3, "at": 0}),
            *({"array": "f", "shape": [1], "at": -1}, {"array": ["a", "<f8"]}, {"array": "f"}),
        ],
    )
    def test_a_forged_array_is_none(self, array: dict[str, object]) -> None:
        """An untrusted file may carry a checksum that is right; numpy is given no type of it."""
        text = json.dumps({"key": KEY, "content": array}).encode()
        body = text + bytes(-len(text) % 8)
        assert decoded(_HEAD.pack(_MAGIC, len(text), crc32(body)) + body, KEY) is None

    def test_two_writers_never_leave_half_an_entry(self, tmp_path: Path) -> None:
        store, contents = Store(tmp_path), [np.full(20_000, number) for number in (1.0, 2.0)]
        with ThreadPoolExecutor(2) as pool:
            writing = [
                pool.submit(lambda c=one: [store.put(KEY, c) for _ in range(100)])
                for one in contents
            ]
            found = [store.get(KEY, np.ndarray) for _ in range(100)]
        assert all(one.exception() is None for one in writing)
        assert {float(np.ptp(one)) for one in found if one is not None} <= {0.0}
        assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == [KEY]

    @pytest.mark.parametrize("forged", [[{"gram": 3}], [{"type": "PhaseFactor"}], [], {}, None])
    def test_a_forged_sum_counts_as_absent(self, tmp_path: Path, forged: object) -> None:
        settings, where = Settings(Preprocessing()), Where(str(tmp_path))
        key = sum_key([a_ref(0)], settings_digest(settings))
        where.store(a_ref(0).location).put(key, forged)
        assert cached([a_ref(0)], settings, where) is None

    @given(st.integers(1, 6), st.booleans())
    def test_a_square_matrix_is_restored_to_the_bit(self, size: int, symmetric: bool) -> None:
        square = np.random.default_rng(size).normal(size=(3, size, size))
        square = square + square.swapaxes(1, 2) if symmetric else square
        data = encoded(KEY, [square])
        assert decoded(data, KEY)[0].tobytes() == square.tobytes()
        assert not symmetric or len(data) < 300 + 8 * 3 * size * (size + 1) / 2

    def test_a_store_that_cannot_be_written_names_a_remedy(self, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("")
        with pytest.raises(CacheError, match="--cache"):
            Store(tmp_path / "file").put(KEY, {})
        assert Store(tmp_path / "file").get(KEY, dict) is None

    def test_archives_of_a_folder_share_a_store(self, tmp_path: Path) -> None:
        here, there = str(tmp_path / "a.mcap"), str(tmp_path / "b.mcap")
        for where in (Where(), Where(str(tmp_path / "elsewhere"))):
            assert where.store(here) == where.store(there)
            assert where.store(here) != where.store(str(tmp_path / "sub" / "a.mcap"))
        assert Where().store(here).folder == tmp_path / ".hil-cache"
        remote = Where(str(tmp_path)).store("s3://bucket/one/a.mcap")
        assert remote.folder is not None
        assert remote.folder.parent == tmp_path

    def test_a_file_in_place_of_the_folder_is_left_alone(self, tmp_path: Path) -> None:
        (tmp_path / ".hil-cache").write_text("not a folder")
        store = Where().store(str(tmp_path / "excitation_000_a1.mcap"))
        assert store.folder is not None
        assert tmp_path not in store.folder.parents

    def test_settings_are_cached_to_the_last_bit(self, tmp_path: Path) -> None:
        settings = Settings(
            Preprocessing(torque_bandwidth=1.0 / 3.0, torque_shape=LowPassShape(2, causal=True)),
            friction={"presliding": 1e-4, "third": "none"},
            noise_variance=(1e-9 / 3.0,) * 6,
            shrinkage=Shrinkage(np.inf),
            choices=(Choice("rows", ("slow", "rests"), (0.1, np.inf), 0),),
        )
        store = Store(tmp_path)
        store.put(KEY, settings)
        assert store.get(KEY, Settings) == settings
        store.put(KEY, {"smoother": "spline", "torque_delay": 0.0})
        assert store.get(KEY, Settings) is None


@pytest.mark.parametrize(
    "name", ["batch/discovery.py", "batch/factors.py", "signals/samples.py", "record.py"]
)
def test_a_change_of_the_programs_changes_their_digest(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, read = code_digest(), Path.read_bytes

    def changed(path: Path) -> bytes:
        return read(path) + (b"\n" if path.as_posix().endswith(name) else b"")

    monkeypatch.setattr(Path, "read_bytes", changed)
    assert code_digest.__wrapped__() != here


# What things are known by


def with_robot(cell: Cell, robot: RobotTable) -> Cell:
    return replace(cell, file=cell.file.model_copy(update={"robot": robot}))


def test_an_arm_is_its_links_friction_and_drives_and_not_its_payload_or_campaign() -> None:
    cell = Cell.load(CELL_PATH)
    own = arm_digest(cell, b"drives")
    longer = cell.with_campaign(repetitions=7)
    assert arm_digest(longer, b"drives") == own
    payload = PayloadTable(mass=2.0, centre=[0.0, 0.0, 0.1])
    loaded = with_robot(cell, cell.file.robot.model_copy(update={"payload": payload}))
    assert arm_digest(loaded, b"drives") == own
    tilted = with_robot(cell, cell.file.robot.model_copy(update={"gravity": [0.0, 1.0, -9.8]}))
    assert arm_digest(tilted, b"drives") != own
    spring = TorsionSpringTable(kind="torsion_spring", joint="joint_2", rest_deg=0.0, stiffness=9.0)
    sprung = with_robot(cell, cell.file.robot.model_copy(update={"elements": [spring]}))
    assert arm_digest(sprung, b"drives") != own
    assert arm_digest(replace(cell, urdf=cell.urdf + "\n"), b"drives") != own
    assert arm_digest(cell, b"other drives") != own


def test_factors_are_known_by_everything_they_depend_on() -> None:
    stated = Settings(Preprocessing(torque_delay=0.002), noise_variance=(1e-9,) * 6)
    for_the_estimate = replace(
        stated, shrinkage=Shrinkage(0.1), choices=(Choice("rows", (), (), 0),)
    )
    assert settings_digest(stated) == settings_digest(for_the_estimate)
    others = [
        stated.preprocessed(smoother="butterworth"),
        stated.preprocessed(torque_delay=0.004),
        stated.preprocessed(torque_bandwidth=30.0),
        replace(stated, noise_variance=(1e-9 * (1 + 2e-16),) * 6),
        replace(stated, noise_variance=None),
        replace(stated, friction={"presliding": 1e-4}),
        replace(stated, axis_delays=(0.001,) * 6),
        replace(stated, delay_variance=1e-9),
    ]
    assert len({settings_digest(one) for one in (stated, *others)}) == 1 + len(others)
    digest = settings_digest(stated)
    assert sum_key([a_ref(0), a_ref(1)], digest) != sum_key([a_ref(1), a_ref(0)], digest)


# Who does the work


@pytest.mark.slow
def test_a_task_that_kills_or_hangs_its_process_costs_itself() -> None:
    """The child knows functions by their module, so these are ready-made ones."""
    fine = ArchiveTask("fine.mcap", abs, (-2.0,))
    dead = ArchiveTask("dead.mcap", os._exit, (3,))
    slow = ArchiveTask("slow.mcap", time.sleep, (60.0,))
    wrong = ArchiveTask("wrong.mcap", int, ("no number",))
    finished: list[int] = []
    with LocalWorkers(2, timeout=4.0) as workers:
        found = list(workers.results([fine, dead, slow, wrong, fine], finished.append))
    assert sum(finished) == 5
    assert [found[0], found[4]] == [2.0, 2.0]
    broken = {one.path: one.reason for one in found if isinstance(one, Broken)}
    assert "ended its process, twice, with status 3" in broken["dead.mcap"]
    assert "took longer than 4 s" in broken["slow.mcap"]
    assert "ValueError" in broken["wrong.mcap"]
