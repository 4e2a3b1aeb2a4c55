"""From request to answer: exchange process and controller process on the loopback device, 1 kHz.

The controller is paced by absolute deadlines; the exchange runs a long motion of six joints under
the guard while an ordinary process drains its ring. In the same run, in blocks that alternate, a
bare echo process with the same scheduling shows what this machine can do at all (the floor).

    python -m benchmarks.turnaround [--cycles N] [--busy] [--stages] [--json]

A reply later than one cycle after its request is missed; the output says where the time of each
went. With `--busy` everything is repeated beside a process that keeps a processor busy. With
`--stages` the time of the exchange process is printed by stage, each median and 99 % in us.
"""

from __future__ import annotations

import multiprocessing
import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks import parser_of, show, turnaround_stages
from benchmarks.session import Sinusoids, drive_train, limits
from benchmarks.turnaround_ends import (
    HOST,
    PERIOD,
    WARM_UP,
    Settings,
    control,
    drain,
    echo,
    spin,
)
from drivers import MotionEnded
from drivers.exchange.process_handle import ExchangeProcess, ExchangeSettings
from drivers.exchange.realtime import RealTimeSettings
from drivers.transports.udp import UdpSpec
from hil.control.simulator_process import free_port

Array = NDArray[np.float64]

CLOSED_CYCLES = 5
_spawn = multiprocessing.get_context("spawn")


def exchange_settings(port: int, realtime: RealTimeSettings) -> ExchangeSettings:
    """A session that bears the pauses while the floor is measured, and stalls of 50 cycles."""
    session = {"silence_timeout": 3600.0, "max_gap": 50}
    return ExchangeSettings(
        UdpSpec(HOST, port, HOST),
        drive_train(),
        limits(),
        PERIOD,
        session,
        realtime=realtime,
        needs_archive=False,
        preload=("benchmarks.session", "benchmarks.turnaround_stages"),
        max_late=1_000_000,
    )


def steal_ticks() -> int:
    """Return the ticks that the host of a virtual machine used its processors for others."""
    return int(Path("/proc/stat").read_text().split("\n", 1)[0].split()[8])


def measure(cycles: int, blocks: int, folder: Path) -> dict[str, Any]:
    """Run once; return its times and the reports of its processes."""
    last = max(os.sched_getaffinity(0))
    answering = RealTimeSettings(priority=50, cpu=last)
    asking = replace(answering, priority=60, cpu=min(os.sched_getaffinity(0)))
    ends = folder / "ends.npz"
    arrivals = folder / "arrivals.npz"
    ours, theirs = _spawn.Pipe()
    port = free_port()
    stolen = steal_ticks()
    exchange = ExchangeProcess.start(exchange_settings(port, answering))
    floor = _spawn.Process(target=echo, args=(theirs, answering), daemon=True)
    reader = _spawn.Process(target=drain, args=(os.getpid(), exchange.ring_fd, str(arrivals)))
    controller = None
    try:
        reader.start()
        floor.start()
        while not ours.poll(0.1):
            exchange.send_heartbeat()
        settings = Settings(port, ours.recv(), cycles, blocks, asking, str(ends))
        controller = _spawn.Process(target=control, args=(settings,))
        exchange.submit(Sinusoids(cycles + 2 * WARM_UP + 1, PERIOD))
        controller.start()
        while controller.is_alive():
            exchange.send_heartbeat()
            controller.join(0.1)
        arrivals.with_suffix(".end").touch()
        while reader.is_alive():
            exchange.send_heartbeat()
            reader.join(0.1)
        status = exchange.status()
        ended = exchange.wait(2.0)
    finally:
        for process in (reader, floor, controller):
            if process is not None and process.is_alive():
                process.kill()
        if exchange.alive:
            exchange.kill()
    with np.load(ends) as file:
        times = dict(file)
    with np.load(arrivals) as file:
        times |= {f"exchange_{name}": array for name, array in file.items()}
    log = exchange.log
    ends_of_motion = [event for event in exchange.events() if isinstance(event, MotionEnded)]
    exchange.close()
    if times["fault"] or ended != 0:
        raise SystemExit(f"the run failed: {times['fault']} {ended} {log} {ends_of_motion}")
    times |= {"status": status, "realtime": exchange.realtime, "steal": steal_ticks() - stolen}
    return times


def trip(times: dict[str, Any], end: str) -> Array:
    """Return the time from request to reply, s, of each measured cycle; NaN without a reply."""
    skipped = WARM_UP + (CLOSED_CYCLES if end == "ours" else 0)
    durations: Array = (times[f"{end}_received"] - times[f"{end}_sent"])[skipped:]
    return durations


