"""A PC program that is none of ours: `socket` and `struct`, written from the wire's description.

It answers a controller in either of two manners known from programs that ran on real robots:
"library" (closed axes get zeros, axes just opened get their actual position) and "lab" (the packet
comes back as received while the drive is off, received targets come back while axes are closed).
In open mode it lets one axis swing in a sine from where it stood. It prints one line whenever what
it receives changes, and a JSON object at the end.

    python foreign_pc.py --port 2001 --exit-after 500
"""

from __future__ import annotations

import argparse
import json
import math
import socket
import struct
import sys
from collections import Counter

HEADER = struct.Struct("<i4s4s")
AXIS = struct.Struct("<i8f")
DRIVE_ON = 5
EXIT = 1
END = 504
DRIVE_OFF = 505
OPEN_MODES = (1, 2, 4, 5, 7, 8, 9)


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--manner", choices=("library", "lab"), default="lab")
    parser.add_argument("--amplitude", type=float, default=0.5, help="motor revolutions")
    parser.add_argument("--sine-period", type=int, default=500, help="cycles")
    parser.add_argument("--exit-after", type=int, default=1000, help="open cycles; 0: never")
    parser.add_argument("--send-505", type=int, default=0, metavar="N", help="in open cycle N")
    return parser.parse_args()


class Program:
    """One PC program; `answer` is given every datagram."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        self.n = 0
        self.period_ms = 0
        self.open_cycles = 0
        self.start: list[float] = []
        self.excursion = 0.0
        self.shown: object = None
        self.seen: Counter[str] = Counter()
        self.story: list[str] = []
        self.fault_sent = False
        self.over = False
        self.moved = 0.0
        self.range = [math.inf, -math.inf]

    def answer(self, data: bytes) -> bytes | None:
        number = struct.unpack_from("<i", data)[0]
        reply = struct.pack("<i", 1 if number == 0x7FFF else number + 1)
        if len(data) == 1200 and number == 10:
            return self.init(data, reply)
        if self.n == 0 or (self.seen["sync after init"] < 2 and not any(data[4:])):
            kind = "sync after init" if self.n else "sync"
            self.seen[kind] += 1
            self.show(number, kind)
            return reply + data[4:]
        if len(data) < 12 + 36 * self.n:
            self.seen["short"] += 1
            return None
        return self.cyclic(data, reply)

    def init(self, data: bytes, reply: bytes) -> bytes:
        self.seen["init"] += 1
        self.n = struct.unpack_from("<i", data, 12)[0]
        self.period_ms = struct.unpack_from("<i", data, 224)[0]
        slots = struct.unpack_from("<10i", data, 228)
        gears = struct.unpack_from("<10f", data, 880)
        self.show(10, "init", f"{self.n} axes, {self.period_ms} ms, slots {slots[: self.n]},"
                  f" gear ratios {[round(g, 3) for g in gears[: self.n]]}")  # fmt: skip
        return reply + data[4:]

    def cyclic(self, data: bytes, reply: bytes) -> bytes | None:
        number, status, _ = HEADER.unpack_from(data)
        axes = [list(AXIS.unpack_from(data, 12 + 36 * i)) for i in range(self.n)]
        modes = [int(axis[0]) for axis in axes]
        on = status[0] == DRIVE_ON
        shown = axes[0]
        self.seen["cyclic"] += 1
        far = self.range[1] - self.range[0] > 1
        self.range = [min(self.range[0], shown[3]), max(self.range[1], shown[3])]
        if not far and self.range[1] - self.range[0] > 1:
            say(f"{number:6d}  more than one revolution")
        self.show(
            number,
            f"status {status[0]}, modes {modes}",
            f"axis 1: D1 {shown[1]:.4f}, D3 {shown[3]:.4f}",
        )
        if modes[0] == END:
            self.over = True
            return reply + (data[4:] if not on else bytes(8) + b"".join(map(closed_axis, axes)))
        opened = on and all(mode in OPEN_MODES for mode in modes)
        if not opened:
            self.open_cycles = 0
            return self.while_not_open(data, reply, on, axes, modes)
        return self.while_open(reply, axes)

    def while_not_open(
        self, data: bytes, reply: bytes, on: bool, axes: list[list[float]], modes: list[int]
    ) -> bytes:
        lab = self.options.manner == "lab"
        if not on and lab:
            return reply + data[4:]
        blocks = []
        for axis, mode in zip(axes, modes, strict=True):
            if mode in OPEN_MODES and on:
                first = 0.0 if mode not in (1, 4, 5) else axis[1] if lab else axis[3]
                blocks.append(AXIS.pack(mode, first, *[0.0] * 7))
            elif lab:
                blocks.append(AXIS.pack(mode, axis[1], axis[2], *[0.0] * 6))
            else:
                blocks.append(closed_axis([mode]))
        return reply + bytes(8) + b"".join(blocks)

    def while_open(self, reply: bytes, axes: list[list[float]]) -> bytes:
        options = self.options
        k = self.open_cycles
        if k == 0:
            self.start = [axis[1] for axis in axes]
            self.excursion = 0.0
        self.open_cycles += 1
        self.moved = max(self.moved, abs(axes[0][3] - self.start[0]))
        off = options.send_505 == k > 0 and not self.fault_sent
        self.fault_sent |= off
        leaving = bool(options.exit_after) and k >= options.exit_after
        asks = leaving and (k - options.exit_after) % 100 == 0  # in one packet; again if unheard
        # a sine that begins and ends each turn at rest
        wanted = options.amplitude * (1 - math.cos(2 * math.pi * k / options.sine_period)) / 2
        if leaving:
            wanted = self.excursion
        step = wanted - self.excursion
        self.excursion = wanted
        blocks = []
        for i, axis in enumerate(axes):
            moving = i == 0
            mode = int(axis[0])
            demand = self.demand(mode, self.start[i], wanted * moving, step * moving)
            mode = DRIVE_OFF if off else mode
            blocks.append(AXIS.pack(mode, *demand, 0.0, 0.0, 0.0))
        self.seen["505" if off else "exit asked" if asks else "set-points"] += 1
        return reply + bytes((EXIT if asks else 0, 0, 0, 0)) + bytes(4) + b"".join(blocks)

    def demand(self, mode: int, start: float, wanted: float, step: float) -> tuple[float, ...]:
        if mode in (1, 4, 5):
            return (start + wanted, step, 0.0, 0.0, 0.0)
        if mode == 7:
            return (wanted, 0.0, 0.0, 0.0, 0.0)
        return (0.0,) * 5

    def show(self, number: int, state: str, more: str = "") -> None:
        if state != self.shown:
            self.shown = state
            self.story.append(state)
            say(f"{number:6d}  {state}  {more}".rstrip())


def say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def closed_axis(axis: list[float]) -> bytes:
    return AXIS.pack(int(axis[0]), *[0.0] * 8)


def main() -> int:
    options = arguments()
    program = Program(options)
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    receiver.bind(("", options.port))
    receiver.settimeout(60.0)
    say(f"listening on port {options.port}")
    try:
        while not program.over:
            data, sender = receiver.recvfrom(1500)
            reply = program.answer(data)
            if reply is not None:
                receiver.sendto(reply, sender)
    except TimeoutError:
        say("silence; giving up")
    finally:
        receiver.close()
    outcome = {
        "seen": program.seen,
        "story": program.story,
        "moved": program.moved,
        "travel": program.range[1] - program.range[0],
        "period_ms": program.period_ms,
        "over": program.over,
    }
    say(json.dumps(outcome))
    return 0 if program.over else 1


if __name__ == "__main__":
    sys.exit(main())
