"""Time of an identification, from samples to parameters with covariance, against figaroh's.

Run with ``python -m benchmarks.identification [--json] [--figaroh PYTHON] [--only PART ...]``:
16 000 samples of the NS 16, 6 joints. Processor time of one thread; repetitions alternate between
all that is compared, and medians are printed, with smallest and largest.

- ``fit_ms``: regressor, block factor, weighted least squares (eq. 4) and cluster-robust covariance
  of 58 parameters: 40 base, and viscous, Coulomb and offset friction. ``large_fit_ms``: the same
  with the largest model there is, ``large_parameters``: every friction term, inertia and friction
  of a coupled wrist.
- ``prepared_fit_ms``: the fit and what is before it: positions smoothed by the spline whose
  tolerance is the noise's variance, masks, derivatives.
- ``ratio_to_figaroh``: figaroh 1.0.2 on the same samples with the same 58 parameters, by the
  faster of its two methods of finding base parameters, over ``fit_ms``: regressor, pivoted
  QR, weighted least squares, relative standard deviations (``figaroh_pivoting_ms``). That of its
  `BaseIdentification.solve` is ``figaroh_double_ms``; with base columns known beforehand, as ours
  are once a model has been built, ``figaroh_known_ms``. Its covariance is the classical one.
  ``torque_difference``: the two fits' predicted torque, as a share of its RMS.
- ``base_ms``: a model from URDF text, that is chain, base parameters and regressor plan.
- ``consistent_ms``: the physically consistent estimate on the factor of the fit.
- ``whole_1000_hz_s``, ``whole_250_hz_s``: all of `hil identify` of 30 s of six axes, report
  included, in a fresh process; ``..._plain_s``: `benchmarks.plain_fit` on the same log, likewise;
  ``..._ratio_to_plain``: the first over the second.
- ``log_look_s``, ``log_identify_s``, ``log_identify_halves_s``: `hil look` and `hil identify` of
  30 s of seven axes at 1 kHz in columns of text, with a URDF, whole and as two logs, likewise;
  ``log_help_s``, ``log_help_of_look_s``: `hil --help`, `hil look --help`. ``..._units``: these over
  ``log_unit``, the slowness of the machine by `benchmarks.whole_run`.
- ``memory_1_min_mb`` and so on: largest memory of `hil identify` of as many minutes of six axes at
  1 kHz, in a fresh process, and its processor time.

figaroh is no dependency of this project. ``--install-figaroh`` puts it into an environment of its
own, `build/figaroh`, which is used where it is there; another interpreter that has it can be named.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import subprocess
import sys
import tempfile
import venv
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Final, NamedTuple

import numpy as np

from benchmarks import parser_of, show, timed, whole_run
from benchmarks.arms import ARMS, urdf
from benchmarks.regressor import SAMPLES, sine_motion
from identification import Motion, RobotModel
from identification.estimators.consistent import consistent_estimate
from identification.estimators.covariance import with_block_covariance
from identification.factor.estimate import Estimate, estimate, joint_weights
from identification.factor.factor import Factor
from identification.model.coupling import Coupling
from identification.model.friction import FrictionLaw
from identification.signals.recording import Recording
from identification.signals.samples import Samples, prepare
from planner.arrays import Array
from sim_fixtures.ns16 import URDF_PATH

ROOT: Final = Path(__file__).resolve().parents[1]
ENVIRONMENT: Final = ROOT / "build" / "figaroh"
RIVAL: Final = Path(__file__).with_name("figaroh_rival.py")
RIVAL_VERSION: Final = "1.0.2"
ROUTES: Final = ("known", "pivoting", "double")
SAME_PARAMETERS: Final = FrictionLaw(third=None, offset=True)
ALL_FRICTION: Final = FrictionLaw(offset=True, stribeck=0.1, asymmetric=True)
"""Every term there is."""
WRIST: Final = Coupling(
    np.array([
        [1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, 1.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 1.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 0.0, 1.0, 0.0, 0.0],
        [0.0, 0.0, 0.0, 0.1, 1.0, 0.0],
        [0.0, 0.0, 0.0, -0.1, 0.1, 1.0],
    ])
)  # fmt: skip
"""Joint 4 turns motors 5 and 6 along, joint 5 motor 6."""
PARTS: Final = ("fits", "models", "whole", "log", "memory")
_POSITION_NOISE: Final = 1e-6  # rad
_TORQUE_NOISE: Final = 1.0  # N·m


class Case(NamedTuple):
    """What is fitted.

    Attributes:
        model: the robot.
        samples: its motion and torque; every row counts.
        recording: the same, its positions with noise.
    """

    model: RobotModel
    samples: Samples
    recording: Recording


class Rival(AbstractContextManager["Rival"]):
    """figaroh in an interpreter of its own, which waits while ours is timed."""

    def __init__(self, python: Path, samples: Samples) -> None:
        self._scratch = tempfile.TemporaryDirectory()
        folder = Path(self._scratch.name)
        self._result = folder / "result.npz"
        motion = samples.motion
        np.savez(
            folder / "samples.npz",
            position=motion.position,
            velocity=motion.velocity,
            acceleration=motion.acceleration,
            torque=samples.torque,
        )
        files = [RIVAL, URDF_PATH, folder / "samples.npz", self._result]
        environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
        # -P: the folder of the script is full of modules of other names' sakes.
        self._process = subprocess.Popen(
            [str(python), "-P", *map(str, files)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
        )

    def run(self, route: str) -> float:
        """Processor time [s] that one run of a route took."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            self._process.stdin.write(f"{route}\n")
            self._process.stdin.flush()
            return float(json.loads(self._process.stdout.readline()))
        except (BrokenPipeError, ValueError):
            raise SystemExit("figaroh's interpreter ended; its reason is above") from None

    def torque(self) -> Array:
        """Torque that its last fit predicts, joint by joint; ends it."""
        self._process.communicate()
        with np.load(self._result) as file:
            return np.asarray(file["pivoting"])

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None and not pipe.closed:
                pipe.close()
        self._scratch.cleanup()


