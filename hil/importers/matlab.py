"""Files of MATLAB: .mat of any version, 7.3 (HDF5) included, and matrices in scripts."""

from __future__ import annotations

import atexit
import re
import resource
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Final, ParamSpec, TypeVar

import numpy as np
import scipy
from numpy.typing import NDArray

import planner  # its worker, with all that plans, is loaded for a .mat alone
from hil.base.safe_input import read_text
from planner.errors import PlannerCrashed, PlanningTimedOut

P = ParamSpec("P")
T = TypeVar("T")

NUMERIC_DTYPE_KINDS: Final = "fiubmM"
"""Kinds of numpy's types that hold real numbers or times."""
_ASSIGNED: Final = re.compile(r"\b([A-Za-z]\w*)\s*=\s*\[([^\[\]]*)\]")
_COMMENT: Final = re.compile(r"[%#].*")
# bytes of the process that reads a .mat: the largest array and its copy
_MAX_MEMORY_BYTES: Final = 8 * 2**30
_TIMEOUT: Final = 120.0  # s
_HDF5_MAGIC: Final = b"\x89HDF\r\n\x1a\n"
_HDF5_OFFSET: Final = 512  # behind MATLAB's own header
_CHUNK_BYTES: Final = 1 << 16


def mat_shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the arrays of numbers in a .mat, structs and cells by path.

    A path is written as in MATLAB: ``log.joint(2).q``. Dimensions of length 1 are left out.
    ValueError, OSError and others: the file is damaged, or takes too long.
    """
    return _in_child(_shapes, str(path), path.stat().st_mtime_ns)


def lost_bytes(path: Path) -> int:
    """Return how many zeros follow the signature of HDF5 in a .mat; 0 where anything else does."""
    with path.open("rb") as file:
        if not file.read(_HDF5_OFFSET + len(_HDF5_MAGIC)).endswith(_HDF5_MAGIC):
            return 0
        size = 0
        while chunk := file.read(_CHUNK_BYTES):
            if any(chunk):
                return 0
            size += len(chunk)
    return size


def mat_array(path: Path, name: str) -> NDArray[Any]:
    """Return one of the arrays of `mat_shapes`."""
    return _in_child(_array, str(path), path.stat().st_mtime_ns, name)


def script_matrices(path: Path) -> dict[str, NDArray[np.float64]]:
    """Return the matrices of numbers that a MATLAB or Octave script assigns."""
    text = _COMMENT.sub("", read_text(path).removeprefix("\ufeff")).replace("...", " ")
    matrices = {}
    for name, body in _ASSIGNED.findall(text):
        rows = [row.replace(",", " ").split() for row in re.split(r"[;\n]", body)]
        matrices[name] = np.array([[float(cell) for cell in row] for row in rows if row])
    return matrices


# In the child process


@lru_cache(maxsize=1)
def _arrays(path: str, _changed: int) -> dict[str, NDArray[Any]]:
    """Return all arrays of a .mat by path; `_changed` is the time of the file's last change."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # tables and strings, which only MATLAB reads
        variables = _variables(path)
    return {
        place: array
        for name, value in variables.items()
        if not name.startswith("__")
        for place, array in _numbers_in(value, name)
    }


def _variables(path: str) -> dict[str, Any]:
    """Return the variables of a .mat that not only MATLAB can read."""
    from pymatreader import read_mat  # with h5py, which only a .mat needs

    try:
        return dict(read_mat(path))
    except Exception as error:  # scipy does not document what it raises
        readable: dict[str, Any] = {}
        with suppress(Exception), Path(path).open("rb") as file:  # none of the file can be read
            for name, _ in scipy.io.matlab.varmats_from_mat(file):
                with suppress(Exception):
                    readable |= read_mat(path, variable_names=[name])
        if not readable:
            raise error
        return readable


def _shapes(path: str, changed: int) -> dict[str, tuple[int, ...]]:
    return {name: array.shape for name, array in _arrays(path, changed).items()}


def _array(path: str, changed: int, name: str) -> NDArray[Any]:
    return _arrays(path, changed)[name]


def _numbers_in(value: object, place: str) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the arrays of numbers within a value of `pymatreader`, each with its path.

    It gives a struct as a dict, a cell array as a list, and an array of structs as a dict of lists:
    those are found as ``s(2).q`` as well as ``s.q(2)``.
    """
    if isinstance(value, np.ndarray):
        if value.dtype.kind in NUMERIC_DTYPE_KINDS:
            yield place, np.squeeze(value)
    elif isinstance(value, dict):
        lengths = {len(field) if isinstance(field, list) else -1 for field in value.values()}
        if len(lengths) == 1 and lengths != {-1}:
            for number in range(lengths.pop()):
                for name, field in value.items():
                    yield from _numbers_in(field[number], f"{place}({number + 1}).{name}")
        for name, field in value.items():
            yield from _numbers_in(field, f"{place}.{name}")
    elif isinstance(value, list):
        for number, element in enumerate(value, 1):
            yield from _numbers_in(element, f"{place}({number})")


def _in_child(function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Call a reader of .mat files in a child process: a damaged file can crash it."""
    with _lock:
        if not _readers:
            _readers.append(planner.WorkerProcess(timeout=_TIMEOUT))
        try:
            return _readers[0].call(_within_memory, partial(function, *args, **kwargs))
        except PlannerCrashed as error:
            raise ValueError("it is damaged") from error
        except PlanningTimedOut as error:
            raise ValueError(f"reading takes longer than {_TIMEOUT:g} s") from error


def _within_memory(read: Callable[[], T]) -> T:
    """Read with limited memory: sizes in a file are not trusted."""
    resource.setrlimit(resource.RLIMIT_AS, (_MAX_MEMORY_BYTES, _MAX_MEMORY_BYTES))
    return read()


_lock = threading.Lock()
_readers: list[planner.WorkerProcess] = []


@atexit.register
def _close() -> None:
    while _readers:
        _readers.pop().close()
