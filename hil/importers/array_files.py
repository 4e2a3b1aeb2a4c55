"""Files of named arrays: numpy's, MATLAB's, Parquet, and messages in MCAP."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import IO, Any, Final, NamedTuple

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from hil.base.arrays import Array
from hil.base.errors import SourceError
from hil.base.safe_input import open_file
from hil.importers import mcap_messages
from hil.importers.column_map import Column
from hil.importers.conclusions import LeftOut, Omitted
from hil.importers.document_messages import ENCODINGS, columns_of_trees, trees
from hil.importers.json_samples import SUFFIXES as JSON
from hil.importers.json_samples import read_json
from hil.importers.matlab import (
    NUMERIC_DTYPE_KINDS,
    lost_bytes,
    mat_array,
    mat_shapes,
    script_matrices,
)
from hil.importers.ros_messages import MessageError, columns_of, decoded, typestore_of
from hil.importers.stated_units import without_unit

MAX_ELEMENTS: Final = 2**28
"""Elements of one array: 2 GiB of doubles, hours of an arm at 5 kHz."""

_MAX_NAMED_ARRAYS: Final = 30


class Stored(NamedTuple):
    """An array that is not yet read: its shape as stated in the file, and its reader."""

    shape: tuple[int, ...]
    load: Callable[[], NDArray[Any]]


class Contents(NamedTuple):
    """What a file holds."""

    arrays: dict[str, Stored]
    left_out: tuple[LeftOut, ...] = ()


def format_of(path: Path) -> str:
    """Return the suffix that determines the format of a file, of JSON also below ``.gz``."""
    suffix = path.suffix.lower()
    below = Path(path.stem).suffix.lower()
    return below if suffix == ".gz" and below in JSON else suffix


class ArrayFile:
    """Arrays of numbers with one or two dimensions, each read on first use.

    The suffix of the file determines its format, see `format_of`.

    Raises:
        SourceError: it cannot be read, or has no array of numbers.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with _readable(path):
            open_file(path).close()  # raises for a pipe, which would block
            contents = READERS[format_of(path)](path)
        self.left_out = contents.left_out
        self._stored = {
            name: array
            for name, array in contents.arrays.items()
            if len(array.shape) in (1, 2) and math.prod(array.shape) > 0
        }
        if not self._stored:
            raise SourceError(path, "has no array of numbers with one or two dimensions")
        self.names = tuple(self._stored)
        self._loaded: dict[str, NDArray[Any]] = {}

    @classmethod
    def in_memory(cls, path: Path, arrays: Mapping[str, NDArray[Any]]) -> ArrayFile:
        """Return arrays that were read already, as a file of this path would have them."""
        file = cls.__new__(cls)
        file.path = path
        contents = _in_memory(arrays)
        file.left_out = contents.left_out
        file._stored = contents.arrays
        file.names = tuple(file._stored)
        file._loaded = {}
        return file

    def has(self, name: str) -> bool:
        """Return whether an array has this name."""
        return name in self._stored

    def unit(self, column: Column) -> str | None:
        """Return the unit in the name of an array, None without one."""
        return without_unit(column)[1] if isinstance(column, str) else None

    def shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of an array."""
        return self._stored[name].shape

    def dtype(self, name: str) -> str:
        """Return the type of an array, which is read for it."""
        return self._array(name, "columns").dtype.name

    def numbers(
        self, columns: Sequence[Column], field: str, array: str | None, *, rows: bool = False
    ) -> Array:
        """Return columns side by side, shape (m, columns).

        Args:
            columns: arrays by name, or columns of a matrix by index.
            field: of the map, for errors.
            array: the matrix.
            rows: whether the indices are of its rows.

        Raises:
            SourceError: no such array or column, or arrays of different lengths.
        """
        parts = [_floats(self._column(name, field, array, rows=rows)) for name in columns]
        if len({len(part) for part in parts}) > 1:
            lengths = ", ".join(f"{c} {len(part)}" for c, part in zip(columns, parts, strict=True))
            problem = f"its arrays differ in length: {lengths}"
            raise SourceError(self.path, problem, field=field, remedy="cut them")
        return np.column_stack(parts)

    def matrix(self, name: str | None, field: str) -> Array:
        """Return an array as a matrix; without a name the only one there is, else SourceError."""
        return _floats(self._matrix(name, field))

    def times(
        self, column: Column, decimals: int, array: str | None = None
    ) -> Sequence[int | None]:
        """Return times as whole nanoseconds, None where one is missing.

        There are `decimals` decimal places between the unit and the second; dates in numpy's types
        need none. An index without `array` is of the only array there is.

        Raises:
            SourceError: no such array or column.
        """
        if isinstance(column, int) and array is None:
            times = self._array(None, "time").ravel()
        else:
            times = self._column(column, "time", array)
        factor = 10 ** (9 - decimals)
        if times.dtype.kind in "mM":
            kind = "datetime64[ns]" if times.dtype.kind == "M" else "timedelta64[ns]"
            stamps = times.astype(kind).astype(np.int64)
            missing = np.isnat(times)
            return [None if no else int(stamp) for stamp, no in zip(stamps, missing, strict=True)]
        if times.dtype.kind in "iu":
            return [int(time) * factor for time in times.tolist()]
        values = times.astype(np.float64)
        finite = np.isfinite(values)
        # Separately, since an epoch in nanoseconds has more digits than a float.
        whole = np.floor(np.where(finite, values, 0.0))
        part = np.rint((np.where(finite, values, 0.0) - whole) * float(factor))
        triples = zip(finite, whole, part, strict=True)
        return [int(w) * factor + int(p) if there else None for there, w, p in triples]

    def _column(
        self, column: Column, field: str, array: str | None, *, rows: bool = False
    ) -> NDArray[Any]:
        """Return one column or row (m,), in its own type."""
        if array is None and isinstance(column, str):
            vector = self._array(column, field)
            if vector.ndim == 2 and 1 not in vector.shape:
                problem = f"array {column!r} has the shape {vector.shape}"
                remedy = "give an array of one dimension, or one of its columns by index"
                raise SourceError(self.path, problem, field=field, remedy=remedy)
            return vector.ravel()
        matrix = self._matrix(array, field)
        matrix = matrix.T if rows else matrix
        if not isinstance(column, int) or column >= matrix.shape[1]:
            problem = (
                f"array {array or self.names[0]!r} has no {'row' if rows else 'column'} {column!r}"
            )
            remedy = f"it has {matrix.shape[1]}, counted from 0"
            raise SourceError(self.path, problem, field=field, remedy=remedy)
        return np.asarray(matrix[:, column])

    def _matrix(self, name: str | None, field: str) -> NDArray[Any]:
        array = self._array(name, field)
        return array[:, None] if array.ndim == 1 else array

    def _array(self, name: str | None, field: str) -> NDArray[Any]:
        """Return an array; without a name the only one there is."""
        name = self.names[0] if name is None and len(self.names) == 1 else name
        if name is None or name not in self._stored:
            problem = f"there is no array {name!r}" if name else "the name of the array is missing"
            shapes = [f"{key} {array.shape}" for key, array in self._stored.items()]
            remedy = f"its arrays are {', '.join(shapes[:_MAX_NAMED_ARRAYS])}"
            raise SourceError(self.path, problem, field=field, remedy=remedy)
        if name not in self._loaded:
            stored = self._stored[name]
            if math.prod(stored.shape) > MAX_ELEMENTS:
                problem = (
                    f"array {name!r} of shape {stored.shape} is too large to be read in one piece"
                )
                raise SourceError(self.path, problem, remedy="save the log in parts")
            with _readable(self.path):
                array = stored.load()
            if array.dtype.kind not in NUMERIC_DTYPE_KINDS or array.shape != stored.shape:
                raise SourceError(self.path, f"array {name!r} does not hold real numbers")
            self._loaded[name] = array
        return self._loaded[name]


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Convert any exception of numpy, scipy or zlib on a damaged file to `SourceError`."""
    try:
        yield
    except SourceError:
        raise
    except Exception as error:
        problem = f"cannot be read ({error or type(error).__name__})"
        remedy = "save the arrays again as .npz, without objects (MATLAB: save -v7)"
        raise SourceError(path, problem, remedy=remedy) from error


