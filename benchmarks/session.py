"""Cost of one cycle: session, guard and drive train of a six-joint arm in open mode.

A first run records what a controller with a perfect arm sends while a sinusoid runs; the timed
runs replay these packets, so that only `Session.reply` (with the motion source's table look-up
inside) stands between the two clock readings. `--warm` cycles at the beginning are left out.

    python -m benchmarks.session [--json] [--cycles N] [--runs N]
"""

# ruff: noqa: E402  the number of BLAS threads has to stand before numpy is imported

from __future__ import annotations

import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"

import argparse
import gc
import json
import time

import numpy as np
from numpy.typing import NDArray

from drivers import CycleRing, DriveTrain, Guard, GuardLimits, InitPacket, Mode, Session, State
from drivers.motion_source import BoundsName
from drivers.packets import DRIVE_ON, CyclicPacket, next_number

Array = NDArray[np.float64]

PERIOD_MS = 2
N = 6
AMPLITUDE = np.array([0.8, 0.5, 0.6, 0.9, 0.7, 1.2])
FREQUENCY = np.array([0.21, 0.17, 0.26, 0.31, 0.37, 0.29])


class Sinusoid:
    """Joint sinusoids from rest, faded in over two seconds, as a table."""

    bounds: BoundsName = "plan"

    def __init__(self, start: Array, cycles: int) -> None:
        t = np.arange(cycles + 1)[:, None] * (PERIOD_MS / 1000.0)
        s = np.clip(t / 2.0, 0.0, 1.0)
        fade = s**4 * (35.0 - 84.0 * s + 70.0 * s**2 - 20.0 * s**3)
        rate = 0.5 * 140.0 * s**3 * (1.0 - s) ** 3
        phase = 2.0 * np.pi * FREQUENCY * t
        self.position = start + AMPLITUDE * fade * np.sin(phase)
        slope = fade * 2.0 * np.pi * FREQUENCY * np.cos(phase) + rate * np.sin(phase)
        self.velocity = AMPLITUDE * slope
        self.start = start
        self._index = 0

    @property
    def finished(self) -> bool:
        """Whether the table is at its end."""
        return self._index + 1 >= len(self.position)

    def begin(self, position: Array) -> None:
        """Shift the table to where the arm is."""
        self.position = self.position + (position - self.start)

    def advance(self) -> tuple[Array, Array]:
        """The next row."""
        self._index += 1
        return self.position[self._index], self.velocity[self._index]

    def stop(self) -> None:
        """Not asked for."""
        raise NotImplementedError("the benchmark never stops")


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


def new_session(capacity: int) -> Session:
    """A session with limits that the sinusoid keeps."""
    limits = GuardLimits(
        lower=np.full(N, -3.0),
        upper=np.full(N, 3.0),
        velocity=np.full(N, 3.0),
        acceleration=np.full(N, 20.0),
        jerk=np.full(N, 300.0),
        following_error=np.full(N, 2.0),
        current=np.full(N, 20.0),
    )
    return Session(drive_train(), Guard(limits, PERIOD_MS / 1000.0), CycleRing(N, capacity))


def record(cycles: int) -> list[bytes]:
    """Packets of a controller whose arm is where it was told to be."""
    session = new_session(64)
    start = np.array([0.1, -0.2, 0.3, -0.4, 0.5, -0.6])
    drives = drive_train()
    init = InitPacket.build(
        N,
        PERIOD_MS,
        {
            "following_error": np.full(N, 2.0),
            "current_limit": np.full(N, 20.0),
            "gear_ratio": drives.gear_ratio,
            "calibration": drives.calibration,
            "kinematic_influence": [0.0, 0.0, 0.0, drives.k54, drives.k64, drives.k65],
        },
    ).encode()
    packets = [init]
    session.reply(init, 0.0)
    session.request(Sinusoid(start, cycles))
    axes = CyclicPacket.zeros(1, N).axes
    axes["d"][:, 0] = axes["d"][:, 2] = drives.motor_revolutions(start)
    axes["d"][:, 4] = 1.0
    number = 10
    for cycle in range(cycles):
        number = next_number(number)
        axes["mode"] = Mode.CLOSED if cycle < 3 else Mode.POSITION
        status = bytes([DRIVE_ON, 0, 0, 0])
        packet = CyclicPacket(number, status, bytes(4), axes.copy()).encode()
        packets.append(packet)
        reply = session.reply(packet, cycle * PERIOD_MS / 1000.0)
        assert reply is not None
        told = CyclicPacket.decode(reply, N).axes["d"]
        axes["d"][:, 0] = axes["d"][:, 2] = told[:, 0]
        axes["d"][:, 1] = axes["d"][:, 3] = told[:, 1]
    assert session.state is State.OPEN, session.events()[-1]
    return packets


def replay(packets: list[bytes]) -> Array:
    """Duration of each `reply`, s."""
    session = new_session(4096)
    session.reply(packets[0], time.perf_counter())
    session.request(Sinusoid(np.array([0.1, -0.2, 0.3, -0.4, 0.5, -0.6]), len(packets)))
    reply, clock = session.reply, time.perf_counter
    durations = np.empty(len(packets) - 1)
    gc.disable()
    for index, packet in enumerate(packets[1:]):
        begin = clock()
        reply(packet, begin)
        durations[index] = clock() - begin
    gc.enable()
    assert session.state is State.OPEN, session.events()[-1]
    return durations


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--json", action="store_true", help="only the line of JSON")
    parser.add_argument("--cycles", type=int, default=20_000)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--warm", type=int, default=1_000)
    options = parser.parse_args()
    packets = record(options.cycles)
    durations = np.array([replay(packets)[options.warm :] for _ in range(options.runs)]) * 1e6
    # Another process can only make a cycle longer: the quietest run is nearest the truth.
    quietest = durations[np.argmin(np.median(durations, axis=1))]
    result = {
        "median_us": round(float(np.median(quietest)), 2),
        "p99_us": round(float(np.percentile(quietest, 99)), 2),
        "worst_run_median_us": round(float(np.median(durations, axis=1).max()), 2),
        "cycles": len(quietest),
    }
    if not options.json:
        print(f"session + guard + drive train, {N} joints, {PERIOD_MS} ms, open mode")
        for name, value in result.items():
            print(f"  {name:20s} {value}")
    print(json.dumps(result))


if __name__ == "__main__":
    main()
