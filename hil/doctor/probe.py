"""Measurements in separate processes with the real-time settings of the exchange.

`python -m hil.doctor.probe KIND ...` prints one JSON line. Latencies are written to a file of
float32 seconds after the measurement, so that a night of cycles fits into locked memory.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.child_process import ChildProcess
from drivers.exchange.realtime import RealTimeSettings, enter

PACKET_BYTES = 228
"""Bytes of a cyclic packet of six axes."""
REPLY_TIMEOUT = 0.5
"""Time after which a packet counts as lost, s."""
_BLOCK_BYTES = 64 * 1024
_TIMED_WRITES = 20


def wake_ups(period: float, seconds: float) -> NDArray[np.float32]:
    """Return the delays of a timer, s, at absolute deadlines; missed ones are skipped."""
    late = np.empty(max(round(seconds / period), 1), dtype=np.float32)
    count = 0
    clock = time.perf_counter
    sleep = time.sleep
    deadline = clock() + period
    end = deadline + seconds
    while deadline < end and count < len(late):
        sleep(max(deadline - clock(), 0.0))
        late[count] = lateness = clock() - deadline
        count += 1
        deadline += period * (1 + int(max(lateness, 0.0) / period))
    return np.maximum(late[:count], 0.0)


def round_trips(port: int, period: float, seconds: float) -> NDArray[np.float32]:
    """Return the times from packet to reply, s; `REPLY_TIMEOUT` for a lost one, others awaited."""
    took = np.empty(max(round(seconds / period), 1), dtype=np.float32)
    count = 0
    clock = time.perf_counter
    sleep = time.sleep
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.connect(("127.0.0.1", port))
        link.settimeout(REPLY_TIMEOUT)
        deadline = clock() + period
        end = deadline + seconds
        while deadline < end and count < len(took):
            sleep(max(deadline - clock(), 0.0))
            sent = clock()
            link.send(count.to_bytes(4, "little") + bytes(PACKET_BYTES - 4))
            took[count] = _wait_for_reply(link, count, sent)
            count += 1
            deadline += period * (1 + int(max(clock() - deadline, 0.0) / period))
        link.send(b"end")
    return took[:count]


def _wait_for_reply(link: socket.socket, number: int, sent: float) -> float:
    while time.perf_counter() - sent < REPLY_TIMEOUT:
        try:
            if int.from_bytes(link.recv(PACKET_BYTES)[:4], "little") == number:
                return time.perf_counter() - sent
        except OSError:  # a time-out, or the other process has ended
            break
    return REPLY_TIMEOUT


def echo() -> None:
    """Return every packet on a free loopback port (printed first) until one is "end"."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind(("127.0.0.1", 0))
        link.settimeout(5.0)
        enter(RealTimeSettings())
        _print_json({"port": link.getsockname()[1]})
        while True:
            try:
                packet, peer = link.recvfrom(PACKET_BYTES)
            except TimeoutError:
                return
            if packet == b"end":
                return
            link.sendto(packet, peer)


def turnaround(period: float, seconds: float) -> NDArray[np.float32]:
    """Measure round trips between two real-time processes over loopback UDP."""
    peer = ChildProcess(("-m", "hil.doctor.probe", "echo"))
    try:
        while "\n" not in peer.output and peer.wait(0.05) is None:
            pass
        port = json.loads(peer.output)["port"]
        enter(RealTimeSettings())
        return round_trips(int(port), period, seconds)
    finally:
        peer.kill()
        peer.close()


def disk(place: Path) -> dict[str, object]:
    """Measure free space and times of 64 KiB writes with `fdatasync`, s, at or above `place`."""
    folder = nearest_folder(place)
    answer: dict[str, object] = {"folder": str(folder), "free": shutil.disk_usage(folder).free}
    took: list[float] = []
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            for _ in range(_TIMED_WRITES):
                file.write(os.urandom(_BLOCK_BYTES))
                file.flush()
                began = time.perf_counter()
                os.fdatasync(file.fileno())
                took.append(time.perf_counter() - began)
                time.sleep(0.02)
    except OSError as error:
        return answer | {"error": error.strerror or str(error)}
    return answer | {"seconds": took}


def nearest_folder(path: Path) -> Path:
    """Return `path` or its nearest existing parent."""
    path = path.absolute()
    while not path.is_dir() and path != path.parent:
        path = path.parent
    return path


def _print_json(answer: object) -> None:
    sys.stdout.write(json.dumps(answer) + "\n")
    sys.stdout.flush()


def main(arguments: list[str]) -> None:
    """Run one probe."""
    kind, *values = arguments
    if kind == "permissions":
        _print_json(asdict(enter(RealTimeSettings())))
    elif kind == "disk":
        _print_json(disk(Path(values[0])))
    elif kind == "echo":
        echo()
    else:
        measure = {"wake-up": wake_ups, "turnaround": turnaround}[kind]
        if kind == "wake-up":
            enter(RealTimeSettings())
        np.save(values[2], measure(float(values[0]), float(values[1])))
        _print_json({"file": values[2]})


if __name__ == "__main__":
    main(sys.argv[1:])