def case(friction: FrictionLaw, coupling: Coupling | None = None) -> Case:
    """The NS 16 with this friction and wrist, and the samples of a motion of 16 s."""
    text = URDF_PATH.read_text(encoding="utf-8")
    model = RobotModel.from_urdf(text, friction=friction, coupling=coupling)
    motion = sine_motion(model.n_joints)
    random = np.random.default_rng(1)
    values = np.concatenate([model.base.grouping @ model.nominal, random.uniform(
        1.0, 10.0, model.n_parameters - model.base.rank
    )])  # fmt: skip
    torque = model.torque(values, motion)
    torque += _TORQUE_NOISE * random.standard_normal(torque.shape)
    samples = Samples(
        motion=motion,
        torque=torque,
        usable=np.ones(torque.shape, dtype=np.bool_),
        segments=(slice(0, SAMPLES),),
        origin=0.0,
        position_bandwidth=np.full(model.n_joints, np.inf),
    )
    noisy = motion.position + _POSITION_NOISE * random.standard_normal(torque.shape)
    recording = Recording(motion.time, noisy, model.joint_names, torque=torque)
    return Case(model, samples, recording)


def fit(model: RobotModel, samples: Samples) -> Estimate:
    """Weighted least squares with cluster-robust covariance, as `hil identify` does it."""
    factor = Factor.by_time(model, samples)
    weights = joint_weights(factor)
    return with_block_covariance(estimate(model, factor, weights), factor, weights)


def prepared_fit(arm_case: Case) -> Estimate:
    """Smooth, mask, and fit."""
    variance = np.full(arm_case.model.n_joints, _POSITION_NOISE**2)
    return fit(arm_case.model, prepare(arm_case.recording, arm_case.model, noise_variance=variance))


def measured(tasks: dict[str, Callable[[], float]], repetitions: int) -> dict[str, Array]:
    """Times [s] of each task (repetitions,), all of them taking turns; the first is not counted."""
    rows = [[task() for task in tasks.values()] for _ in range(repetitions + 1)]
    return dict(zip(tasks, np.array(rows[1:]).T, strict=True))


