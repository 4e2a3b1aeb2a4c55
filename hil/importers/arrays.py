"""Files of named arrays: .npz and .npy of numpy, .mat and .m of MATLAB, ROS 2 messages in MCAP."""

from __future__ import annotations

import atexit
import math
import re
import resource
import threading
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import IO, Any, Final, NamedTuple, ParamSpec, TypeVar

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray
from scipy.io import loadmat, whosmat
from scipy.io.matlab import varmats_from_mat

from hil.archive.cdr import LayoutError, MessageLayout, layout_of
from hil.errors import SourceError
from hil.importers import mcap_messages
from hil.importers.column_map import Column
from hil.reading import open_file, read_text
from planner.errors import PlannerCrashed, PlanningTimedOut
from planner.worker import WorkerProcess

Array = NDArray[np.float64]
P = ParamSpec("P")
T = TypeVar("T")

MOST_NUMBERS: Final = 2**28
"""Elements of one array: 2 GiB of doubles, hours of an arm at 5 kHz."""

_NUMBERS: Final = "fiubmM"
_MATLAB_NUMBERS: Final = {"double", "single", "logical"} | {
    f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)
}
_MATLAB_NESTED: Final = ("struct", "cell", "object")
_MOST_NAMED: Final = 30
_ASSIGNED: Final = re.compile(r"\b([A-Za-z]\w*)\s*=\s*\[([^\[\]]*)\]")
_COMMENT: Final = re.compile(r"[%#].*")
_MEMORY: Final = 8 * 2**30  # bytes of the process that reads a .mat: the largest array and its copy
_TIMEOUT: Final = 120.0  # s


class Stored(NamedTuple):
    """An array that is not yet read: its shape as stated in the file, and its reader."""

    shape: tuple[int, ...]
    load: Callable[[], NDArray[Any]]


