"""Parts of the batch by themselves: what is kept, how sums are made, who does the work."""

from __future__ import annotations

import operator
import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.batch.cache import Store, Where, decoded, encoded
from hil.batch.cache_codec import settings_from, settings_header
from hil.batch.errors import CacheError
from hil.batch.keeping import BUNDLE, bundles
from hil.batch.keys import arm_digest, settings_digest, sum_key
from hil.batch.local import LocalWorkers
from hil.batch.on_workers import ArchiveTask, Part
from hil.batch.tree import sum_tree
from hil.batch.tree_sum import TreeSum
from hil.batch.types import ArchiveRef, Broken
from hil.cell import Cell
from hil.cell.schema import PayloadTable, RobotTable, TorsionSpringTable
from hil.identify.settings import Settings
from identification.estimators.shrinkage import Shrinkage
from identification.selection.inner_prediction import Choice
from identification.signals.low_passes import LowPassShape
from identification.signals.samples import Preprocessing
from sim_fixtures.ns16 import CELL_PATH

KEY = "0123456789abcdef"


def a_ref(index: int, campaign: str = "/data/one") -> ArchiveRef:
    name = f"{campaign}/archives/excitation_{index:03d}_a1.mcap"
    return ArchiveRef(name, f"{index:064x}", "excitation", "arm", campaign, index, "cell", "motion")


# Sums


@given(st.lists(st.none() | st.floats(-1e6, 1e6), max_size=200))
def test_a_sum_of_terms_that_come_one_by_one_is_that_of_the_tree(terms: list[float | None]) -> None:
    sums = TreeSum[float]()
    for term in terms:
        sums.add(term)
    assert sums.result() == sum_tree(terms, lambda a, b: a + b)  # to the last bit


def test_many_terms_are_not_kept() -> None:
    sums = TreeSum[float]()
    for _ in range(8**4 + 5):
        sums.add(1.0)
    assert len(sums._levels) == 5
    assert sums.result() == 8**4 + 5


@given(st.permutations(range(40)))
def test_bundles_do_not_depend_on_the_order_of_archives(order: list[int]) -> None:
    found = bundles([a_ref(k) for k in order])
    assert [len(one) for one in found] == [BUNDLE, BUNDLE, 40 - 2 * BUNDLE]
    assert [ref.index for one in found for ref in one] == list(range(40))


# What is kept


@given(st.data())
def test_an_entry_with_one_wrong_bit_is_none(data: st.DataObject) -> None:
    whole = encoded(KEY, {"a": [1.5, "x"]}, {"values": np.arange(7.0), "none": np.zeros((0, 3))})
    entry = decoded(whole, KEY)
    assert entry is not None
    assert entry.header == {"a": [1.5, "x"]}
    assert entry.arrays["values"].tobytes() == np.arange(7.0).tobytes()
    assert entry.arrays["none"].shape == (0, 3)
    bit = data.draw(st.integers(0, 8 * len(whole) - 1))
    damaged = bytearray(whole)
    damaged[bit // 8] ^= 1 << bit % 8
    assert decoded(bytes(damaged), KEY) is None
    assert decoded(whole[: data.draw(st.integers(0, len(whole) - 1))], KEY) is None
    assert decoded(whole, KEY[::-1]) is None


def test_a_store_that_cannot_be_written_to_is_an_error_with_a_remedy(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(CacheError, match="--cache"):
        Store(tmp_path / "file").put(KEY, {})
    assert Store(tmp_path / "file").get(KEY) is None


def test_archives_of_a_folder_share_a_store_wherever_it_is(tmp_path: Path) -> None:
    here, there = str(tmp_path / "a.mcap"), str(tmp_path / "b.mcap")
    for where in (Where(), Where(str(tmp_path / "elsewhere"))):
        assert where.store(here) == where.store(there)
        assert where.store(here) != where.store(str(tmp_path / "sub" / "a.mcap"))
    assert Where().store(here).folder == tmp_path / ".hil-cache"
    remote = Where(str(tmp_path)).store("s3://bucket/one/a.mcap")
    assert remote.folder.parent == tmp_path


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
    plain = Settings(Preprocessing(torque_delay=0.002), noise_variance=(1e-9,) * 6)
    for_the_estimate = replace(
        plain, shrinkage=Shrinkage(0.1), choices=(Choice("rows", (), (), 0),)
    )
    assert settings_digest(plain) == settings_digest(for_the_estimate)
    others = [
        plain.preprocessed(smoother="butterworth"),
        plain.preprocessed(torque_delay=0.004),
        plain.preprocessed(torque_bandwidth=30.0),
        replace(plain, noise_variance=(1e-9 * (1 + 2e-16),) * 6),
        replace(plain, noise_variance=None),
        replace(plain, friction={"presliding": 1e-4}),
        replace(plain, axis_delays=(0.001,) * 6),
        replace(plain, delay_variance=1e-9),
    ]
    assert len({settings_digest(one) for one in (plain, *others)}) == 1 + len(others)
    digest = settings_digest(plain)
    assert sum_key([a_ref(0), a_ref(1)], digest) != sum_key([a_ref(1), a_ref(0)], digest)


def test_settings_are_kept_to_the_last_bit() -> None:
    settings = Settings(
        Preprocessing(torque_bandwidth=1.0 / 3.0, torque_shape=LowPassShape(2, causal=True)),
        friction={"presliding": 1e-4, "third": "none"},
        noise_variance=(1e-9 / 3.0,) * 6,
        shrinkage=Shrinkage(np.inf),
        choices=(Choice("rows", ("slow", "rests"), (0.1, np.inf), 0),),
    )
    entry = decoded(encoded(KEY, settings_header(settings), {}), KEY)
    assert entry is not None
    assert settings_from(entry.header) == settings
    assert settings_from(entry.header | {"preprocessing": {"smoother": "none"}}) is None
    assert settings_from({"smoother": "spline", "torque_delay": 0.0}) is None


# Who does the work


@pytest.mark.slow
def test_a_task_that_kills_or_hangs_its_process_costs_itself() -> None:
    """The child knows functions by their module, so these are ready-made ones."""
    fine = ArchiveTask("fine.mcap", Part, (2.0, "note"))
    dead = ArchiveTask("dead.mcap", os._exit, (3,))
    slow = ArchiveTask("slow.mcap", time.sleep, (60.0,))
    wrong = ArchiveTask("wrong.mcap", int, ("no number",))
    counted: list[int] = []
    with LocalWorkers(2, timeout=4.0) as workers:
        (found,) = workers.sums(
            [[fine, dead, slow, wrong, fine]], operator.add, done=counted.append
        )
    assert sum(counted) == 5
    assert [found.notes[0], found.notes[4], found.total] == ["note", "note", 4.0]
    broken = {note.path: note.reason for note in found.notes if isinstance(note, Broken)}
    assert "ended its process" in broken["dead.mcap"]
    assert "took longer than 4 s" in broken["slow.mcap"]
    assert "ValueError" in broken["wrong.mcap"]
