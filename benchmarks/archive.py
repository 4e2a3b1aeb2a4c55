"""Time of decoding archives: ours against the readers that others use, in one run.

Run with ``python -m benchmarks.archive [--json] [--folder FOLDER] [--sizes]``: 30 repetitions of
16 s at 1 kHz with 6 joints (480 000 cycles), made once by our writer; `--folder` stores them.

All decode the columns that identification reads, from the channel ``/hil/cycle`` to contiguous
arrays:

- ours: `hil.archive.open_archive`, checksums verified;
- mcap: the messages of the library's reader, joined and viewed as one numpy structure, which is
  the least that can be done with them (``decode_ratio_to_mcap``, of the faster of its two
  readers), and `struct` message by message;
- typed: `mcap-ros2-support`, each message an object.

``archives_to_estimate_s`` is the processor time of one thread from these archives to an estimate
with covariance, each repetition's among them (`benchmarks.batch`).

None of the others verifies checksums. One thread, whose processor time counts; the readers take
turns, and medians are compared. `--sizes` compares compressions of the chunks of one archive.
"""

from __future__ import annotations

import struct
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import zstandard
from mcap.reader import NonSeekingReader, SeekingReader
from mcap_ros2.decoder import DecoderFactory
from numpy.typing import NDArray

from benchmarks import parser_of, show, timed
from benchmarks.archive_files import CYCLES, JOINTS, SECONDS, repetitions
from benchmarks.batch import archives_to_estimate
from hil.archive import open_archive, verified_records
from hil.archive.cdr import fixed_layout
from hil.archive.schema import CYCLE, profile

Columns = Mapping[str, NDArray[Any]]

REPETITIONS = 30
ROUNDS = 5
COLUMNS = (
    "cycle",
    "target_position",
    "position",
    "torque",
    "target_current",
    "commanded_position",
    "gap",
)
_CODES = {"<f8": "d", "<i8": "q", "<i4": "i"}  # of struct, by the types of the columns
_LAYOUT = fixed_layout(profile(JOINTS)[CYCLE].definition).dtype


def ours(path: Path) -> Columns:
    """Decode with the package."""
    archive = open_archive(path, fields=COLUMNS)
    assert archive.complete, archive.missing
    return archive.columns


def joined(path: Path, reader: Any) -> Columns:
    """Decode with mcap's reader and one numpy view of all messages."""
    with path.open("rb") as stream:
        messages = reader(stream).iter_messages(topics=[CYCLE], log_time_order=False)
        data = b"".join([message.data for _, _, message in messages])
    rows = np.frombuffer(data, _LAYOUT)
    return {name: np.ascontiguousarray(rows[name]) for name in COLUMNS}


def unpacked(path: Path, reader: Any) -> Columns:
    """Decode with mcap's reader and `struct`, message by message."""
    unpack, widths = _unpacker()
    with path.open("rb") as stream:
        messages = reader(stream).iter_messages(topics=[CYCLE], log_time_order=False)
        values = [unpack(message.data) for _, _, message in messages]
    rows = np.array(values)
    columns = {}
    at = 0
    for name, width in zip(COLUMNS, widths, strict=True):
        base = _LAYOUT[name].base
        columns[name] = np.ascontiguousarray(rows[:, at : at + width].astype(base))
        columns[name] = columns[name].reshape(-1, *_LAYOUT[name].shape)
        at += width
    return columns


def _unpacker() -> tuple[Callable[[bytes], tuple[Any, ...]], list[int]]:
    """What unpacks the columns of one message, and how many numbers each has."""
    code = "<"
    at = 0
    widths = []
    fields = _LAYOUT.fields
    assert fields is not None
    for name in COLUMNS:
        dtype, offset = fields[name][:2]
        widths.append(int(np.prod(dtype.shape, dtype=int)))
        code += f"{offset - at}x{widths[-1]}{_CODES[dtype.base.str]}"
        at = offset + dtype.itemsize
    return struct.Struct(code).unpack_from, widths


def typed(path: Path) -> Columns:
    """Decode with mcap-ros2-support."""
    with path.open("rb") as stream:
        reader = SeekingReader(stream, decoder_factories=[DecoderFactory()])
        messages = [
            decoded
            for *_, decoded in reader.iter_decoded_messages(topics=[CYCLE], log_time_order=False)
        ]
    return {
        name: np.array([getattr(message, name) for message in messages], _LAYOUT[name].base)
        for name in COLUMNS
    }


def decode_all(decode: Callable[[Path], Columns], paths: Sequence[Path]) -> None:
    """Decode archives one after the other."""
    for path in paths:
        decode(path)


