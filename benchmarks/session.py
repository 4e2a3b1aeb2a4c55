"""Cost of one cycle: session, guard and drive train of a six-joint arm in open mode.

A first run records what a controller with a perfect arm sends while periodic joint sinusoids run;
the timed runs replay these packets, period after period with running numbers, so that only
`Session.reply` (with the motion source's table look-up inside) is timed. `--warm` cycles at the
beginning are left out.

With enough cycles for it, the cost of the first and of the last `--window` cycles are compared,
and a further run measures what memory was allocated in between and not released.

`--profile` prints instead where the processor's time of a cycle goes: shares of `Session.reply`,
each with the calls inside it. Python's profiler makes short calls count too much.

    python -m benchmarks.session [--json] [--cycles N] [--runs N] [--window N] [--profile]
"""

from __future__ import annotations

import argparse
import cProfile
import gc
import struct
import time
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benchmarks import parser_of, show
from drivers import CycleRing, DriveTrain, Guard, GuardLimits, InitPacket, Mode, Session, State
from drivers.c4g_packets import DRIVE_ON, CyclicPacket, next_number
from drivers.motion_source import BoundsName

Array = NDArray[np.float64]

PERIOD_MS = 2
N = 6
AMPLITUDE = np.array([0.8, 0.5, 0.6, 0.9, 0.7, 1.2])
FREQUENCY = np.array([0.21, 0.17, 0.26, 0.31, 0.37, 0.29])
FADE_TIME = 2.0
"""Time in which the sinusoids fade in, s."""
FADE = 1_000
"""Cycles of that time."""
LOOP = 50_000
"""Cycles after which all of them, being multiples of 0.01 Hz, begin again."""
START = np.array([0.1, -0.2, 0.3, -0.4, 0.5, -0.6])


_LEAST_SHARE: Final = 0.03  # of a cycle


def sines(t: Array, start: Array, fade_time: float) -> tuple[Array, Array]:
    """Position and velocity (m, 6) of joint sinusoids from rest, faded in, at times (m,)."""
    s = np.clip(t[:, None] / fade_time, 0.0, 1.0)
    fade = s**4 * (35.0 - 84.0 * s + 70.0 * s**2 - 20.0 * s**3)
    rate = 140.0 * s**3 * (1.0 - s) ** 3 / fade_time
    phase = 2.0 * np.pi * FREQUENCY * t[:, None]
    slope = fade * 2.0 * np.pi * FREQUENCY * np.cos(phase) + rate * np.sin(phase)
    return start + AMPLITUDE * fade * np.sin(phase), AMPLITUDE * slope


class Sinusoids:
    """Joint sinusoids from rest, faded in over two seconds, as a table of `cycles` periods.

    With `loop`, the last `loop` rows are repeated without end.
    """

    bounds: BoundsName = "plan"

    def __init__(self, cycles: int, period: float, loop: int = 0) -> None:
        times = np.arange(cycles, dtype=np.float64) * period
        self.position, self.velocity = sines(times, START, FADE_TIME)
        self.start = START
        self._loop = loop
        self._index = 0

    @property
    def finished(self) -> bool:
        """Whether the table is at its end."""
        return not self._loop and self._index + 1 >= len(self.position)

    def begin(self, position: Array) -> None:
        """Shift the table to where the arm is."""
        self.position = self.position + (position - self.start)

    def advance(self) -> tuple[Array, Array]:
        """The next row."""
        self._index += 1
        if self._loop and self._index == len(self.position):
            self._index -= self._loop
        return self.position[self._index], self.velocity[self._index]

    def stop(self) -> None:
        """End here; at speed the guard refuses that, and the benchmark fails."""
        self.position = self.position[: self._index + 1]
        self._loop = 0


def drive_train() -> DriveTrain:
    """A wrist-coupled six-joint drive train."""
    return DriveTrain(
        gear_ratio=np.array([-120.0, 150.0, -110.0, 90.0, 80.0, -60.0]),
        calibration=np.array([0.5, -1.25, 2.0, 0.0, 0.25, -0.75]),
        joint_sign=np.array([-1.0, 1.0, -1.0, -1.0, 1.0, -1.0]),
        joint_offset=np.array([0.0, 0.0, -1.5, 0.0, 1.5, 0.0]),
        torque_constant=np.full(N, 0.5),
        current_limit=np.full(N, 20.0),
        k54=0.01,
        k64=0.002,
        k65=0.03,
    )


def limits() -> GuardLimits:
    """Limits that the sinusoids keep."""
    return GuardLimits(
        lower=np.full(N, -3.0),
        upper=np.full(N, 3.0),
        velocity=np.full(N, 3.0),
        acceleration=np.full(N, 20.0),
        jerk=np.full(N, 300.0),
        following_error=np.full(N, 2.0),
        current=np.full(N, 20.0),
    )


def new_session(capacity: int) -> Session:
    """A session of these drives."""
    return Session(drive_train(), Guard(limits(), PERIOD_MS / 1000.0), CycleRing(N, capacity))


CLOSED = 3
"""Cycles before the axes open."""
_NUMBER = struct.Struct("<i")


def init_packet(period_ms: int) -> bytes:
    """What the controller of these drives announces."""
    drives = drive_train()
    return InitPacket.build(
        N,
        period_ms,
        {
            "following_error": np.full(N, 2.0),
            "current_limit": np.full(N, 20.0),
            "gear_ratio": drives.gear_ratio,
            "calibration": drives.calibration,
            "kinematic_influence": [0.0, 0.0, 0.0, drives.k54, drives.k64, drives.k65],
        },
    ).encode()


