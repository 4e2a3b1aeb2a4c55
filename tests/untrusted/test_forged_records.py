"""What is kept between runs, sealed rightly and put together by somebody: it counts as absent."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from hil.archive import Archive
from hil.batch.cache import Where
from hil.batch.cache_codec import phase_entry, summary_entry
from hil.batch.keeping import _Shelf, kept_bundle
from hil.batch.keys import settings_digest, sum_key, summary_key
from hil.batch.types import ArchiveRef, Bundle, Fit, Summary
from hil.errors import ArchiveError
from hil.identify.settings import Settings
from hil.study.analysis import class_in
from hil.study.records import Record, read_record, write_record
from identification.excitation import Journal, SearchSettings
from identification.factor.factor import Estimate
from identification.factor.phases import PhaseFactor
from identification.signals.samples import Preprocessing
from tests.identification.searching import problem

# What a batch keeps

NAMES = ("a", "b", "c")
SETTINGS = Settings(Preprocessing())
Doctored = Callable[[dict[str, Any], dict[str, Any]], object]


def a_factor() -> PhaseFactor:
    columns = (np.array([2, 0]), np.array([1]))
    gram = tuple(np.ones((3, len(one) + 1, len(one) + 1)) for one in columns)
    return PhaseFactor(gram, columns, np.ones((3, 2), dtype=np.intp), NAMES)


def a_summary(ref: ArchiveRef) -> Summary:
    estimate = Estimate(
        *(NAMES, ("kg", "m", "N"), np.ones(3), np.eye(3), np.ones(2)),
        *(np.full(2, 7), "weighted least squares", 3.0),
    )
    fits = {"weighted": Fit(estimate, 1.0), "ordinary": Fit(estimate, 1.0)}
    return Summary(ref, a_factor(), fits, 2.0, ("a doubt",))


@pytest.fixture
def shelf(tmp_path: Path) -> tuple[ArchiveRef, Where]:
    """A bundle of one archive, kept."""
    where = Where(str(tmp_path / "kept"))
    location = str(tmp_path / "excitation_000_a1.mcap")
    ref = ArchiveRef(location, "0" * 64, "excitation", "arm", "campaign", 0, "cell", "motion")
    _Shelf((ref,), SETTINGS, where).put(Bundle((ref,), (a_summary(ref),), a_factor()))
    return ref, where


def test_what_was_kept_is_what_was_put_there(shelf: tuple[ArchiveRef, Where]) -> None:
    ref, where = shelf
    found = kept_bundle((ref,), SETTINGS, where)
    assert found is not None
    assert found.phase is not None
    (summary,) = found.summaries
    for ours, theirs in ((found.phase, a_factor()), (summary.total, a_factor())):
        assert phase_entry(ours, "")[0] == phase_entry(theirs, "")[0]
        for a, b in zip(ours.gram, theirs.gram, strict=True):
            np.testing.assert_array_equal(a, b)
    assert summary_entry(summary)[0] == summary_entry(a_summary(ref))[0]


def header(key: str, value: object) -> Doctored:
    return lambda header, _: header.__setitem__(key, value)


def array(key: str, made: Callable[[Any], Any]) -> Doctored:
    return lambda _, arrays: arrays.__setitem__(key, made(arrays[key]))


def word(key: str, value: object) -> Doctored:
    return lambda header, _: header["fits"]["weighted"].__setitem__(key, value)


SHAPES: dict[str, Callable[[Any], Any]] = {
    "nothing": lambda a: a[:0],
    "one less": lambda a: a[:-1],
    "twice as long": lambda a: np.concatenate([a, a]),
    "one dimension more": lambda a: a[None],
    "half as precise": lambda a: a.astype(f"{a.dtype.kind}4"),
}
SUMS: dict[str, Doctored] = {
    "no joint": header("joints", 0),
    "a joint too many": header("joints", 3),
    "no whole number of joints": header("joints", 1.5),
    "a joint's number as a truth": header("joints", True),
    "without end": header("joints", 10**30),
    "no names": header("names", None),
    "a name less": header("names", ["a", "b"]),
    "other names": header("names", ["a", "b", "d"]),
    "names that are none": header("names", [1, 2, 3]),
    "a column that is no parameter": array("columns0", lambda a: a + 1),
    "a column before the first": array("columns0", lambda a: a - 1),
    "a column twice": array("columns0", lambda a: a * 0),
    "another column": array("columns1", lambda a: a * 0),
    "no sum of a joint": lambda _, arrays: arrays.pop("gram1"),
} | {f"{n}: {how}": array(n, f) for n in ("gram0", "columns1") for how, f in SHAPES.items()}
SUMMARIES: dict[str, Doctored] = {
    "no sum": header("total.joints", None),
    "no fits": header("fits", {}),
    "fits that are none": header("fits", [1]),
    "another fit": lambda header, _: header["fits"].__setitem__("other", {}),
    "a time before the beginning": header("duration", -1.0),
    "no end": header("duration", float("inf")),
    "a time in words": header("duration", "1"),
    "doubts that are none": header("doubts", [1]),
    "a reason that is none": header("broken", {}),
    "names of another arm": word("names", ["a", "b", "d"]),
    "a unit less": word("units", ["kg"]),
    "no method": word("method", None),
    "no condition": word("condition", None),
    "no factor": word("interval_factor", None),
    "an effect in words": word("design_effect", "x"),
    "undetermined is one word": word("undetermined", "abc"),
} | {
    f"{name}: {how}": array(f"weighted.{name}", made)
    for name in ("values", "covariance", "noise_std", "samples")
    for how, made in SHAPES.items()
}


def doctor(ref: ArchiveRef, where: Where, key: str, change: Doctored) -> None:
    store = where.store(ref.location)
    entry = store.get(key)
    assert entry is not None
    header, arrays = json.loads(json.dumps(entry.header)), dict(entry.arrays)
    change(header, arrays)
    store.put(key, header, arrays)
    assert store.get(key) is not None  # sealed as it should be


@pytest.mark.parametrize("how", SUMS)
def test_a_sum_that_fits_no_model_or_not_its_summaries_is_made_anew(
    how: str, shelf: tuple[ArchiveRef, Where]
) -> None:
    ref, where = shelf
    doctor(ref, where, sum_key((ref,), settings_digest(SETTINGS)), SUMS[how])
    assert kept_bundle((ref,), SETTINGS, where) is None


@pytest.mark.parametrize("how", SUMMARIES)
def test_a_summary_that_does_not_fit_is_made_anew(
    how: str, shelf: tuple[ArchiveRef, Where]
) -> None:
    ref, where = shelf
    doctor(ref, where, summary_key(ref, settings_digest(SETTINGS)), SUMMARIES[how])
    assert kept_bundle((ref,), SETTINGS, where) is None


def test_what_is_no_folder_keeps_nothing_and_stops_nothing(tmp_path: Path) -> None:
    (tmp_path / ".hil-cache").write_text("not a folder")
    store = Where().store(str(tmp_path / "excitation_000_a1.mcap"))
    assert tmp_path not in store.folder.parents


# Records of a study


def test_a_study_reads_its_archives_again_where_a_record_does_not_fit(tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    write_record(path, Record(inputs="digest"))
    assert read_record(path, Record, "digest") is not None
    assert read_record(path, Record, "another digest") is None
    for content in ('{"inputs": 1}', '{"inputs": "digest", "more": 1}', "[" * 10_000, "\0"):
        path.write_text(content)
        assert read_record(path, Record, "digest") is None


def test_a_plan_whose_moves_are_none_is_told_with_its_archive(tmp_path: Path) -> None:
    path = tmp_path / "validation_000_a1.mcap"
    plan = json.dumps({"moves": [{"target": "x"}]}).encode()
    archive = cast("Archive", SimpleNamespace(path=path, attachments={"plan.json": plan}))
    with pytest.raises(ArchiveError, match="its plan cannot be read") as told:
        class_in(archive)
    assert str(path) in str(told.value)


# What a search keeps


def test_a_journal_full_of_forged_frames_is_read_in_time_that_grows_as_it_does(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    file = BytesIO()
    Journal(file, problem(), SearchSettings(population=4, generations=3))
    frame = 12 + len(b"\x93NUMPY")
    count = 2_000
    for k in range(count):  # each claims all that follows
        length = frame * (count - k) - 12
        file.write(length.to_bytes(8, "little") + bytes(4) + b"\x93NUMPY")
    summed, crc32 = [], zlib.crc32

    def counted(data: bytes) -> int:
        summed.append(len(data))
        return crc32(data)

    monkeypatch.setattr(zlib, "crc32", counted)
    Journal(file, problem(), SearchSettings(population=4, generations=3))
    assert sum(summed) < 8 * len(file.getvalue())
