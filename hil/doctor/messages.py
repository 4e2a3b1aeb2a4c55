"""What the checks of a PC found, in words, with shell commands as remedies."""

from __future__ import annotations

import errno
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple, assert_never

from rich.console import Console
from rich.table import Table
from rich.text import Text

from drivers.exchange.realtime import LIMITS_FILE, RealTimeSettings
from hil.base.terminal_text import plural, printable
from hil.doctor.diagnosis import REPLY_RESERVE_SECONDS, Diagnosis, Fitness
from hil.doctor.findings import (
    CanInterface,
    CanState,
    CheckStatus,
    DiskRefused,
    DiskSilent,
    DiskSpace,
    DoctorCheck,
    Found,
    Governors,
    IdleStates,
    LockedMemory,
    MemoryLock,
    NoLink,
    Port,
    ProbeFailed,
    Route,
    RouteState,
    RtdeReply,
    RtdeSilent,
    Scheduling,
    UncheckedLink,
    WriteTimes,
)

GROUP = "realtime"
RULE_FILE = "/etc/udev/rules.d/90-hil.rules"
_JOIN = f'sudo groupadd -f {GROUP} && sudo usermod -aG {GROUP} "$USER"'
_LOG_IN_AGAIN = "# log out and in again, then: ulimit -r; ulimit -l"
_CPU = "/sys/devices/system/cpu"
CRITERIA: Final = (
    "a cycle is fit if no cycle of the measurement was late, with"
    f" {1e6 * REPLY_RESERVE_SECONDS:.0f} µs reserved for packet work and wire, and 99.9 % of the"
    " latencies used at most half of this time"
)
_MOVE = "# or put the campaign folder on another, local disk"


class CheckWords(NamedTuple):
    """A check in words: its name, what was found, and shell commands as remedy."""

    name: str
    facts: str
    remedy: tuple[str, ...] = ()


def check_words(check: DoctorCheck) -> CheckWords:
    """Return a check in words."""
    match check.found:
        case Scheduling() | MemoryLock() | Governors() | IdleStates() | ProbeFailed():
            return _of_computer(check.found)
        case DiskSilent() | DiskSpace() | DiskRefused() | WriteTimes():
            return _of_disk(check.found, check.status)
        case CanInterface():
            return _of_can(check.found)
        case Port():
            return _of_port(check.found)
        case Route():
            return _of_route(check.found)
    return _of_link(check.found)


def _limit_lines(item: str, value: str) -> tuple[str, ...]:
    line = f"echo '@{GROUP} - {item} {value}' | sudo tee -a {LIMITS_FILE}"
    return (_JOIN, line, _LOG_IN_AGAIN)


def _of_computer(
    found: Scheduling | MemoryLock | Governors | IdleStates | ProbeFailed,
) -> CheckWords:
    match found:
        case ProbeFailed(probe):
            name = probe if probe == "permissions" else f"{probe} latency"
            command = "python -m hil.doctor.probe permissions   # prints the error"
            return CheckWords(name, "the probe failed", (command,))
        case Scheduling():
            return _of_scheduling(found)
        case MemoryLock():
            return _of_memory(found)
        case Governors(names):
            setting = f"echo performance | sudo tee {_CPU}/cpu*/cpufreq/scaling_governor"
            is_slow = names not in ((), ("performance",))
            facts = ", ".join(names) or "no frequency scaling on this machine"
            return CheckWords("frequency governor", facts, (setting,) * is_slow)
        case IdleStates(excluded=True):
            return CheckWords("idle states", "not entered during an exchange")
        case IdleStates():
            rule = f'KERNEL=="cpu_dma_latency", GROUP="{GROUP}", MODE="0660"'
            remedy = (
                _JOIN,
                f"echo '{rule}' | sudo tee {RULE_FILE}",
                "sudo udevadm control --reload"
                " && sudo udevadm trigger --name-match=cpu_dma_latency",
                "# log out and in again, then: ls -l /dev/cpu_dma_latency; groups",
            )
            return CheckWords("idle states", "/dev/cpu_dma_latency may not be written", remedy)
    assert_never(found)


def _of_scheduling(found: Scheduling) -> CheckWords:
    name = "real-time priority"
    limited = "no limit" if found.limit < 0 else f"rtprio limit {found.limit}"
    if found.is_real_time:
        return CheckWords(name, f"{found.given} granted ({limited})")
    remedy = _limit_lines("rtprio", "98")
    if not 0 <= found.limit < RealTimeSettings().priority:
        remedy += ("cat /proc/sys/kernel/sched_rt_runtime_us   # 0 forbids real-time programs",)
    facts = f"refused, its scheduling is {found.given or 'ordinary'}; {limited}"
    return CheckWords(name, facts, remedy)


