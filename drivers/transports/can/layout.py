"""Frames of both profiles as tables of signals: what the DBC files are made from.

Bits are counted as DBC does for little-endian signals: bit 0 is the lowest bit of byte 0, and
`start` is the lowest bit of the signal. Standard (11-bit) identifiers; the lower one wins the bus,
so answers come first.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, NamedTuple

from drivers.packets import Mode

MAX_AXES: Final = 6
PAYLOADS_FD: Final = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""Bytes that a CAN FD frame can carry."""

# Identifiers.
FD_DOWN: Final = 0x100
FD_UP_A: Final = 0x110
FD_UP_B: Final = 0x111
CLASSIC_DOWN: Final = (0x120, 0x121, 0x122)
CLASSIC_UP_HEADER: Final = 0x130
CLASSIC_UP_AXIS: Final = tuple(range(0x131, 0x131 + MAX_AXES))
SEGMENT_DOWN: Final = 0x180
SEGMENT_UP: Final = 0x181

# Classic: packed integers.
REVOLUTION_BITS: Final = 27
DIFFERENCE_BITS: Final = 17
CURRENT_BITS: Final = 12
COUNTS_PER_REVOLUTION: Final = 65536
COUNTS_PER_AMPERE: Final = 64
UP_COUNTER_BITS: Final = 4
DOWN_COUNTER_BITS: Final = 6

SLOW_FIELDS: Final = ("D2", "extra1", "extra2", "extra3")
"""What goes up one value per cycle, in turn; the last in turn is the functionality word."""
FUNCTIONALITY: Final = len(SLOW_FIELDS) * MAX_AXES
"""Index of the functionality word among the slow values."""


class Frame(NamedTuple):
    """One data frame with a standard identifier."""

    id: int
    data: bytes


@dataclass(frozen=True)
class Signal:
    """One field of a frame.

    Attributes:
        start, length: bits.
        kind: "float" is IEEE with 32 bits.
        scale: physical value of one count.
        mux: value of the frame's multiplexer for which the field is there; None: always.
        multiplexer: whether this field is the multiplexer.
        values: names of values.
    """

    name: str
    start: int
    length: int
    kind: Literal["unsigned", "signed", "float"] = "unsigned"
    scale: float = 1.0
    unit: str = ""
    mux: int | None = None
    multiplexer: bool = False
    values: Mapping[int, str] | None = None


@dataclass(frozen=True)
class FrameLayout:
    """One frame: `length` in bytes; `sender` "Controller" or "PC"."""

    id: int
    name: str
    length: int
    sender: Literal["Controller", "PC"]
    signals: tuple[Signal, ...]
    comment: str


FD_MODE_CODES: Final[dict[int, int]] = {
    **{mode: mode for mode in range(18)},
    **{mode: mode - 300 for mode in range(500, 509)},
}
"""Mode on the C4G wire to its byte in FD frames."""
CLASSIC_MODE_CODES: Final[dict[int, int]] = {
    mode: code
    for code, mode in enumerate((0, 1, 2, 4, 5, 7, 8, 9, 10, 500, 501, 502, 504, 505, 506, 508))
}
"""Mode on the C4G wire to its four bits in classic frames."""


class Action:
    """What a classic frame says of one axis: two bits."""

    MIRROR: Final = 0
    SET: Final = 1
    SET_AND_EXIT: Final = 2
    WORD: Final = 3


class Word:
    """Meaning of the D1 field of an axis whose action is WORD; EXIT is added to any of them."""

    MIRROR: Final = 0
    CLOSED_ZERO: Final = 1
    ZERO: Final = 2
    DRIVE_OFF: Final = 3
    FOLLOWING_ERROR: Final = 4
    EXIT: Final = 16


_ACTION_NAMES: Final = {0: "mirror", 1: "set_point", 2: "set_point_and_exit", 3: "word"}


def _mode_names(codes: Mapping[int, int]) -> dict[int, str]:
    known = {int(mode): mode.name.lower() for mode in Mode}
    return {code: known.get(mode, f"mode_{mode}") for mode, code in codes.items()}


def _floats(name: str, first_byte: int, axes: range, unit: str) -> list[Signal]:
    return [
        Signal(f"{name}_axis{axis}", 8 * (first_byte + 4 * i), 32, "float", 1.0, unit)
        for i, axis in enumerate(axes)
    ]


