"""Messages of ROS to arrays: decoded by `rosbags`, one column for each number in them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import lru_cache
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype

from hil.importers.xcdr2 import in_version_1, is_version_2

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

JOINT_STATE: Final = "sensor_msgs/msg/JointState"
CONTROLLER_STATE: Final = "control_msgs/msg/JointTrajectoryControllerState"
_HEAD: Final = "std_msgs/Header header\nstring[] joint_names\n"
_CONTROLLER_STATES: Final = (
    # Since Iron; Humble; before.
    (("reference", "feedback", "error", "output"), ("reference", "feedback", "error", "output")),
    (
        ("reference", "feedback", "error", "output", "desired", "actual"),
        ("reference", "feedback", "error", "output", "desired", "actual"),
    ),
    (("desired", "actual", "error"), ()),
)
"""Points of joints, and of joints with several axes, in the states of trajectory controllers."""
_MAX_SEQUENCE_ELEMENTS: Final = 1 << 16  # elements of a sequence in a message
# elements of a column; what is larger is an image or a cloud of points
_MAX_COLUMN_ELEMENTS: Final = 4096
_ROS1_HEADER: Final = "seq"


class MessageError(ValueError):
    """Messages that cannot be decoded, or not as columns."""


@lru_cache(maxsize=64)
def typestore_of(kind: str, definition: str, encoding: str) -> Typestore:
    """Return the types of messages: by a definition, or by ROS 2 where there is none.

    `encoding` is that of the definition, ``ros2msg``, ``ros2idl`` or empty.

    Raises:
        MessageError: the definition is invalid.
    """
    from rosbags import typesys  # only for messages
    from rosbags.typesys.store import Typestore

    ros2_store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    if not definition.strip() and kind in ros2_store.types:
        return ros2_store
    try:
        if "idl" in encoding:
            read = typesys.get_types_from_idl(definition)
        else:
            name = kind if "/msg/" in kind else _with_msg(kind)
            read = typesys.get_types_from_msg(definition, name)
        for _, described in read.values():
            for _, node in described:
                _check_size(node)
        # Names of the definition take precedence over ROS 2's, which may be of another version.
        store = Typestore(max_sequence_length=_MAX_SEQUENCE_ELEMENTS)
        store.register({**ros2_store.fielddefs, **read})
    except Exception as error:  # rosbags does not document what it raises
        raise MessageError(
            f"its definition is invalid ({error or type(error).__name__})"
        ) from error
    return store


def definitions_of(kind: str, definition: str) -> tuple[str, ...]:
    """Return the definitions that messages may have: the given one, or of releases of ROS 2.

    Bags of Humble and before have none, and `rosbags` none of the messages of controllers.
    """
    if definition.strip() or kind not in (CONTROLLER_STATE, CONTROLLER_STATE.replace("/msg", "")):
        return (definition,)
    return tuple(
        _HEAD
        + "".join(f"trajectory_msgs/JointTrajectoryPoint {name}\n" for name in single)
        + ("string[] multi_dof_joint_names\n" if several else "")
        + "".join(
            f"trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_{name}\n" for name in several
        )
        for single, several in _CONTROLLER_STATES
    )


def _with_msg(kind: str) -> str:
    package, _, name = kind.rpartition("/")
    return f"{package}/msg/{name}"


def _check_size(node: tuple[Any, Any]) -> None:
    """Refuse fixed arrays if one message would fill the memory."""
    kind, content = node
    if kind == Nodetype.ARRAY and content[1] > _MAX_SEQUENCE_ELEMENTS:
        raise MessageError(f"it has an array of {content[1]} elements")


def decoded(store: Typestore, kind: str, data: bytes) -> Any:
    """Return a message of ROS 2.

    Raises:
        MessageError: it cannot be decoded.
    """
    name = kind if "/msg/" in kind else _with_msg(kind)
    try:
        version_1 = in_version_1(data, name, store) if is_version_2(data) else data
        return store.deserialize_cdr(version_1, name)
    except Exception as error:  # rosbags does not document what it raises
        raise MessageError(f"cannot be decoded ({error or type(error).__name__})") from error


def columns_of(stamps: Sequence[int], messages: Sequence[Any]) -> dict[str, NDArray[Any]]:
    """Return the numbers of messages of one type by the path of their field, and their ``stamp``.

    A field of numbers is an array (m, length); lists of texts must be the same in all messages,
    since they name what the numbers are. `stamps` are those of the file [ns], used where the
    headers of the messages have none.

    Raises:
        MessageError: names or lengths differ, or an array is too long.
    """
    columns: dict[str, NDArray[Any]] = {}
    for path, read in _fields_of(messages[0], "", lambda message: message):
        try:
            values = [read(message) for message in messages]
        except (IndexError, AttributeError):
            raise MessageError(f"its messages differ in lengths of arrays: {path}") from None
        if isinstance(values[0], list):
            _check_alike(values, path)
            continue
        try:
            columns[path] = np.array(values)
        except ValueError:  # of different lengths
            raise MessageError(f"its messages differ in lengths of arrays: {path}") from None
    columns = {path: column for path, column in columns.items() if column.size}
    seconds, nanoseconds = (
        columns.pop(f"header/stamp/{part}", None) for part in ("sec", "nanosec")
    )
    columns.pop(f"header/{_ROS1_HEADER}", None)
    stamp = np.array(stamps, np.int64)
    if seconds is not None and nanoseconds is not None and (seconds.any() or nanoseconds.any()):
        stamp = seconds.astype(np.int64) * 10**9 + nanoseconds
    return {"stamp": stamp, **columns}


_Read = Callable[[Any], Any]


def _fields_of(value: Any, path: str, read: _Read) -> Iterator[tuple[str, _Read]]:
    """Yield paths of the numbers, arrays and lists in a message, and how each is read from one."""
    if isinstance(value, np.ndarray):
        if value.size > _MAX_COLUMN_ELEMENTS:
            raise MessageError(f"{path} has {value.size} elements")
        yield path, read
    elif is_dataclass(value):
        for field in fields(value):
            if field.default is MISSING and field.name != "__msgtype__":  # else a constant
                inner = getattr(value, field.name)
                place = f"{path}/{field.name}".lstrip("/")
                # C code where only names lead to a number, as in most messages.
                dotted = place.replace("/", ".")
                if not any(part.isdigit() for part in place.split("/")):
                    yield from _fields_of(inner, place, attrgetter(dotted))
                else:
                    yield from _fields_of(inner, place, _Attribute(read, field.name))
    elif isinstance(value, list):
        yield path, read  # its texts or its length
        for index, element in enumerate(value):
            if not isinstance(element, str):
                yield from _fields_of(element, f"{path}/{index}", _Element(read, index))
    elif not isinstance(value, str):
        yield path, read


@dataclass(frozen=True)
class _Attribute:
    """Reads a field of what another reads."""

    outer: _Read
    name: str

    def __call__(self, message: Any) -> Any:
        return getattr(self.outer(message), self.name)


@dataclass(frozen=True)
class _Element:
    """Reads an element of what another reads."""

    outer: _Read
    index: int

    def __call__(self, message: Any) -> Any:
        return self.outer(message)[self.index]


def _check_alike(lists: Sequence[list[Any]], path: str) -> None:
    """Raise MessageError where lists of texts, or the lengths of lists, differ."""
    first = lists[0]
    if any(len(values) != len(first) for values in lists):
        raise MessageError(f"its messages differ in lengths of arrays: {path}")
    texts = bool(first) and isinstance(first[0], str)
    if texts and any(values != first for values in lists):
        raise MessageError(f"its messages differ in {path}: {', '.join(first)}")