def time_fits(python: Path | None, repetitions: int) -> dict[str, float | int | None]:
    """Time the fits, ours and figaroh's in turns."""
    same = case(SAME_PARAMETERS)
    large = case(ALL_FRICTION, WRIST)
    tasks: dict[str, Callable[[], float]] = {
        "fit": partial(timed, partial(fit, same.model, same.samples)),
        "large_fit": partial(timed, partial(fit, large.model, large.samples)),
        "prepared_fit": partial(timed, partial(prepared_fit, same)),
    }
    with nullcontext() if python is None else Rival(python, same.samples) as rival:
        if rival is not None:
            tasks |= {f"figaroh_{route}": partial(rival.run, route) for route in ROUTES}
        times = measured(tasks, repetitions)
        difference = None if rival is None else _difference(same, rival.torque())
    result: dict[str, float | int | None] = {}
    for name, values in times.items():
        result |= _spread(name, values)
    result["ratio_to_figaroh"] = None
    for route in ROUTES if python is not None else ():
        ratio = round(float(np.median(times[f"figaroh_{route}"]) / np.median(times["fit"])), 2)
        result["ratio_to_figaroh" if route == "pivoting" else f"ratio_to_figaroh_{route}"] = ratio
    result["torque_difference"] = difference
    result["parameters"] = same.model.n_parameters
    result["large_parameters"] = large.model.n_parameters
    return result


def time_models(repetitions: int) -> dict[str, float | int]:
    """Time what is done once per arm, and the physically consistent estimate."""
    texts = {name: urdf(where).read_text(encoding="utf-8") for name, where in ARMS.items()}
    arm_case = case(SAME_PARAMETERS)
    factor = Factor.from_samples(arm_case.model, arm_case.samples.motion, arm_case.samples.torque)
    free = estimate(arm_case.model, factor)
    tasks: dict[str, Callable[[], float]] = {
        f"base_{name}": partial(timed, partial(RobotModel.from_urdf, text))
        for name, text in texts.items()
    }
    tasks["consistent"] = partial(timed, partial(consistent_estimate, arm_case.model, factor, free))
    result: dict[str, float | int] = {}
    for name, values in measured(tasks, repetitions).items():
        result |= _spread(name, values)
    for name, text in texts.items():
        result[f"base_{name}_rank"] = RobotModel.from_urdf(text).base.rank
    return result


def installed(python: Path | None, *, install: bool) -> Path | None:
    """The interpreter that has figaroh: the one named, or that of an environment of its own."""
    interpreter = ENVIRONMENT / "bin" / "python"
    if install:
        venv.create(ENVIRONMENT, with_pip=True)
        # The same numerical libraries on both sides.
        pins = [f"{name}=={importlib.metadata.version(name)}" for name in ("numpy", "scipy", "pin")]
        packages = [f"figaroh=={RIVAL_VERSION}", *pins]
        subprocess.run([str(interpreter), "-m", "pip", "install", "--quiet", *packages], check=True)
    if python is not None:
        return python
    return interpreter if interpreter.exists() else None


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, and print the figures."""
    parser = parser_of(__doc__)
    parser.add_argument("--repetitions", type=int, default=9)
    parser.add_argument("--figaroh", type=Path, metavar="PYTHON", help="interpreter that has it")
    parser.add_argument("--install-figaroh", action="store_true", help="into build/figaroh")
    parser.add_argument(
        "--only", nargs="+", choices=PARTS, default=PARTS, metavar="PART", help=", ".join(PARTS)
    )
    options = parser.parse_args(arguments)

    python = installed(options.figaroh, install=options.install_figaroh)
    result: dict[str, Any] = {}
    if "fits" in options.only:
        if python is None:
            print("figaroh is not installed; add --install-figaroh to compare", file=sys.stderr)
        result |= time_fits(python, options.repetitions)
    if "models" in options.only:
        result |= time_models(options.repetitions)
    if "whole" in options.only:
        result |= whole_run.times()
    if "log" in options.only:
        result |= whole_run.raw_log()
    if "memory" in options.only:
        result |= whole_run.memory()
    result |= {
        "samples": SAMPLES,
        "repetitions": options.repetitions,
        "clock": "processor time, BLAS of one thread; medians",
    }
    show(result, only_json=options.json)


def _spread(name: str, seconds: Array) -> dict[str, float]:
    """Median, smallest and largest in ms."""
    return {
        f"{name}_ms": round(1e3 * float(np.median(seconds)), 2),
        f"{name}_least_ms": round(1e3 * float(seconds.min()), 2),
        f"{name}_most_ms": round(1e3 * float(seconds.max()), 2),
    }


def _difference(arm_case: Case, theirs: Array) -> float:
    """Largest difference of the predicted torques as a share of their RMS."""
    motion: Motion = arm_case.samples.motion
    ours = arm_case.model.torque(fit(arm_case.model, arm_case.samples).values, motion)
    apart = np.abs(ours.T.reshape(-1) - theirs).max()
    return float(apart / np.sqrt(np.mean(ours**2)))


if __name__ == "__main__":
    main()