def _slow(start: int) -> list[Signal]:
    """The values that share one place, distinguished by the multiplexer."""
    units = {"D2": "rev/cycle", "extra1": "A", "extra2": "kg m2", "extra3": ""}
    signals = [
        Signal(
            f"{name}_axis{axis + 1}", start, 32, "float", 1.0, units[name],
            mux=MAX_AXES * field + axis,
        )
        for field, name in enumerate(SLOW_FIELDS)
        for axis in range(MAX_AXES)
    ]  # fmt: skip
    return [*signals, Signal("functionality", start, 32, mux=FUNCTIONALITY)]


_ALL: Final = range(1, MAX_AXES + 1)


def fd_frames() -> tuple[FrameLayout, ...]:
    """Cyclic frames and segments of the FD profile."""
    names = _mode_names(FD_MODE_CODES)
    up_modes = [Signal(f"mode_axis{a}", 8 * (1 + a), 8, values=names) for a in _ALL]
    down_modes = [Signal(f"mode_axis{a}", 8 * (3 + a), 8, values=names) for a in _ALL]
    mirrored = [Signal(f"mirrored_axis{a}", 23 + a, 1) for a in _ALL]
    return (
        FrameLayout(
            FD_DOWN, "DOWN", 64, "PC",
            (Signal("number", 0, 16), Signal("status", 16, 8), *mirrored, *down_modes,
             *_floats("D1", 12, _ALL, "rev"), *_floats("D2", 36, _ALL, "rev/cycle")),
            "Answer of a cycle.",
        ),
        FrameLayout(
            FD_UP_A, "UP_A", 64, "Controller",
            (Signal("number", 0, 16), *up_modes, *_floats("D1", 8, _ALL, "rev"),
             *_floats("D3", 32, _ALL, "rev"), *_floats("D4", 56, range(1, 3), "rev/cycle")),
            "First half of a cycle.",
        ),
        FrameLayout(
            FD_UP_B, "UP_B", 48, "Controller",
            (Signal("number", 0, 16), Signal("status", 16, 8),
             Signal("slow", 24, 8, multiplexer=True), *_slow(32),
             *_floats("D4", 8, range(3, 7), "rev/cycle"), *_floats("D5", 24, _ALL, "A")),
            "Second half of a cycle, with one slow value.",
        ),
        *_segments(64),
    )  # fmt: skip


def classic_frames() -> tuple[FrameLayout, ...]:
    """Cyclic frames and segments of the classic profile."""
    names = _mode_names(CLASSIC_MODE_CODES)
    revolution = 1.0 / COUNTS_PER_REVOLUTION
    axis_signals = (
        Signal("counter", 0, UP_COUNTER_BITS),
        Signal("mode", 4, 4, values=names),
        Signal("D3", 8, REVOLUTION_BITS, "signed", revolution, "rev"),
        Signal("D1_minus_D3", 35, DIFFERENCE_BITS, "signed", revolution, "rev"),
        Signal("D5", 52, CURRENT_BITS, "signed", 1.0 / COUNTS_PER_AMPERE, "A"),
    )
    header = (
        Signal("number", 0, 16),
        Signal("status", 16, 8),
        Signal("slow", 24, 8, multiplexer=True),
        *_slow(32),
    )
    return (
        *(_classic_down(pair, frame_id, revolution) for pair, frame_id in enumerate(CLASSIC_DOWN)),
        FrameLayout(CLASSIC_UP_HEADER, "UP_HEADER", 8, "Controller", header, "Begins a cycle."),
        *(
            FrameLayout(frame_id, f"UP_AXIS_{axis}", 8, "Controller", axis_signals, f"Axis {axis}.")
            for axis, frame_id in enumerate(CLASSIC_UP_AXIS, start=1)
        ),
        *_segments(8),
    )


def _classic_down(pair: int, frame_id: int, revolution: float) -> FrameLayout:
    first, second = 2 * pair + 1, 2 * pair + 2
    signals = (
        Signal("counter", 0, DOWN_COUNTER_BITS),
        Signal(f"action_axis{first}", 6, 2, values=_ACTION_NAMES),
        Signal(f"D1_axis{first}", 8, REVOLUTION_BITS, "signed", revolution, "rev"),
        Signal(f"action_axis{second}", 35, 2, values=_ACTION_NAMES),
        Signal(f"D1_axis{second}", 37, REVOLUTION_BITS, "signed", revolution, "rev"),
    )
    comment = f"Answer of a cycle for axes {first} and {second}."
    return FrameLayout(frame_id, f"DOWN_{pair + 1}", 8, "PC", signals, comment)


