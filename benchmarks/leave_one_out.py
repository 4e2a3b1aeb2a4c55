"""What the defaults of the automatic settings are worth on a robot that they were not chosen on.

Run with ``python -m benchmarks.leave_one_out [--data FOLDER] [--only NAME ...]
[--defaults NAME ...] [--json]``, with FOLDER as in `benchmarks.board`.

Each default of `identification.selection`, and the offset of the prior, is
varied alone. For each robot, the value with the least geometric mean of held-out errors over all
*other* robots is applied to this one: on the first held-out split, all rows, as a ratio to the
error of `benchmarks.plain_fit`. If a default were fitted to these recordings, the mean of the
ratios with a robot left out would be larger than that of the present values.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, Final
from unittest.mock import patch

import numpy as np

from benchmarks import parser_of, show
from benchmarks.board import DATA, cut, fit_errors, identified_parts, split_logs
from benchmarks.published import known
from identification.estimators import prior
from identification.selection import folds, questions, scores

ALTERNATIVES: Final[Mapping[str, tuple[Any, ...]]] = {
    "MIN_IMPROVEMENT": (0.0, 0.03),
    "MIN_TERM_IMPROVEMENT": (0.0, 0.05),
    "MIN_REVERSAL_IMPROVEMENT": (0.02, 0.10),
    "EXCLUDED_ROWS": (("halts", "rests", "slow"),),
    "BANDWIDTHS": (
        (14.0, 10.0, 20.0, 7.0, 40.0),
        (10.0, 14.0, 7.0, 20.0, 5.0, 3.5, 40.0),
        (20.0, 14.0, 40.0, 10.0, 7.0, 5.0, 3.5),
    ),
    "VELOCITIES": (("position", "measured"),),
    "PRESLIDING_DISTANCES": (
        (1e-5, 3e-5, 1e-6, 1e-4, 3e-4, 1e-3),
        (1e-4, 3e-5, 3e-4, 1e-5, 1e-3, 1e-6),
        (3e-4, 1e-4, 1e-3, 3e-5, 1e-5, 1e-6),
    ),
    "PRIOR_WEIGHTS": ((1.0,), (1.0, 4.0), (1.0, 4.0, 16.0), (4.0, 16.0, 64.0, 1e4)),
    "FOLDS": (3, 8),
    "MIN_CERTAINTY": (1.0, 2.0),
    "TRANSFER_STD": (0.0, 0.02, 0.1),
    "MIN_ROTORS_IMPROVEMENT": (0.0, 0.1, 0.2),
    "MIN_IMPOSSIBLE_IMPROVEMENT": (0.02, 0.05, 0.1),
    "OFFSET_STD_SHARE": (0.2, 0.3, 0.5, 1.0),
}
"""Other values of each default; of a sequence, the first is the one that others have to beat."""
PRESENT: Final = "present values"
_MODULES: Final = (folds, scores, questions, prior)


def ratios(name: str, data: Path, defaults: Sequence[str]) -> dict[tuple[str, str], float]:
    """Return the error relative to the ordinary fit on one robot, by default and its value."""
    split, logs = split_logs(name, data)
    parts = cut(split, logs)
    fit, _ = fit_errors(parts)
    errors = {}
    with tempfile.TemporaryDirectory() as scratch:
        errors[PRESENT, ""] = identified_parts(parts, Path(scratch)).error / fit
        for default in defaults:
            for value in ALTERNATIVES[default]:
                with default_of(default, value):
                    error = identified_parts(parts, Path(scratch)).error
                errors[default, str(value)] = error / fit
                print(f"{name}: {default} = {value}: {error / fit:.3f}", flush=True)
    return errors


def modules_of(default: str) -> list[ModuleType]:
    """Return the modules that have a default."""
    return [module for module in _MODULES if hasattr(module, default)]


@contextmanager
def default_of(name: str, value: Any) -> Iterator[None]:
    """Give a default another value, in each module that has it."""
    with ExitStack() as stack:
        for module in modules_of(name):
            stack.enter_context(patch.object(module, name, value))
        yield


def chosen_without(robots: Mapping[str, Mapping[tuple[str, str], float]], default: str) -> Any:
    """The value of a default that is best on the others, and the ratio with it, by robot."""
    keys = [(PRESENT, ""), *((default, str(value)) for value in ALTERNATIVES[default])]
    choices = {}
    for name, robot_ratios in robots.items():
        others = [ratio for other, ratio in robots.items() if other != name]
        best = min(
            keys, key=lambda key: np.mean([np.log(other_ratios[key]) for other_ratios in others])
        )
        choices[name] = {"value": best[1] or "present", "ratio": robot_ratios[best]}
    return choices


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table, and the line of JSON if asked for."""
    parser = parser_of(__doc__)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--only", nargs="+", default=known(), help="some of the recordings")
    parser.add_argument(
        "--defaults", nargs="+", default=[*ALTERNATIVES], choices=[*ALTERNATIVES], help="some"
    )
    options = parser.parse_args(arguments)
    if len(set(options.only)) < 2:
        parser.error("--only needs at least two recordings: each is judged by all others")
    robots = {name: ratios(name, options.data, options.defaults) for name in options.only}
    mean = {PRESENT: _geometric([robot_ratios[PRESENT, ""] for robot_ratios in robots.values()])}
    table = {default: chosen_without(robots, default) for default in options.defaults}
    for default, by_robot in table.items():
        mean[default] = _geometric([choice["ratio"] for choice in by_robot.values()])
    show({"mean_ratio": mean, "chosen": table}, only_json=options.json)


def _geometric(values: list[float]) -> float:
    return float(np.exp(np.log(values).mean()))


if __name__ == "__main__":
    main()
