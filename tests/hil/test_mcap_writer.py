"""Our MCAP writer against the one of the format's makers: the same calls, the same bytes."""

from __future__ import annotations

import io
from dataclasses import dataclass
from unittest import mock

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

from hil.archive import mcap_writer
from hil.archive.mcap_writer import McapWriter

NANOSECONDS = st.integers(0, 2**62)


@dataclass(frozen=True)
class Batch:
    """Messages of two channels at the same instants, their content drawn by the seed."""

    stamp: tuple[int, ...]
    seed: int


@dataclass(frozen=True)
class Event:
    stamp: int
    text: bytes


@dataclass(frozen=True)
class Note:
    name: str
    entries: dict[str, str]


@dataclass(frozen=True)
class Flush:
    pass


STEPS = st.lists(
    st.one_of(
        st.builds(Batch, st.lists(NANOSECONDS, max_size=5).map(tuple), st.integers(0, 99)),
        st.builds(Event, NANOSECONDS, st.binary(max_size=40)),
        st.builds(
            Note, st.text(max_size=5), st.dictionaries(st.text(max_size=5), st.text(max_size=5))
        ),
        st.just(Flush()),
    ),
    max_size=8,
)
SIZES = (61, 8)  # odd, so that nothing may rely on alignment


def rows_of(batch: Batch) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(batch.seed)
    return tuple(
        rng.integers(0, 256, (len(batch.stamp), size), np.uint8).view(f"V{size}")[:, 0]
        for size in SIZES
    )


def ours(steps: list, attachment: bytes) -> bytes:
    file = io.BytesIO()
    writer = McapWriter(file.write)
    writer.start("ros2", "test")
    writer.add_attachment("a.txt", "text/plain", attachment)
    channels = [writer.register(f"/{i}", "cdr", f"s/{i}", "ros2msg", b"int8 x") for i in range(3)]
    written = 0
    for step in steps:
        if isinstance(step, Batch):
            number = written + np.arange(len(step.stamp))
            writer.add_rows(channels[:2], np.array(step.stamp, np.int64), number, rows_of(step))
            written += len(step.stamp)
        elif isinstance(step, Event):
            writer.add_message(channels[2], step.stamp, 7, step.text)
        elif isinstance(step, Note):
            writer.add_metadata(step.name, step.entries)
        else:
            writer.flush()
    writer.finish()
    return file.getvalue()


def theirs(steps: list, attachment: bytes) -> bytes:
    file = io.BytesIO()
    writer = Writer(file, chunk_size=1 << 62, compression=CompressionType.ZSTD)
    writer.start("ros2", "test")
    writer.add_attachment(0, 0, "a.txt", "text/plain", attachment)
    channels = [
        writer.register_channel(
            f"/{i}", "cdr", writer.register_schema(f"s/{i}", "ros2msg", b"int8 x")
        )
        for i in range(3)
    ]
    written = 0
    for step in steps:
        if isinstance(step, Batch):
            rows = rows_of(step)
            for i, stamp in enumerate(step.stamp):
                for channel, messages in zip(channels, rows, strict=False):
                    writer.add_message(channel, stamp, messages[i].tobytes(), stamp, written)
                written += 1
        elif isinstance(step, Event):
            writer.add_message(channels[2], step.stamp, step.text, step.stamp, 7)
        elif isinstance(step, Note):
            writer.add_metadata(step.name, step.entries)
        else:
            writer.flush()
    writer.finish()
    return file.getvalue()


@settings(deadline=None)
@given(steps=STEPS, attachment=st.binary(max_size=50))
def test_the_same_calls_give_the_bytes_of_the_reference_writer(steps, attachment):
    """At its level of compression."""
    with mock.patch.object(mcap_writer, "_LEVEL", 3):
        assert ours(steps, attachment) == theirs(steps, attachment)