class ArrayFile:
    """Arrays of numbers with one or two dimensions, each read on first use.

    The suffix of the file determines its format.

    Raises:
        SourceError: it cannot be read, or has no array of numbers.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with _readable(path):
            open_file(path).close()  # raises for a pipe, which would block
            found = READERS[path.suffix.lower()](path)
        self._stored = {
            name: array
            for name, array in found.items()
            if len(array.shape) in (1, 2) and math.prod(array.shape) > 0
        }
        if not self._stored:
            raise SourceError(path, "has no array of numbers with one or two dimensions")
        self.names = tuple(self._stored)
        self._loaded: dict[str, NDArray[Any]] = {}

    def numbers(
        self, columns: Sequence[Column], field: str, array: str | None, *, rows: bool = False
    ) -> Array:
        """Return columns side by side, shape (m, columns).

        They are arrays by name, or columns (`rows`: rows) by index of the matrix `array`. `field`
        is that of the map, for errors.

        Raises:
            SourceError: no such array or column, or arrays of different lengths.
        """
        found = [self._column(one, field, array, rows=rows).astype(np.float64) for one in columns]
        if len({len(one) for one in found}) > 1:
            lengths = ", ".join(f"{c} {len(one)}" for c, one in zip(columns, found, strict=True))
            problem = f"its arrays differ in length: {lengths}"
            raise SourceError(self.path, problem, field=field, remedy="cut them")
        return np.column_stack(found)

    def matrix(self, name: str | None, field: str) -> Array:
        """Return an array as a matrix; without a name the only one there is, else SourceError."""
        return self._matrix(name, field).astype(np.float64)

    def times(self, column: Column, decimals: int, array: str | None = None) -> list[int | None]:
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
            return [None if no else int(one) for one, no in zip(stamps, missing, strict=True)]
        if times.dtype.kind in "iu":
            return [int(one) * factor for one in times.tolist()]
        values = times.astype(np.float64)
        known = np.isfinite(values)
        # Separately, since an epoch in nanoseconds has more digits than a float.
        whole = np.floor(np.where(known, values, 0.0))
        part = np.rint((np.where(known, values, 0.0) - whole) * float(factor))
        found = zip(known, whole, part, strict=True)
        return [int(w) * factor + int(p) if there else None for there, w, p in found]

    def _column(
        self, column: Column, field: str, array: str | None, *, rows: bool = False
    ) -> NDArray[Any]:
        """Return one column or row (m,), in its own type."""
        if array is None and isinstance(column, str):
            found = self._array(column, field)
            if found.ndim == 2 and 1 not in found.shape:
                problem = f"array {column!r} has the shape {found.shape}"
                remedy = "name an array of one dimension, or a column of it by index"
                raise SourceError(self.path, problem, field=field, remedy=remedy)
            return found.ravel()
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
            remedy = f"its arrays are {', '.join(shapes[:_MOST_NAMED])}"
            raise SourceError(self.path, problem, field=field, remedy=remedy)
        if name not in self._loaded:
            stored = self._stored[name]
            if math.prod(stored.shape) > MOST_NUMBERS:
                problem = f"array {name!r} of shape {stored.shape} is too large to be read at once"
                raise SourceError(self.path, problem, remedy="save the log in parts")
            with _readable(self.path):
                array = stored.load()
            if array.dtype.kind not in _NUMBERS or array.shape != stored.shape:
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


def _npz(path: Path) -> dict[str, Stored]:
    with zipfile.ZipFile(path) as archive:
        members = [name for name in archive.namelist() if name.endswith(".npy")]
        heads = {}
        for name in members:
            with archive.open(name) as stream:
                heads[name] = _head(stream)
    return {
        name.removesuffix(".npy"): Stored(head[0], partial(_member, path, name))
        for name, head in heads.items()
        if head is not None and head[1].kind in _NUMBERS
    }


def _member(path: Path, name: str) -> NDArray[Any]:
    with zipfile.ZipFile(path) as archive, archive.open(name) as stream:
        return np.asarray(npy.read_array(stream, allow_pickle=False))


def _npy(path: Path) -> dict[str, Stored]:
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


def _mat(path: Path) -> dict[str, Stored]:
    entries = [one for one in _in_child(_variables, str(path)) if not one[0].startswith("__")]
    nested = [name for name, _, kind in entries if kind in _MATLAB_NESTED]
    return {
        name: Stored(shape, partial(_matlab_variable, path, name))
        for name, shape, kind in entries
        if kind in _MATLAB_NUMBERS
    } | _in_memory(_in_child(_struct_fields, str(path), nested) if nested else {})


def _variables(path: str) -> list[tuple[str, tuple[int, ...], str]]:
    """Return name, shape and class of the variables.

    scipy lists none of them if one has no shape (tables, strings, time series of MATLAB); each is
    then read by itself.
    """
    try:
        return list(whosmat(path))
    except TypeError:
        found = []
        with Path(path).open("rb") as file:
            for _, alone in varmats_from_mat(file):
                with suppress(TypeError):
                    found += whosmat(alone)
        return found


def _struct_fields(path: str, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Return the arrays of numbers within structs and cells, by path: ``log.joint(2).q``."""
    found: dict[str, NDArray[Any]] = {}

    def walk(value: object, place: str) -> None:
        if not isinstance(value, np.ndarray):
            return
        if value.dtype.kind in _NUMBERS:
            found[place] = np.squeeze(value) if value.ndim > 2 else value
        elif value.dtype.names or value.dtype.kind == "O":
            one_struct = value.dtype.names and value.size == 1
            for number, element in enumerate(value.ravel(order="F"), 1):
                at = place if one_struct else f"{place}({number})"
                if not value.dtype.names:
                    walk(element, at)
                for name in value.dtype.names or ():
                    walk(element[name], f"{at}.{name}")

    variables = loadmat(path, variable_names=names)
    for name in names:
        walk(variables[name], name)
    if sum(array.size for array in found.values()) > MOST_NUMBERS:
        raise ValueError("its structs are too large to be read at once")
    return found


def _matlab_variable(path: Path, name: str) -> NDArray[Any]:
    return np.asarray(_in_child(loadmat, str(path), variable_names=[name])[name])