def _segments(length: int) -> tuple[FrameLayout, ...]:
    signals = (
        Signal("transfer", 0, 8),
        Signal("segment", 8, 8, multiplexer=True),
        Signal("packet_length", 16, 16, mux=0),
        Signal("crc32", 32, 32, mux=0),
    )
    comment = "Segment of a packet that is not cyclic; from segment 1 on, data from byte 2 on."
    down = FrameLayout(SEGMENT_DOWN, "SEGMENT_DOWN", length, "PC", signals, comment)
    up = FrameLayout(SEGMENT_UP, "SEGMENT_UP", length, "Controller", signals, comment)
    return down, up


FILES: Final = {
    "fd": Path(__file__).with_name("c4g_open_fd.dbc"),
    "classic": Path(__file__).with_name("c4g_open_classic.dbc"),
}
_NODES: Final = ("Controller", "PC")
_LARGEST_FLOAT: Final = "3.4E+38"


def dbc_text(profile: str) -> str:
    """The whole file for "fd" or "classic"."""
    fd = profile == "fd"
    frames = fd_frames() if fd else classic_frames()
    lines = ['VERSION ""', "", "NS_ :", "", "BS_:", "", f"BU_: {' '.join(_NODES)}", ""]
    for frame in frames:
        lines.append(f"BO_ {frame.id} {frame.name}: {frame.length} {frame.sender}")
        receiver = next(node for node in _NODES if node != frame.sender)
        lines += [_signal(signal, receiver) for signal in frame.signals]
        lines.append("")
    lines += [f'CM_ BO_ {frame.id} "{frame.comment}";' for frame in frames]
    lines += _attributes(frames, fd=fd)
    for frame in frames:
        for signal in frame.signals:
            if signal.values is not None:
                names = " ".join(f'{value} "{name}"' for value, name in signal.values.items())
                lines.append(f"VAL_ {frame.id} {signal.name} {names} ;")
    for frame in frames:
        lines += [
            f"SIG_VALTYPE_ {frame.id} {signal.name} : 1;"
            for signal in frame.signals
            if signal.kind == "float"
        ]
    return "\n".join(lines) + "\n"


def _signal(signal: Signal, receiver: str) -> str:
    mux = " M" if signal.multiplexer else "" if signal.mux is None else f" m{signal.mux}"
    sign = "+" if signal.kind == "unsigned" else "-"
    low, high = _range(signal)
    return (
        f" SG_ {signal.name}{mux} : {signal.start}|{signal.length}@1{sign} "
        f'({signal.scale!r},0) [{low}|{high}] "{signal.unit}" {receiver}'
    )


def _range(signal: Signal) -> tuple[str, str]:
    if signal.kind == "float":
        return f"-{_LARGEST_FLOAT}", _LARGEST_FLOAT
    if signal.kind == "signed":
        most = ((1 << signal.length - 1) - 1) * signal.scale
        return repr(-most), repr(most)
    return "0", repr((1 << signal.length) - 1)


def _attributes(frames: Sequence[FrameLayout], *, fd: bool) -> list[str]:
    """What tools read the kind of frame from."""
    kinds = ",".join(f'"{name}"' for name in _FRAME_FORMATS)
    kind = _FRAME_FORMATS.index("StandardCAN_FD" if fd else "StandardCAN")
    return [
        'BA_DEF_ "BusType" STRING ;',
        f'BA_DEF_ BO_ "VFrameFormat" ENUM {kinds};',
        'BA_DEF_DEF_ "BusType" "CAN";',
        'BA_DEF_DEF_ "VFrameFormat" "StandardCAN";',
        f'BA_ "BusType" "{"CAN FD" if fd else "CAN"}";',
        *(f'BA_ "VFrameFormat" BO_ {frame.id} {kind};' for frame in frames),
    ]


_FRAME_FORMATS: Final = (
    "StandardCAN", "ExtendedCAN", "reserved", "J1939PG",
    *(f"reserved{i}" for i in range(4, 14)), "StandardCAN_FD", "ExtendedCAN_FD",
)  # fmt: skip


def main() -> None:
    """Write the files."""
    for profile, path in FILES.items():
        path.write_text(dbc_text(profile), encoding="ascii")
        sys.stdout.write(f"{path.name} written\n")


if __name__ == "__main__":
    main()
