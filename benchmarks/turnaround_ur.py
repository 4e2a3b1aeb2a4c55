"""From a frame of RTDE to its set-point: exchange process and controller process, 500 Hz.

The controller is the simulated one with the program of `hil`, over real ports, with an arm that
follows without dynamics. The exchange runs a long motion of six joints under the guard, as in `hil
run`, while an ordinary process drains its ring.

    python -m benchmarks.turnaround_ur [--minutes N] [--busy] [--json]

A set-point is late if it comes more than one cycle after its frame was sent, or never; the output
says where the time of each went. A bare process on each processor notes meanwhile when the machine
itself stalls (`benchmarks.machine_stalls`): `late_by_stalls` are late set-points that would have
come in time without these stalls, `late_otherwise` are the program's own, and
`latest_otherwise_ms` is the longest time of these from a frame to its set-point without stalls.
`packets_late`, `replies_late` and `not_accepted` are the counts of `drivers.punctuality` during the
motion, `exchange_page_faults` the page faults of the exchange process then. `machine_busy` is the
share of all processors in use, ours and others'. With `--busy` every processor is kept busy by an
ordinary process.
"""

from __future__ import annotations

import multiprocessing
import os
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks import machine_stalls, parser_of, show
from benchmarks.session import FADE, LOOP, Sinusoids
from benchmarks.turnaround import Array, figures, steal_ticks
from benchmarks.turnaround_ends import WARM_UP, drain, spin
from drivers import MotionEnded
from drivers.exchange.process_handle import ExchangeProcess, ExchangeSettings
from drivers.exchange.realtime import RealTimeSettings, enter
from hil.cell import Cell
from hil.control.simulator_process import free_port
from sim_fixtures.ur import CELL_PATH, SimulatedUr, UrArmTruth, UrServer, UrSettings

PERIOD: Final = 0.002
_BEARABLE: Final = 50
"""Set-points in a row that may be late without an end of the measurement."""
_SETTLING_SECONDS: Final = 1.0
"""Time after which the frames that came while the exchange started are read."""
_COUNTS: Final = (
    ("packets_late", "late_packets"), ("replies_late", "late"), ("not_accepted", "rejected"),
)  # fmt: skip
_spawn = multiprocessing.get_context("spawn")


class _Plant:
    def __init__(self, position: Array) -> None:
        self.position = position
        self.velocity = np.zeros(6)

    def set_state(self, position: Array, velocity: Array) -> None:
        self.position, self.velocity = position, velocity


class IdealArm:
    """An arm that is where its target is; it costs the controller no time."""

    def __init__(self, position: Array) -> None:
        self.plant = _Plant(position)
        self.truth = UrArmTruth()
        self.current = self.target_moment = self.target_current = np.zeros(6)
        self.temperature = np.full(6, 27.0)

    def step(self, q: Array, qd: Array, qdd: Array) -> None:
        """Follow the targets of a cycle."""
        del qdd
        self.plant.set_state(q, qd)

    def rest(self) -> None:
        """Stay."""

    def measured_current(self) -> Array:
        """Return no current."""
        return self.current

    def measured_position(self) -> Array:
        """Return the position."""
        return self.plant.position

    def measured_velocity(self) -> Array:
        """Return the velocity."""
        return self.plant.velocity


class TimedUr(SimulatedUr):
    """A controller with an ideal arm that notes when each set-point comes.

    Attributes:
        came: time at which the set-point to each frame came [s], by number of the set-point.
    """

    def __init__(self, at: Array, cycles: int) -> None:
        super().__init__(UrSettings(remote_control=True), at=at)
        self.arm = IdealArm(at)  # type: ignore[assignment]
        self.came = np.full(cycles, np.nan)
        self.ended_by = ""

    def write_inputs(self, values: Mapping[str, float]) -> None:
        """See `SimulatedUr.write_inputs`."""
        number = int(values.get("input_int_register_24", 0))
        if 0 < number < len(self.came):
            self.came[number] = time.monotonic()
        super().write_inputs(values)

    def upload(self, text: str) -> None:
        """See `SimulatedUr.upload`; a stall of this computer is to be measured, not stopped at."""
        super().upload(text)
        if self._loaded is not None and self._loaded[1] is not None:
            self._loaded = (self._loaded[0], replace(self._loaded[1], watchdog=3600.0))


class TimedServer(UrServer):
    """A server that notes when each frame was due and sent [s], by cycle since the first client."""

    def __init__(self, controller: TimedUr, cycles: int, **ports: int) -> None:
        super().__init__(controller, **ports)  # type: ignore[arg-type]
        self.due = np.full(cycles, np.nan)
        self.sent = np.full(cycles, np.nan)
        self.sending = 0

    def _send_cycle(self) -> None:
        served = self.clients > 0
        # The number of a set-point is that of its frame, from 1 on.
        if served and (index := self.sending + 1) < len(self.sent):
            self.sending = index
            self.due[index] = self._due - PERIOD
            self.sent[index] = time.monotonic()
        super()._send_cycle()