def _in_child(function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Call scipy's reader in a child process: a damaged file can crash it."""
    with _lock:
        if not _readers:
            _readers.append(WorkerProcess(timeout=_TIMEOUT))
        try:
            return _readers[0].call(_within_memory, partial(function, *args, **kwargs))
        except PlannerCrashed as error:
            raise ValueError("it is damaged") from error
        except PlanningTimedOut as error:
            raise ValueError(f"reading takes longer than {_TIMEOUT:g} s") from error


def _within_memory(read: Callable[[], T]) -> T:
    """Read with limited memory: sizes in a file are not trusted."""
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    return read()


_lock = threading.Lock()
_readers: list[WorkerProcess] = []


@atexit.register
def _close() -> None:
    while _readers:
        _readers.pop().close()


def _matlab_text(path: Path) -> dict[str, Stored]:
    """Matrices of a MATLAB or Octave script."""
    text = _COMMENT.sub("", read_text(path).removeprefix("\ufeff")).replace("...", " ")
    found = {}
    for name, body in _ASSIGNED.findall(text):
        rows = [row.replace(",", " ").split() for row in re.split(r"[;\n]", body)]
        found[name] = np.array([[float(cell) for cell in row] for row in rows if row])
    return _in_memory(found)


def read_mcap(path: Path) -> dict[str, NDArray[Any]]:
    """Return arrays by ``topic/field``, such as ``/joint_states/position`` (m, n).

    ``topic/stamp`` is the time of its messages [ns]: that of their header, or else the file's.

    Raises:
        SourceError: the file cannot be read, or has no topic that can be read this way.
    """
    known, messages = mcap_messages.read(path, lambda _, topic: topic.is_ros2)
    refused = {name: f"{t} is not ROS 2" for name, t in known.items() if not t.is_ros2}
    layouts: dict[str, MessageLayout] = {}
    found: dict[str, list[tuple[int, bytes]]] = {}
    for name, stamp, data in messages:
        if name in refused:
            continue
        try:
            if name not in layouts:
                definition = known[name].definition.decode(errors="replace")
                layouts[name] = layout_of(known[name].kind, definition, data)
            size = layouts[name].size
            if len(data) - size not in range(4):  # a writer may pad the end to whole words
                raise LayoutError("its messages differ in length")
        except LayoutError as error:
            refused[name] = str(error)
            found.pop(name, None)
            continue
        found.setdefault(name, []).append((stamp, data[:size]))
    arrays: dict[str, NDArray[Any]] = {}
    for name, own in found.items():
        try:
            columns = _columns(layouts[name], own)
        except LayoutError as error:
            refused[name] = str(error)
        else:
            arrays |= {f"{name}/{field}": column for field, column in columns.items()}
    if not arrays:
        reasons = "; ".join(f"{name}: {why}" for name, why in refused.items()) or "it has no topic"
        problem = f"has no topic whose messages can be read as columns ({reasons})"
        remedy = "record joint states and currents as ROS 2 messages of constant size"
        raise SourceError(path, problem, remedy=remedy)
    return arrays


def _columns(
    layout: MessageLayout, messages: Sequence[tuple[int, bytes]]
) -> dict[str, NDArray[Any]]:
    """Return the fields of messages of one topic, given with log times [ns], and their stamps."""
    joined = np.frombuffer(b"".join(data for _, data in messages), np.uint8)
    data = joined.reshape(len(messages), layout.size)
    if not layout.matches(data):
        raise LayoutError("its messages differ in names or lengths of arrays")
    rows = data.view(layout.dtype)[:, 0]
    columns: dict[str, NDArray[Any]] = {
        name: rows[name].copy() for name in layout.dtype.names or ()
    }
    seconds, rest = (columns.pop(f"header/stamp/{part}", None) for part in ("sec", "nanosec"))
    if seconds is None or rest is None or not (seconds.any() or rest.any()):
        return {"stamp": np.array([stamp for stamp, _ in messages], np.int64), **columns}
    return {"stamp": np.asarray(seconds.astype(np.int64) * 10**9 + rest), **columns}


def _in_memory(arrays: Mapping[str, NDArray[Any]]) -> dict[str, Stored]:
    return {
        name: Stored(array.shape, partial(np.asarray, array))
        for name, array in arrays.items()
        if array.dtype.kind in _NUMBERS
    }


READERS: Mapping[str, Callable[[Path], dict[str, Stored]]] = {
    ".npz": _npz,
    ".npy": _npy,
    ".mat": _mat,
    ".m": _matlab_text,
    ".mcap": lambda path: _in_memory(read_mcap(path)),
}
"""Readers of files of arrays by suffix; every other file is text in columns."""
