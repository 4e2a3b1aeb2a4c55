"""DBC files made from the layout: ``python -m drivers.transports.can.dbc`` writes them anew.

They ship with the package, so that any CAN tool can decode a trace.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from drivers.transports.can.layout import FrameLayout, Signal, classic_frames, fd_frames

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