def _of_memory(found: MemoryLock) -> CheckWords:
    limited = "no limit" if found.limit < 0 else f"memlock limit {found.limit // 1024} KiB"
    remedy = _limit_lines("memlock", "unlimited")
    match found.extent:
        case LockedMemory.ALL:
            return CheckWords("memory lock", f"granted ({limited})")
        case LockedMemory.IN_USE_AT_START:
            facts = f"only what is in use at the start; {limited}"
            return CheckWords("memory lock", facts, remedy)
        case LockedMemory.NONE:
            return CheckWords("memory lock", f"refused; {limited}", remedy)
    assert_never(found.extent)


def _of_disk(
    found: DiskSilent | DiskSpace | DiskRefused | WriteTimes, status: CheckStatus
) -> CheckWords:
    match found:
        case DiskSilent(folder):
            facts = f"the disk of {folder} does not respond"
            return CheckWords("disk write", facts, (f"df -h {folder}", _MOVE))
        case DiskSpace(folder, free, hours):
            facts = f"{free / 1e9:.1f} GB free at {folder}: {hours:.1f} h of recording at 1 ms"
            remedy = () if status is CheckStatus.OK else (f"du -xh {folder} | sort -h | tail",)
            return CheckWords("disk space", facts, remedy)
        case DiskRefused(folder, error):
            facts = f"cannot write to {folder}: {error or 'no result'}"
            return CheckWords("disk write", facts, (f"ls -ld {folder}; id", _MOVE))
        case WriteTimes(middle, longest):
            facts = f"64 KiB written in {1e3 * middle:.1f} ms, at most {1e3 * longest:.1f} ms"
            return CheckWords("disk write", facts, () if status is CheckStatus.OK else (_MOVE,))
    assert_never(found)


def _of_can(found: CanInterface) -> CheckWords:
    bus = found.bus
    name = f"CAN {bus.interface} {bus.channel}"
    rates = f"bitrate {bus.bitrate or 1_000_000} dbitrate {bus.data_bitrate or 5_000_000} fd on"
    bring_up = f"sudo ip link set {bus.channel} up txqueuelen 100 type can {rates}"
    data = f", data {found.data_rate} bit/s" if found.data_rate else ""
    facts = f"up, {found.rate} bit/s{data}"
    match found.state:
        case CanState.NOT_EXAMINED:
            return CheckWords(name, "not a kernel device; it is opened by the exchange only")
        case CanState.NO_INTERFACE:
            look = "ip -brief link show type can"
            load = "sudo modprobe can_raw   # and the card's driver"
            return CheckWords(name, "is not a CAN interface", (look, load))
        case CanState.DOWN:
            return CheckWords(name, "down", (bring_up,))
        case CanState.VIRTUAL:
            return CheckWords(name, "virtual bus, no bit rate")
        case CanState.UNSTATED:
            remedy = (f"ip -details link show {bus.channel}",)
            return CheckWords(name, "bit rate not stated", remedy)
        case CanState.AS_WANTED:
            return CheckWords(name, facts)
        case CanState.OTHER_RATES:
            down = f"sudo ip link set {bus.channel} down"
            return CheckWords(name, f"{facts}; the cell needs {rates}", (down, bring_up))
    assert_never(found.state)


def _of_port(found: Port) -> CheckWords:
    wanted = found.wanted
    name = f"{wanted.protocol} port {wanted.port}"
    match found.error:
        case 0:
            return CheckWords(name, f"can be bound on {wanted.bind}")
        case errno.EADDRINUSE:
            look = f"sudo ss -l{wanted.protocol[0].lower()}np sport = :{wanted.port}   # names it"
            return CheckWords(name, "in use by another program", (look,))
        case errno.EADDRNOTAVAIL:
            look = "ip -brief addr   # then set controller.bind in the cell file, or 0.0.0.0"
            return CheckWords(name, f"{wanted.bind} is not an address of this PC", (look,))
        case errno.EACCES | errno.EPERM:
            setting = f"net.ipv4.ip_unprivileged_port_start={wanted.port}"
            remedy = (
                f"echo '{setting}' | sudo tee /etc/sysctl.d/90-hil.conf && sudo sysctl --system",
                "# once; hil then needs no privilege for this port",
            )
            return CheckWords(name, "needs a privilege", remedy)
        case error:
            number = errno.errorcode.get(error, f"error {error}")
            return CheckWords(name, f"cannot be bound ({number})")


