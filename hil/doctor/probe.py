"""Measures in a process of its own, with the real-time settings of the exchange.

The command line itself so never runs in real time. `python -m hil.doctor.probe KIND ...` prints
one JSON line.

Latencies go to a file of float32 seconds, written after the measurement: fine enough for any of
them, and a night of cycles still fits into locked memory.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.exchange.realtime import RealTimeSettings, enter

PACKET = 228
"""Bytes of a cyclic packet of six axes."""
PATIENCE = 0.5
"""s after which a question counts as never answered."""
_BLOCK = 64 * 1024
_WRITES = 20


def wake_ups(period: float, seconds: float) -> NDArray[np.float32]:
    """How late a timer wakes this process, s, at absolute deadlines `period` apart.

    A deadline that passed while the process was late is skipped, not made up for.
    """
    late = np.empty(max(round(seconds / period), 1), dtype=np.float32)
    count, clock, sleep = 0, time.perf_counter, time.sleep
    deadline = clock() + period
    end = deadline + seconds
    while deadline < end and count < len(late):
        sleep(max(deadline - clock(), 0.0))
        late[count] = lateness = clock() - deadline
        count += 1
        deadline += period * (1 + int(max(lateness, 0.0) / period))
    return np.maximum(late[:count], 0.0)


def ask(port: int, period: float, seconds: float) -> NDArray[np.float32]:
    """Times from question to answer, s; one that never comes counts `PATIENCE`.

    The next question waits for the answer, so a stall shows as one long time, as long as it was.
    """
    took = np.empty(max(round(seconds / period), 1), dtype=np.float32)
    count, clock, sleep = 0, time.perf_counter, time.sleep
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.connect(("127.0.0.1", port))
        link.settimeout(PATIENCE)
        deadline = clock() + period
        end = deadline + seconds
        while deadline < end and count < len(took):
            sleep(max(deadline - clock(), 0.0))
            sent = clock()
            link.send(count.to_bytes(4, "little") + bytes(PACKET - 4))
            took[count] = _answered(link, count, sent)
            count += 1
            deadline += period * (1 + int(max(clock() - deadline, 0.0) / period))
        link.send(b"end")
    return took[:count]


def _answered(link: socket.socket, number: int, sent: float) -> float:
    while time.perf_counter() - sent < PATIENCE:
        try:
            if int.from_bytes(link.recv(PACKET)[:4], "little") == number:
                return time.perf_counter() - sent
        except OSError:  # a time-out, or the far end is gone
            break
    return PATIENCE


def echo() -> None:
    """Answer every packet on a free loopback port (printed first) until asked to end."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind(("127.0.0.1", 0))
        link.settimeout(5.0)
        enter(RealTimeSettings())
        _say({"port": link.getsockname()[1]})
        while True:
            try:
                packet, peer = link.recvfrom(PACKET)
            except TimeoutError:
                return
            if packet == b"end":
                return
            link.sendto(packet, peer)


def turnaround(period: float, seconds: float) -> NDArray[np.float32]:
    """Question and answer between two real-time processes over loopback UDP."""
    command = [sys.executable, "-m", "hil.doctor.probe", "echo"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stdin=subprocess.DEVNULL) as far_end:
        try:
            assert far_end.stdout is not None
            port = json.loads(far_end.stdout.readline())["port"]
            enter(RealTimeSettings())
            return ask(int(port), period, seconds)
        finally:
            far_end.kill()


def disk(place: Path) -> dict[str, object]:
    """Room at `place` (or the nearest folder above it that exists), and times of writes, s.

    A write is 64 KiB and the wait until the disk has it, as the archive does it.
    """
    folder = nearest_folder(place)
    answer: dict[str, object] = {"folder": str(folder), "free": shutil.disk_usage(folder).free}
    took: list[float] = []
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            for _ in range(_WRITES):
                file.write(os.urandom(_BLOCK))
                file.flush()
                began = time.perf_counter()
                os.fdatasync(file.fileno())
                took.append(time.perf_counter() - began)
                time.sleep(0.02)
    except OSError as error:
        return answer | {"error": error.strerror or str(error)}
    return answer | {"seconds": took}


def nearest_folder(place: Path) -> Path:
    """`place`, or the nearest folder above it that exists."""
    place = place.absolute()
    while not place.is_dir() and place != place.parent:
        place = place.parent
    return place


def _say(answer: object) -> None:
    sys.stdout.write(json.dumps(answer) + "\n")
    sys.stdout.flush()


def main(words: list[str]) -> None:
    """Run one probe."""
    kind, *rest = words
    if kind == "permissions":
        _say(asdict(enter(RealTimeSettings())))
    elif kind == "disk":
        _say(disk(Path(rest[0])))
    elif kind == "echo":
        echo()
    else:
        measure = {"wake-up": wake_ups, "turnaround": turnaround}[kind]
        if kind == "wake-up":
            enter(RealTimeSettings())
        np.save(rest[2], measure(float(rest[0]), float(rest[1])))
        _say({"file": rest[2]})


if __name__ == "__main__":
    main(sys.argv[1:])