def _npz(path: Path) -> Contents:
    with zipfile.ZipFile(path) as archive:
        members = [name for name in archive.namelist() if name.endswith(".npy")]
        heads = {}
        for name in members:
            with archive.open(name) as stream:
                heads[name] = _head(stream)
    stored = {
        name.removesuffix(".npy"): Stored(head[0], partial(_member, path, name))
        for name, head in heads.items()
        if head is not None and head[1].kind in NUMERIC_DTYPE_KINDS
    }
    return Contents(stored)


def _member(path: Path, name: str) -> NDArray[Any]:
    with zipfile.ZipFile(path) as archive, archive.open(name) as stream:
        return np.asarray(npy.read_array(stream, allow_pickle=False))


def _npy(path: Path) -> Contents:
    array = np.load(path, mmap_mode="r", allow_pickle=False)
    if array.dtype.names:  # a structured array: one column per field
        return _in_memory({name: array[name] for name in array.dtype.names})
    return _in_memory({"array": array})


def _head(stream: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]] | None:
    """Return shape and type of the numbers in a .npy stream; None for an unknown version."""
    readers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    reader = readers.get(npy.read_magic(stream))
    if reader is None:
        return None
    shape, _, dtype = reader(stream)
    return shape, dtype


def _mat(path: Path) -> Contents:
    if lost := lost_bytes(path):
        problem = (
            f"its data are lost: it has the header of MATLAB 7.3, and then {lost} bytes that are "
            "all zero, as after an interrupted copy or on a full disk"
        )
        raise SourceError(path, problem, remedy="copy it again, or save it again in MATLAB")
    stored = {
        name: Stored(shape, partial(mat_array, path, name))
        for name, shape in mat_shapes(path).items()
    }
    return Contents(stored)


