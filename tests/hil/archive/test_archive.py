"""Archives as they are written and read back: names, content, chunks, determinism."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from drivers.cycle_records import cycle_dtype
from hil.archive import (
    KINDS,
    ArchiveName,
    ArchiveWriter,
    Level,
    header,
    open_archive,
    schema,
    verified_records,
)
from hil.archive.check import check_archive
from hil.base.errors import ArchiveError, ArchiveVersionError, ArchiveWriteError

JOINTS = ("joint_1", "joint_2", "joint_3")
ATTACHMENTS = {"cell.toml": b"[cell]\n", "robot.urdf": b"<robot/>" * 50}
NAME = "excitation_007_a2.mcap"


def records(count: int, seed: int = 0, first: int = 12_000) -> NDArray[np.void]:
    """Cycle records with random content in every field."""
    rng = np.random.default_rng(seed)
    rows = np.zeros(count, cycle_dtype(len(JOINTS)))
    for name in rows.dtype.names or ():
        shape = rows[name].shape
        if rows[name].dtype.kind == "f":
            rows[name] = rng.normal(size=shape)
        else:
            rows[name] = rng.integers(0, 200, shape)
    rows["gap"] = 0
    rows["cycle"] = first + np.arange(count)
    rows["commanded_position"][:2] = np.nan
    return rows


def same(a: NDArray[np.void], b: NDArray[np.void]) -> bool:
    """Whether two sets of records are equal to the bit in every field (padding is ignored)."""
    return a.dtype == b.dtype and all(
        a[name].tobytes() == b[name].tobytes() for name in a.dtype.names or ()
    )


def torques(rows: NDArray[np.void]) -> NDArray[np.float64]:
    return 60.0 * rows["target_current"]


def writer(path: Path, **changes: object) -> ArchiveWriter:
    settings: dict[str, object] = {
        "joint_names": JOINTS,
        "period": 0.001,
        "metadata": {"campaign": "c1", "simulated": "yes"},
        "attachments": ATTACHMENTS,
        "durable": False,
    }
    return ArchiveWriter(path, **{**settings, **changes})  # type: ignore[arg-type]


def write(path: Path, rows: NDArray[np.void], *edges: int) -> Path:
    """An archive of these records, which come in portions that end at the edges."""
    with writer(path) as archive:
        for start, stop in zip((0, *edges), (*edges, len(rows)), strict=True):
            archive.write(rows[start:stop], torques(rows[start:stop]))
        archive.close("completed")
    return path


def chunks(path: Path) -> int:
    with path.open("rb") as stream:
        walked = verified_records.records(stream, path.stat().st_size)
        return sum(record.opcode == verified_records.CHUNK for record in walked)


class TestNames:
    @given(st.sampled_from(KINDS), st.integers(0, 10**6), st.integers(1, 99))
    def test_a_name_is_parsed_to_what_it_was_made_of(self, kind, index, attempt):
        name = ArchiveName(kind, index, attempt)
        assert ArchiveName.parse(Path("somewhere") / name) == name
        assert str(ArchiveName("excitation", 7)) == "excitation_007_a1.mcap"

    @pytest.mark.parametrize(
        "name", ["excitation.mcap", "dance_001_a1.mcap", "move_1_a1.mcap", "move_001_a0.mcap", "x"]
    )
    def test_other_names_are_refused(self, name):
        assert ArchiveName.parse(name) is None


class TestRoundTrip:
    def test_records_and_metadata_are_read_back(self, tmp_path):
        rows = records(257)
        path = write(tmp_path / NAME, rows)
        archive = open_archive(path)
        assert archive.complete and archive.missing is None
        assert same(archive.cycles(), rows)
        assert np.array_equal(archive.columns["torque"], torques(rows))
        for column in archive.columns.values():
            assert column.flags.c_contiguous and not column.flags.writeable
        assert (archive.joint_names, archive.period) == (JOINTS, 0.001)
        assert archive.attachments == ATTACHMENTS
        expected = {"kind": "excitation", "index": "7", "attempt": "2", "campaign": "c1"}
        assert expected.items() <= archive.header.entries.items()
        some = open_archive(path, fields=["position", "torque"])
        assert set(some.columns) == {"stamp", "position", "torque"}
        with pytest.raises(ArchiveError, match="no column"):
            some.cycles()

    def test_the_outcome_counts_what_was_written(self, tmp_path):
        rows = records(120)
        rows["gap"][[30, 110]] = 2
        with writer(tmp_path / NAME) as archive:
            archive.write(rows, torques(rows))
            archive.close("stopped", reason="Ctrl-C", details={"operator": "me"})
        assert open_archive(tmp_path / NAME).outcome.entries == {
            "outcome": "stopped", "reason": "Ctrl-C", "operator": "me", "samples": "120",
            "events": "0", "lost_packets": "4", "first_cycle": "12000", "last_cycle": "12119",
        }  # fmt: skip
        assert check_archive(tmp_path / NAME).conforms

    def test_cycles_or_torques_may_be_missing(self, tmp_path):
        """An unknown torque is NaN; the default outcome is ``unknown``."""
        archive = open_archive(write(tmp_path / NAME, records(0)))
        assert archive.complete and archive.n_samples == 0
        with writer(tmp_path / "excitation_008_a1.mcap") as bare:
            bare.write(records(5))
        archive = open_archive(bare.path)
        assert np.isnan(archive.columns["torque"]).all()
        assert archive.outcome.outcome == "unknown"

    def test_events_are_read_back_with_text_and_data(self, tmp_path):
        """Data that JSON cannot represent are converted."""
        data = {"value": np.nan, "last": np.arange(3.0), "pair": (1, np.int64(2)), 5: Path("x")}
        with writer(tmp_path / NAME) as archive:
            archive.event(500, "Refused", "too\nfast", level=Level.ERROR, data=data)  # type: ignore[arg-type]
            archive.write(records(250), None)
            archive.event(None, "MotionEnded", "the end")
            archive.close("refused")
        first, last = open_archive(tmp_path / NAME).events
        assert (first.time, first.name, first.text) == (0.5, "Refused", "too fast")
        assert first.level == Level.ERROR
        assert first.data == {"value": None, "last": [0.0, 1.0, 2.0], "pair": [1, 2], "5": "x"}
        assert (last.time, last.text, last.data) == (pytest.approx(12.249), "the end", {})


class TestChunks:
    @pytest.mark.safety
    @given(st.lists(st.integers(1, 260), min_size=1, max_size=12))
    def test_bytes_do_not_depend_on_the_batches(self, tmp_path_factory, batches):
        folder = tmp_path_factory.mktemp("bytes")
        rows = records(600)
        whole = write(folder / NAME, rows).read_bytes()
        (folder / NAME).unlink()
        edges = [int(edge) for edge in np.cumsum(batches) if edge < 600]
        assert write(folder / NAME, rows, *edges).read_bytes() == whole

    def test_end_every_100_ms_of_the_controllers_time(self, tmp_path):
        """Lost cycles make one shorter, and none later."""
        assert chunks(write(tmp_path / NAME, records(1001))) == 11
        gapped = np.delete(records(300), slice(150, 250))
        assert chunks(write(tmp_path / "move_000_a1.mcap", gapped)) == 3

    def test_flush_writes_an_incomplete_one(self, tmp_path):
        archive = writer(tmp_path / NAME)
        archive.write(records(130))
        assert open_archive(tmp_path / NAME).n_samples == 100
        archive.flush()
        assert open_archive(tmp_path / NAME).n_samples == 130
        archive.close("completed")
        with pytest.raises(ArchiveWriteError, match="is closed"):
            archive.write(records(1, first=430))


class TestBadInput:
    @pytest.mark.parametrize(
        ("name", "metadata", "sentence"),
        [
            (f"nowhere/{NAME}", {}, r"nowhere.*cannot be created: No such file"),
            (NAME, {"kind": "validation"}, "'validation', but 'excitation' in the file name"),
            ("x.mcap", {}, "None is not a kind of archive; use standstill"),
        ],
    )
    def test_invalid_archive_leaves_no_file(self, tmp_path, name, metadata, sentence):
        """And an existing file is never overwritten."""
        with pytest.raises(ArchiveWriteError, match=sentence):
            writer(tmp_path / name, metadata=metadata)
        assert not (tmp_path / name).exists()
        (tmp_path / NAME).write_bytes(b"precious")
        with pytest.raises(ArchiveWriteError, match=r"exists already.*never overwritten"):
            writer(tmp_path / NAME)
        assert (tmp_path / NAME).read_bytes() == b"precious"

    def test_records_of_another_arm_or_session_are_refused(self, tmp_path):
        rows = records(100)
        falling = records(100, first=12_100)
        falling["cycle"][60:] -= 30
        refused = [
            (records(100, first=first), f"cycle {first} follows cycle 12099")
            for first in (12000, 12099, 0)
        ]
        with writer(tmp_path / NAME) as archive:
            with pytest.raises(ValueError, match="are expected"):
                archive.write(np.zeros(3, cycle_dtype(6)))
            archive.write(rows[:0])
            archive.write(rows, torques(rows))
            for others, why in [*refused, (falling, "cycle 12130 follows cycle 12159")]:
                with pytest.raises(ArchiveWriteError, match=rf"{why}.*begin another archive"):
                    archive.write(others)
            archive.close("completed")
        back = open_archive(tmp_path / NAME)
        assert back.complete
        assert same(back.cycles(), rows)

    def test_records_without_a_state_to_archive_are_refused(self, tmp_path):
        with (
            writer(tmp_path / NAME, states=(schema.UR_STATE,)) as archive,
            pytest.raises(ValueError, match=schema.UR_STATE),
        ):
            archive.write(records(3))

    def test_full_disk_leaves_what_was_flushed(self, tmp_path, monkeypatch):
        rows = records(500)
        archive = writer(tmp_path / NAME)
        archive.write(rows[:250], torques(rows[:250]))

        def full(descriptor, data):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        monkeypatch.setattr(os, "write", full)
        with pytest.raises(ArchiveWriteError, match="No space left on device; what was flushed"):
            archive.write(rows[250:], torques(rows[250:]))
        monkeypatch.undo()
        assert archive.file.closed
        back = open_archive(tmp_path / NAME)
        assert same(back.cycles(), rows[:200])
        assert back.damage is not None

    def test_exception_closes_the_archive_and_is_its_reason(self, tmp_path):
        with pytest.raises(RuntimeError), writer(tmp_path / NAME) as archive:
            archive.write(records(30))
            raise RuntimeError("cable pulled")
        outcome = open_archive(tmp_path / NAME).outcome
        assert (outcome.outcome, outcome.samples) == ("interrupted", 30)
        assert outcome.reason == "RuntimeError: cable pulled"

    def test_later_version_is_refused(self, tmp_path, monkeypatch):
        monkeypatch.setattr("hil.archive.writer.FORMAT_VERSION", 9)
        write(tmp_path / NAME, records(5))
        with pytest.raises(ArchiveVersionError, match="version 9; this software reads version 1"):
            open_archive(tmp_path / NAME)


def test_archive_of_an_earlier_version_with_ages_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cycles had the age of each value, for links that sent some in turn; it is a column."""
    rows = records(300)
    aged = np.zeros(len(rows), [*rows.dtype.descr, ("age", "<u2", (8,))])
    for name in rows.dtype.names:
        aged[name] = rows[name]
    aged["age"] = np.arange(8)
    monkeypatch.setattr(schema, "_CYCLE", schema._CYCLE + "uint16[8] age\n")
    schema.profile.cache_clear()
    path = write(tmp_path / NAME, aged)
    monkeypatch.undo()
    schema.profile.cache_clear()
    archive = open_archive(path)
    assert archive.complete
    np.testing.assert_array_equal(archive.columns["age"], aged["age"])
    assert same(archive.cycles(), rows)
    assert check_archive(path).conforms


def test_documentation_shows_the_messages() -> None:
    page = Path(__file__).parents[3] / "docs" / "archive-format.md"
    text = page.read_text(encoding="utf-8")
    profile = schema.profile(6)
    for definition in (profile[topic].definition for topic in (schema.CYCLE, schema.MOTOR_CURRENT)):
        assert definition.partition("=" * 80)[0].strip() in text
    for topic in (schema.CYCLE, schema.MEASURED, schema.COMMANDED, schema.EVENTS):
        assert f"`{topic}`" in text
    assert f"version {header.FORMAT_VERSION}" in text.splitlines()[0]
    assert all(f"`{kind}`" in text for kind in KINDS)
