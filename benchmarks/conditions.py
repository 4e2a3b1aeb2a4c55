"""Real logs as another logger would have written them, through what `hil identify LOG` runs.

Run with ``python -m benchmarks.conditions [--data FOLDER] [--only NAME] [--condition NAME]
[--json]``. Each held-out split of `benchmarks.board` is repeated under each condition
(:data:`CONDITIONS`): fitted and predicted log are both written anew and read without a column map,
so that what motion and torque reveal of their columns is part of what is measured. *Ratio* is the
error over that of `benchmarks.plain_fit` on the same rows, to which the columns are known.
"""

from __future__ import annotations

import re
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks import parser_of, show
from benchmarks.board import ABOVE_PLAIN, DATA, Parts, cut, fit_errors, import_all, row_name
from benchmarks.degradations import delayed_torque
from benchmarks.fetch import FETCHED
from benchmarks.joint_log import JointLog
from benchmarks.plain_fit import causally_low_passed
from benchmarks.published import Published, known
from hil.base.errors import HilError
from hil.identified.identified_arm import arm_from
from identification.errors import IdentificationError

Row = dict[str, Any]
"""Of the line of JSON: `data`, `split`, `condition`, and errors or why it was refused."""

TORQUE_BITS: Final = 16
TORQUE_NOISE: Final = 0.03  # of the scatter of each joint's torque
POSITION_NOISE: Final = 3e-5  # rad
DECIMALS: Final = 4
SECONDS: Final = 10.0
FILTER: Final = 5.0  # Hz, two poles
FILTERED_RATE: Final = 125.0  # Hz
SCALE_SCATTER: Final = 0.5  # of the logarithm of N·m per unit of a motor's current
_MASS: Final = re.compile(r"""(<mass[^>]*value\s*=\s*)["'][^"']*["']""")


def without_velocity(log: JointLog) -> JointLog:
    """Positions and torques alone."""
    return replace(log, velocity=None)


def without_masses(log: JointLog) -> JointLog:
    """A URDF whose bodies all have one kilogram."""
    urdf = _MASS.sub(r'\1"1"', log.robot.urdf)
    return replace(log, robot=replace(log.robot, urdf=urdf))


def quantised_torque(log: JointLog) -> JointLog:
    """Torques in steps of their range over 2 to the number of bits."""
    step = np.ptp(log.torque, axis=0) / 2**TORQUE_BITS
    step[step == 0.0] = 1.0
    return replace(log, torque=np.rint(log.torque / step) * step)


def noisy(log: JointLog) -> JointLog:
    """White noise in torque and position."""
    random = np.random.default_rng(0)
    torque = TORQUE_NOISE * log.torque.std(axis=0) * random.standard_normal(log.torque.shape)
    position = POSITION_NOISE * random.standard_normal(log.position.shape)
    return replace(log, torque=log.torque + torque, position=log.position + position)


def rounded(log: JointLog) -> JointLog:
    """A text of few decimals."""
    velocity = None if log.velocity is None else np.round(log.velocity, DECIMALS)
    position, torque = np.round(log.position, DECIMALS), np.round(log.torque, DECIMALS)
    return replace(log, position=position, velocity=velocity, torque=torque)


def currents(log: JointLog) -> JointLog:
    """Torques in the units of each motor's current, without the torque constants."""
    random = np.random.default_rng(1)
    scale = np.exp(SCALE_SCATTER * random.standard_normal(log.torque.shape[1]))
    return replace(log, torque=log.torque * scale)


def negated(log: JointLog) -> JointLog:
    """Torques that act on the arm's drives, not on the arm."""
    return replace(log, torque=-log.torque)


def filtered(log: JointLog) -> JointLog:
    """A controller's causal low-pass of the torque, at the rate of its interface."""
    rate = 1.0 / float(np.median(np.diff(log.time)))
    torque = causally_low_passed(log.time, log.torque, min(FILTER, 0.4 * rate))
    return slower(FILTERED_RATE)(replace(log, torque=torque))


def short(log: JointLog) -> JointLog:
    """The beginning of a log."""
    return log.rows(log.time < log.time[0] + SECONDS)