def read_mcap(path: Path) -> dict[str, NDArray[Any]]:
    """Return arrays by ``topic/field``, such as ``/joint_states/position`` (m, n).

    ``topic/stamp`` is the time of its messages [ns]: that of their header, or else the file's.

    Raises:
        SourceError: the file cannot be read, or has no topic that can be read this way.
    """
    topics, messages = mcap_messages.read(path, lambda _, topic: _is_readable(topic))
    refused = {
        name: f"{t} is neither ROS 2 nor JSON nor Protobuf"
        for name, t in topics.items()
        if not _is_readable(t)
    }
    by_topic: dict[str, list[tuple[int, bytes]]] = {}
    for name, stamp, data in messages:
        by_topic.setdefault(name, []).append((stamp, data))
    arrays: dict[str, NDArray[Any]] = {}
    for name, received in by_topic.items():
        topic = topics[name]
        try:
            columns = _columns(topic, received)
        except MessageError as error:
            refused[name] = str(error)
        else:
            arrays |= {f"{name}/{field}": column for field, column in columns.items()}
    if not arrays:
        reasons = "; ".join(f"{name}: {why}" for name, why in refused.items()) or "it has no topic"
        problem = f"has no topic whose messages can be read as columns ({reasons})"
        remedy = (
            "record joint states and currents as messages of ROS 2, JSON or Protobuf with "
            "constant names and lengths"
        )
        raise SourceError(path, problem, remedy=remedy)
    return arrays


def _is_readable(topic: mcap_messages.Topic) -> bool:
    return topic.is_ros2 or topic.encoding in ENCODINGS