def _of_route(found: Route) -> CheckWords:
    name = "route to the controller"
    address, device = found.address, found.device
    match found.state:
        case RouteState.UNKNOWN_HOST:
            facts = f"{found.host!r} is neither an IPv4 address nor in /etc/hosts"
            write = f"# write an address in the cell file: host = 10.2.12.150, not {found.host}"
            return CheckWords(name, facts, (write,))
        case RouteState.NO_TOOL:
            return CheckWords(name, "ip is not installed", ("sudo apt install iproute2",))
        case RouteState.NONE:
            return CheckWords(name, f"none to {address}", ("ip -brief link", _add_for(address)))
        case RouteState.LOCAL:
            return CheckWords(name, f"{address} is this PC itself (a simulated controller)")
        case RouteState.GATEWAY:
            facts = f"over gateway {found.gateway} on {device}"
            return CheckWords(name, facts, (_add_for(address),))
        case RouteState.NO_CARRIER:
            bring_up = (f"sudo ip link set {device} up", "# check the cable")
            return CheckWords(name, f"{device} has no carrier", bring_up)
        case RouteState.DIRECT:
            return CheckWords(name, f"{address} directly on {device}")
    assert_never(found.state)


def _add_for(address: str) -> str:
    """Return the command that gives this PC an address next to that of the controller."""
    head, last = address.rsplit(".", 1)
    own = f"{head}.{int(last) - 1 if int(last) > 1 else int(last) + 1}"
    return f"sudo ip addr add {own}/24 dev CARD   # CARD: the one cabled to the controller"


def _of_link(found: Found) -> CheckWords:
    match found:
        case NoLink():
            return CheckWords("controller link", "none: no cell, or a simulated one")
        case UncheckedLink(description):
            return CheckWords("controller link", f"not checked: {description}")
        case RtdeReply(where, version, problem):
            facts = f"{where} replies: software {version}"
            if problem:
                facts += f" (recorded only; {problem})"
            return CheckWords("RTDE", facts)
        case RtdeSilent(where, error, remedy):
            remedy = remedy or "make sure that this is the RTDE port (30004)"
            return CheckWords("RTDE", f"{where}: {error}", (f"# {remedy}",))
    raise TypeError(type(found))


_COLOUR = {
    CheckStatus.OK: "green",
    CheckStatus.WARN: "yellow",
    CheckStatus.BAD: "red",
    CheckStatus.UNKNOWN: "blue",
}
_OTHERWISE = (
    "switch off C-states, frequency stepping and hyper-threading in the firmware set-up (BIOS); "
    "isolate a processor; {}use another PC."
)


def show(diagnosis: Diagnosis, console: Console) -> None:
    """Print checks, latencies, verdict and remedies."""
    table = Table(box=None, pad_edge=False)
    for title in ("check", "", "found"):
        table.add_column(title, overflow="fold")
    for check in diagnosis.checks:
        status = Text(check.status, style=_COLOUR[check.status])
        words = check_words(check)
        table.add_row(Text(words.name), status, Text(printable(words.facts)))
    console.print(table)
    lines = [
        f"{latency.name} [µs]: "
        + ", ".join(
            f"{name.removesuffix('_us')} {value:g}" for name, value in latency.summary().items()
        )
        for latency in diagnosis.latencies
    ]
    lines += fitness_lines(diagnosis.cycles)
    first = [*remedies(diagnosis.checks)]
    lines += [f"({CRITERIA})", *first]
    if not diagnosis.cycle_fit:
        case = "If it is still not fit after that" if first else "To make it fit"
        otherwise = _OTHERWISE.format("use 2 ms; " if diagnosis.cycles[1].fit else "")
        lines.append(f"\n{case}: {otherwise}")
    for line in (*lines, ""):
        console.print(printable(line), markup=False, highlight=False, soft_wrap=True)
    style = "bold green" if diagnosis.fit else "bold red"
    console.print(Text(printable(line_of(diagnosis)), style=style), soft_wrap=True)


def fitness_lines(verdicts: Sequence[Fitness]) -> list[str]:
    """Return a line for each verdict; cycles with the same verdict and reason share one."""
    cycles: dict[tuple[bool, str], list[str]] = {}
    for verdict in verdicts:
        cycles.setdefault((verdict.fit, reason_of(verdict)), []).append(str(verdict.cycle_ms))
    return [
        f"{' and '.join(alike)} ms: {'fit' if fit else 'not fit'}; {reason}"
        for (fit, reason), alike in cycles.items()
    ]


