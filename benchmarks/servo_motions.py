"""Errors of whole motions of an arm without torque, simulated from their commands alone.

Run with ``python -m benchmarks.servo_motions FOLDER [--compare FILE.xml ...] [--only NAME]``, where
FOLDER has the results of `hil identify` and its archives. The table has a row for each motion,
fitted ones as well, from the first sample to the last: root mean square over samples and joints
[mrad or mm] of the command itself, of the identified servo, of that with MuJoCo's terms alone, and
of the parameters that MJCF files state.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil.pipeline.sources import gather_sources
from hil.results.provenance import RESULTS
from hil.results.servo_result import ServoResults, ServoValue
from hil.servo.identification import bodies_of
from hil.servo.maker_file import maker_parameters
from identification.servo.parameters import PLACE
from identification.servo.prediction import predicted
from identification.servo.recorded_motion import Grid, motions_of

Array = NDArray[np.float64]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--compare", type=Path, nargs="*", default=[])
    parser.add_argument("--only", default="")
    options = parser.parse_args()
    results = ServoResults.load(options.folder / RESULTS)
    archives = sorted(options.folder.glob("*.mcap"))
    sources = gather_sources(archives, results.split, in_sample=True, with_torque=False)
    cell = sources.cell
    bodies = bodies_of(cell, options.folder)
    grid = Grid.of(sources.training[0].recording)
    names = cell.joint_names
    sets = [_values(results.servo, names), _values(results.simulators["mujoco"].servo, names)]
    sets += [maker_parameters(path, names) for path in options.compare]
    titles = ["command", "identified", "MuJoCo's terms", *(path.name for path in options.compare)]
    print("  ".join([f"{'motion':24}", *(f"{title:>16}" for title in titles)]))
    for source in sources.training:
        if options.only not in source.name:
            continue
        for motion in motions_of(source.recording, cell.model, bodies, grid):
            simulated = predicted(cell.model, bodies, motion, sets)
            errors = [motion.command - motion.position, *(simulated - motion.position)]
            figures = [1e3 * float(np.sqrt(np.mean(error**2))) for error in errors]
            fitted = " (fitted)" if source.name in results.archives else ""
            row = [f"{source.path.stem + fitted:24}", *(f"{figure:16.3g}" for figure in figures)]
            print("  ".join(row), flush=True)


def _values(servo: Sequence[ServoValue], names: Sequence[str]) -> Array:
    """Return the parameters (n, P) in SI units."""
    values = np.zeros((len(names), len(PLACE)))
    for each in servo:
        values[names.index(each.joint), PLACE[each.name]] = each.value
    return values


if __name__ == "__main__":
    main()
