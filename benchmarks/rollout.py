"""Time of a rollout: 1 000 windows of a second, of 50 arms of six axes.

    python -m benchmarks.rollout
    python -m benchmarks.rollout --arms [--data DIR] [--only NAME]
    python -m benchmarks.rollout --sysid [--iterations N] [--data DIR] [--only NAME]

The arm is the nominal NS 16 (simulated), its torque along sines is exact. Prints time and processor
time; wanted are 30 s on two idle cores.

With `--arms` held-out motions of the real arms of the board are simulated instead. Prints position
errors at 0.5 s and their ratio to those of the nominal arm (at most 0.5 is wanted, where the URDF
has masses), and the share of measured positions in the 95 % band at 0.2 s (88 to 99 % is wanted);
and what misses that.

With `--sysid` an arm by `hil identify`, and the same polished on windows of one second which cover
the fitted recording, are compared with one that the minimiser of `mujoco.sysid`
(`benchmarks.sysid_rival`) fits to these windows. All are then simulated in the same held-out
windows, under the recorded torque and a feedback of 1 Hz. Prints errors, processor time from the
recording on, and the errors of rotors that are too heavy by `MORE_ROTOR` and of positions that
continue at the start velocity; wanted are no larger error and a tenth of the time. The recording is
that of a simulated NS 16, or those of `--only`. It needs what `mujoco.sysid` imports:
`pip install 'mujoco[sysid]'`.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks import parser_of
from benchmarks.board import DATA, import_all, simulated_logs
from benchmarks.published import Published, known
from hil.base.progress import Silent
from hil.cell import Cell
from hil.pipeline.identified_model import IdentifiedModel, model_of
from hil.pipeline.identify_folder import identify_paths
from hil.results.rollout_result import JUDGED_HORIZON, RolloutResult
from hil.rollout.torque_rollout import RolloutOptions, nominal_arm, roll_out
from identification import Samples
from identification.export.exported_arm import ExportedArm
from identification.model.joint_ranges import JointRanges
from identification.model.motion import Motion
from identification.rollout.polish import Driven, polished
from identification.rollout.position_errors import (
    HORIZONS,
    RecordedMotion,
    continued,
    errors_of,
    horizon_rows,
    light_feedback,
    recorded_stretches,
    simulate,
)
from identification.rollout.windows import STEP_SECONDS, windows_of
from sim_fixtures.ns16 import CELL_PATH

Array = NDArray[np.float64]

WINDOWS = 1000
ARMS = 50
MORE_ROTOR = 0.1  # kg·m²
LARGEST_RATIO = 0.5
"""Error of the identified arm over that of the nominal one at 0.5 s."""


def recorded(arm: ExportedArm) -> RecordedMotion:
    """Return windows of the arm's exact torque along sines."""
    model = arm.model
    random = np.random.default_rng(1)
    stride = 0.1
    duration = 1.2 + stride * (WINDOWS - 1)
    grid = np.arange(0.0, duration, 0.002)
    rate = random.uniform(1.0, 4.0, model.n_joints)
    phase = random.uniform(0.0, 6.0, model.n_joints)
    angle = rate * grid[:, None] + phase
    motion = Motion(
        grid, 0.3 * np.sin(angle), 0.3 * rate * np.cos(angle), -0.3 * rate**2 * np.sin(angle)
    )
    torque = model.torque(arm.values, motion)
    everything = np.ones(torque.shape, dtype=np.bool_)
    bandwidth = np.full(model.n_joints, np.inf)
    samples = Samples(motion, torque, everything, (slice(0, len(grid)),), 0.0, bandwidth)
    stretches, owners = recorded_stretches(model, [(samples, None)], STEP_SECONDS)
    return RecordedMotion(
        windows_of(stretches, STEP_SECONDS, 1.0, stride).some(WINDOWS), tuple(owners)
    )


def time_of_windows() -> None:
    """Print the time of the windows."""
    cell = Cell.load(CELL_PATH)
    model = cell.model
    infinite = np.full(len(cell.joint_names), np.inf)
    standard = model.nominal
    standard[model.layout.rotors] = cell.nominal.rotor_inertia
    ranges = JointRanges(-infinite, infinite, infinite, infinite)
    arm = ExportedArm(cell.urdf, model, standard, cell.nominal_values(), ranges)
    motion = recorded(arm)
    feedback = light_feedback(arm, STEP_SECONDS, 1.0)
    begin = time.perf_counter()
    processor = time.process_time()
    for _ in range(ARMS):
        simulate(arm, motion, feedback)
    wall = time.perf_counter() - begin
    cpu = time.process_time() - processor
    print(
        f"{len(motion.windows)} windows of 1 s x {ARMS} arms of {model.n_joints} axes:"
        f" {wall:.1f} s, {cpu:.1f} s of processor time"
    )


