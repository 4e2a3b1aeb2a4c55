"""An import in memory is what its archive contains once it is written."""

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.archive import (
    ImportedSamples,
    imported_archive,
    open_archive,
    write_archive,
    write_samples,
)
from hil.base.errors import ArchiveWriteError

JOINTS = ("shoulder", "elbow")
CHANNELS = ("velocity", "torque", "motor_current", "commanded_position")
WHAT = {
    "joint_names": JOINTS,
    "metadata": {"use": "excitation", "importer": "log"},
    "attachments": {"robot.urdf": b"<robot/>", "cell.toml": b"[cell]\n"},
}


def recorded(channels, count=2500, seed=0):
    rng = np.random.default_rng(seed)
    stamp = np.cumsum(rng.integers(1, 2_000_000, count))
    arrays = {name: rng.normal(size=(count, 2)) for name in ("position", *channels)}
    if "commanded_position" in arrays:
        arrays["commanded_position"][:3] = np.nan
    return ImportedSamples(stamp=stamp, **arrays)


def assert_same(mine, read):
    for field in fields(mine):
        if field.name not in ("columns", "path"):
            assert getattr(mine, field.name) == getattr(read, field.name), field.name
    assert set(mine.columns) == set(read.columns)
    for name, column in mine.columns.items():
        assert column.dtype == read.columns[name].dtype
        assert column.tobytes() == read.columns[name].tobytes()
        assert column.flags.c_contiguous and not column.flags.writeable


@settings(max_examples=20, deadline=None)
@given(st.sets(st.sampled_from(CHANNELS)), st.sampled_from([None, 0.001]))
def test_it_equals_the_archive_that_is_read(tmp_path_factory, channels, period):
    path = tmp_path_factory.mktemp("archives") / "log.mcap"
    samples = recorded(sorted(channels))
    mine = imported_archive(path, samples, period=period, **WHAT)
    write_samples(path, samples, period=period, **WHAT)
    assert_same(mine, open_archive(path))


def test_it_is_written_as_its_samples_are(tmp_path):
    samples = recorded(CHANNELS)
    mine = imported_archive(tmp_path / "a.mcap", samples, **WHAT)
    write_samples(tmp_path / "b.mcap", samples, **WHAT)
    write_archive(mine, tmp_path / "a.mcap")
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_it_does_not_change_with_the_arrays_it_was_made_of(tmp_path):
    samples = recorded(CHANNELS)
    mine = imported_archive(tmp_path / "a.mcap", samples, **WHAT)
    before = mine.columns["position"].copy()
    samples.position[:] = 0.0
    np.testing.assert_array_equal(mine.columns["position"], before)


def test_a_stamp_that_no_archive_stores_is_refused(tmp_path):
    samples = ImportedSamples(stamp=np.array([-1, 5]), position=np.zeros((2, 2)))
    with pytest.raises(ArchiveWriteError, match="outside 0"):
        imported_archive(tmp_path / "a.mcap", samples, **WHAT)