@dataclass(frozen=True)
class Settings:
    """What the controller's process needs."""

    cell: Cell
    cycles: int
    realtime: RealTimeSettings
    result: str


def control(settings: Settings) -> None:
    """The controller's process, until the motion has ended or its cycles are over."""
    table = settings.cell.controller.rtde
    robot = TimedUr(settings.cell.initial, settings.cycles)
    server = TimedServer(
        robot, settings.cycles,
        rtde=table.port, primary=table.primary_port, dashboard=table.dashboard_port,
    )  # fmt: skip
    report = enter(settings.realtime)
    streamed = False

    def is_over() -> bool:
        nonlocal streamed
        streams = robot.stream is not None
        over = streamed and not streams
        streamed = streamed or streams
        return over or server.sending + 1 >= settings.cycles

    server.run(is_over)
    server.close()
    np.savez(
        settings.result, came=robot.came, due=server.due, sent=server.sent,
        ended=np.array(server.sending), scheduling=np.array(report.scheduling),
        ending=np.array(robot.output_registers.ints.get(28, 0)),
    )  # fmt: skip


def cell_at_free_ports() -> Cell:
    """The simulated UR5e, at ports of this computer that are free."""
    ports = {name: free_port() for name in ("port", "primary_port", "dashboard_port")}
    values = {f"controller.rtde.{name}": port for name, port in ports.items()}
    return Cell.load(CELL_PATH).with_values(values)


def measure(cycles: int, folder: Path) -> dict[str, Any]:
    """Run once; return times at the controller and at the exchange, and the machine's stalls."""
    with machine_stalls.watched(folder) as stalls:
        times = _times(cycles, folder)
    return times | {"stalls": stalls}


def _times(cycles: int, folder: Path) -> dict[str, Any]:
    cell = cell_at_free_ports()
    processors = os.sched_getaffinity(0)
    answering = RealTimeSettings(priority=50, cpu=max(processors))
    asking = replace(answering, priority=60, cpu=min(processors))
    ends, arrivals = folder / "ends.npz", folder / "arrivals.npz"
    stolen, ticks = steal_ticks(), processor_ticks()
    controller = _spawn.Process(
        target=control, args=(Settings(cell, cycles, asking, str(ends)),), daemon=True
    )
    controller.start()
    protocol = cell.ur_protocol
    program = replace(protocol.program, patience=_BEARABLE + 1)
    session = {
        "max_gap": _BEARABLE, "silence_timeout": 3600.0,
        "protocol": replace(protocol, program=program),
    }  # fmt: skip
    settings = ExchangeSettings(
        cell.transport_spec(), cell.drive_train, cell.guard_limits, cell.period,
        cell.session_settings() | session,
        realtime=answering, needs_archive=False, max_late=1_000_000,
        preload=("benchmarks.session",),
    )  # fmt: skip
    exchange = _started(settings)
    reader = _spawn.Process(target=drain, args=(os.getpid(), exchange.ring_fd, str(arrivals)))
    try:
        reader.start()
        time.sleep(_SETTLING_SECONDS)
        before = exchange.status()
        exchange.submit(Sinusoids(LOOP + FADE, PERIOD, loop=LOOP))
        faults = latest = page_faults(exchange.pid)
        while controller.is_alive():
            exchange.send_heartbeat()
            if exchange.alive:
                latest = page_faults(exchange.pid)
            controller.join(0.1)
        arrivals.with_suffix(".end").touch()
        while reader.is_alive():
            exchange.send_heartbeat()
            reader.join(0.1)
        status, log = exchange.status(), exchange.log
        endings = [event.reason for event in exchange.events() if isinstance(event, MotionEnded)]
        realtime = exchange.realtime
    finally:
        for process in (reader, controller):
            if process.is_alive():
                process.kill()
        if exchange.alive:
            exchange.kill()
        exchange.close()
    with np.load(ends) as file:
        times = dict(file)
    with np.load(arrivals) as file:
        times |= {f"exchange_{name}": array for name, array in file.items()}
    return times | {
        "status": status, "before": before, "log": log, "endings": endings, "realtime": realtime,
        "page_faults": latest - faults,
        "steal": steal_ticks() - stolen, "busy": busy_share(ticks), "load": os.getloadavg(),
    }  # fmt: skip


def processor_ticks() -> Array:
    """Return the ticks of all processors by use, as in /proc/stat."""
    return np.array(Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:9], float)


def busy_share(before: Array) -> float:
    """Return the share of the processors' time since then that was not idle."""
    passed = processor_ticks() - before
    idle = passed[3] + passed[4]  # idle, and waiting for a disk
    return float(1.0 - idle / max(passed.sum(), 1.0))


def page_faults(process: int) -> int:
    """Return the page faults of a process so far."""
    # The name, in parentheses, may contain spaces.
    fields = Path("/proc", str(process), "stat").read_text().rpartition(")")[2].split()
    return int(fields[7]) + int(fields[9])


