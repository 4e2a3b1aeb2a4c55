"""Archives with predicted torque and residual next to the measured quantities, for viewers."""

from __future__ import annotations

from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from hil.archive.schema import LIBRARY, MEASURED, PROFILE, joint_states, profile
from hil.base.arrays import Array
from hil.base.files import file_digest, make_folder, write_files
from hil.pipeline.identification import Identification
from hil.pipeline.sources import stamps_of
from hil.pipeline.stored_identification import StoredIdentification

PREDICTED: Final = "/joint_states_predicted"
RESIDUAL: Final = "/joint_states_residual"
FOLDER: Final = "annotated"
_ANNOTATION: Final = "annotation"  # metadata record of an annotated archive


def annotate(identification: Identification | StoredIdentification, output: Path) -> list[Path]:
    """Write a copy of each archive with its predicted torque and residual, in a new folder.

    The copies are for viewers: they lack the seals of an archive, and `hil identify` refuses them.

    Raises:
        ArchiveError: an archive cannot be read again.
    """
    prepared = identification.prepared
    values = identification.values
    sources = prepared.sources
    model = identification.cell.model
    held_out = () if sources.in_sample else zip(sources.held_out, prepared.held_out, strict=True)
    pairs = [*zip(sources.training, prepared.training, strict=True), *held_out]
    parts: dict[Path, list[tuple[NDArray[np.int64], Array, Array]]] = {}
    for source, samples in pairs:
        known_torque = samples.known_torque(model)
        predicted = samples.predicted_torque(model, values) + known_torque
        residual = samples.torque + known_torque - predicted
        parts.setdefault(source.path, []).append(
            (stamps_of(source, identification.cell), predicted, residual)
        )
    folder = output / FOLDER
    make_folder(folder)
    written = []
    for path, columns in parts.items():
        stamp, predicted, residual = (np.concatenate(part) for part in zip(*columns, strict=True))
        torques = {PREDICTED: predicted, RESIDUAL: residual}
        content = _annotated(path, model.joint_names, stamp, torques)
        write_files(folder, {path.name: content})
        written.append(folder / path.name)
    return written


def _annotated(
    path: Path,
    names: tuple[str, ...],
    stamp: NDArray[np.int64],
    torques: Mapping[str, Array],
) -> bytes:
    """Return a copy of an archive with JointState messages of these efforts (m, n) by topic."""
    content = BytesIO()
    writer = Writer(content, compression=CompressionType.ZSTD)
    writer.start(PROFILE, LIBRARY)
    writer.add_metadata(_ANNOTATION, {"source": path.name, "sha256": file_digest(path)})
    with path.open("rb") as stream:
        reader = make_reader(stream)
        for attachment in reader.iter_attachments():
            writer.add_attachment(
                attachment.create_time,
                attachment.log_time,
                attachment.name,
                attachment.media_type,
                attachment.data,
            )
        _copy_messages(reader, writer)
    kind = profile(len(names))[MEASURED]
    schema = writer.register_schema(kind.schema, "ros2msg", kind.definition.encode())
    for topic, effort in torques.items():
        channel = writer.register_channel(topic, "cdr", schema)
        rows = joint_states(names, stamp, {"effort": effort})
        for k, (at, row) in enumerate(zip(stamp.tolist(), rows, strict=True)):
            writer.add_message(channel, at, row.tobytes(), at, k)
    writer.finish()  # type: ignore[no-untyped-call]
    return content.getvalue()


def _copy_messages(reader: Any, writer: Writer) -> None:
    schemas: dict[int, int] = {}
    channels: dict[int, int] = {}
    for schema, channel, message in reader.iter_messages():
        if channel.id not in channels:
            if schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(
                    schema.name, schema.encoding, schema.data
                )
            channels[channel.id] = writer.register_channel(
                channel.topic, channel.message_encoding, schemas[schema.id], channel.metadata
            )
        writer.add_message(
            channels[channel.id],
            message.log_time,
            message.data,
            message.publish_time,
            message.sequence,
        )