def same(path: Path, decoders: Sequence[Callable[[Path], Columns]]) -> bool:
    """Whether all decode the same values, to the bit."""
    first, *others = (decode(path) for decode in decoders)
    return all(
        other[name].dtype == first[name].dtype and other[name].tobytes() == first[name].tobytes()
        for other in others
        for name in COLUMNS
    )


def measure(paths: Sequence[Path], turns: int) -> dict[str, Any]:
    """Times and ratios. The slow ones decode fewer archives, which are all alike."""
    decoders: dict[str, Callable[[Path], Columns]] = {
        "ours": ours,
        "mcap_seeking": lambda path: joined(path, SeekingReader),
        "mcap_streaming": lambda path: joined(path, NonSeekingReader),
        "mcap_struct": lambda path: unpacked(path, NonSeekingReader),
        "typed": typed,
    }
    if not same(paths[0], list(decoders.values())):
        raise SystemExit("the readers do not decode the same values")
    shares = {"ours": len(paths), "typed": 1}
    rounds: dict[str, list[float]] = {name: [] for name in decoders}
    for turn in range(turns):
        for name, decode in decoders.items():
            count = min(len(paths), shares.get(name, 3))
            first = turn * count % max(1, len(paths) - count + 1)
            some = paths[first : first + count]
            rounds[name].append(timed(partial(decode_all, decode, some)) * len(paths) / len(some))
    times = {name: float(np.median(values)) for name, values in rounds.items()}
    mcap = min(times["mcap_seeking"], times["mcap_streaming"])
    return {
        "decode_ratio_to_mcap": round(mcap / times["ours"], 2),
        "decode_ratio_to_mcap_struct": round(times["mcap_struct"] / times["ours"], 2),
        "decode_ratio_to_typed": round(times["typed"] / times["ours"], 1),
        **{f"{name}_s": round(value, 4) for name, value in times.items()},
        "archives": len(paths),
        "cycles": len(paths) * CYCLES,
        "bytes_per_cycle": round(sum(path.stat().st_size for path in paths) / len(paths) / CYCLES),
        "clock": "processor time of one thread",
    }


def sizes(path: Path) -> list[dict[str, Any]]:
    """Return size, compression and decompression time of an archive's chunks by method."""
    decompressor = zstandard.ZstdDecompressor()
    with path.open("rb") as stream:
        size = path.stat().st_size
        packed_chunks = [
            (verified_records.parse_chunk(record), record.offset)
            for record in verified_records.records(stream, size)
            if record.opcode == verified_records.CHUNK
        ]
        chunks = [verified_records.chunk_data(*entry) for entry in packed_chunks]
    other_bytes = size - sum(len(packed_chunk.data) for packed_chunk, _ in packed_chunks)
    methods: dict[str, tuple[Callable[[bytes], bytes], Callable[[bytes], bytes]]] = {
        "none": (bytes, bytes),
        "lz4": (lz4.frame.compress, lz4.frame.decompress),
    }
    for level in (-5, -1, 1, 3, 6, 12):
        compressor = zstandard.ZstdCompressor(level=level)
        methods[f"zstd {level}"] = (compressor.compress, decompressor.decompress)
    table = []
    for name, (pack, unpack) in methods.items():
        start = time.process_time()
        packed = [pack(chunk) for chunk in chunks]
        middle = time.process_time()
        for data in packed:
            unpack(data)
        end = time.process_time()
        total = sum(len(data) for data in packed) + other_bytes
        table.append(
            {
                "compression": name,
                "megabytes_per_minute": round(total / SECONDS * 60 / 1e6, 1),
                "compress_us_per_cycle": round((middle - start) / CYCLES * 1e6, 2),
                "decompress_us_per_cycle": round((end - middle) / CYCLES * 1e6, 2),
            }
        )
    return table


def main() -> None:
    """Measure, and print the figures."""
    parser = parser_of(__doc__)
    parser.add_argument("--folder", type=Path, help="folder of the archives")
    parser.add_argument("--sizes", action="store_true", help="compare compressions as well")
    parser.add_argument("--repetitions", type=int, default=REPETITIONS, help="archives")
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="turns of each reader")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        paths = repetitions(arguments.folder or Path(temporary), arguments.repetitions)
        result = measure(paths, arguments.rounds)
        result["archives_to_estimate_s"] = round(archives_to_estimate(paths), 2)
        if arguments.sizes:
            result["sizes"] = sizes(paths[0])
    show(result, only_json=arguments.json)


if __name__ == "__main__":
    main()
