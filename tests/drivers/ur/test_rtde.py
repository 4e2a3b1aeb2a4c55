"""Frames of RTDE: what is packed is unpacked, however the network cuts it."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import PacketError
from drivers.ur.rtde import (
    ControllerText,
    FrameSplitter,
    FrameType,
    OutputRecipe,
    OutputsMissingError,
    RtdeError,
    RtdeFrame,
    accepted,
    controller_text,
    controller_version,
    frame,
    outputs_request,
    version_request,
)

FORMATS = {
    "BOOL": "?", "UINT8": "B", "UINT32": "I", "INT32": "i", "UINT64": "Q", "DOUBLE": "d",
    "VECTOR3D": "3d", "VECTOR6D": "6d", "VECTOR6INT32": "6i", "VECTOR6UINT32": "6I",
}  # fmt: skip
"""Of `struct`, by the types of the maker's guide."""
FRAMES = st.lists(st.tuples(st.sampled_from(FrameType), st.binary(max_size=300)), max_size=8)


def test_requests_are_those_of_the_guide() -> None:
    assert version_request() == b"\x00\x05V\x00\x02"
    assert frame(FrameType.START) == b"\x00\x03S"
    names = ("timestamp", "actual_q")
    request = outputs_request(500.0, names)
    assert request == b"\x00\x1dO" + struct.pack(">d", 500.0) + b"timestamp,actual_q"


@given(FRAMES, st.data())
def test_a_stream_cut_anywhere_gives_the_same_frames(
    frames: list[tuple[FrameType, bytes]], data: st.DataObject
) -> None:
    stream = b"".join(frame(kind, payload) for kind, payload in frames)
    cuts = data.draw(st.lists(st.integers(0, len(stream)), max_size=10).map(sorted))
    splitter = FrameSplitter()
    received = []
    for start, stop in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        received += splitter.feed(stream[start:stop])
    assert received == [RtdeFrame(kind, payload) for kind, payload in frames]
    assert splitter.unfinished == 0


@given(st.binary(min_size=1, max_size=200))
def test_a_frame_that_is_cut_short_is_never_given(payload: bytes) -> None:
    whole = frame(FrameType.DATA, payload)
    splitter = FrameSplitter()
    assert splitter.feed(whole[:-1]) == []
    assert splitter.unfinished == len(whole) - 1


@pytest.mark.parametrize("length", [0, 1, 2])
def test_a_length_below_the_header_is_no_rtde(length: int) -> None:
    with pytest.raises(RtdeError, match="not the RTDE port"):
        FrameSplitter().feed(struct.pack(">HB", length, FrameType.DATA))


@st.composite
def recipes_with_values(draw: st.DrawFn) -> tuple[list[str], list[bytes]]:
    """Types of a recipe, and the packed values of some frames."""
    types = draw(st.lists(st.sampled_from(sorted(FORMATS)), min_size=1, max_size=12))
    size = struct.calcsize(">" + "".join(FORMATS[kind] for kind in types))
    rows = draw(st.lists(st.binary(min_size=size, max_size=size), min_size=1, max_size=5))
    return types, rows


@given(recipes_with_values())
def test_values_are_those_of_an_independent_unpacker(
    drawn: tuple[list[str], list[bytes]],
) -> None:
    types, rows = drawn
    names = [f"output_{k}" for k in range(len(types))]
    recipe = OutputRecipe.confirmed(names, b"\7" + ",".join(types).encode())
    values = recipe.values([b"\7" + row for row in rows])
    for k, row in enumerate(rows):
        start = 0
        for name, kind in zip(names, types, strict=True):
            layout = struct.Struct(">" + FORMATS[kind])
            expected = layout.unpack_from(row, start)
            start += layout.size
            np.testing.assert_array_equal(np.ravel(values[name][k]), expected)


def test_outputs_that_are_missing_are_named() -> None:
    with pytest.raises(OutputsMissingError, match="does not send payload, no_such") as caught:
        OutputRecipe.confirmed(["timestamp", "payload", "no_such"], b"\0DOUBLE,NOT_FOUND,NOT_FOUND")
    assert caught.value.names == ("payload", "no_such")


@pytest.mark.parametrize(
    ("reply", "problem"),
    [
        (b"\1DOUBLE", "2 outputs were requested, 1 confirmed"),
        (b"\1DOUBLE,QUATERNION", "unknown type: 'QUATERNION'"),
        (b"", "2 outputs were requested, 1 confirmed"),
    ],
)
def test_a_reply_that_confirms_something_else_is_refused(reply: bytes, problem: str) -> None:
    with pytest.raises(RtdeError, match=problem):
        OutputRecipe.confirmed(["timestamp", "actual_q"], reply)


@pytest.mark.parametrize("payload", [b"\1" + bytes(7), b"\1" + bytes(9), b"\2" + bytes(8), b""])
def test_a_data_frame_of_another_recipe_is_refused(payload: bytes) -> None:
    recipe = OutputRecipe.confirmed(["timestamp"], b"\1DOUBLE")
    with pytest.raises(PacketError):
        recipe.values([payload])


def test_texts_and_versions_are_read() -> None:
    payload = b"\5hello\3URP\2"
    assert controller_text(payload) == ControllerText("hello", "URP", 2)
    for length in range(len(payload)):
        with pytest.raises(PacketError):
            controller_text(payload[:length])
    assert str(controller_version(struct.pack(">4I", 5, 15, 2, 7))) == "5.15.2.7"
    assert accepted(b"\1") and not accepted(b"\0")
    for reply in (b"", b"\1\1"):
        with pytest.raises(PacketError, match="length of the reply"):
            accepted(reply)


def test_names_that_no_controller_would_read_are_refused() -> None:
    with pytest.raises(ValueError, match="at most 2048"):
        outputs_request(500.0, ["actual_q"] * 300)
