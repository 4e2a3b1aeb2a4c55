"""Parts of an archive: columns, channels and times, without decoding the rest."""

from __future__ import annotations

from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.cycle_records import cycle_dtype
from hil.archive import ArchiveWriter, ImportedSamples, open_archive, write_samples
from hil.archive.check import check_archive
from hil.archive.repair import repair
from tests.hil.archive.conftest import FIRST, peak

PERIOD = 0.01


def within(cycle: np.ndarray, start: float | None, stop: float | None) -> np.ndarray:
    """Which cycles lie in the range [s]."""
    begin = 0 if start is None else round(start * 1e9)
    end = 10**18 if stop is None else round(stop * 1e9)
    return (cycle * 10_000_000 >= begin) & (cycle * 10_000_000 < end)


instants = st.none() | st.floats(49.5, 51.0) | st.integers(4999, 5050).map(lambda c: c * PERIOD)


class TestTimes:
    @pytest.mark.long
    @given(instants, instants, st.booleans(), st.sampled_from([0, 1 << 20]))
    def test_range_selects_samples_and_events(self, written, start, stop, truncated, batch):
        """Of a truncated file what is left."""
        path = written.path
        sound = 43
        if truncated:
            path = path.with_name("truncated.mcap")
            sound = 30
            path.write_bytes(written.data[: written.chunks[3].offset])
        with mock.patch("hil.archive.scan._BATCH_BYTES", batch):  # bytes of chunks decoded at once
            archive = open_archive(path, start=start, stop=stop)
        chosen = within(written.rows["cycle"], start, stop) & (np.arange(43) < sound)
        assert np.array_equal(archive.columns["cycle"], written.rows["cycle"][chosen])
        assert np.array_equal(archive.columns["position"], written.rows["position"][chosen])
        starts = np.array([0, 15, 30])
        inside = starts[within(FIRST + starts, start, stop) & (starts < sound)]
        assert [event.data["start"] for event in archive.events] == inside.tolist()
        assert archive.complete != truncated

    def test_damage_outside_the_range_is_not_read(self, written, path):
        """It stops a full reading; so does one within, and a damaged summary is ignored."""
        at = written.records[-1].end + 40
        summary = written.data[:at] + bytes([written.data[at] ^ 1]) + written.data[at + 1 :]
        for data, cycles, complete in (
            (written.changed(written.chunks[1], -5), range(20, 43), True),
            (written.changed(written.chunks[3], -5), [*range(20, 30), *range(40, 43)], False),
            (summary, range(20, 43), False),
        ):
            path.write_bytes(data)
            assert not open_archive(path).complete
            archive = open_archive(path, start=50.2)
            assert archive.complete == complete
            assert np.array_equal(archive.columns["cycle"], FIRST + np.array(cycles))

    def test_stamps_that_run_backwards_are_selected_one_by_one(self, tmp_path):
        stamp = np.array([5, 9, 1, 7, 3], np.int64) * 10**9
        position = np.arange(5.0)[:, None]
        path = write_samples(
            tmp_path / "x.mcap", ImportedSamples(stamp, position), joint_names=("a",), metadata={}
        )
        archive = open_archive(path, start=3.0, stop=8.0)
        assert archive.columns["position"][:, 0].tolist() == [0.0, 3.0, 4.0]


CYCLES = 8_000
CONTENT = CYCLES * 1100  # bytes of messages, about
WORK = 3_000_000


@pytest.fixture(scope="module")
def long(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rows = np.zeros(CYCLES, cycle_dtype(6))
    rows["cycle"] = np.arange(CYCLES)
    rows["position"] = np.random.default_rng(1).normal(size=(CYCLES, 6))
    file = tmp_path_factory.mktemp("memory") / "move_000_a1.mcap"
    names = tuple(f"joint_{i}" for i in range(6))
    with ArchiveWriter(file, joint_names=names, period=0.001, metadata={}, durable=False) as w:
        for start in range(0, CYCLES, 1000):
            w.write(rows[start : start + 1000])
        w.close("completed")
    return file


@pytest.mark.long
def test_work_holds_little_more_than_the_part(long):
    """Checks and repairs hold a chunk at a time."""
    column = CYCLES * 8
    assert CONTENT > 2.5 * WORK
    assert peak(lambda: open_archive(long, fields=["cycle"])) < 3 * column + WORK
    assert peak(lambda: open_archive(long, start=1.0, stop=1.1)) < WORK
    assert peak(lambda: check_archive(long)) < WORK
    truncated = long.with_name("truncated.mcap")
    truncated.write_bytes(long.read_bytes()[:-5000])
    assert peak(lambda: repair(truncated)) < WORK
