"""Copies of archives for viewers, with the torque that the identified model predicts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.archive import Archive, open_archive, schema
from hil.archive.mcap_writer import McapWriter
from hil.archive.writer import register
from hil.errors import InputError
from hil.files import make_folder, write_files
from hil.identify import Identification
from hil.identify.sources import Source
from hil.progress import Reporter
from identification.signals.samples import Samples

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

FOLDER: Final = "annotated"
PREDICTED: Final = "/joint_states_predicted"
_CHUNK: Final = 10**9  # ns


def annotate(found: Identification, output: Path, reporter: Reporter) -> list[Path]:
    """Write a copy of each fitted or predicted archive into a folder of `output`.

    Raises:
        InputError: two archives have one file name.
        OutputError: the folder cannot be written to.
    """
    predictions = dict(_predictions(found))
    names = [path.name for path in predictions]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(
            next(path for path in predictions if path.name == twice),
            "has the file name of another archive",
            field="--annotate",
            remedy="annotate the archives of each folder separately",
        )
    folder = output / FOLDER
    make_folder(folder)
    with reporter.task("annotating archives", len(predictions)) as task:
        for path, prediction in predictions.items():
            write_files(folder, {path.name: annotated(open_archive(path), prediction)})
            task.advance(1, path.name)
    reporter.say(f"copies with predicted torque: {folder}")
    return [folder / name for name in names]


def _predictions(found: Identification) -> Iterator[tuple[Path, dict[str, Array]]]:
    """Yield path, and time since the first sample [s] and predicted effort, of each archive."""
    prepared = found.prepared
    sources = prepared.sources.training, prepared.training
    pairs = [*zip(*sources, strict=True)]
    if not prepared.sources.in_sample:
        pairs += zip(prepared.sources.held_out, prepared.held_out, strict=True)
    for path in dict.fromkeys(source.path for source, _ in pairs):
        parts = [_prediction(found, *pair) for pair in pairs if pair[0].path == path]
        yield path, {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _prediction(found: Identification, source: Source, samples: Samples) -> dict[str, Array]:
    predicted = samples.predicted_torque(found.cell.model, found.estimate.pooled.values)
    recorded = source.recording.torque
    assert recorded is not None  # fitted and predicted recordings have torques
    return {
        "time": source.recording.time,
        "effort": recorded - (samples.torque - predicted),  # known payloads act on both
    }


def annotated(archive: Archive, prediction: Mapping[str, Array]) -> bytes:
    """Return an MCAP file with the channels for viewers and the predicted torque.

    The prediction has ``time`` since the first sample (m,) [s], and ``effort`` (m, n).
    """
    columns, names = archive.columns, archive.joint_names
    stamp = np.asarray(columns["stamp"], np.int64)
    shift = 0
    with suppress(ValueError):  # virtual time has no date
        begin = datetime.fromisoformat(archive.header.recorded_at or "").timestamp()
        shift = round(begin) * 10**9 - int(stamp[0])
    first = int(stamp[0]) + shift
    fields = {"position": "position", "velocity": "velocity", "effort": "torque"}
    measured_values = {f: columns[c] for f, c in fields.items() if c in columns}
    states = {schema.MEASURED: (stamp, measured_values)}
    if "commanded_position" in columns:
        commands = {name: schema.set_points(columns, name) for name in ("position", "velocity")}
        states[schema.COMMANDED] = (stamp, commands)
    times = stamp[0] + np.rint(1e9 * prediction["time"]).astype(np.int64)
    states[PREDICTED] = (times, {"effort": prediction["effort"]})
    measured = schema.profile(len(names))[schema.MEASURED]
    once = schema.description_messages(archive.attachments.get("robot.urdf", b""))
    content: list[bytes] = []
    writer = McapWriter(content.append, schema.PROFILE, schema.LIBRARY)
    for channel, message in once.items():
        writer.add_message(register(writer, channel), first, 0, message)
    events = register(writer, schema.EVENT_CHANNEL)
    for number, event in enumerate(archive.events):
        at = event.stamp + shift
        writer.add_message(events, at, number, event.encode(at))
    messages = []
    for topic, (times, values) in states.items():
        number = register(writer, schema.Channel(topic, measured.schema, measured.definition))
        messages.append((number, times + shift, schema.joint_states(names, times + shift, values)))
    last = max(int(times[-1]) for _, times, _ in messages)
    for start in range(first, last + 1, _CHUNK):
        for number, times, rows in messages:
            a, b = np.searchsorted(times, (start, start + _CHUNK))
            writer.add_rows([number], times[a:b], np.arange(a, b), [rows[a:b]])
        writer.flush()
    writer.finish()
    return b"".join(content)