def compare_with_sysid(names: Sequence[str], data: Path, iterations: int) -> None:
    """Print errors and processor times of `hil identify` and of `mujoco.sysid`."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        if not names:
            archives = {
                n: log.imported(folder / f"{n}.mcap") for n, log in simulated_logs()[1].items()
            }
            _print_comparison("NS 16 (simulated)", [*archives.values()], iterations)
        for name in names:
            published = Published.named(name)
            archives = import_all(published, data / (published.folder or name), folder)
            split = published.splits[0]
            predict = [archives[split.predicted]] if split.predicted else []
            _print_comparison(f"{name}, {split}", [archives[split.fitted], *predict], iterations)


def _print_comparison(name: str, archives: Sequence[Path], iterations: int) -> None:
    """Print the comparison for a recording that is fitted, and those that are predicted."""
    from benchmarks.sysid_rival import fit_by_sysid, positions_of

    begin = time.process_time()
    model = model_of(identify_paths(archives[:1], Silent(), predict=archives[1:]))
    seconds = time.process_time() - begin
    arm = model.arm
    nominal = nominal_arm(model.cell, arm)
    if nominal is None:
        raise SystemExit(f"{name}: the URDF has no masses to start from")
    feedback = light_feedback(arm, STEP_SECONDS, 1.0)
    fitted = _windows_of(model, model.prepared.fitted, HORIZONS[-1])
    held_out = _windows_of(model, model.prepared.held_out, 0.1)
    begin = time.process_time()
    polished_arm = polished(Driven(arm, fitted, feedback))
    polished_seconds = seconds + time.process_time() - begin
    begin = time.process_time()
    rival = fit_by_sysid(nominal, fitted, feedback, iterations)
    rival_seconds = time.process_time() - begin
    print(
        f"{name}: {len(fitted.windows)} fitted and {len(held_out.windows)} held-out windows;"
        f" mujoco.sysid: {rival.parameters} parameters, at most {iterations} iterations,"
        f" all windows simulated {rival.simulations} times"
    )
    rows = {
        "hil identify": (simulate(arm, held_out, feedback), seconds),
        f"rotors + {MORE_ROTOR:g} kg·m²": (
            simulate(_with_heavier_rotors(arm), held_out, feedback),
            None,
        ),
        "the same, polished": (polished_arm.on(held_out).positions(), polished_seconds),
        "mujoco.sysid": (positions_of(rival, nominal, held_out, feedback), rival_seconds),
        "nominal": (simulate(nominal, held_out, feedback), None),
        "start velocity": (continued(held_out.windows), None),
    }
    print(f"{'position error (rms) [mrad]':30}" + "".join(f"{f'{h:g} s':>10}" for h in HORIZONS))
    measured = held_out.windows.reached[:, horizon_rows(held_out.windows)]
    for label, (positions, spent) in rows.items():
        joints = errors_of(positions, measured, arm.model.chain).joints
        overall = 1e3 * np.sqrt(np.mean(joints**2, axis=1))
        figures = "".join(f"{error:10.3g}" for error in overall)
        print(
            f"{label:30}{figures}" + ("" if spent is None else f"   in {spent:.1f} s"), flush=True
        )


def _with_heavier_rotors(arm: ExportedArm) -> ExportedArm:
    """Return an arm whose rotors are heavier than the identified ones by `MORE_ROTOR`."""
    model = arm.model
    standard = arm.standard.copy()
    standard[model.layout.rotors] += MORE_ROTOR
    values = arm.values.copy()
    values[: model.base.rank] = model.base.grouping @ standard
    return replace(arm, standard=standard, values=values)


def _windows_of(
    model: IdentifiedModel, samples: Sequence[Samples], stride: float
) -> RecordedMotion:
    """Return windows of one second of samples, which start every `stride` seconds."""
    stretches, owners = recorded_stretches(
        model.arm.model, [(recording, None) for recording in samples], STEP_SECONDS
    )
    return RecordedMotion(windows_of(stretches, STEP_SECONDS, HORIZONS[-1], stride), tuple(owners))


def arms(names: Sequence[str], data: Path) -> None:
    """Print errors and bands of real arms, and what misses the bounds."""
    missed = []
    for name in names:
        published = Published.named(name)
        with tempfile.TemporaryDirectory() as scratch:
            archives = import_all(published, data / (published.folder or name), Path(scratch))
            for split in published.splits:
                if split.in_sample or split.part == "last":
                    continue
                predict = [archives[split.predicted]] if split.predicted else []
                identification = identify_paths([archives[split.fitted]], Silent(), predict=predict)
                result = roll_out(model_of(identification), RolloutOptions(), Silent()).result
                missed += _print_arm(f"{name}, {split}", result)
    print(f"missed: {len(missed)}" + "".join(f"\n  {line}" for line in missed))


def _print_arm(name: str, result: RolloutResult) -> list[str]:
    """Print a row, and return the bounds that it misses."""
    missed = []
    ratio = None if result.ratio is None else result.ratio[JUDGED_HORIZON]
    at = result.horizons[JUDGED_HORIZON]
    print(
        f"{name:40} {result.windows:4} windows, {result.identified.unstable:3} unstable;"
        f" error at {at:g} s {1e3 * result.identified.overall(JUDGED_HORIZON):.3g} mrad,"
        f" {'no nominal' if ratio is None else f'{ratio:.3f} of nominal'};"
        f" in the band {result.band:.1%}",
        flush=True,
    )
    if ratio is not None and ratio > LARGEST_RATIO:
        missed.append(f"{name}: {ratio:.2f} of the nominal error at {at:g} s")
    if not result.band_holds:
        missed.append(f"{name}: {result.band_message}")
    return missed


def main(arguments: Sequence[str] | None = None) -> None:
    """Print times, errors of real arms, or a comparison with `mujoco.sysid`."""
    parser = parser_of(__doc__)
    parser.add_argument("--arms", action="store_true", help="real arms in place of the time")
    parser.add_argument("--sysid", action="store_true", help="compare with mujoco.sysid")
    parser.add_argument("--iterations", type=int, default=30, help="of mujoco.sysid, at most")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of recordings")
    parser.add_argument("--only", action="append", choices=known(), help="may be repeated")
    options = parser.parse_args(arguments)
    if options.sysid:
        compare_with_sysid(options.only or (), options.data, options.iterations)
    elif options.arms:
        arms(options.only or known(), options.data)
    else:
        time_of_windows()


if __name__ == "__main__":
    main()
