"""Messages in JSON or Protobuf to arrays: one column for each number in them.

Both are trees of names and numbers; a list next to a list of names of the same length has a column
for each name.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hil.importers.ros_messages import MessageError

ENCODINGS: Final = ("json", "protobuf")
Number = int | float
_SECONDS: Final = ("sec", "secs", "seconds")
_NANOSECONDS: Final = ("nanosec", "nsec", "nsecs", "nanos")
_STAMPS: Final = ("stamp", "timestamp", "time")
_MAX_LIST_NUMBERS: Final = 4096  # numbers in one list


def trees(
    kind: str, encoding: str, definition: bytes, messages: Sequence[bytes]
) -> list[Mapping[str, Any]]:
    """Return messages as dictionaries.

    Args:
        kind: name of the schema.
        encoding: of the messages.
        definition: of the schema.
        messages: as recorded.

    Raises:
        MessageError: one cannot be decoded.
    """
    try:
        if encoding == "json":
            decoded = [json.loads(message) for message in messages]
        else:
            decoded = _of_protobuf(kind, definition, messages)
    except Exception as error:  # protobuf does not document what it raises
        raise MessageError(f"cannot be decoded ({error or type(error).__name__})") from error
    if not all(isinstance(tree, dict) for tree in decoded):
        raise MessageError("are not objects with named fields")
    return decoded


def _of_protobuf(kind: str, definition: bytes, messages: Sequence[bytes]) -> list[Any]:
    from google.protobuf import descriptor_pb2, descriptor_pool, json_format, message_factory

    files = descriptor_pb2.FileDescriptorSet.FromString(definition)
    pool = descriptor_pool.DescriptorPool()
    unresolved = {file.name: file for file in files.file}
    while unresolved:  # a file is added after those that it imports
        ready = [
            file for file in unresolved.values() if not unresolved.keys() & set(file.dependency)
        ]
        if not ready:
            raise MessageError("have a definition that imports itself")
        for file in ready:
            pool.Add(unresolved.pop(file.name))
    message_class = message_factory.GetMessageClass(pool.FindMessageTypeByName(kind))
    return [
        json_format.MessageToDict(
            message_class.FromString(message),
            preserving_proto_field_name=True,
            always_print_fields_with_no_presence=True,
        )
        for message in messages
    ]


def columns_of_trees(
    received: Sequence[int], messages: Sequence[Mapping[str, Any]]
) -> dict[str, NDArray[Any]]:
    """Return arrays by field; ``stamp`` is the time of the messages [ns], else of receipt.

    Raises:
        MessageError: fields or names change from message to message, or there is no number.
    """
    rows = [dict(numbers_of(message)) for message in messages]
    names = list(rows[0])
    if any(row.keys() != rows[0].keys() for row in rows):
        raise MessageError("have fields or names that change from message to message")
    stamps = [stamp_of(message) for message in messages]
    are_stamped = all(stamp is not None for stamp in stamps) and any(stamps)
    arrays: dict[str, NDArray[Any]] = {
        "stamp": np.array(stamps if are_stamped else received, dtype=np.int64)
    }
    for name in names:
        try:
            arrays[name] = np.array([row[name] for row in rows], dtype=np.float64)
        except ValueError as error:
            problem = f"have lists of different lengths in {name!r}"
            raise MessageError(problem) from error
    if len(arrays) == 1:
        raise MessageError("have no number")
    return arrays


def numbers_of(
    tree: Mapping[str, Any], above: str = "", *, times: bool = False
) -> Iterator[tuple[str, Number | list[Number]]]:
    """Yield numbers and lists of numbers by field; with `times`, also numeric stamps.

    `above` begins the name of each field.
    """
    labels: list[str] = next((value for value in tree.values() if _are_names(value)), [])
    for key, value in tree.items():
        name = f"{above}{key}"
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if key == "header" or (key in _STAMPS and not (times and is_number)):
            continue
        if is_number:
            yield name, value
        elif isinstance(value, dict):
            yield from numbers_of(value, f"{name}.", times=times)
        elif isinstance(value, list) and 0 < len(value) <= _MAX_LIST_NUMBERS and are_numbers(value):
            if len(labels) == len(value):
                yield from ((f"{name}/{label}", x) for label, x in zip(labels, value, strict=True))
            else:
                yield name, list(value)


def _are_names(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(x, str) for x in value)


def are_numbers(value: Sequence[Any]) -> bool:
    """Return whether all of a list are numbers."""
    return all(isinstance(x, int | float) and not isinstance(x, bool) for x in value)


def stamp_of(tree: Mapping[str, Any]) -> int | None:
    """Return the time of a message [ns], None without one."""
    header = tree.get("header")
    places = [header, tree] if isinstance(header, dict) else [tree]
    for place in places:
        for key in _STAMPS:
            if key in place:
                return nanoseconds_of(place[key])
    return None


def nanoseconds_of(value: Any) -> int | None:
    """Return a stamp of seconds and their parts, or a date as text [ns]; None of another one."""
    if isinstance(value, dict):
        seconds = next((value[key] for key in _SECONDS if key in value), None)
        part = next((value[key] for key in _NANOSECONDS if key in value), 0)
        return None if seconds is None else int(seconds) * 10**9 + int(part)
    if isinstance(value, str):  # of protobuf's Timestamp
        try:
            return int(np.datetime64(value.removesuffix("Z"), "ns").astype(np.int64))
        except ValueError:
            return None
    return None