def accounts(times: dict[str, Any]) -> list[dict[str, Any]]:
    """Return each late or missing reply of the exchange with its probable cause."""
    first = WARM_UP + CLOSED_CYCLES
    durations = trip(times, "ours")
    arrival = np.full(len(durations) + first + 1, np.nan)
    cycle = times["exchange_cycle"]
    inside = (cycle >= 1) & (cycle <= len(arrival))
    arrival[cycle[inside] - 1] = times["exchange_arrival"][inside]
    rows = []
    for index in np.flatnonzero(~(durations <= PERIOD)):
        at = int(index) + first
        to_exchange = float(arrival[at] - times["ours_sent"][at])
        answered = float(times["ours_received"][at] - arrival[at])
        if np.isnan(to_exchange):
            what = "the exchange was delayed and replied to a later packet"
        elif to_exchange > 0.5 * PERIOD:
            what = "the network or the controller was delayed before the packet arrived"
        elif np.isnan(answered):
            what = "the reply was lost"
        else:
            what = "the exchange, or the controller waiting for it, was delayed"
        rows.append(
            {
                "cycle": int(index),
                "what": what,
                "to_exchange_us": _us(to_exchange),
                "from_exchange_us": _us(answered),
                "controller_woke_late_us": _us(float(times["ours_woke_late"][at])),
            }
        )
    return rows


def figures(durations: Array) -> dict[str, Any]:
    """Return percentiles of the durations, s, of the cycles that were answered.

    `missed` counts cycles without a reply within their period, `never_answered` those without any.
    """
    came = durations[np.isfinite(durations)]
    result: dict[str, Any] = {}
    for name, share in (("p50_us", 50.0), ("p99_us", 99.0), ("p999_us", 99.9), ("max_us", 100)):
        result[name] = _us(float(np.percentile(came, share))) if len(came) else None
    result["answered"] = len(came)
    result["never_answered"] = len(durations) - len(came)
    result["missed"] = int((~(durations <= PERIOD)).sum())
    return result


def _us(seconds: float) -> float | None:
    return round(1e6 * seconds, 1) if np.isfinite(seconds) else None


def summary(times: dict[str, Any]) -> dict[str, Any]:
    """The figures of one run; percentiles are those of the answers that came, see `figures`."""
    result: dict[str, Any] = {}
    for end, prefix, late in (("ours", "", "missed"), ("floor", "floor_", "floor_late")):
        for name, value in figures(trip(times, end)).items():
            result[late if name == "missed" else prefix + name] = value
    status = times["status"]
    result |= {
        "cycles": len(trip(times, "ours")),
        "controller_late": int((times["ours_woke_late"] > PERIOD).sum()),
        "left_out": status.late - status.replied_late,
        "answered_late": status.replied_late,
        "worst_turnaround_us": round(status.worst_turnaround_us, 1),
        "pickup_us": round(status.pickup_us, 1),
        "records_lost": int(times["exchange_overflow"]),
        "steal_ticks": times["steal"],
        "scheduling": times["realtime"].scheduling,
        "misses": accounts(times),
    }
    return result


def run(cycles: int, blocks: int, *, busy: bool) -> dict[str, Any]:
    """One run, beside a load or not."""
    load = _spawn.Process(target=spin, args=(os.getpid(),), daemon=True)
    if busy:
        load.start()
    try:
        with tempfile.TemporaryDirectory() as folder:
            return summary(measure(cycles, blocks, Path(folder)))
    finally:
        if busy:
            load.kill()


def stage_figures(times: NDArray[np.int64]) -> dict[str, Any]:
    """Median and 99 % of each stage, and of their sum, us; `times` (cycles, stages) ns."""
    columns = dict(zip(turnaround_stages.NAMES, times.T, strict=True))
    columns["all"] = times.sum(axis=1)
    return {
        f"{name}_us": [_us(1e-9 * float(p)) for p in np.percentile(column, (50.0, 99.0))]
        for name, column in columns.items()
    }


def main() -> None:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--cycles", type=int, default=100_000)
    parser.add_argument("--blocks", type=int, default=10)
    parser.add_argument("--busy", action="store_true", help="once more beside a busy processor")
    parser.add_argument("--stages", action="store_true", help="where the exchange spends the time")
    options = parser.parse_args()
    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        stages = Path(folder) / "stages.npy"
        if options.stages:
            os.environ[turnaround_stages.FILE] = str(stages)
        result = run(options.cycles, options.blocks, busy=False)
        os.environ.pop(turnaround_stages.FILE, None)
        if options.stages:
            result |= stage_figures(np.load(stages)[WARM_UP:])
    if options.busy:
        beside = run(options.cycles, options.blocks, busy=True)
        result |= {f"busy_{name}": value for name, value in beside.items()}
    result["seconds"] = round(time.monotonic() - begin)
    show(result, only_json=options.json)


if __name__ == "__main__":
    main()