def slower(rate: float) -> Callable[[JointLog], JointLog]:
    """Return what keeps one row in several, at about a rate [Hz]."""

    def thinned(log: JointLog) -> JointLog:
        step = float(np.median(np.diff(log.time)))
        return log.rows(slice(None, None, max(1, round(1.0 / (rate * step)))))

    return thinned


CONDITIONS: Final[dict[str, Callable[[JointLog], JointLog]]] = {
    "as recorded": lambda log: log,
    "without velocity": without_velocity,
    "without masses": without_masses,
    "100 Hz": slower(100.0),
    "50 Hz": slower(50.0),
    "16 bits of torque": quantised_torque,
    "noise": noisy,
    "late torque": delayed_torque,
    "four decimals": rounded,
    "currents": currents,
    "negated torque": negated,
    "filtered torque": filtered,
    "10 s": short,
    "100 Hz without velocity": lambda log: without_velocity(slower(100.0)(log)),
}
"""What becomes of both logs, by name."""


def written(log: JointLog, path: Path) -> Path:
    """Write a log as arrays with names that say what they are."""
    velocity = {} if log.velocity is None else {"velocity": log.velocity}
    arrays = {"time": log.time, "position": log.position, "torque": log.torque, **velocity}
    np.savez(path, allow_pickle=False, **arrays)
    return path


def errors_of(parts: Parts, folder: Path) -> Row:
    """Errors of hil and of the ordinary fit, or the refusal; seconds of the processor."""
    fitted = written(parts.fitted, folder / "fitted.npz")
    predicted = written(parts.predicted, folder / "predicted.npz")
    start = time.process_time()
    try:
        arm = arm_from([fitted], None, parts.fitted.robot, [predicted], None, None, None)
    except (HilError, IdentificationError) as refusal:
        return {"refused": str(refusal)}
    seconds = time.process_time() - start
    error = arm.results.validation[0].all_rows_relative_error
    plain, _ = fit_errors(parts)
    return {"hil": error, "plain": plain, "ratio": error / plain, "seconds": seconds}


def rows_of(name: str, data: Path, conditions: Sequence[str]) -> Iterator[Row]:
    """Every held-out split of a robot under each condition."""
    published = Published.named(name)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        archives = import_all(published, data / (published.folder or name), folder)
        logs = {log: JointLog.read(path, published.rated_payload) for log, path in archives.items()}
        for split in published.splits:
            for condition in () if split.in_sample else conditions:
                changed = {log: CONDITIONS[condition](values) for log, values in logs.items()}
                row = {"data": name, "split": str(split), "condition": condition}
                yield row | errors_of(cut(split, changed), folder)


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Figures over all rows."""
    ratios = np.array([row["ratio"] for row in rows if "ratio" in row])
    above = [row for row in rows if row.get("ratio", 0.0) > ABOVE_PLAIN]
    return {
        "rows": list(rows),
        "mean_ratio": float(np.exp(np.log(ratios).mean())),
        "worst_ratio": float(ratios.max()),
        "above_plain": [f"{row_name(row)}, {row['condition']}" for row in above],
        "refused": [f"{row_name(row)}, {row['condition']}" for row in rows if "refused" in row],
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a line per row, then the line of JSON."""
    parser = parser_of(__doc__)
    parser.add_argument("--data", type=Path, help="folder of recordings")
    parser.add_argument("--only", action="append", choices=known(), help="may be repeated")
    parser.add_argument("--condition", action="append", choices=[*CONDITIONS])
    options = parser.parse_args(arguments)
    data = options.data or (DATA if DATA.is_dir() else FETCHED)
    rows = []
    for name in options.only or known():
        for row in rows_of(name, data, options.condition or [*CONDITIONS]):
            rows.append(row)
            if not options.json:
                print("  ".join(_words(row)), flush=True)
    show(summary(rows), only_json=True)


def _words(row: Row) -> Iterator[str]:
    """Yield the columns of a printed line."""
    yield f"{row['data']:11} {row['split']:30} {row['condition']:18}"
    if "refused" in row:
        yield f"refused: {row['refused']}"
        return
    yield f"hil {row['hil']:.2%}  plain {row['plain']:.2%}  ratio {row['ratio']:.2f}"


if __name__ == "__main__":
    main()