def _started(settings: ExchangeSettings) -> ExchangeProcess:
    """Start the exchange as soon as the controller listens."""
    until = time.monotonic() + 60.0
    while True:
        try:
            return ExchangeProcess.start(settings)
        except Exception:
            if time.monotonic() > until:
                raise
            time.sleep(0.2)


def summary(times: Mapping[str, Any], cycles: int) -> dict[str, Any]:
    """The figures of one run: times from frame to set-point, and where late ones were late."""
    sent, due = times["sent"], times["due"]
    last = int(times["ended"])
    came = _by_frame(times["came"], sent[:last])
    first = next((k for k in range(1, last) if np.isfinite(came[k : k + WARM_UP]).all()), last)
    arrival = np.full(len(sent), np.nan)
    inside = times["exchange_cycle"] + 1 < len(arrival)
    # The set-point to a frame has the number after that of its cycle.
    arrival[times["exchange_cycle"][inside] + 1] = times["exchange_arrival"][inside]
    arrival = _by_frame(arrival, sent[:last])
    rows = slice(first + WARM_UP, last - 2)
    sent, came, due, arrival = (values[rows] for values in (sent, came, due, arrival))
    result = figures_of(came - sent)
    late = ~(came - sent <= PERIOD)
    # A frame without a set-point was left out for a newer one, whose set-point came instead.
    answered_by = np.where(np.isnan(came), np.fmin.accumulate(came[::-1])[::-1], came)
    union = machine_stalls.merged(times["stalls"])
    stalled = machine_stalls.stalled_within(union, sent[late], answered_by[late])
    otherwise = answered_by[late] - sent[late] - stalled
    own = ~(otherwise <= PERIOD)
    to_exchange = (arrival - sent)[late]
    answered = (came - arrival)[late]
    parts = (("to_exchange", arrival - sent), ("in_exchange_and_back", came - arrival))
    for name, part in parts:
        result[f"{name}_p50_us"], result[f"{name}_p99_us"] = (
            round(1e6 * float(value), 1) for value in np.nanpercentile(part, (50.0, 99.0))
        )
    result |= {
        "late_by_stalls": int(late.sum() - own.sum()),
        "late_otherwise": int(own.sum()),
        "latest_otherwise_ms": round(1e3 * float(otherwise.max(initial=0.0)), 3),
        **machine_stalls.figures(times["stalls"], PERIOD),
        "cycles": len(sent),
        "wanted": cycles,
        "late_on_the_way_or_in_the_controller": int((to_exchange > 0.5 * PERIOD).sum()),
        "late_without_arrival": int(np.isnan(to_exchange).sum()),
        "late_in_the_exchange": int((answered > 0.5 * PERIOD).sum()),
        "frames_sent_late": int((sent - due > 0.5 * PERIOD).sum()),
        "frame_latest_ms": round(1e3 * float(np.nanmax(sent - due)), 3),
        "exchange_scheduling": times["realtime"].scheduling,
        "exchange_memory_locked": times["realtime"].memory_locked,
        "exchange_cpu_awake": times["realtime"].cpu_awake,
        "exchange_refused": "; ".join(times["realtime"].refused),
        "exchange_page_faults": times["page_faults"],
        "controller_scheduling": str(times["scheduling"]),
        **{
            name: getattr(times["status"], field) - getattr(times["before"], field)
            for name, field in _COUNTS
        },
        "steal_ticks": times["steal"],
        "machine_busy": round(times["busy"], 2),
        "load_average": round(times["load"][0], 1),
        "ended_by": ", ".join(times["endings"]),
        "log": times["log"],
    }
    return result


def _by_frame(times: Array, sent: Array) -> Array:
    """Return times by number of the set-point as times by frame, of which earlier ones are skipped.

    The exchange begins with the newest of the frames that came while its process started.
    """
    numbers = np.flatnonzero(np.isfinite(times))
    frame = np.searchsorted(sent[1:], times[numbers]) - numbers
    offset = int(np.median(frame)) if len(frame) else 0
    shifted = np.full_like(times, np.nan)
    at = numbers + offset
    inside = (at >= 0) & (at < len(times))
    shifted[at[inside]] = times[numbers[inside]]
    return shifted


def figures_of(durations: Array) -> dict[str, Any]:
    """Percentiles [us] and counts; `late` are those beyond a cycle."""
    found = figures(durations)
    found.pop("missed")
    found["late"] = int((~(durations <= PERIOD)).sum())
    return found


def main() -> None:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--busy", action="store_true", help="with every processor busy")
    options = parser.parse_args()
    begin = time.monotonic()
    cycles = round(60.0 * options.minutes / PERIOD) + 4 * WARM_UP
    loads = []
    if options.busy:
        for _ in os.sched_getaffinity(0):
            loads.append(_spawn.Process(target=spin, args=(os.getpid(),), daemon=True))
            loads[-1].start()
    try:
        with tempfile.TemporaryDirectory() as folder:
            result = summary(measure(cycles, Path(folder)), cycles)
    finally:
        for load in loads:
            load.kill()
    result["seconds"] = round(time.monotonic() - begin)
    show(result, only_json=options.json)


if __name__ == "__main__":
    main()
