"""Archives made from foreign recordings: samples with stamps of their own, all known at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil.archive.file_writer import ArchiveFile
from hil.archive.schema import Batch, SampleEncoder
from hil.archive.writer import checked_metadata
from hil.errors import ArchiveWriteError

Array = NDArray[np.float64]

_CHUNK = 1000  # samples


@dataclass(frozen=True, eq=False)
class Samples:
    """A foreign recording, m samples of n joints, joint side in SI units.

    Attributes:
        stamp: (m,) nanoseconds, of whatever clock the recording has.
        position: (m, n) [rad].
        velocity: (m, n) [rad/s], None when it was not recorded.
        torque: (m, n) [N·m], None when it was not recorded.
        motor_current: (m, n) [A], motor side, None when it was not recorded.
    """

    stamp: NDArray[np.int64]
    position: Array
    velocity: Array | None = None
    torque: Array | None = None
    motor_current: Array | None = None


def write_samples(
    path: str | PathLike[str],
    samples: Samples,
    *,
    joint_names: Sequence[str],
    metadata: Mapping[str, str],
    attachments: Mapping[str, bytes] | None = None,
    period: float | None = None,
    durable: bool = True,
) -> Path:
    """Write a foreign recording as an archive of kind ``imported``.

    Args:
        path: the file, which must not exist.
        samples: what was recorded.
        joint_names: joints in the order of the columns.
        metadata: entries of the ``hil`` metadata record, such as where the recording comes from.
        attachments: content by file name.
        period: step [s] of a recording at a fixed rate; its time is then counted in samples.
        durable: wait until the disk has the data.

    Raises:
        ArchiveWriteError: the file exists, the disk refuses, or a stamp cannot be stored.
    """
    path = Path(path)
    if samples.stamp.size and not 0 <= samples.stamp.min() <= samples.stamp.max() < 2**31 * 10**9:
        raise ArchiveWriteError(
            path, "a stamp lies outside 0 .. 2^31 s", remedy="shift the recording's clock"
        )
    encoder = SampleEncoder(
        joint_names,
        velocity=samples.velocity is not None,
        torque=samples.torque is not None,
        motor_current=samples.motor_current is not None,
    )
    own: dict[str, object] = {"joint_names": list(joint_names)}
    if period is not None:
        own["period"] = period
    file = ArchiveFile(
        path,
        channels=encoder.channels,
        metadata=checked_metadata(path, {**metadata, "kind": "imported"}, own),
        attachments=attachments or {},
        durable=durable,
    )
    for start in range(0, len(samples.stamp), _CHUNK):
        file.add(_encode(encoder, samples, slice(start, start + _CHUNK)))
        file.flush()
    file.finish({"outcome": "completed", "samples": str(len(samples.stamp)), "events": "0"})
    return path


def _encode(encoder: SampleEncoder, samples: Samples, part: slice) -> Batch:
    def cut(values: Array | None) -> Array | None:
        return None if values is None else values[part]

    return encoder.encode(
        samples.stamp[part],
        samples.position[part],
        cut(samples.velocity),
        cut(samples.torque),
        cut(samples.motor_current),
    )