def summary(diagnosis: Diagnosis) -> list[str]:
    """Return the verdict, the checks that are not passed with their first remedy, and latencies."""
    worst_first = sorted(diagnosis.checks, key=lambda check: _STATUS_ORDER.index(check.status))
    failed = [check for check in worst_first if check.status is not CheckStatus.OK]
    lines = [line_of(diagnosis)]
    for check in failed:
        words = check_words(check)
        lines.append(f"{check.status}: {words.name}: {words.facts}")
        lines += [f"    {command}" for command in words.remedy[:1]]
    for latency in diagnosis.latencies:
        half, most, longest = (1e6 * latency.percentile(p) for p in (50.0, 99.9, 100.0))
        lines.append(
            f"{latency.name}: half within {half:.0f} µs, 99.9 % within {most:.0f} µs, all within"
            f" {longest:.0f} µs"
        )
    lines += fitness_lines(diagnosis.cycles)
    passed = [check_words(each).name for each in diagnosis.checks if each.status is CheckStatus.OK]
    return [*lines, *([f"ok: {', '.join(passed)}"] if passed else [])]


_STATUS_ORDER: Final = (CheckStatus.BAD, CheckStatus.WARN, CheckStatus.UNKNOWN, CheckStatus.OK)


def remedies(checks: Sequence[DoctorCheck]) -> Iterator[str]:
    """Yield the commands of each check with a remedy, worst first, each command once."""
    given: set[str] = set()
    for status in (CheckStatus.BAD, CheckStatus.WARN, CheckStatus.UNKNOWN):
        for check in checks:
            words = check_words(check)
            if check.status is status and words.remedy:
                yield f"\n{words.name} ({status}):"
                yield from (f"    {command}" for command in words.remedy if command not in given)
                given.update(words.remedy)


def as_json(diagnosis: Diagnosis) -> dict[str, object]:
    """Return all results; the keys are stable."""
    return {
        "fit": diagnosis.fit,
        "provisional": diagnosis.provisional,
        "cycle_ms": diagnosis.cycle_ms,
        "verdict": line_of(diagnosis),
        "criteria": CRITERIA,
        "seconds": diagnosis.seconds,
        "cycles": [_cycle_entry(verdict) for verdict in diagnosis.cycles],
        "latency": {each.name: each.summary() for each in diagnosis.latencies},
        "checks": [_check_entry(check) for check in diagnosis.checks],
    }


def _check_entry(check: DoctorCheck) -> dict[str, object]:
    name, facts, remedy = check_words(check)
    return {"name": name, "status": check.status, "facts": facts, "remedy": remedy}


def _cycle_entry(verdict: Fitness) -> dict[str, object]:
    bound, evidence = verdict.late_per_hour_upper_95, verdict.evidence
    return {
        "cycle_ms": verdict.cycle_ms,
        "fit": verdict.fit,
        "late_cycles": verdict.late_cycles,
        "share_used": None if evidence is None else round(evidence.share_used, 4),
        "late_per_hour_upper_95": None if bound is None else round(bound, 4),
        "reason": reason_of(verdict),
    }


def reason_of(verdict: Fitness) -> str:
    """Return why a cycle is fit or not."""
    evidence = verdict.evidence
    if evidence is None:
        return "nothing was measured"
    used = f"{100 * evidence.share_used:.0f} % of the cycle"
    if late := verdict.late_cycles:
        hours = evidence.seconds / 3600.0
        return (
            f"{plural(late, 'cycle')} late in {evidence.seconds:.0f} s of {evidence.worst} (about"
            f" {late / hours:.0f} an hour), the longest {1e3 * evidence.longest:.1f} ms"
        )
    if not verdict.fit:
        return f"none late, but {evidence.slow} uses {used} at 99.9 %"
    return (
        f"none late in {evidence.seconds:.0f} s (fewer than {verdict.late_per_hour_upper_95:.0f} an"
        f" hour, with 95 % confidence); {used} used at 99.9 %"
    )


def line_of(diagnosis: Diagnosis) -> str:
    """Return the verdict in one or two sentences."""
    fit_at_1_ms, fit_at_2_ms = (verdict.fit for verdict in diagnosis.cycles[:2])
    text = "2 ms is fit; 1 ms is not." if fit_at_2_ms else "Neither 1 ms nor 2 ms is fit."
    if fit_at_1_ms:  # and then 2 ms is
        text = "1 ms is fit, and so is 2 ms."
    if diagnosis.fit:
        text += f" This PC can answer a controller at {diagnosis.cycle_ms} ms."
    elif diagnosis.cycle_fit:
        bad = ", ".join(check_words(check).name for check in diagnosis.bad)
        text += f" But the link will not work: {bad}."
    else:
        text += f" Do not connect an arm at {diagnosis.cycle_ms} ms."
    if diagnosis.provisional:
        text += f" Provisional: measured for {diagnosis.seconds:g} s; at least 60 s are needed."
    return text
