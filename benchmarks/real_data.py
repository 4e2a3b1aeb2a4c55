"""Torque error of identified models on real recordings, read by the package's own importers.

Run with ``python -m benchmarks.real_data --data DIR [--json]``, where DIR is a folder that is
named like a file of ``benchmarks/recordings`` (``ur10_unisa``, ``tx40``). Each friction law is
fitted

- to the whole recording: in-sample error;
- to its first 70 %: held-out error, of predicting the last 30 %. A temporal split of one motion,
  not a prediction of other motions.

Errors are ||tau - tau_hat|| / ||tau|| over all joints and over all rows of the part in question,
standing still and first and last rows included. `torque_bandwidth` is that of the low-pass the
torque has come through before it was logged, found on the fitted part alone; "plain" does without.
The headline figures are those of the full friction law, bandwidth included.
"""

# ruff: noqa: E402 - threads are pinned before numpy is imported, or BLAS does not see it

from __future__ import annotations

import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"

import argparse
import importlib.metadata
import json
import tempfile
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

from hil.importers import ColumnMap, Robot, import_csv, import_rosbag2
from hil.recordings import open_recording
from identification.estimation import estimate
from identification.friction import FrictionLaw
from identification.model import RobotModel
from identification.preprocessing import Preprocessing, prepare
from identification.recording import Recording
from identification.torque_channel import find_torque_bandwidth
from identification.validation import prediction_error

CONFIGURATIONS = Path(__file__).parent / "recordings"
FITTED_SHARE = 0.7
LAWS = {
    "linear_friction": FrictionLaw(third=None, offset=True),
    "quadratic_friction": FrictionLaw(third="quadratic", offset=True),
}


def _urdf(configuration: dict[str, Any], folder: Path) -> Path:
    """Return the URDF: beside the recording, or in an installed package."""
    package = configuration.get("urdf_package")
    if package is None:
        return folder / str(configuration["urdf"])
    for file in importlib.metadata.files(package) or ():
        if file.name == configuration["urdf"]:
            return Path(str(file.locate()))
    raise SystemExit(f"{configuration['urdf']} is not in the package {package}; is it installed?")


def _recording(configuration: dict[str, Any], folder: Path, urdf: Path) -> Recording:
    """Import into an archive and read that, as `hil import` and `hil identify` do."""
    robot = Robot.from_urdf(urdf)
    with tempfile.TemporaryDirectory() as scratch:
        archive = Path(scratch) / "imported.mcap"
        if "bag" in configuration:
            import_rosbag2(folder / configuration["bag"], archive, robot=robot)
        else:
            columns = ColumnMap.model_validate(configuration["map"])
            import_csv(folder / configuration["log"], archive, robot=robot, columns=columns)
        return open_recording(archive)


def _error(
    model: RobotModel, fitted: Recording, predicted: Recording, options: Preprocessing
) -> float:
    """Relative torque error over all joints and rows of one part, after a fit to another."""
    samples = prepare(fitted, model, options=options)
    values = estimate(model, samples.factor(model)).values
    target = prepare(predicted, model, options=options)
    (error,) = prediction_error(model, values, [target], all_rows=True)
    return error.overall


def _figures(model: RobotModel, recording: Recording, options: Preprocessing) -> dict[str, Any]:
    """Held-out and in-sample errors with and without the low-pass before the log."""
    cut = round(FITTED_SHARE * recording.n_samples)
    first = recording.between(0, cut)
    last = recording.between(cut, recording.n_samples)
    found = None if options.smooth_torque else find_torque_bandwidth(first, model)
    best = options if found is None else replace(options, torque_bandwidth=found)
    return {
        "held_out_relative_error": round(_error(model, first, last, best), 5),
        "in_sample_relative_error": round(_error(model, recording, recording, best), 5),
        "torque_bandwidth": None if found is None else round(found, 3),
        "plain_held_out_relative_error": round(_error(model, first, last, options), 5),
        "plain_in_sample_relative_error": round(_error(model, recording, recording, options), 5),
    }


def main() -> None:
    """Measure, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--data", type=Path, required=True, help="folder with the recording")
    parser.add_argument("--json", action="store_true", help="print the line of JSON only")
    arguments = parser.parse_args()
    folder = arguments.data.resolve()
    file = CONFIGURATIONS / f"{folder.name}.toml"
    if not file.is_file():
        known = ", ".join(sorted(path.stem for path in CONFIGURATIONS.glob("*.toml")))
        raise SystemExit(f"nothing is known about {folder.name}; known are {known}")
    configuration = tomllib.loads(file.read_text(encoding="utf-8"))
    bandwidth = configuration.get("smooth_bandwidth")
    options = Preprocessing(smooth_torque=bandwidth is not None, torque_bandwidth=bandwidth)
    urdf = _urdf(configuration, folder)
    recording = _recording(configuration, folder, urdf)

    figures: dict[str, Any] = {}
    for name, law in LAWS.items():
        model = RobotModel.from_urdf(urdf.read_text(encoding="utf-8"), friction=law)
        figures[name] = _figures(model, recording, options)
        if not arguments.json:
            print(f"{folder.name}, {name.replace('_', ' ')}:")
            for key, value in figures[name].items():
                shown = f"{value:.2%}" if key.endswith("error") else value
                print(f"  {key.replace('_', ' '):34} {shown}")
    headline = figures["quadratic_friction"]
    result = {
        "data": folder.name,
        "held_out_relative_error": headline["held_out_relative_error"],
        "in_sample_relative_error": headline["in_sample_relative_error"],
        **figures,
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