def record() -> list[bytes]:
    """Return packets of a controller with an ideal arm; the last `LOOP` may be repeated."""
    session = new_session(64)
    init = init_packet(PERIOD_MS)
    packets = [init]
    session.reply(init, 0.0)
    session.request(Sinusoids(FADE + LOOP, PERIOD_MS / 1000.0, LOOP))
    axes = CyclicPacket.zeros(1, N).axes
    axes["d"][:, 0] = axes["d"][:, 2] = drive_train().motor_revolutions(START)
    axes["d"][:, 4] = 1.0
    number = 10
    for cycle in range(CLOSED + 2 + FADE + LOOP):
        number = next_number(number)
        axes["mode"] = Mode.CLOSED if cycle < CLOSED else Mode.POSITION
        status = bytes([DRIVE_ON, 0, 0, 0])
        packet = CyclicPacket(number, status, bytes(4), axes.copy()).encode()
        packets.append(packet)
        reply = session.reply(packet, cycle * PERIOD_MS / 1000.0)
        assert reply is not None
        commanded = CyclicPacket.decode(reply, N).axes["d"]
        axes["d"][:, 0] = axes["d"][:, 2] = commanded[:, 0]
        axes["d"][:, 1] = axes["d"][:, 3] = commanded[:, 1]
    assert session.state is State.OPEN, session.events()[-1]
    return packets


def stream(packets: list[bytes], cycles: int) -> Iterator[bytes]:
    """`cycles` cyclic packets with running numbers."""
    number = 10
    index = 0
    for _ in range(cycles):
        number = next_number(number)
        index = index + 1
        if index == len(packets):
            index -= LOOP
        yield _NUMBER.pack(number) + packets[index][4:]


def begun(packets: list[bytes]) -> Session:
    """A session that has had the init packet and a motion requested."""
    session = new_session(4096)
    session.reply(packets[0], 0.0)
    session.request(Sinusoids(FADE + LOOP, PERIOD_MS / 1000.0, LOOP))
    return session


def replay(packets: list[bytes], cycles: int) -> Array:
    """Duration of each `reply`, s."""
    session = begun(packets)
    reply = session.reply
    clock = time.perf_counter
    durations = np.empty(cycles)
    gc.disable()
    for index, packet in enumerate(stream(packets, cycles)):
        begin = clock()
        # The link's own time, because a run is faster than the cycle and may be interrupted.
        reply(packet, index * PERIOD_MS / 1000.0)
        durations[index] = clock() - begin
    gc.enable()
    assert session.state is State.OPEN, session.events()[-1]
    return durations


def allocated(packets: list[bytes], cycles: int, warm: int) -> int:
    """Bytes allocated after `warm` cycles that are not free again after `cycles`."""
    session = begun(packets)
    for index, packet in enumerate(stream(packets, cycles)):
        if index == warm:
            tracemalloc.start()
            gc.collect()
            before = tracemalloc.get_traced_memory()[0]
        session.reply(packet, index * PERIOD_MS / 1000.0)
    gc.collect()
    growth = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert session.state is State.OPEN, session.events()[-1]
    return growth


def profile(cycles: int) -> dict[str, Any]:
    """Shares of the processor's time of `Session.reply`, the largest first."""
    packets = record()
    session = begun(packets)
    profiler = cProfile.Profile(time.process_time)
    for index, packet in enumerate(stream(packets, cycles)):
        now = index * PERIOD_MS / 1000.0
        profiler.runcall(session.reply, packet, now)
    assert session.state is State.OPEN, session.events()[-1]
    entries = profiler.getstats()
    calls = sum(entry.callcount for entry in entries)
    shares = {}
    for entry in entries:
        code = entry.code
        if not isinstance(code, str) and "drivers" in Path(code.co_filename).parts:
            shares[f"{Path(code.co_filename).stem}.{code.co_name}"] = entry.totaltime
    whole = shares["session.reply"]
    shares = {name: round(t / whole, 3) for name, t in shares.items() if t > _LEAST_SHARE * whole}
    ordered = sorted(shares.items(), key=lambda item: -item[1])
    return {"calls_per_cycle": round(calls / cycles), **dict(ordered)}


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """All figures."""
    packets = record()
    warm = options.warm
    window = options.window
    runs = np.array([replay(packets, options.cycles)[warm:] for _ in range(options.runs)]) * 1e6
    # Another process can only make a cycle longer: the quietest run is nearest the truth.
    quietest = runs[np.argmin(np.median(runs, axis=1))]
    result = {
        "median_us": round(float(np.median(quietest)), 2),
        "p99_us": round(float(np.percentile(quietest, 99)), 2),
        "worst_run_median_us": round(float(np.median(runs, axis=1).max()), 2),
        "cycles": len(quietest),
    }
    if len(quietest) >= 2 * window:
        result["median_first_us"] = round(float(np.median(quietest[:window])), 2)
        result["median_last_us"] = round(float(np.median(quietest[-window:])), 2)
        result["allocated_bytes"] = allocated(packets, options.cycles, warm)
    return result


def main() -> None:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--cycles", type=int, default=20_000)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--warm", type=int, default=1_000)
    parser.add_argument("--window", type=int, default=100_000)
    parser.add_argument("--profile", action="store_true", help="where the time goes")
    options = parser.parse_args()
    if options.cycles <= options.warm:
        parser.error(f"--cycles must be more than the {options.warm} of --warm")
    figures = profile(options.cycles) if options.profile else measure(options)
    show(figures, only_json=options.json)


if __name__ == "__main__":
    main()