def _floats(array: Any) -> Array:
    with np.errstate(invalid="ignore"):  # a signalling NaN is refused later, as any NaN
        floats: Array = array.astype(np.float64)
    return floats


def _columns(
    topic: mcap_messages.Topic, received: Sequence[tuple[int, bytes]]
) -> dict[str, NDArray[Any]]:
    """Return the columns of the messages of a topic; MessageError."""
    stamps = [stamp for stamp, _ in received]
    if topic.encoding in ENCODINGS:
        messages = [data for _, data in received]
        content = trees(topic.kind, topic.encoding, topic.definition, messages)
        return columns_of_trees(stamps, content)
    definition = topic.definition.decode(errors="replace")
    store = typestore_of(topic.kind, definition, topic.schema_encoding)
    return columns_of(stamps, [decoded(store, topic.kind, data) for _, data in received])


def _parquet(path: Path) -> Contents:
    """Return the columns of a table; lists of numbers, as LeRobot's, are matrices."""
    from pyarrow import parquet

    table = parquet.read_table(path)
    arrays = {}
    for name in table.column_names:
        values = table[name].to_numpy()
        if values.dtype == object and len(values) and isinstance(values[0], np.ndarray):
            values = _stacked(path, name, values)
        arrays[name] = _as_numbers(values)
    episodes = np.unique(arrays.get("episode_index", np.zeros(1)))
    if len(episodes) > 1:
        problem = f"has {len(episodes)} episodes, each with a clock that starts at zero"
        remedy = "save one of them as a file of its own"
        raise SourceError(path, problem, field="episode_index", remedy=remedy)
    return _in_memory(arrays)


def _stacked(path: Path, name: str, lists: NDArray[Any]) -> NDArray[Any]:
    """Return lists of equal length as a matrix, a list that is missing as NaN."""
    size = len(lists[0])
    odd = [row for row, part in enumerate(lists) if part is not None and len(part) != size]
    if odd:
        problem = f"row {odd[0]} has a list of {len(lists[odd[0]])} numbers, row 0 one of {size}"
        remedy = (
            f"leave such rows out when the table is saved: df[df[{name!r}].str.len() == {size}]"
        )
        raise SourceError(path, problem, field=name, remedy=remedy)
    return np.stack([np.full(size, np.nan) if part is None else part for part in lists])


def _as_numbers(values: NDArray[Any]) -> NDArray[Any]:
    """Return a column of text as numbers, NaN for other cells, if most cells are numbers."""
    if values.dtype != object:
        return values
    import pandas as pd  # 0.4 s

    numbers = np.asarray(pd.to_numeric(pd.Series(values), errors="coerce"), np.float64)
    return numbers if np.isfinite(numbers).mean() > 0.5 else values


def _json(path: Path) -> Contents:
    try:
        arrays, is_cut = read_json(path)
    except ValueError as error:
        problem = f"cannot be read ({error})"
        remedy = (
            "write an object with the same names for each sample, on a line of its own: "
            '{"t": 0.0, "q": [...], "tau": [...]}'
        )
        raise SourceError(path, problem, remedy=remedy) from error
    stored = _in_memory(arrays).arrays
    return Contents(stored, (LeftOut(Omitted.CUT_ROW, 1),) if is_cut else ())


def _in_memory(arrays: Mapping[str, NDArray[Any]]) -> Contents:
    stored = {
        name: Stored(array.shape, partial(np.asarray, array))
        for name, array in arrays.items()
        if array.dtype.kind in NUMERIC_DTYPE_KINDS
    }
    return Contents(stored)


READERS: Mapping[str, Callable[[Path], Contents]] = {
    ".npz": _npz,
    ".npy": _npy,
    ".mat": _mat,
    ".m": lambda path: _in_memory(script_matrices(path)),
    ".parquet": _parquet,
    ".mcap": lambda path: _in_memory(read_mcap(path)),
    **dict.fromkeys(JSON, _json),
}
"""Readers of files of arrays by suffix; every other file is text in columns."""
