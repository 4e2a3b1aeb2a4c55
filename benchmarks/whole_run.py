"""The whole `hil identify` of a simulated log: processor time against an ordinary fit, and memory.

`benchmarks.identification` prints the figures. Each program runs in a fresh process, start and
imports of Python included: ``hil identify ARCHIVE --output FOLDER`` with default settings, which
writes the report and all files, and ``benchmarks.plain_fit``, on the same log. Both fit the first
70 % and predict the rest. The log is one of the NS 16 of `benchmarks.coverage`.

Raw logs are of a Panda, seven axes in columns of text. Their times are also given in units of the
machine's slowness: of what the ordinary fit of the NS 16 at 1 kHz takes, over the 5.5 s that it
took on the machine of `performance.md`.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.arms import ARMS, urdf
from benchmarks.coverage import ARM_TYPES, Conditions, drawn_arm, logged
from benchmarks.fresh_process import Usage, usage
from benchmarks.joint_log import JointLog
from hil.importers.imported_robot import Robot

RATES: Final = (1000.0, 250.0)  # Hz
DURATION: Final = 30.0  # s
MINUTES: Final = (1.0, 2.0, 4.0, 8.0)
MEMORY_RATE: Final = 1000.0  # Hz
URDF: Final = ARMS["ns16"]
_ARM: Final = ARM_TYPES["ns16"]
_LOG_ARM: Final = ARM_TYPES["panda"]
_LOG_RATE: Final = 1000.0  # Hz
_FIT_SECONDS: Final = 5.5  # s, of the ordinary fit on the machine of `performance.md`
_NOT_GOOD: Final = 5  # exit status of `hil identify` where the model is not good
_DELAY: Final = 0.0  # s


def simulated_archive(folder: Path, duration: float, rate: float) -> Path:
    """Simulate and import a log of six axes; its arrays are beside the archive, as .npz."""
    log = logged(drawn_arm(_ARM, 1), 1, 0, duration, _DELAY, Conditions(rate=rate, scale=0.0))
    robot = Robot.from_urdf(urdf(URDF))
    joint_log = JointLog(robot, log.time, log.position, None, log.torque, _ARM.rated_payload)
    return joint_log.imported(folder / "log.mcap")


def identified(archive: Path, output: Path) -> Usage:
    """Identify an archive by the command line."""
    command = [sys.executable, "-m", "hil", "identify", str(archive), "--output", str(output)]
    return usage(command, accepted=(0, _NOT_GOOD))


def fitted(archive: Path) -> Usage:
    """Fit the log of an archive in the ordinary way."""
    arguments = [str(archive.with_suffix(".npz")), str(urdf(URDF))]
    return usage([sys.executable, "-m", "benchmarks.plain_fit", *arguments])


def times(rates: Sequence[float] = RATES, duration: float = DURATION) -> dict[str, float]:
    """Processor times [s] of both, and their ratio, by sampling rate [Hz]."""
    result = {}
    for rate in rates:
        with tempfile.TemporaryDirectory() as scratch:
            archive = simulated_archive(Path(scratch), duration, rate)
            ours = identified(archive, Path(scratch) / "result")
            plain = fitted(archive)
        name = f"whole_{rate:.0f}_hz"
        result[f"{name}_s"] = round(ours.seconds, 2)
        result[f"{name}_plain_s"] = round(plain.seconds, 2)
        result[f"{name}_ratio_to_plain"] = round(ours.seconds / plain.seconds, 2)
    return result


def memory(minutes: Sequence[float] = MINUTES, rate: float = MEMORY_RATE) -> dict[str, float]:
    """Peak memory [MB] and processor time [s], by minutes of log."""
    result = {}
    for duration in minutes:
        with tempfile.TemporaryDirectory() as scratch:
            archive = simulated_archive(Path(scratch), 60.0 * duration, rate)
            ours = identified(archive, Path(scratch) / "result")
        result[f"memory_{duration:g}_min_mb"] = round(ours.peak_mb, 1)
        result[f"memory_{duration:g}_min_s"] = round(ours.seconds, 2)
    return result


def written_logs(folder: Path, duration: float = DURATION, rate: float = _LOG_RATE) -> list[Path]:
    """Write a simulated log of seven axes as columns of text, whole and in two halves."""
    log = logged(drawn_arm(_LOG_ARM, 1), 1, 0, duration, _DELAY, Conditions(rate=rate, scale=0.0))
    joints = range(1, log.position.shape[1] + 1)
    names = ["time_s", *(f"q{j}_rad" for j in joints), *(f"tau{j}_Nm" for j in joints)]
    rows = np.column_stack([log.time, log.position, log.torque])
    middle = len(rows) // 2
    parts = {"whole": rows, "first": rows[:middle], "second": rows[middle:]}
    for name, part in parts.items():
        place = folder / f"{name}.csv"
        np.savetxt(place, part, fmt="%.8g", delimiter=",", header=",".join(names), comments="")
    return [folder / f"{name}.csv" for name in parts]


def raw_log(duration: float = DURATION, rate: float = _LOG_RATE) -> dict[str, float]:
    """Processor times [s] from a log in columns of text, and in units of the machine's slowness."""
    hil = [sys.executable, "-m", "hil"]
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        log, *halves = written_logs(folder, duration, rate)
        fit = fitted(simulated_archive(folder, duration, rate)).seconds
        arm = ["--urdf", str(urdf(_LOG_ARM.urdf))]
        commands = {
            "help": ["--help"],
            "help_of_look": ["look", "--help"],
            "look": ["look", str(log), *arm],
            "identify": ["identify", str(log), *arm, "-o", str(folder / "whole")],
            "identify_halves": ["identify", *map(str, halves), *arm, "-o", str(folder / "halves")],
        }
        seconds = {
            name: usage([*hil, *command], accepted=(0, _NOT_GOOD)).seconds
            for name, command in commands.items()
        }
    unit = fit / _FIT_SECONDS
    figures = {"log_unit": round(unit, 2)}
    for name, used in seconds.items():
        figures[f"log_{name}_s"] = round(used, 2)
        figures[f"log_{name}_units"] = round(used / unit, 2)
    return figures
